# SPDX-License-Identifier: Apache-2.0
"""Kinds that measure points of the platform from a frame, and their base: targets, tips and probes.

`position`, as a tracker measures reflectors or a CMM measures spheres; `bearing`, two angles by a
theodolite or a camera.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Self

import numpy as np

from loopcal import engine, geometry
from loopcal.errors import DataError
from loopcal.measure import array_checks
from loopcal.measure.kinds import setup_parameters as setup
from loopcal.measure.kinds.kind import (
    POSITION_COLUMNS,
    Column,
    Evaluation,
    Kind,
    checked,
    make_angles,
)
from loopcal.typing import BoolArray, FloatArray, IntArray
from loopcal.units import Dimension

# The g columns of each target (.., k, g), their derivatives (.., k, g, 3) by its coordinates in the
# frame, and (.., k, g, w) by the setup items that only this kind has.
Prediction = tuple[FloatArray, FloatArray, Mapping[str, FloatArray]]

ITEMS = ("frame", "targets")
IDENTITY = np.eye(3)


def name_point(pose: str, target: str, targets: Sequence[str]) -> str:
    """Return the name of a measured point: POSE_TARGET, or POSE where there is one target."""
    return f"{pose}_{target}" if len(targets) > 1 else pose


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class TargetKind(Kind):
    """A kind that is a function of points p of the platform in a frame: `x = R_f' (R p + t - t_f)`.

    With h = R p + t - t_f: `dx = R_f' (v + omega x R p) + R_f' R dp - R_f' (v_f + omega_f x h)`.

    Parameters
    ----------
    targets : names of the k targets that one row measures. With several, columns are called `a.x`
        and so on.
    places : (k, 3) [m], targets on the platform; default: the origin of the robot's tool. If the
        targets are unknown, these are their nominal values.
    T_base_frame : (4, 4), frame of the instrument in the base; default: the base itself. If it is
        unknown, its nominal value.
    unknown : which of `allowed_unknown` are unknown. One value holds for a session (of a surface:
        for a group of rows).
    frame : name of the frame. Kinds that use the same name share its parameters.
    of : stage of a chain on whose platform the targets are; default: the end platform. "base" (of
        the kinds position, bearing and distance): the targets are fixed to the base. Their rows
        belong to no pose, and unknown ones keep their places in all sessions.

    Raises
    ------
    DataError : shapes do not fit, a name occurs twice, `unknown` lists something that is not
        allowed, or places of targets on the base are neither given nor unknown.
    """

    targets: tuple[str, ...] = ("target",)
    places: FloatArray | None = None
    T_base_frame: FloatArray = checked(array_checks.check_pose, "T_base_frame", np.eye(4))
    unknown: tuple[str, ...] = ()
    frame: str = "frame"
    of: str = ""

    measures_points: ClassVar[bool] = True
    allowed_unknown: ClassVar[tuple[str, ...]] = ITEMS

    def __post_init__(self) -> None:
        super().__post_init__()
        targets = array_checks.check_names(self.targets, "targets")
        array_checks.set_fields(self, targets=targets)
        shape = (len(targets), 3)
        if self.places is not None:
            is_single_place = len(self.places) > 0 and np.ndim(self.places[0]) == 0
            places = [self.places] if is_single_place else self.places
            if len(places) != len(targets):
                raise DataError(
                    f"the number of places is {len(places)}, but there are {len(targets)} targets "
                    f"({', '.join(targets)}). Give one place [x, y, z] for each target"
                )
            array_checks.set_fields(
                self, places=array_checks.check_array(places, "the places of the targets", shape)
            )
        elif self.is_of_base and "targets" not in self.unknown:
            raise DataError(
                f"the places of {', '.join(targets)} on the base are neither given nor unknown. "
                "Give `places` in the base frame, or list targets in `unknown`"
            )
        elif self.is_of_base:
            array_checks.set_fields(self, places=np.zeros(shape))

    def with_tool(self, T_platform_tool: FloatArray) -> Self:
        """Return the kind with its targets at the origin of the tool, or of the stage's platform,
        unless it states their places.
        """
        if self.has_tool:
            return self
        origin = np.zeros(3) if self.of else T_platform_tool[:3, 3]
        return replace(self, places=np.repeat(origin[None], len(self.targets), axis=0))

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
    def target_columns(self) -> Mapping[str, tuple[int, ...]]:
        """The targets with the indices of their columns."""
        g = len(self.per_target)
        return {target: tuple(range(i * g, (i + 1) * g)) for i, target in enumerate(self.targets)}

    @cached_property
    def possible_setup(self) -> Mapping[str, setup.SetupItem]:
        """Frame and targets; a kind adds the items that only it has."""
        places = np.zeros((len(self.targets), 3)) if self.places is None else self.places
        return {
            "frame": setup.make_frame_item(self.frame, self.T_base_frame),
            "targets": setup.make_points_item(
                self.targets, places, "machine" if self.is_of_base else "session"
            ),
        }

    @cached_property
    def divided(self) -> tuple[Kind, IntArray] | None:
        """The kind of one unknown target, whose place is a parameter: one kind for all targets."""
        if self.places is None or len(self.targets) == 1 or "targets" not in self.unknown:
            return None
        pairs = zip(self.targets, self.places, strict=True)
        kinds = [replace(self, targets=(name,), places=place[None]) for name, place in pairs]
        names = [p.name for p in self.nuisance_parameters]
        places = [[names.index(p.name) for p in kind.nuisance_parameters] for kind in kinds]
        return kinds[0], np.array(places)

    @abstractmethod
    def predict(self, x: FloatArray, values: FloatArray) -> Prediction:
        """Return the columns of targets x (.., k, 3) in the frame, and their derivatives."""

    def _predict(self, T: FloatArray, values: FloatArray, joints: FloatArray) -> Evaluation:
        x, rows = self.locate_targets(T, values)
        predicted, by_x, by_item = self.predict(x, values)
        rows = rows if by_x is IDENTITY else by_x @ rows
        if by_item:
            rows = rows + self.join_columns(by_item, predicted.shape)
        flat = (*predicted.shape[:-2], predicted.shape[-2] * predicted.shape[-1])
        return self.split_columns(predicted.reshape(flat), rows.reshape(*flat, rows.shape[-1]))

    def locate_targets(self, T: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return targets x (.., k, 3) in the frame, and derivatives (.., k, 3, 6 + u), at poses."""
        k = len(self.targets)
        of_frame, places = (self.item_values(values, name) for name in ("frame", "targets"))
        p = self._stated_places() if places is None else places.reshape(*places.shape[:-1], k, 3)
        if isinstance(T, np.ndarray) and T.ndim == 4 and values.ndim == 3:  # no jax in tests
            points = p if p.ndim == 4 else p[None, None]
            given = array_checks.drop_repeats(T), self.T_base_frame, of_frame, points, self._columns
            if (located := engine.locate_points(*given)) is not None:
                return located
        frame = setup.place_frame(self.T_base_frame, of_frame)
        R, Q = T[..., None, :3, :3], np.swapaxes(frame[..., None, :3, :3], -1, -2)
        arm = (R @ p[..., None])[..., 0]
        lever = arm + T[..., None, :3, 3] - frame[..., None, :3, 3]
        identity = np.broadcast_to(np.eye(3), (*arm.shape, 3))
        blocks = {"twist": Q @ np.concatenate([-geometry.hat(arm), identity], axis=-1)}
        if of_frame is not None:
            by_twist = Q @ np.concatenate([geometry.hat(lever), -identity], axis=-1)
            blocks["frame"] = by_twist @ setup.linearize_frame(of_frame)[..., None, :, :]
        if places is not None:
            by_place = (Q @ R)[..., None, :] * np.eye(k)[:, None, :, None]
            blocks["targets"] = by_place.reshape(*by_place.shape[:-4], k, 3, 3 * k)
        return (Q @ lever[..., None])[..., 0], self.join_columns(blocks, lever.shape)

    @cached_property
    def _columns(self) -> tuple[int, int, int]:
        """First columns of the frame and of targets that are unknown, -1 for none; all columns."""
        first = [6 + self._slices[i].start if i in self._slices else -1 for i in ITEMS]
        return first[0], first[1], 6 + len(self._is_length)

    def collect_points(
        self, T: FloatArray, measured: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return every measured target as a row, at nominal nuisance parameters: moving (q, 3, 3 k)
        and origin (q, 3), by which `moving p + origin` is the point in the base with p the places
        of all targets; these points (q, 3); and the measured columns (q, g).
        """
        k = len(self.targets)
        moving = (T[:, None, :3, None, :3] * np.eye(k)[:, None, :, None]).reshape(-1, 3, 3 * k)
        origin = np.repeat(T[:, :3, 3], k, axis=0)
        columns = measured.reshape(-1, len(self.per_target))
        complete = ~np.any(np.isnan(columns), axis=-1)
        points = moving @ self._stated_places().ravel() + origin
        return moving[complete], origin[complete], points[complete], columns[complete]

    def to_frame(self, points: FloatArray) -> FloatArray:
        """Return points (q, 3) of the base in the stated frame."""
        return (points - self.T_base_frame[:3, 3]) @ self.T_base_frame[:3, :3]

    def _stated_places(self) -> FloatArray:
        if self.places is None:
            raise DataError(
                f"the kind {self.name!r} has no places of its targets: use "
                f"kind.with_tool(robot.tool), or give `places`"
            )
        return self.places


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Position(TargetKind):
    """Positions of one or several targets. Residual: `x_predicted - x_measured` in axes of the
    frame.

    Setup parameters: `frame.rx` to `frame.rz` [rad], `frame.x` to `frame.z` [m], and `target.x`
    to `target.z` [m] of each target.

    Parameters
    ----------
    Those of `TargetKind`; "frame" and "targets" may be unknown.
    station : (3,) [m], place of the instrument in the frame, from which noise by range and angle
        counts; default: its origin.
    """

    station: FloatArray | None = checked(array_checks.check_point, "the station")

    name: ClassVar[str] = "position"
    length_error: ClassVar[str] = "position"
    per_target: ClassVar[tuple[Column, ...]] = POSITION_COLUMNS

    @classmethod
    def examples(cls) -> tuple[Self, ...]:
        """Return the tool's origin, an unknown target in an unknown frame, and three targets."""
        corners = np.array([[0.1, 0.0, 0.02], [-0.05, 0.08, 0.02], [-0.05, -0.08, 0.02]])
        return (
            cls(),
            cls(targets=("reflector",), unknown=("frame", "targets"), frame="tracker"),
            cls(targets=("a", "b", "c"), places=corners),
            cls(targets=("a", "b", "c"), places=corners, unknown=("targets", "frame")),
        )

    @property
    def sight_noise(self) -> Mapping[str, Dimension]:
        """Noise of the range, of the angle across the line of sight, and of the reflector."""
        angle, length = Dimension.ANGLE, Dimension.LENGTH
        return {"range": length, "angle": angle, "centering": length}

    def spread_sight_noise(self, measured: FloatArray) -> dict[str, FloatArray]:
        """Return the covariances (.., 3 k, 3 k) of measured points (.., 3 k) per variance of each
        `sight_noise`, as an instrument at the station measures them. DataError where nothing says
        where it stands.
        """
        is_base = "frame" not in self.unknown and np.array_equal(self.T_base_frame, np.eye(4))
        if self.station is None and is_base:
            raise DataError(
                "noise by range and angle needs the place of the instrument, but the frame is the "
                "base. Give `station`, as [1200 mm, 0 mm, 900 mm]"
            )
        station = np.zeros(3) if self.station is None else self.station
        lever = np.nan_to_num(measured).reshape(*measured.shape[:-1], -1, 3) - station
        length = np.maximum(np.linalg.norm(lever, axis=-1), geometry.FLATNESS)[..., None]
        along = (lever / length)[..., None] * (lever / length)[..., None, :]
        spread = {"range": along, "angle": length[..., None] ** 2 * (np.eye(3) - along)}
        spread["centering"] = np.broadcast_to(np.eye(3), along.shape)
        shape, apart = (*measured.shape, measured.shape[-1]), np.eye(lever.shape[-2])
        return {
            name: np.einsum("...kij,kl->...kilj", block, apart).reshape(shape)
            for name, block in spread.items()
        }

    def predict(self, x: FloatArray, values: FloatArray) -> Prediction:
        """Return the points themselves."""
        return x, IDENTITY, {}

    def guess_values(self, T: FloatArray, measured: FloatArray) -> FloatArray:
        """Return frame and targets in closed form; DataError where the frame is unknown and all
        points are collinear.
        """
        if self.is_of_base:
            base = np.broadcast_to(np.eye(4), (len(measured), 4, 4))
            _, _, points, positions = self.collect_points(base, measured)
            if not self.locates_frame or len(positions) < 3:
                return self.nominal_values[None]
            frame = geometry.align_point_sets(positions, points)
            return self.assemble_values({"frame": setup.encode_frame(self.T_base_frame, frame)})
        if {"frame", "targets"} <= set(self.unknown):
            guess = self.guess_sets(T[None], measured[None], np.ones((1, len(T)), dtype=bool))[0]
            if isinstance(guess, DataError):
                raise guess
            return guess
        moving, origin, points, positions = self.collect_points(T, measured)
        is_framed = "frame" in self.unknown and len(positions) > 0
        if not self.unknown or (len(positions) < 3 and not is_framed):
            return self.nominal_values[None]
        # two leave a rotation open
        if "frame" in self.unknown and len(positions) > 2 and _are_collinear(positions):
            raise self._report_line(len(positions))
        if "targets" not in self.unknown:
            frame = geometry.align_point_sets(positions, points)
            return setup.encode_frame(self.T_base_frame, frame)[None]
        base = positions @ self.T_base_frame[:3, :3].T + self.T_base_frame[:3, 3]
        rows = moving.reshape(base.size, -1)
        return geometry.solve_least_squares(rows, (base - origin).ravel())[None]

    def guess_sets(
        self, T: FloatArray, measured: FloatArray, is_row: BoolArray, worth: float = np.inf
    ) -> list[FloatArray | DataError]:
        """Return the candidates of each set; frames with targets of all sets are found together,
        see `geometry.solve_frame_and_points`.
        """
        if self.is_of_base or not {"frame", "targets"} <= set(self.unknown):
            return super().guess_sets(T, measured, is_row, worth)
        (s, r), k = measured.shape[:2], len(self.targets)
        positions = np.where(is_row[..., None], measured, np.nan).reshape(s, r * k, 3)
        guesses: list[FloatArray | DataError] = [self.nominal_values[None]] * s
        count = (~np.isnan(positions).any(axis=2)).sum(axis=1)
        chosen = np.flatnonzero(count >= 3)
        if chosen.size:
            is_flat = _are_collinear(positions[chosen])
            for j in chosen[is_flat]:
                guesses[j] = self._report_line(int(count[j]))
            chosen = chosen[~is_flat]
        if chosen.size:
            own = np.broadcast_to(T, (s, *T.shape[1:]))[chosen]
            moving = own[:, :, None, :3, None, :3] * np.eye(k)[:, None, :, None]
            moving = moving.reshape(len(chosen), r * k, 3, 3 * k)
            origin = np.repeat(own[:, :, :3, 3], k, axis=1)
            sets = positions[chosen], moving, origin, worth
            frames, places, of = geometry.solve_frame_and_points(*sets)
            items = {"frame": setup.encode_frame(self.T_base_frame, frames), "targets": places}
            ends = np.flatnonzero(np.diff(of)) + 1
            for j, of_set in zip(chosen, np.split(self.assemble_values(items), ends), strict=True):
                guesses[j] = of_set
        return guesses

    def _report_line(self, count: int) -> DataError:
        """Return why an unknown frame does not follow from `count` positions on a line."""
        return DataError(
            f"the {count} positions are collinear, so the rotation of the frame {self.frame!r} "
            f"about their line stays open. Measure poses off the line, or give a known "
            f"T_base_frame"
        )

    @property
    def locates_frame(self) -> bool:
        """Whether targets at stated places on the base determine the frame: not on a line."""
        if not self.is_of_base or self.places is None or "frame" not in self.unknown:
            return False
        return len(self.places) > 2 and not bool(_are_collinear(self.places))


def _are_collinear(points: FloatArray) -> BoolArray:
    """Return whether points (.., q, 3) are on a line, NaN where missing."""
    is_there = ~np.isnan(points).any(axis=-1, keepdims=True)
    present, count = np.where(is_there, points, 0.0), is_there.sum(axis=-2, keepdims=True)
    middle = present.sum(axis=-2, keepdims=True) / np.maximum(count, 1)
    extent = np.linalg.svd(np.where(is_there, points - middle, 0.0), compute_uv=False)
    return np.asarray(extent[..., 1] <= geometry.FLATNESS * extent[..., 0])


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Bearing(TargetKind):
    """Two angles of each target. Residual: differences of angles, wrapped.

    Theodolite: `azimuth = atan2(y, x)`, `elevation = atan2(z, hypot(x, y))`. Camera, whose optical
    axis is z: `azimuth = atan2(x, z)`, `elevation = atan2(y, z)`.

    Setup parameters: those of `Position`.

    Parameters
    ----------
    form : "theodolite" or "camera".
    Others : see `TargetKind`; "frame" (the station) and "targets" may be unknown.

    Raises
    ------
    DataError : as `TargetKind`, or for another form.
    """

    form: str = "theodolite"

    name: ClassVar[str] = "bearing"
    per_target: ClassVar[tuple[Column, ...]] = make_angles("azimuth", "elevation")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.form not in ("theodolite", "camera"):
            raise DataError(f"the form of a bearing is {self.form!r}. Use theodolite or camera")

    @classmethod
    def examples(cls) -> tuple[Self, ...]:
        """Return a theodolite, a camera at an unknown station, and two targets."""
        station = geometry.make_pose(np.eye(3), np.array([-1.5, -0.8, 0.1]))
        behind = geometry.make_pose(np.eye(3), np.array([0.1, -0.1, -2.5]))
        pair = np.array([[0.1, 0.0, 0.02], [-0.05, 0.08, 0.02]])
        return (
            cls(T_base_frame=station),
            cls(T_base_frame=behind, form="camera", unknown=("frame",), frame="camera"),
            cls(
                targets=("a", "b"),
                places=pair,
                T_base_frame=station,
                unknown=("frame", "targets"),
                frame="station",
            ),
        )

    def predict(self, x: FloatArray, values: FloatArray) -> Prediction:
        """Return both angles."""
        if self.form == "camera":
            return (*predict_camera_angles(x), {})
        a, b, c = x[..., 0], x[..., 1], x[..., 2]
        flat = a * a + b * b
        reach, level = flat + c * c, np.sqrt(flat)
        # a target straight above or below the station has an azimuth without a slope: NaN, by
        # which a fit refuses the row
        with np.errstate(invalid="ignore", divide="ignore"):
            slopes = [
                np.stack([-b / flat, a / flat, np.zeros_like(a)], axis=-1),
                np.stack([-a * c / level, -b * c / level, level], axis=-1) / reach[..., None],
            ]
        angles = np.stack([np.arctan2(b, a), np.arctan2(c, level)], axis=-1)
        return angles, np.stack(slopes, axis=-2), {}

    def guess_values(self, T: FloatArray, measured: FloatArray) -> FloatArray:
        """Return the station by resection, with the targets at their stated places."""
        _, _, points, angles = self.collect_points(T, measured)
        if "frame" not in self.unknown or len(angles) < 4 or self.is_of_base:
            return self.nominal_values[None]
        rays = convert_camera_angles(angles)
        if self.form == "theodolite":
            (azimuth, elevation), level = angles.T, np.cos(angles[:, 1])
            rays = np.stack(
                [level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1
            )
        frames = geometry.solve_resection(rays, points)
        return self.assemble_values({"frame": setup.encode_frame(self.T_base_frame, frames)})


def predict_camera_angles(x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the angles `atan2(x, z)` and `atan2(y, z)` (.., 2) of vectors (.., 3) about an optical
    axis z, and their derivatives (.., 2, 3), which are not finite at the vector 0.
    """
    a, b, c = x[..., 0], x[..., 1], x[..., 2]
    zero = np.zeros_like(a)
    across, up = a * a + c * c, b * b + c * c
    with np.errstate(invalid="ignore", divide="ignore"):
        slopes = [
            np.stack([c / across, zero, -a / across], axis=-1),
            np.stack([zero, c / up, -b / up], axis=-1),
        ]
    return np.stack([np.arctan2(a, c), np.arctan2(b, c)], axis=-1), np.stack(slopes, axis=-2)


def convert_camera_angles(angles: FloatArray) -> FloatArray:
    """Return the unit vectors (.., 3) of angles (.., 2)."""
    first, second = angles[..., 0], angles[..., 1]
    ray = np.stack([np.tan(first), np.tan(second), np.ones_like(first)], axis=-1)
    # behind the camera the tangents belong to the opposite ray
    ray = np.where((np.cos(first) < 0.0)[..., None], -ray, ray)
    return ray / np.linalg.norm(ray, axis=-1, keepdims=True)
