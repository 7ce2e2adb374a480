# SPDX-License-Identifier: Apache-2.0
"""Base of the kinds that touch a surface with points of the platform.

The columns are gaps between point and surface. A gap is 0 where a probe just touches, after
correction for its ball and its deflection. Rows of one group share the parameters of the surface.
"""

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar

import numpy as np

from loopcal.measure.array_checks import check_array, check_direction, set_fields
from loopcal.measure.kinds import setup_parameters as setup
from loopcal.measure.kinds.points.target_kind import TargetKind
from loopcal.parameters import Parameter
from loopcal.typing import FloatArray
from loopcal.units import Dimension


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
    Others: see `TargetKind`; "frame", "surface" and "targets" (the offsets of the probe) may be
    unknown. Faces of a body with known dimensions, such as a datum cube, are known surfaces in one
    unknown frame.

    Raises
    ------
    DataError
        As `TargetKind`, and if the length of a direction is zero.
    """

    through: FloatArray = field(default_factory=lambda: np.zeros(3))
    along: FloatArray = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    surface: str = "surface"

    allowed_unknown: ClassVar[tuple[str, ...]] = ("frame", "surface", "targets")
    changes_with_pose: ClassVar[bool] = False
    measures_points: ClassVar[bool] = False
    length_error: ClassVar[str] = "gap"

    def __post_init__(self) -> None:
        super().__post_init__()
        through = check_array(self.through, "the point of the surface", (3,))
        along = check_direction(self.along, "the direction of the surface")
        set_fields(self, through=through, along=along)

    @property
    @abstractmethod
    def surface_parameters(self) -> tuple[Parameter, ...]:
        """The parameters of the surface; rows of one group share them."""

    @cached_property
    def possible_setup(self) -> Mapping[str, setup.SetupItem]:
        """Also the surface."""
        stated = {f"{self.surface}.through": self.through, f"{self.surface}.along": self.along}
        return {
            **super().possible_setup,
            "surface": setup.SetupItem(self.surface_parameters, stated),
        }

    def make_parameters(
        self, names: tuple[str, ...], dimension: Dimension, nominal: FloatArray | None = None
    ) -> tuple[Parameter, ...]:
        """Return parameters of the surface with these names."""
        return setup.make_parameters(self.surface, names, dimension, nominal, "group")

    def collect_contacts(
        self, T: FloatArray, measured: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return points (q, 3) in the frame, for targets at their stated places, and gaps."""
        _, _, points, gaps = self.collect_points(T, measured)
        return self.to_frame(points), gaps
