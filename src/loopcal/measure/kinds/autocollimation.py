# SPDX-License-Identifier: Apache-2.0
"""Kind `autocollimation`: two angles of a mirror on the platform against the optical axis of an
autocollimator.
"""

from dataclasses import dataclass, field
from typing import ClassVar, Self

import numpy as np

from loopcal.measure.arrays import stored_pose
from loopcal.measure.kinds.aim import AimKind
from loopcal.measure.kinds.kind import Column, chosen
from loopcal.measure.kinds.surface import stored_direction
from loopcal.typing import FloatArray
from loopcal.units import Dimension


@dataclass(frozen=True, eq=False, kw_only=True)
class Autocollimation(AimKind):
    """Angles of a mirror's normal. Residual: differences of `atan2(d_x, d_z)` and `atan2(d_y,
    d_z)`, wrapped.

    d is the normal in the instrument, whose z axis is the optical one, pointing as the normal does
    (towards the instrument). Angles are those of the mirror; one that states the angles of the
    reflected beam states twice as much.

    Parameters
    ----------
    normal : (3,)
        Normal of the mirror on the platform, of any length. Where unknown, the value it is counted
        from.
    mirror : str
        Name of the mirror, after which its unknowns are called.
    T_base_frame : (4, 4)
        Frame of the instrument in the base, of which only the orientation matters.
    frame : str
        Name of the frame; kinds that name the same one share its unknowns.
    unknown : tuple of str
        Which of "frame" and "mirror" are unknown.

    Raises
    ------
    DataError
        If the normal has no length, the frame is no pose, or something else is said to be unknown.
    """

    normal: FloatArray = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    mirror: str = "mirror"
    T_base_frame: FloatArray = field(default_factory=lambda: np.eye(4))
    frame: str = "frame"

    name: ClassVar[str] = "autocollimation"
    allowed_unknown: ClassVar[tuple[str, str]] = ("frame", "mirror")

    def __post_init__(self) -> None:
        object.__setattr__(
            self, "normal", stored_direction(self.normal, "the normal of the mirror")
        )
        object.__setattr__(self, "T_base_frame", stored_pose(self.T_base_frame, "T_base_frame"))
        object.__setattr__(self, "unknown", chosen(self.unknown, self.allowed_unknown, self.name))

    @classmethod
    def examples(cls) -> tuple[Self, ...]:
        """A mirror seen along z, and an unknown one from an unknown side."""
        return (cls(), cls(unknown=("frame", "mirror"), frame="collimator", mirror="face"))

    @property
    def columns(self) -> tuple[Column, ...]:
        """Two angles."""
        return (Column("angle_x", Dimension.ANGLE), Column("angle_y", Dimension.ANGLE))

    @property
    def stated(self) -> tuple[str, FloatArray, str, FloatArray]:
        """Frame and mirror."""
        return self.frame, self.T_base_frame[:3, :3], self.mirror, self.normal

    def predict(self, d: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Both angles (.., 2) and their slopes (.., 2, 3)."""
        x, y, z = d[..., 0], d[..., 1], d[..., 2]
        zero = np.zeros_like(x)
        flat, up = x * x + z * z, y * y + z * z
        slopes = [
            np.stack([z / flat, zero, -x / flat], axis=-1),
            np.stack([zero, z / up, -y / up], axis=-1),
        ]
        return np.stack([np.arctan2(x, z), np.arctan2(y, z)], axis=-1), np.stack(slopes, axis=-2)

    def directions(self, measured: FloatArray) -> FloatArray:
        """Normals of two angles, in front of the instrument."""
        x, y = np.tan(measured[..., 0]), np.tan(measured[..., 1])
        d = np.stack([x, y, np.ones_like(x)], axis=-1)
        return d / np.linalg.norm(d, axis=-1, keepdims=True)

    def find_invalid_rows(self, measured: FloatArray) -> tuple[tuple[int, str], ...]:
        """Rows whose mirror is turned away."""
        with np.errstate(invalid="ignore"):
            away = np.argwhere(np.abs(measured) >= np.pi / 2)
        sentence = "has an angle of {:.6g} deg, at which a mirror faces away; check the unit"
        return tuple((int(i), sentence.format(np.rad2deg(measured[i, j]))) for i, j in away)
