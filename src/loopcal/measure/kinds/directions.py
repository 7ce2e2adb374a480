# SPDX-License-Identifier: Apache-2.0
"""Bases of the kinds that measure directions: axes in a frame, or gravity on the platform."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Self

import numpy as np

from loopcal import geometry
from loopcal.measure.array_checks import check_direction, check_pose
from loopcal.measure.kinds import kind
from loopcal.measure.kinds import setup_parameters as setup
from loopcal.measure.kinds.kind import Column, Evaluation, InvalidRows, Kind
from loopcal.measure.kinds.position import convert_camera_angles, predict_camera_angles
from loopcal.typing import BoolArray, FloatArray
from loopcal.units import Dimension

UPWARD = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class DirectionKind(Kind):
    """A kind that is a function of a direction `d = S' Q a`, with S an orientation and a a
    direction; both may be unknown.

    Outward, Q = R, the platform's rotation: a is an axis of the platform, S the orientation of an
    instrument in the base. Inward, Q = R': a is a direction of the base (gravity), S the mounting
    of a sensor on the platform. With s the rotation of S: `dd = S' (dQ a) + S' Q da + S' (Q a x
    s)`, where `dR a = omega x R a`, `dR' a = R' (a x omega)`.

    unknown : which of `allowed_unknown`, (orientation, direction), are unknown: three and two
        numbers. One value holds for a session.
    """

    unknown: tuple[str, ...] = ()

    inward: ClassVar[bool] = False
    angle_error: ClassVar[str] = "orientation"

    @property
    @abstractmethod
    def stated(self) -> tuple[str, FloatArray, str, FloatArray]:
        """Name and rotation (3, 3) of the orientation; name and unit vector of the direction."""

    @cached_property
    def possible_setup(self) -> Mapping[str, setup.SetupItem]:
        """Orientation and direction."""
        orientation, S, direction, a = self.stated
        of_orientation, of_direction = self.allowed_unknown
        rotations = setup.make_parameters(direction, setup.DIRECTION_AXES, Dimension.ANGLE)
        return {
            of_orientation: setup.make_orientation_item(orientation, S),
            of_direction: setup.SetupItem(rotations, {direction: a}),
        }

    def locate_direction(self, T: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the direction d (.., 3) and its derivative (.., 3, 6 + u)."""
        _, S, _, stated = self.stated
        of_orientation, of_direction = self.allowed_unknown
        rotation, angles = (self.item_values(values, name) for name in self.allowed_unknown)
        R = T[..., :3, :3]
        Q = np.swapaxes(R, -1, -2) if self.inward else R
        if rotation is not None:
            S = geometry.exp_so3(rotation) @ S
        St = np.swapaxes(S, -1, -2)
        a = setup.place_direction(stated, angles)
        rotated = (Q @ a[..., None])[..., 0]
        by_omega = St @ (Q @ geometry.hat(a) if self.inward else -geometry.hat(rotated))
        blocks = {"twist": np.concatenate([by_omega, np.zeros_like(by_omega)], axis=-1)}
        if rotation is not None:
            by_rotation = geometry.left_jacobian_so3(rotation)
            blocks[of_orientation] = St @ geometry.hat(rotated) @ by_rotation
        if angles is not None:
            blocks[of_direction] = St @ Q @ setup.linearize_direction(stated, angles)
        d = (St @ rotated[..., None])[..., 0]
        return d, self.join_columns(blocks, d.shape)

    @abstractmethod
    def convert_to_directions(self, measured: FloatArray) -> tuple[FloatArray, ...]:
        """Return the unit vectors d (.., 3) that columns (.., c) can stand for, usually one."""

    def guess_values(self, T: FloatArray, measured: FloatArray) -> FloatArray:
        """Return orientation and direction in closed form, from the whole rotation group."""
        complete = ~np.any(np.isnan(measured), axis=-1)
        if not self.unknown or np.count_nonzero(complete) < 3:
            return self.nominal_values[None]
        R = T[complete, :3, :3]
        Q = np.swapaxes(R, -1, -2) if self.inward else R
        _, S, _, a = self.stated
        of_orientation, of_direction = self.allowed_unknown
        candidates = []
        for d in self.convert_to_directions(measured[complete]):
            if of_orientation in self.unknown:
                known = None if of_direction in self.unknown else a
                rotations, directions = geometry.solve_directions(d, Q, known)
            else:
                mean = np.einsum("rji,jk,rk->i", Q, S, d)
                rotations, directions = S[None], (mean / np.linalg.norm(mean))[None]
            items = {
                of_orientation: setup.encode_rotation(S, rotations),
                of_direction: setup.encode_direction(a, directions),
            }
            candidates.append(self.assemble_values(items))
        return np.concatenate(candidates)


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class AxisKind(DirectionKind):
    """A kind that measures an axis of the platform in the frame of an instrument.

    T_base_frame : (4, 4), frame of the instrument in the base; only its orientation matters.
    frame : name of the frame. Kinds that use the same name share its parameters.
    Others : see `DirectionKind`.
    """

    T_base_frame: FloatArray = kind.checked(check_pose, "T_base_frame", np.eye(4))
    frame: str = "frame"


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Direction(AxisKind):
    """Direction of an axis as a unit vector, such as the normal of a probed face.

    Residual: `2 B'd / (1 + m'd)`, with B two unit vectors perpendicular to the measured m. It is
    twice the tangent of half the angle between the predicted direction d and m, which equals the
    angle where that is small, and is unbounded where d is opposite to m.

    Setup parameters [rad]: `frame.rx` to `frame.rz`, `axis.u` and `axis.v`.

    Parameters
    ----------
    axis : (3,), the axis on the platform, of any length. If the axis is unknown, its nominal value.
    axis_name : name of the axis; its parameters begin with it.
    Others : see `AxisKind`; "frame" and "axis" may be unknown.

    Raises
    ------
    DataError : the length of the axis is zero, the frame is not a pose, or `unknown` lists
        something else.
    """

    axis: FloatArray = kind.checked(check_direction, "the axis", UPWARD)
    axis_name: str = "axis"

    name: ClassVar[str] = "direction"
    # the three components, as measuring machines write them
    per_target: ClassVar[tuple[Column, ...]] = tuple(Column(n, Dimension.RATIO) for n in "ijk")
    allowed_unknown: ClassVar[tuple[str, ...]] = ("frame", "axis")

    @classmethod
    def examples(cls) -> tuple[Self, ...]:
        """Return a known axis, and an unknown one in an unknown frame."""
        face = np.array([0.0, 0.6, 0.8])
        return (cls(), cls(axis=face, unknown=("axis", "frame"), frame="cmm", axis_name="face"))

    @property
    def noise_columns(self) -> tuple[Column, ...]:
        """Two angles perpendicular to the direction."""
        return kind.make_angles("across_a", "across_b")

    @property
    def stated(self) -> tuple[str, FloatArray, str, FloatArray]:
        """Frame and axis."""
        return self.frame, self.T_base_frame[:3, :3], self.axis_name, self.axis

    @property
    def placeholder(self) -> FloatArray:
        """The z axis, where no direction was measured."""
        return UPWARD

    def detect_present(self, measured: FloatArray) -> BoolArray:
        """Return both residuals, or none where a component is missing."""
        return np.repeat(~np.any(np.isnan(measured), axis=-1, keepdims=True), 2, axis=-1)

    def find_invalid_rows(self, measured: FloatArray) -> InvalidRows:
        """Return rows with an incomplete direction, or one whose length is not 1."""
        incomplete = "has an incomplete direction. Give i, j and k, or none of them"
        invalid = kind.list_rows(kind.is_incomplete(measured), lambda _: incomplete)
        return invalid + kind.list_not_unit(measured, "direction")

    def convert_to_directions(self, measured: FloatArray) -> tuple[FloatArray, ...]:
        """Return the columns, scaled to length one."""
        return (measured / np.linalg.norm(measured, axis=-1, keepdims=True),)

    def _evaluate(
        self, T: FloatArray, measured: FloatArray, values: FloatArray, joints: FloatArray
    ) -> Evaluation:
        d, rows = self.locate_direction(T, values)
        length = np.sqrt(np.sum(measured * measured, axis=-1, keepdims=True))
        # a row with a missing component has no direction: its length is not 1
        complete = length > 0.5
        m = np.where(complete, measured / np.where(complete, length, 1.0), self.placeholder)
        Bt = np.swapaxes(setup.make_perpendicular_basis(m), -1, -2)
        facing = 1.0 + np.sum(m * d, axis=-1, keepdims=True)
        scale = 2.0 / np.where(facing > 1e-9, facing, 1e-9)
        residual = scale * (Bt @ d[..., None])[..., 0]
        slopes = scale[..., None] * (Bt - 0.5 * residual[..., None] * m[..., None, :])
        return self.split_columns(residual, slopes @ rows)

    def _measure(
        self, T: FloatArray, noise: FloatArray, values: FloatArray, joints: FloatArray
    ) -> FloatArray:
        """Return directions (t, r, 3), rotated by the noise (t, r, 2) perpendicular to them."""
        d, _ = self.locate_direction(T, values)
        rotation = np.cross(d, (setup.make_perpendicular_basis(d) @ noise[..., None])[..., 0])
        return (geometry.exp_so3(rotation) @ d[..., None])[..., 0]


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Inclination(DirectionKind):
    """Elevations of a sensor's x and y axis above the horizontal, by inclinometers on the platform.
    Residual: differences of angles.

    With the upward vertical d in axes of the sensor: `tilt_x = atan2(d_x, hypot(d_y, d_z))`,
    `tilt_y` likewise.

    Setup parameters [rad]: `inclinometer.rx` to `inclinometer.rz`, `gravity.u` and `gravity.v`.

    Parameters
    ----------
    up : (3,), the upward vertical in the base, of any length. If gravity is unknown, its nominal
        value.
    T_platform_sensor : (4, 4), mounting of the sensor; only its orientation matters.
    sensor : name of the sensor; the parameters of its mounting begin with it.
    unknown : which of "mounting" and "gravity" are unknown.

    Raises
    ------
    DataError : the length of the vertical is zero, the mounting is not a pose, or `unknown` lists
        something else.
    """

    up: FloatArray = kind.checked(check_direction, "the vertical", UPWARD)
    T_platform_sensor: FloatArray = kind.checked(check_pose, "T_platform_sensor", np.eye(4))
    sensor: str = "inclinometer"

    name: ClassVar[str] = "inclination"
    per_target: ClassVar[tuple[Column, ...]] = kind.make_angles("tilt_x", "tilt_y")
    allowed_unknown: ClassVar[tuple[str, ...]] = ("mounting", "gravity")
    inward: ClassVar[bool] = True

    @classmethod
    def examples(cls) -> tuple[Self, ...]:
        """Return a level base, an unknown vertical, and an unknown mounting too."""
        both = cls(unknown=("mounting", "gravity"), sensor="level")
        return (cls(), cls(unknown=("gravity",)), both)

    @property
    def stated(self) -> tuple[str, FloatArray, str, FloatArray]:
        """Mounting and vertical."""
        return self.sensor, self.T_platform_sensor[:3, :3], "gravity", self.up

    def _predict(self, T: FloatArray, values: FloatArray, joints: FloatArray) -> Evaluation:
        """Return both elevations."""
        d, rows = self.locate_direction(T, values)
        x, y, z = d[..., 0], d[..., 1], d[..., 2]
        level_x, level_y = np.sqrt(y * y + z * z), np.sqrt(x * x + z * z)
        angles = np.stack([np.arctan2(x, level_x), np.arctan2(y, level_y)], axis=-1)
        # d has length one
        first = np.stack([level_x, -x * y / level_x, -x * z / level_x], axis=-1)
        second = np.stack([-x * y / level_y, level_y, -y * z / level_y], axis=-1)
        return self.split_columns(angles, np.stack([first, second], axis=-2) @ rows)

    def convert_to_directions(self, measured: FloatArray) -> tuple[FloatArray, ...]:
        """Return the vertical in an upright sensor; with an unknown mounting, also in one that
        hangs upside down, which shows the same tilts.
        """
        side = np.sin(measured)
        rest = np.sqrt(np.maximum(1.0 - np.sum(side * side, axis=-1, keepdims=True), 0.0))
        d = np.concatenate([side, rest], axis=-1)
        upright = d / np.linalg.norm(d, axis=-1, keepdims=True)
        upside_down = upright * np.array([1.0, 1.0, -1.0])
        return (upright, upside_down) if "mounting" in self.unknown else (upright,)

    def find_invalid_rows(self, measured: FloatArray) -> InvalidRows:
        """Return rows whose two tilts are impossible together."""
        is_beyond_vertical = np.any(np.abs(measured) > np.pi / 2, axis=-1)
        return kind.list_rows(
            is_beyond_vertical | (np.sum(np.sin(measured) ** 2, axis=-1) > 1.0),
            lambda i: (
                "has tilts of {:.6g} and {:.6g} deg, which are impossible together: elevations of "
                "two perpendicular axes add up to at most 90 deg. Check the unit"
            ).format(*np.rad2deg(measured[i])),
        )


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Autocollimation(AxisKind):
    """Angles of a mirror on the platform, by an autocollimator. Residual: differences of
    `atan2(d_x, d_z)` and `atan2(d_y, d_z)`, wrapped.

    d is the normal of the mirror in the frame of the instrument. The z axis of that frame is the
    optical axis and has the direction of the normal, towards the instrument. Angles belong to the
    mirror. An instrument with angles of the reflected beam shows twice these values.

    Setup parameters [rad]: `frame.rx` to `frame.rz`, `mirror.u` and `mirror.v`.

    Parameters
    ----------
    normal : (3,), normal of the mirror on the platform, of any length. If the mirror is unknown,
        its nominal value.
    mirror : name of the mirror; its parameters begin with it.
    Others : see `AxisKind`; "frame" and "mirror" may be unknown.

    Raises
    ------
    DataError : the length of the normal is zero, the frame is not a pose, or `unknown` lists
        something else.
    """

    normal: FloatArray = kind.checked(check_direction, "the normal of the mirror", UPWARD)
    mirror: str = "mirror"

    name: ClassVar[str] = "autocollimation"
    per_target: ClassVar[tuple[Column, ...]] = kind.make_angles("angle_x", "angle_y")
    allowed_unknown: ClassVar[tuple[str, ...]] = ("frame", "mirror")

    @classmethod
    def examples(cls) -> tuple[Self, ...]:
        """Return a mirror along z, and an unknown mirror in an unknown frame."""
        return (cls(), cls(unknown=("frame", "mirror"), frame="collimator", mirror="face"))

    @property
    def stated(self) -> tuple[str, FloatArray, str, FloatArray]:
        """Frame and mirror."""
        return self.frame, self.T_base_frame[:3, :3], self.mirror, self.normal

    def _predict(self, T: FloatArray, values: FloatArray, joints: FloatArray) -> Evaluation:
        """Return both angles."""
        d, rows = self.locate_direction(T, values)
        angles, slopes = predict_camera_angles(d)
        return self.split_columns(angles, slopes @ rows)

    def convert_to_directions(self, measured: FloatArray) -> tuple[FloatArray, ...]:
        """Return the normals of two angles, towards the instrument."""
        return (convert_camera_angles(measured),)

    def find_invalid_rows(self, measured: FloatArray) -> InvalidRows:
        """Return rows whose mirror faces away from the instrument."""
        away = np.abs(measured) >= np.pi / 2
        return kind.list_rows(
            np.asarray(np.any(away, axis=-1)),
            lambda i: (
                f"has an angle of {np.rad2deg(measured[i][away[i]][0]):.6g} deg, at which the "
                "mirror faces away from the instrument. Check the unit"
            ),
        )
