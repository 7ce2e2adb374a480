# SPDX-License-Identifier: Apache-2.0
"""Kind `inclination`: two tilts of the platform against gravity, by inclinometers on it."""

from dataclasses import dataclass, field
from typing import ClassVar, Self

import numpy as np

from loopcal.measure.array_checks import check_direction, check_pose
from loopcal.measure.kinds.directions.direction_kind import DirectionKind
from loopcal.measure.kinds.kind import Column, check_unknown
from loopcal.typing import FloatArray
from loopcal.units import Dimension


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Inclination(DirectionKind):
    """Elevations of a sensor's x and y axis above the horizontal. Residual: differences of angles.

    With the upward vertical d in axes of the sensor: `tilt_x = atan2(d_x, hypot(d_y, d_z))`,
    `tilt_y` likewise.

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
    """

    up: FloatArray = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    T_platform_sensor: FloatArray = field(default_factory=lambda: np.eye(4))
    sensor: str = "inclinometer"

    name: ClassVar[str] = "inclination"
    allowed_unknown: ClassVar[tuple[str, ...]] = ("mounting", "gravity")
    inward: ClassVar[bool] = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "up", check_direction(self.up, "the vertical"))
        object.__setattr__(
            self, "T_platform_sensor", check_pose(self.T_platform_sensor, "T_platform_sensor")
        )
        object.__setattr__(
            self, "unknown", check_unknown(self.unknown, self.allowed_unknown, self.name)
        )

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

    def convert_to_directions(self, measured: FloatArray) -> FloatArray:
        """Return the upward vertical in an upright sensor."""
        side = np.sin(measured)
        rest = np.sqrt(np.maximum(1.0 - np.sum(side * side, axis=-1, keepdims=True), 0.0))
        d = np.concatenate([side, rest], axis=-1)
        return d / np.linalg.norm(d, axis=-1, keepdims=True)

    def interpret_columns(self, measured: FloatArray) -> tuple[FloatArray, ...]:
        """Return the vertical in an upright sensor and in one that hangs upside down, which shows
        the same tilts.
        """
        upright = self.convert_to_directions(measured)
        return (
            (upright, upright * np.array([1.0, 1.0, -1.0]))
            if "mounting" in self.unknown
            else (upright,)
        )

    def find_invalid_rows(self, measured: FloatArray) -> tuple[tuple[int, str], ...]:
        """Return rows whose two tilts are impossible together."""
        with np.errstate(invalid="ignore"):
            wrong = np.flatnonzero(
                (np.sum(np.sin(measured) ** 2, axis=-1) > 1.0)
                | np.any(np.abs(measured) > np.pi / 2, axis=-1)
            )
        sentence = (
            "has tilts of {:.6g} and {:.6g} deg, which are impossible together: elevations of two "
            "perpendicular axes add up to at most 90 deg; check the unit"
        )
        return tuple((int(i), sentence.format(*np.rad2deg(measured[i]))) for i in wrong)
