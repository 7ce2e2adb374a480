# SPDX-License-Identifier: Apache-2.0
"""What kinds share that look at points of the platform from a frame: targets, tips and probes."""

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar, Self

import numpy as np

from loopcal import geometry
from loopcal.errors import DataError
from loopcal.measure.arrays import stored, stored_pose
from loopcal.measure.kinds import parts
from loopcal.measure.kinds.kind import Column, Evaluation, Kind, chosen
from loopcal.parameters import Parameter
from loopcal.typing import FloatArray
from loopcal.units import Dimension


@dataclass(frozen=True, eq=False, kw_only=True)
class TargetKind(Kind):
    """A kind that is a function of points p of the platform, seen from a frame at `x = R_f' (R p +
    t - t_f)`.

    With h = R p + t - t_f: `dx = R_f' (v + omega x R p) + R_f' R dp - R_f' (v_f + omega_f x h)`.

    Parameters
    ----------
    targets : tuple of str
        Names of the k targets that one row sees; with several, columns are called `a.x` and so on.
    places : (k, 3) [m], optional
        Targets on the platform; default: the origin of the robot's tool. Where unknown, the values
        they are counted from.
    T_base_frame : (4, 4), optional
        Frame of the instrument in the base; default: the base itself.
    unknown : tuple of str
        Which of `allowed_unknown` are unknown; each has one value for a session (surfaces: for a group of
        rows).
    frame : str
        Name of the frame; kinds that name the same one share its unknowns.

    Raises
    ------
    DataError
        If shapes do not fit, a name comes twice, or something is said to be unknown that cannot be.
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
                f"the targets are {', '.join(targets) or 'none'}: name at least one, and each once"
            )
        object.__setattr__(self, "targets", targets)
        if self.places is not None:
            places = stored(
                np.atleast_2d(self.places), "the places of the targets", (len(targets), 3)
            )
            object.__setattr__(self, "places", places)
        object.__setattr__(self, "T_base_frame", stored_pose(self.T_base_frame, "T_base_frame"))
        object.__setattr__(self, "unknown", chosen(self.unknown, self.allowed_unknown, self.name))

    def with_tool(self, T_platform_tool: FloatArray) -> Self:
        """The kind with its targets at the tool's origin, unless their places are stated."""
        if self.has_tool:
            return self
        return replace(
            self, places=np.repeat(T_platform_tool[None, :3, 3], len(self.targets), axis=0)
        )

    @property
    def has_tool(self) -> bool:
        """Whether the places of the targets are known, or what they are counted from."""
        return self.places is not None

    @property
    def columns(self) -> tuple[Column, ...]:
        """The columns of each target, named after it where there are several."""
        if len(self.targets) == 1:
            return self.per_target
        return tuple(
            Column(f"{target}.{column.name}", column.dimension)
            for target in self.targets
            for column in self.per_target
        )

    @property
    def setup_items(self) -> Mapping[str, tuple[Parameter, ...]]:
        """Frame, targets, and what the kind adds, as far as they are unknown."""
        places = np.zeros((len(self.targets), 3)) if self.places is None else self.places
        found: dict[str, tuple[Parameter, ...]] = {}
        for name in self.unknown:
            if name == "frame":
                found[name] = parts.frame_part(self.frame, self.T_base_frame)
            elif name == "targets":
                named = zip(self.targets, places, strict=True)
                found[name] = tuple(
                    p for target, place in named for p in parts.point_part(target, place)
                )
            else:
                found[name] = self.own_item(name)
        return found

    @property
    def target_columns(self) -> Mapping[str, tuple[int, ...]]:
        """The targets."""
        g = len(self.per_target)
        return {target: tuple(range(i * g, (i + 1) * g)) for i, target in enumerate(self.targets)}

    def own_item(self, name: str) -> tuple[Parameter, ...]:
        """Parameters of a part that only this kind has."""
        raise NotImplementedError(name)

    @property
    def references(self) -> Mapping[str, FloatArray]:
        """The stated orientation of the frame."""
        return {self.frame: self.T_base_frame[:3, :3]} if "frame" in self.unknown else {}

    def sight(self, T: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Targets x (.., k, 3) in the frame, and their derivative (.., k, 3, 6 + u), at poses T
        (.., 4, 4).
        """
        own = self.item_values(values, "frame")
        frame = parts.frame_at(self.T_base_frame, own)
        R, Q = T[..., None, :3, :3], np.swapaxes(frame[..., None, :3, :3], -1, -2)
        arm = (R @ self.places_at(values)[..., None])[..., 0]
        lever = arm + T[..., None, :3, 3] - frame[..., None, :3, 3]
        identity = np.broadcast_to(np.eye(3), (*arm.shape, 3))
        blocks = {"twist": Q @ np.concatenate([-geometry.hat(arm), identity], axis=-1)}
        if own is not None:
            blocks["frame"] = (
                Q
                @ np.concatenate([geometry.hat(lever), -identity], axis=-1)
                @ parts.frame_slope(own)[..., None, :, :]
            )
        if "targets" in self.unknown:
            k = len(self.targets)
            each = (Q @ R)[..., None, :] * np.eye(k)[:, None, :, None]
            blocks["targets"] = each.reshape(*each.shape[:-4], k, 3, 3 * k)
        return (Q @ lever[..., None])[..., 0], self.columns_of(blocks, lever.shape)

    def places_at(self, values: FloatArray) -> FloatArray:
        """Targets (.., k, 3) on the platform."""
        own = self.item_values(values, "targets")
        if own is not None:
            return own.reshape(*own.shape[:-1], len(self.targets), 3)
        return self.placed()

    def placed(self) -> FloatArray:
        """Stated places (k, 3); DataError before the kind is mounted."""
        if self.places is None:
            raise DataError(
                f"the kind {self.name!r} does not know its targets: use kind.with_tool(robot.tool), "
                "or state their places"
            )
        return self.places

    @abstractmethod
    def predict(
        self, x: FloatArray, values: FloatArray
    ) -> tuple[FloatArray, FloatArray, Mapping[str, FloatArray]]:
        """What would be read of targets x (.., k, 3) in the frame.

        Returns
        -------
        predicted : (.., k, g). by_x : (.., k, g, 3). own : part -> (.., k, g, w), for the parts
            that only this kind has.
        """

    def _predicted(self, T: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Columns (.., m) and derivatives (.., m, 6 + u)."""
        x, rows = self.sight(T, values)
        predicted, by_x, own = self.predict(x, values)
        rows = by_x @ rows
        if own:
            rows = rows + self.columns_of(own, predicted.shape)
        m = predicted.shape[-1] * predicted.shape[-2]
        return predicted.reshape(*predicted.shape[:-2], m), rows.reshape(
            *rows.shape[:-3], m, rows.shape[-1]
        )

    def _evaluate(
        self, T: FloatArray, measured: FloatArray, values: FloatArray, joints: FloatArray
    ) -> Evaluation:
        predicted, rows = self._predicted(T, values)
        residual = predicted - measured
        return self.split(geometry.wrap_angle(residual) if self.wraps else residual, rows)

    def measure(
        self,
        T: FloatArray,
        noise: FloatArray,
        unknowns: FloatArray | None = None,
        joints: FloatArray | None = None,
    ) -> FloatArray:
        """Columns (t, r, c) with noise added."""
        return self._predicted(T, self.values(unknowns))[0] + noise

    def offset_part(self) -> tuple[Parameter, ...]:
        """One unknown added to all readings of a session."""
        return (Parameter(f"{self.name}.offset", Dimension.LENGTH, 0.0, scope="session"),)


def offset_of(kind: Kind, values: FloatArray) -> tuple[FloatArray, dict[str, FloatArray]]:
    """The offset (.., 1, 1) of all readings, zero where known, and its derivative as a part."""
    own = kind.item_values(values, "offset")
    if own is None:
        return np.zeros((1, 1)), {}
    return own[..., None, :], {"offset": np.ones((1, 1, 1))}


def points_of(
    kind: TargetKind, T: FloatArray, measured: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Every target that was seen as a row of its own, at nominal unknowns.

    Returns
    -------
    moving : (q, 3, 3 k) with `moving p + origin` the point in the base, p the places of all
        targets.
    origin : (q, 3). points : (q, 3) in the base. seen : (q, g).
    """
    k = len(kind.targets)
    g = measured.shape[-1] // k
    moving = (T[:, None, :3, None, :3] * np.eye(k)[:, None, :, None]).reshape(-1, 3, 3 * k)
    origin = np.repeat(T[:, :3, 3], k, axis=0)
    seen = measured.reshape(-1, g)
    whole = ~np.any(np.isnan(seen), axis=-1)
    points = moving @ kind.placed().ravel() + origin
    return moving[whole], origin[whole], points[whole], seen[whole]


def length_of(x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Lengths (.., 1) of vectors (.., 3) and unit vectors; those of length zero have none, and get
    zeros.
    """
    square = np.sum(x * x, axis=-1, keepdims=True)
    safe = np.sqrt(np.where(square > 0.0, square, 1.0))
    return np.where(square > 0.0, safe, 0.0), x / safe
