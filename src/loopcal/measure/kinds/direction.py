# SPDX-License-Identifier: Apache-2.0
"""Kind `direction`: an axis of the platform as a unit vector in a frame, such as the normal of a
touched face.
"""

from dataclasses import dataclass, field
from typing import ClassVar, Self

import numpy as np

from loopcal import geometry
from loopcal.measure.arrays import stored_pose
from loopcal.measure.kinds import parts
from loopcal.measure.kinds.aim import AimKind
from loopcal.measure.kinds.kind import Bools, Column, Evaluation, chosen
from loopcal.measure.kinds.surface import stored_direction
from loopcal.typing import FloatArray
from loopcal.units import Dimension


@dataclass(frozen=True, eq=False, kw_only=True)
class Direction(AimKind):
    """Direction of an axis. Residual: `2 B'd / (1 + m'd)`, B two unit vectors across the measured
    direction m.

    That is twice the tangent of half the angle between predicted d and measured m, along the two
    directions across m: the angle itself where it is small, and without end where d points
    backwards.

    Parameters
    ----------
    axis : (3,)
        The axis on the platform, of any length. Where unknown, the value it is counted from.
    axis_name : str
        Its name, after which its unknowns are called.
    T_base_frame : (4, 4)
        Frame of the instrument in the base, of which only the orientation matters.
    frame : str
        Name of the frame; kinds that name the same one share its unknowns.
    unknown : tuple of str
        Which of "frame" and "axis" are unknown.

    Raises
    ------
    DataError
        If the axis has no length, the frame is no pose, or something else is said to be unknown.
    """

    axis: FloatArray = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    axis_name: str = "axis"
    T_base_frame: FloatArray = field(default_factory=lambda: np.eye(4))
    frame: str = "frame"

    name: ClassVar[str] = "direction"

    def __post_init__(self) -> None:
        object.__setattr__(self, "axis", stored_direction(self.axis, "the axis"))
        object.__setattr__(self, "T_base_frame", stored_pose(self.T_base_frame, "T_base_frame"))
        object.__setattr__(self, "unknown", chosen(self.unknown, self.allowed_unknown, self.name))

    @classmethod
    def examples(cls) -> tuple[Self, ...]:
        """A known axis, and an unknown one in an unknown frame."""
        return (
            cls(),
            cls(
                axis=np.array([0.0, 0.6, 0.8]),
                unknown=("axis", "frame"),
                frame="cmm",
                axis_name="face",
            ),
        )

    @property
    def columns(self) -> tuple[Column, ...]:
        """The three components, as measuring machines write them."""
        return tuple(Column(name, Dimension.RATIO) for name in ("i", "j", "k"))

    @property
    def noise_columns(self) -> tuple[Column, ...]:
        """Two angles across the direction."""
        return (Column("across_a", Dimension.ANGLE), Column("across_b", Dimension.ANGLE))

    @property
    def stated(self) -> tuple[str, FloatArray, str, FloatArray]:
        """Frame and axis."""
        return self.frame, self.T_base_frame[:3, :3], self.axis_name, self.axis

    @property
    def placeholder(self) -> FloatArray:
        """A direction that stands where none was measured."""
        return np.array([0.0, 0.0, 1.0])

    def detect_present(self, measured: FloatArray) -> Bools:
        """Both residuals, or none where a component is missing."""
        return np.repeat(~np.any(np.isnan(measured), axis=-1, keepdims=True), 2, axis=-1)

    def find_invalid_rows(self, measured: FloatArray) -> tuple[tuple[int, str], ...]:
        """Rows with a part of a direction, or one that is not of length one."""
        length = np.linalg.norm(measured, axis=-1)
        missing = np.isnan(measured)
        partly = np.any(missing, axis=-1) & ~np.all(missing, axis=-1)
        found = [
            (int(i), "has only a part of its direction; give i, j and k, or none of them")
            for i in np.flatnonzero(partly)
        ]
        return tuple(found) + tuple(
            (int(i), f"has a direction of length {length[i]:.6g}; it must be 1 to 1e-3")
            for i in np.flatnonzero(np.abs(length - 1.0) > 1e-3)
        )

    def predict(self, d: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The direction itself."""
        return d, np.eye(3)

    def directions(self, measured: FloatArray) -> FloatArray:
        """The columns, made of length one."""
        return measured / np.linalg.norm(measured, axis=-1, keepdims=True)

    def _evaluate(
        self, T: FloatArray, measured: FloatArray, values: FloatArray, joints: FloatArray
    ) -> Evaluation:
        # a row with a missing component has no direction at all
        d, rows = self.direction(T, values)
        length = np.sqrt(np.sum(measured * measured, axis=-1, keepdims=True))
        m = np.where(length > 0.5, measured / np.where(length > 0.5, length, 1.0), self.placeholder)
        Bt = np.swapaxes(parts.across(m), -1, -2)
        facing = 1.0 + np.sum(m * d, axis=-1, keepdims=True)
        half = 2.0 / np.where(facing > 1e-9, facing, 1e-9)
        residual = half * (Bt @ d[..., None])[..., 0]
        slopes = half[..., None] * (Bt - 0.5 * residual[..., None] * m[..., None, :])
        return self.split(residual, slopes @ rows)

    def measure(
        self,
        T: FloatArray,
        noise: FloatArray,
        unknowns: FloatArray | None = None,
        joints: FloatArray | None = None,
    ) -> FloatArray:
        """Columns (t, r, 3) turned by noise (t, r, 2) across the direction."""
        d = self.direction(T, self.values(unknowns))[0]
        B = parts.across(d)
        turn = np.cross(d, (B @ noise[..., None])[..., 0])
        return (geometry.exp_so3(turn) @ d[..., None])[..., 0]
