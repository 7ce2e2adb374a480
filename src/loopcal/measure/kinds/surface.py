# SPDX-License-Identifier: Apache-2.0
"""What kinds share that touch a surface with points of the platform; rows of one group share the
surface's unknowns.

The columns are gaps between point and surface, 0 where a probe just touches and its ball and
deflection are dealt with.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from loopcal.errors import DataError
from loopcal.measure.arrays import stored
from loopcal.measure.kinds.target import TargetKind, points_of
from loopcal.typing import FloatArray


@dataclass(frozen=True, eq=False, kw_only=True)
class SurfaceKind(TargetKind):
    """A kind that touches a surface through or about a stated point, along or across a stated
    direction.

    Parameters
    ----------
    through : (3,) [m]
        A point of the surface (a sphere: its centre) in the frame. Where the surface is unknown,
        the value it is counted from.
    along : (3,)
        Normal of a plane, direction of a line, in the frame; of any length.
    surface : str
        Name of the surface; its unknowns are called after it. A plane and a line of one name,
        stated alike, share `u` and `v`: the line is perpendicular to the plane.
    Others: see `TargetKind`; "surface" and "targets" (the probe's offsets) may be unknown.

    Raises
    ------
    DataError
        As `TargetKind`, and if a direction has no length.
    """

    through: FloatArray = field(default_factory=lambda: np.zeros(3))
    along: FloatArray = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    surface: str = "surface"

    allowed_unknown: ClassVar[tuple[str, ...]] = ("surface", "targets")
    changes_with_pose: ClassVar[bool] = False

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "through", stored(self.through, "the point of the surface", (3,)))
        object.__setattr__(
            self, "along", stored_direction(self.along, "the direction of the surface")
        )

    @property
    def references(self) -> Mapping[str, FloatArray]:
        """The stated point and direction."""
        if "surface" not in self.unknown:
            return {}
        return {f"{self.surface}.through": self.through, f"{self.surface}.along": self.along}

    def touched(self, T: FloatArray, measured: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Points (q, 3) in the frame, targets where they are stated, and their gaps (q, g)."""
        _, _, points, seen = points_of(self, T, measured)
        return (points - self.T_base_frame[:3, 3]) @ self.T_base_frame[:3, :3], seen


def stored_direction(value: FloatArray, what: str) -> FloatArray:
    """Read-only unit vector (3,) along a vector; DataError where it has no length."""
    vector = stored(value, what, (3,))
    length = float(np.linalg.norm(vector))
    if not length > 0.0:
        raise DataError(
            f"{what} is 0, 0, 0, which points nowhere; give a vector of any length but zero"
        )
    unit = vector / length
    # one that is of length one already must come back as it was written
    return vector if abs(length - 1.0) < 1e-15 else stored(unit, what, (3,))
