# SPDX-License-Identifier: Apache-2.0
"""Kind `inclination`: two tilts of the platform against gravity, by inclinometers on it."""

from dataclasses import dataclass, field
from typing import ClassVar, Self

import numpy as np

from loopcal.measure.array_checks import check_direction, check_pose, set_fields
from loopcal.measure.kinds.directions.direction_kind import DirectionKind
from loopcal.measure.kinds.rows import Column, InvalidRows, list_rows
from loopcal.typing import FloatArray
from loopcal.units import Dimension


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Inclination(DirectionKind):
    """Elevations of a sensor's x and y axis above the horizontal. Residual: differences of angles.

    With the upward vertical d in axes of the sensor: `tilt_x = atan2(d_x, hypot(d_y, d_z))`,
    `tilt_y` likewise.

    Setup parameters [rad]: `inclinometer.rx` to `inclinometer.rz`, `gravity.u` and `gravity.v`.

    Parameters
    ----------
    up : (3,)
        The upward vertical in the base, of any length. If gravity is unknown, its nominal value.
    T_platform_sensor : (4, 4)
        Mounting of the sensor; only its orientation matters.
    sensor : str
        Name of the sensor; the parameters of its mounting begin with it.
    unknown : tuple of str
        Which of "mounting" and "gravity" are unknown.

    Raises
    ------
    DataError
        If the length of the vertical is zero, the mounting is not a pose, or `unknown` lists
        something else.

    Examples
    --------
    >>> from loopcal.geometry import make_pose, rotation_about_axis
    >>> T = make_pose(rotation_about_axis(0.1, 0), np.zeros(3))
    >>> Inclination().measure(T[None, None], noise=np.zeros((1, 1, 2))).round(6)
    array([[[0. , 0.1]]])
    """

    up: FloatArray = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    T_platform_sensor: FloatArray = field(default_factory=lambda: np.eye(4))
    sensor: str = "inclinometer"

    name: ClassVar[str] = "inclination"
    allowed_unknown: ClassVar[tuple[str, ...]] = ("mounting", "gravity")
    inward: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        mounting = check_pose(self.T_platform_sensor, "T_platform_sensor")
        set_fields(self, up=check_direction(self.up, "the vertical"), T_platform_sensor=mounting)

    @classmethod
    def examples(cls) -> tuple[Self, ...]:
        """Return a level base, an unknown vertical, and an unknown mounting too."""
        return (
            cls(),
            cls(unknown=("gravity",)),
            cls(unknown=("mounting", "gravity"), sensor="level"),
        )

    @property
    def columns(self) -> tuple[Column, ...]:
        """Two angles."""
        return (Column("tilt_x", Dimension.ANGLE), Column("tilt_y", Dimension.ANGLE))

    @property
    def stated(self) -> tuple[str, FloatArray, str, FloatArray]:
        """Mounting and vertical."""
        return self.sensor, self.T_platform_sensor[:3, :3], "gravity", self.up

    def predict(self, d: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return both elevations (.., 2) and their derivatives (.., 2, 3)."""
        x, y, z = d[..., 0], d[..., 1], d[..., 2]
        level_x, level_y = np.sqrt(y * y + z * z), np.sqrt(x * x + z * z)
        angles = np.stack([np.arctan2(x, level_x), np.arctan2(y, level_y)], axis=-1)
        # d has length one
        first = np.stack([level_x, -x * y / level_x, -x * z / level_x], axis=-1)
        second = np.stack([-x * y / level_y, level_y, -y * z / level_y], axis=-1)
        return angles, np.stack([first, second], axis=-2)

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
        sentence = (
            "has tilts of {:.6g} and {:.6g} deg, which are impossible together: elevations of two "
            "perpendicular axes add up to at most 90 deg; check the unit"
        )
        is_beyond_vertical = np.any(np.abs(measured) > np.pi / 2, axis=-1)
        return list_rows(
            is_beyond_vertical | (np.sum(np.sin(measured) ** 2, axis=-1) > 1.0),
            lambda i: sentence.format(*np.rad2deg(measured[i])),
        )
