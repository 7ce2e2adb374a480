# SPDX-License-Identifier: Apache-2.0
"""What kinds share that see the robot's tool from a known frame."""

from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from loopcal import se3
from loopcal.errors import DataError
from loopcal.measure.arrays import stored_pose
from loopcal.measure.kinds.kind import Column, Kind
from loopcal.units import Dimension

Array = NDArray[np.float64]

POSITION = ("x", "y", "z")


def position_columns() -> tuple[Column, ...]:
    """Columns x y z."""
    return tuple(Column(name, Dimension.LENGTH) for name in POSITION)


@dataclass(frozen=True, eq=False, kw_only=True)
class ToolKind(Kind):
    """A kind that sees the tool in the frame of the instrument, both known.

    Parameters
    ----------
    T_base_frame : (4, 4), optional
        Instrument frame in the base; default: the base itself.
    T_platform_tool : (4, 4), optional
        Tool on the platform; default: the robot's own, filled in by `mounted`.

    Raises
    ------
    DataError
        If one of them is not a pose.
    """

    T_base_frame: Array = field(default_factory=lambda: np.eye(4))
    T_platform_tool: Array | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_base_frame", stored_pose(self.T_base_frame, "T_base_frame"))
        if self.T_platform_tool is not None:
            object.__setattr__(self, "T_platform_tool", stored_pose(self.T_platform_tool, "T_platform_tool"))

    def mounted(self, T_platform_tool: Array) -> Self:
        """The kind with this tool (4, 4), unless it has one of its own."""
        return self if self.is_mounted else replace(self, T_platform_tool=T_platform_tool)

    @property
    def is_mounted(self) -> bool:
        """Whether the tool is known."""
        return self.T_platform_tool is not None

    def seen(self, T: Array) -> Array:
        """T_frame_tool (..., 4, 4) at platform poses T_base_platform (..., 4, 4)."""
        return se3.inverse(self.T_base_frame) @ (T @ self._tool())

    def transport(self, T: Array) -> Array:
        """Map (..., 6, 6) from the platform twist in base axes to the tool's twist in axes of the frame."""
        arm = T[..., :3, :3] @ self._tool()[:3, 3]
        return se3.transport(arm, self.T_base_frame[:3, :3].T)

    def _tool(self) -> Array:
        if self.T_platform_tool is None:
            raise DataError(
                f"the kind {self.name!r} does not know its tool: use kind.mounted(robot.tool),"
                " or state T_platform_tool (np.eye(4) for the platform itself)"
            )
        return self.T_platform_tool
