# SPDX-License-Identifier: Apache-2.0
"""Base of the kinds that touch a surface with points of the platform.

The columns are gaps between point and surface. A gap is 0 where a probe just touches, after
correction for its ball and its deflection. Rows of one group share the parameters of the surface.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from loopcal.measure.array_checks import check_array, check_direction
from loopcal.measure.kinds.points.target_kind import TargetKind
from loopcal.typing import FloatArray


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class SurfaceKind(TargetKind):
    """A kind that touches a surface, which is stated by a point and a direction.

    Parameters
    ----------
    through : (3,) [m]
        A point of the surface (of a sphere: its center) in the frame. If the surface is unknown,
        its nominal value.
    along : (3,)
        Normal of a plane or direction of a line, in the frame; of any length.
    surface : str
        Name of the surface; its parameters begin with it. A plane and a line with the same name,
        point and direction share `u` and `v`: the line is perpendicular to the plane.
    Others: see `TargetKind`; "surface" and "targets" (the offsets of the probe) may be unknown.

    Raises
    ------
    DataError
        As `TargetKind`, and if the length of a direction is zero.
    """

    through: FloatArray = field(default_factory=lambda: np.zeros(3))
    along: FloatArray = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    surface: str = "surface"

    allowed_unknown: ClassVar[tuple[str, ...]] = ("surface", "targets")
    changes_with_pose: ClassVar[bool] = False

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(
            self, "through", check_array(self.through, "the point of the surface", (3,))
        )
        object.__setattr__(
            self, "along", check_direction(self.along, "the direction of the surface")
        )

    @property
    def references(self) -> Mapping[str, FloatArray]:
        """The stated point and direction."""
        if "surface" not in self.unknown:
            return {}
        return {f"{self.surface}.through": self.through, f"{self.surface}.along": self.along}

    def collect_contacts(
        self, T: FloatArray, measured: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return points (q, 3) in the frame, for targets at their stated places, and gaps."""
        _, _, points, gaps = self.collect_points(T, measured)
        return (points - self.T_base_frame[:3, 3]) @ self.T_base_frame[:3, :3], gaps
