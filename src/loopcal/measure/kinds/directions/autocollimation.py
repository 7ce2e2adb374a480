# SPDX-License-Identifier: Apache-2.0
"""Kind `autocollimation`: two angles of a mirror on the platform against the optical axis of an
autocollimator.
"""

from dataclasses import dataclass, field
from typing import ClassVar, Self

import numpy as np

from loopcal.measure.array_checks import check_direction, set_fields
from loopcal.measure.kinds.camera_angles import convert_camera_angles, predict_camera_angles
from loopcal.measure.kinds.directions.direction_kind import AxisKind
from loopcal.measure.kinds.rows import Column, InvalidRows
from loopcal.typing import FloatArray
from loopcal.units import Dimension


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Autocollimation(AxisKind):
    """Angles of a mirror's normal. Residual: differences of `atan2(d_x, d_z)` and `atan2(d_y,
    d_z)`, wrapped.

    d is the normal of the mirror in the frame of the instrument. The z axis of that frame is the
    optical axis and has the direction of the normal, towards the instrument. Angles are those of
    the mirror. An instrument that states angles of the reflected beam states twice these values.

    Setup parameters [rad]: `frame.rx` to `frame.rz`, `mirror.u` and `mirror.v`.

    Parameters
    ----------
    normal : (3,)
        Normal of the mirror on the platform, of any length. If the mirror is unknown, its nominal
        value.
    mirror : str
        Name of the mirror; its parameters begin with it.
    Others: see `AxisKind`; "frame" and "mirror" may be unknown.

    Raises
    ------
    DataError
        If the length of the normal is zero, the frame is not a pose, or `unknown` lists something
        else.

    Examples
    --------
    >>> from loopcal.geometry import make_pose, rotation_about_axis
    >>> T = make_pose(rotation_about_axis(0.01, 1), np.zeros(3))
    >>> Autocollimation().measure(T[None, None], noise=np.zeros((1, 1, 2))).round(6)
    array([[[0.01, 0.  ]]])
    """

    normal: FloatArray = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    mirror: str = "mirror"

    name: ClassVar[str] = "autocollimation"
    allowed_unknown: ClassVar[tuple[str, ...]] = ("frame", "mirror")

    def __post_init__(self) -> None:
        super().__post_init__()
        set_fields(self, normal=check_direction(self.normal, "the normal of the mirror"))

    @classmethod
    def examples(cls) -> tuple[Self, ...]:
        """Return a mirror along z, and an unknown mirror in an unknown frame."""
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
        """Return both angles (.., 2) and their derivatives (.., 2, 3)."""
        return predict_camera_angles(d)

    def convert_to_directions(self, measured: FloatArray) -> tuple[FloatArray, ...]:
        """Return the normals of two angles, towards the instrument."""
        return (convert_camera_angles(measured),)

    def find_invalid_rows(self, measured: FloatArray) -> InvalidRows:
        """Return rows whose mirror faces away from the instrument."""
        away = np.argwhere(np.abs(measured) >= np.pi / 2)
        sentence = (
            "has an angle of {:.6g} deg, at which the mirror faces away from the instrument; check "
            "the unit"
        )
        return tuple((int(i), sentence.format(np.rad2deg(measured[i, j]))) for i, j in away)
