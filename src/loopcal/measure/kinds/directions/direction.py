# SPDX-License-Identifier: Apache-2.0
"""Kind `direction`: an axis of the platform as a unit vector in a frame, such as the normal of a
probed face.
"""

from dataclasses import dataclass, field
from typing import ClassVar, Self

import numpy as np

from loopcal import geometry
from loopcal.measure.array_checks import check_direction, check_pose
from loopcal.measure.kinds.directions.direction_kind import DirectionKind
from loopcal.measure.kinds.kind import Column, Evaluation, check_unknown
from loopcal.measure.kinds.setup_parameters import make_perpendicular_basis
from loopcal.typing import BoolArray, FloatArray
from loopcal.units import Dimension


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Direction(DirectionKind):
    """Direction of an axis. Residual: `2 B'd / (1 + m'd)`, with B two unit vectors perpendicular to
    the measured direction m.

    The residual is twice the tangent of half the angle between the predicted direction d and m,
    along the two vectors B. It equals the angle where that is small, and is unbounded where d is
    opposite to m.

    Parameters
    ----------
    axis : (3,)
        The axis on the platform, of any length. If the axis is unknown, its nominal value.
    axis_name : str
        Name of the axis; its parameters begin with it.
    T_base_frame : (4, 4)
        Frame of the instrument in the base; only its orientation matters.
    frame : str
        Name of the frame. Kinds that use the same name share its parameters.
    unknown : tuple of str
        Which of "frame" and "axis" are unknown.

    Raises
    ------
    DataError
        If the length of the axis is zero, the frame is not a pose, or `unknown` lists something
        else.
    """

    axis: FloatArray = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    axis_name: str = "axis"
    T_base_frame: FloatArray = field(default_factory=lambda: np.eye(4))
    frame: str = "frame"

    name: ClassVar[str] = "direction"

    def __post_init__(self) -> None:
        object.__setattr__(self, "axis", check_direction(self.axis, "the axis"))
        object.__setattr__(self, "T_base_frame", check_pose(self.T_base_frame, "T_base_frame"))
        object.__setattr__(
            self, "unknown", check_unknown(self.unknown, self.allowed_unknown, self.name)
        )

    @classmethod
    def examples(cls) -> tuple[Self, ...]:
        """Return a known axis, and an unknown one in an unknown frame."""
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
        """Two angles perpendicular to the direction."""
        return (Column("across_a", Dimension.ANGLE), Column("across_b", Dimension.ANGLE))

    @property
    def stated(self) -> tuple[str, FloatArray, str, FloatArray]:
        """Frame and axis."""
        return self.frame, self.T_base_frame[:3, :3], self.axis_name, self.axis

    @property
    def placeholder(self) -> FloatArray:
        """The z axis, where no direction was measured."""
        return np.array([0.0, 0.0, 1.0])

    def detect_present(self, measured: FloatArray) -> BoolArray:
        """Return both residuals as present, or none where a component is missing."""
        return np.repeat(~np.any(np.isnan(measured), axis=-1, keepdims=True), 2, axis=-1)

    def find_invalid_rows(self, measured: FloatArray) -> tuple[tuple[int, str], ...]:
        """Return rows with an incomplete direction, or one whose length is not 1."""
        length = np.linalg.norm(measured, axis=-1)
        missing = np.isnan(measured)
        incomplete = np.any(missing, axis=-1) & ~np.all(missing, axis=-1)
        invalid = [
            (int(i), "has an incomplete direction; give i, j and k, or none of them")
            for i in np.flatnonzero(incomplete)
        ]
        return tuple(invalid) + tuple(
            (int(i), f"has a direction of length {length[i]:.6g}; the length must be 1 to 1e-3")
            for i in np.flatnonzero(np.abs(length - 1.0) > 1e-3)
        )

    def predict(self, d: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the direction itself."""
        return d, np.eye(3)

    def convert_to_directions(self, measured: FloatArray) -> FloatArray:
        """Return the columns, scaled to length one."""
        return measured / np.linalg.norm(measured, axis=-1, keepdims=True)

    def _evaluate(
        self, T: FloatArray, measured: FloatArray, values: FloatArray, joints: FloatArray
    ) -> Evaluation:
        d, rows = self.locate_direction(T, values)
        length = np.sqrt(np.sum(measured * measured, axis=-1, keepdims=True))
        # a row with a missing component has no direction: its length is not 1
        complete = length > 0.5
        m = np.where(complete, measured / np.where(complete, length, 1.0), self.placeholder)
        Bt = np.swapaxes(make_perpendicular_basis(m), -1, -2)
        facing = 1.0 + np.sum(m * d, axis=-1, keepdims=True)
        scale = 2.0 / np.where(facing > 1e-9, facing, 1e-9)
        residual = scale * (Bt @ d[..., None])[..., 0]
        slopes = scale[..., None] * (Bt - 0.5 * residual[..., None] * m[..., None, :])
        return self.split_columns(residual, slopes @ rows)

    def measure(
        self,
        T: FloatArray,
        noise: FloatArray,
        nuisance: FloatArray | None = None,
        joints: FloatArray | None = None,
    ) -> FloatArray:
        """Return columns (t, r, 3), rotated by noise (t, r, 2) perpendicular to the direction."""
        d = self.locate_direction(T, self.values_or_nominal(nuisance))[0]
        B = make_perpendicular_basis(d)
        rotation = np.cross(d, (B @ noise[..., None])[..., 0])
        return (geometry.exp_so3(rotation) @ d[..., None])[..., 0]
