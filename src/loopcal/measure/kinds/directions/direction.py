# SPDX-License-Identifier: Apache-2.0
"""Kind `direction`: an axis of the platform as a unit vector in a frame, such as the normal of a
probed face.
"""

from dataclasses import dataclass, field
from typing import ClassVar, Self

import numpy as np

from loopcal import geometry
from loopcal.measure.array_checks import check_direction, set_fields
from loopcal.measure.kinds.directions.direction_kind import AxisKind
from loopcal.measure.kinds.rows import Column, Evaluation, InvalidRows, is_incomplete, list_rows
from loopcal.measure.kinds.setup_parameters import make_perpendicular_basis
from loopcal.typing import BoolArray, FloatArray
from loopcal.units import Dimension


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Direction(AxisKind):
    """Direction of an axis. Residual: `2 B'd / (1 + m'd)`, with B two unit vectors perpendicular to
    the measured direction m.

    The residual is twice the tangent of half the angle between the predicted direction d and m,
    along the two vectors B. It equals the angle where that is small, and is unbounded where d is
    opposite to m.

    Setup parameters [rad]: `frame.rx` to `frame.rz`, `axis.u` and `axis.v`.

    Parameters
    ----------
    axis : (3,)
        The axis on the platform, of any length. If the axis is unknown, its nominal value.
    axis_name : str
        Name of the axis; its parameters begin with it.
    Others: see `AxisKind`; "frame" and "axis" may be unknown.

    Raises
    ------
    DataError
        If the length of the axis is zero, the frame is not a pose, or `unknown` lists something
        else.

    Examples
    --------
    >>> kind = Direction(axis=np.array([0.0, 0.0, 1.0]))
    >>> kind.measure(np.eye(4)[None, None], noise=np.zeros((1, 1, 2)))
    array([[[0., 0., 1.]]])
    """

    axis: FloatArray = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    axis_name: str = "axis"

    name: ClassVar[str] = "direction"
    allowed_unknown: ClassVar[tuple[str, ...]] = ("frame", "axis")

    def __post_init__(self) -> None:
        super().__post_init__()
        set_fields(self, axis=check_direction(self.axis, "the axis"))

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

    def find_invalid_rows(self, measured: FloatArray) -> InvalidRows:
        """Return rows with an incomplete direction, or one whose length is not 1."""
        length = np.linalg.norm(measured, axis=-1)
        return list_rows(
            is_incomplete(measured),
            lambda _: "has an incomplete direction; give i, j and k, or none of them",
        ) + list_rows(
            np.abs(length - 1.0) > 1e-3,
            lambda i: f"has a direction of length {length[i]:.6g}; the length must be 1 to 1e-3",
        )

    def predict(self, d: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the direction itself."""
        return d, np.eye(3)

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
        Bt = np.swapaxes(make_perpendicular_basis(m), -1, -2)
        facing = 1.0 + np.sum(m * d, axis=-1, keepdims=True)
        scale = 2.0 / np.where(facing > 1e-9, facing, 1e-9)
        residual = scale * (Bt @ d[..., None])[..., 0]
        slopes = scale[..., None] * (Bt - 0.5 * residual[..., None] * m[..., None, :])
        return self.split_columns(residual, slopes @ rows)

    def _measure(
        self, T: FloatArray, noise: FloatArray, values: FloatArray, joints: FloatArray
    ) -> FloatArray:
        """Return columns (t, r, 3), rotated by noise (t, r, 2) perpendicular to the direction."""
        d, _ = self.locate_direction(T, values)
        rotation = np.cross(d, (make_perpendicular_basis(d) @ noise[..., None])[..., 0])
        return (geometry.exp_so3(rotation) @ d[..., None])[..., 0]
