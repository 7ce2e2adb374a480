# SPDX-License-Identifier: Apache-2.0
"""Base of the kinds that measure points of the platform from a frame: targets, tips and probes."""

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar, Self

import numpy as np

from loopcal import geometry
from loopcal.errors import DataError
from loopcal.measure.array_checks import check_array, check_pose
from loopcal.measure.kinds import setup_parameters as setup
from loopcal.measure.kinds.kind import Column, Evaluation, Kind, check_unknown
from loopcal.parameters import Parameter
from loopcal.typing import FloatArray
from loopcal.units import Dimension


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class TargetKind(Kind):
    """A kind that is a function of points p of the platform in a frame: `x = R_f' (R p + t - t_f)`.

    With h = R p + t - t_f: `dx = R_f' (v + omega x R p) + R_f' R dp - R_f' (v_f + omega_f x h)`.

    Parameters
    ----------
    targets : tuple of str
        Names of the k targets that one row measures. With several, columns are called `a.x` and so
        on.
    places : (k, 3) [m], optional
        Targets on the platform; default: the origin of the robot's tool. If the targets are
        unknown, these are their nominal values.
    T_base_frame : (4, 4), optional
        Frame of the instrument in the base; default: the base itself.
    unknown : tuple of str
        Which of `allowed_unknown` are unknown. One value holds for a session (of a surface: for a
        group of rows).
    frame : str
        Name of the frame. Kinds that use the same name share its parameters.

    Raises
    ------
    DataError
        If shapes do not fit, a name occurs twice, or `unknown` lists something that is not allowed.
    """

    targets: tuple[str, ...] = ("target",)
    places: FloatArray | None = None
    T_base_frame: FloatArray = field(default_factory=lambda: np.eye(4))
    unknown: tuple[str, ...] = ()
    frame: str = "frame"

    allowed_unknown: ClassVar[tuple[str, ...]] = ("frame", "targets")
    per_target: ClassVar[tuple[Column, ...]]
    wraps: ClassVar[bool] = False

    def __post_init__(self) -> None:
        targets = (self.targets,) if isinstance(self.targets, str) else tuple(self.targets)
        if not targets or len(set(targets)) < len(targets):
            raise DataError(
                f"the targets are {', '.join(targets) or 'empty'}; name at least one, and each once"
            )
        object.__setattr__(self, "targets", targets)
        if self.places is not None:
            places = check_array(
                np.atleast_2d(self.places), "the places of the targets", (len(targets), 3)
            )
            object.__setattr__(self, "places", places)
        object.__setattr__(self, "T_base_frame", check_pose(self.T_base_frame, "T_base_frame"))
        object.__setattr__(
            self, "unknown", check_unknown(self.unknown, self.allowed_unknown, self.name)
        )

    def with_tool(self, T_platform_tool: FloatArray) -> Self:
        """Return the kind with its targets at the tool's origin, unless it states their places."""
        if self.has_tool:
            return self
        return replace(
            self, places=np.repeat(T_platform_tool[None, :3, 3], len(self.targets), axis=0)
        )

    @property
    def has_tool(self) -> bool:
        """Whether places of the targets are stated; if they are unknown, their nominal values."""
        return self.places is not None

    @property
    def columns(self) -> tuple[Column, ...]:
        """The columns of each target, with its name in front where there are several."""
        if len(self.targets) == 1:
            return self.per_target
        return tuple(
            Column(f"{target}.{column.name}", column.dimension)
            for target in self.targets
            for column in self.per_target
        )

    @property
    def setup_items(self) -> Mapping[str, tuple[Parameter, ...]]:
        """Frame, targets and further items of the kind, if unknown."""
        places = np.zeros((len(self.targets), 3)) if self.places is None else self.places
        items: dict[str, tuple[Parameter, ...]] = {}
        for name in self.unknown:
            if name == "frame":
                items[name] = setup.make_frame_parameters(self.frame, self.T_base_frame)
            elif name == "targets":
                items[name] = tuple(
                    parameter
                    for target, place in zip(self.targets, places, strict=True)
                    for parameter in setup.make_point_parameters(target, place)
                )
            else:
                items[name] = self.make_item_parameters(name)
        return items

    @property
    def target_columns(self) -> Mapping[str, tuple[int, ...]]:
        """The targets with the indices of their columns."""
        g = len(self.per_target)
        return {target: tuple(range(i * g, (i + 1) * g)) for i, target in enumerate(self.targets)}

    def make_item_parameters(self, name: str) -> tuple[Parameter, ...]:
        """Return the parameters of a setup item that only this kind has."""
        raise NotImplementedError(name)

    @property
    def references(self) -> Mapping[str, FloatArray]:
        """The stated orientation of the frame."""
        return {self.frame: self.T_base_frame[:3, :3]} if "frame" in self.unknown else {}

    def locate_targets(self, T: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return targets x (.., k, 3) in the frame and their derivative (.., k, 3, 6 + u), at poses
        T (.., 4, 4).
        """
        frame_values = self.item_values(values, "frame")
        frame = setup.place_frame(self.T_base_frame, frame_values)
        R, Q = T[..., None, :3, :3], np.swapaxes(frame[..., None, :3, :3], -1, -2)
        arm = (R @ self.places_from(values)[..., None])[..., 0]
        lever = arm + T[..., None, :3, 3] - frame[..., None, :3, 3]
        identity = np.broadcast_to(np.eye(3), (*arm.shape, 3))
        blocks = {"twist": Q @ np.concatenate([-geometry.hat(arm), identity], axis=-1)}
        if frame_values is not None:
            blocks["frame"] = (
                Q
                @ np.concatenate([geometry.hat(lever), -identity], axis=-1)
                @ setup.linearize_frame(frame_values)[..., None, :, :]
            )
        if "targets" in self.unknown:
            k = len(self.targets)
            by_place = (Q @ R)[..., None, :] * np.eye(k)[:, None, :, None]
            blocks["targets"] = by_place.reshape(*by_place.shape[:-4], k, 3, 3 * k)
        return (Q @ lever[..., None])[..., 0], self.join_columns(blocks, lever.shape)

    def places_from(self, values: FloatArray) -> FloatArray:
        """Return the targets (.., k, 3) on the platform."""
        places = self.item_values(values, "targets")
        if places is not None:
            return places.reshape(*places.shape[:-1], len(self.targets), 3)
        return self.stated_places()

    def stated_places(self) -> FloatArray:
        """Return the stated places (k, 3); DataError where the kind has none."""
        if self.places is None:
            raise DataError(
                f"the kind {self.name!r} has no places of its targets: use "
                "kind.with_tool(robot.tool), or state `places`"
            )
        return self.places

    @abstractmethod
    def predict(
        self, x: FloatArray, values: FloatArray
    ) -> tuple[FloatArray, FloatArray, Mapping[str, FloatArray]]:
        """Return the columns of targets x (.., k, 3) in the frame, and their derivatives.

        Returns
        -------
        predicted : (.., k, g). by_x : (.., k, g, 3).
        by_item : setup item -> (.., k, g, w), for the items that only this kind has.
        """

    def _predict_columns(self, T: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return columns (.., m) and derivatives (.., m, 6 + u)."""
        x, rows = self.locate_targets(T, values)
        predicted, by_x, by_item = self.predict(x, values)
        rows = by_x @ rows
        if by_item:
            rows = rows + self.join_columns(by_item, predicted.shape)
        m = predicted.shape[-1] * predicted.shape[-2]
        return predicted.reshape(*predicted.shape[:-2], m), rows.reshape(
            *rows.shape[:-3], m, rows.shape[-1]
        )

    def _evaluate(
        self, T: FloatArray, measured: FloatArray, values: FloatArray, joints: FloatArray
    ) -> Evaluation:
        predicted, rows = self._predict_columns(T, values)
        residual = predicted - measured
        return self.split_columns(geometry.wrap_angle(residual) if self.wraps else residual, rows)

    def measure(
        self,
        T: FloatArray,
        noise: FloatArray,
        nuisance: FloatArray | None = None,
        joints: FloatArray | None = None,
    ) -> FloatArray:
        """Return columns (t, r, c) with noise added."""
        return self._predict_columns(T, self.values_or_nominal(nuisance))[0] + noise

    def make_offset_parameter(self) -> tuple[Parameter, ...]:
        """Return the parameter of an offset of all readings of a session."""
        return (Parameter(f"{self.name}.offset", Dimension.LENGTH, 0.0, scope="session"),)

    def collect_points(
        self, T: FloatArray, measured: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return every measured target as a row, at nominal nuisance parameters.

        Returns
        -------
        moving : (q, 3, 3 k), origin : (q, 3)
            `moving p + origin` is the point in the base, with p the places of all targets.
        points : (q, 3) in the base. columns : (q, g) that were measured.
        """
        k = len(self.targets)
        g = measured.shape[-1] // k
        moving = (T[:, None, :3, None, :3] * np.eye(k)[:, None, :, None]).reshape(-1, 3, 3 * k)
        origin = np.repeat(T[:, :3, 3], k, axis=0)
        columns = measured.reshape(-1, g)
        complete = ~np.any(np.isnan(columns), axis=-1)
        points = moving @ self.stated_places().ravel() + origin
        return moving[complete], origin[complete], points[complete], columns[complete]


def evaluate_offset(kind: Kind, values: FloatArray) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Return the offset (.., 1, 1) of all readings (zero where known) and its derivative."""
    offset = kind.item_values(values, "offset")
    if offset is None:
        return np.zeros((1, 1)), {}
    return offset[..., None, :], {"offset": np.ones((1, 1, 1))}


def measure_lengths(x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return lengths (.., 1) of vectors (.., 3) and unit vectors, zero where a length is 0."""
    square = np.sum(x * x, axis=-1, keepdims=True)
    safe = np.sqrt(np.where(square > 0.0, square, 1.0))
    return np.where(square > 0.0, safe, 0.0), x / safe


def find_nonpositive_rows(measured: FloatArray) -> tuple[tuple[int, str], ...]:
    """Return rows (index, end of a sentence) of distances (r, c) that are zero or negative."""
    wrong = np.argwhere(measured <= 0.0)
    sentence = (
        "has a distance of {:.6g} m; a distance is above 0: correct it, or leave the cell empty if "
        "nothing was measured"
    )
    return tuple((int(i), sentence.format(measured[i, j])) for i, j in wrong)
