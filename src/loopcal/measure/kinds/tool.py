# SPDX-License-Identifier: Apache-2.0
"""What kinds share that see the robot's tool from a frame; both may be known or not."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar, Self

import numpy as np

from loopcal import geometry
from loopcal.errors import DataError
from loopcal.measure.arrays import stored_pose
from loopcal.measure.closed_form import OCTAHEDRAL
from loopcal.measure.kinds import parts
from loopcal.measure.kinds.kind import Column, Kind, chosen
from loopcal.parameters import Parameter
from loopcal.typing import FloatArray
from loopcal.units import Dimension

POSITION = ("x", "y", "z")


def position_columns() -> tuple[Column, ...]:
    """Columns x y z."""
    return tuple(Column(name, Dimension.LENGTH) for name in POSITION)


@dataclass(frozen=True, eq=False, kw_only=True)
class ToolKind(Kind):
    """A kind that sees the tool in the frame of the instrument.

    Parameters
    ----------
    T_base_frame : (4, 4), optional
        Instrument frame in the base; default: the base itself. Where unknown, the value it is
        counted from.
    T_platform_tool : (4, 4), optional
        Tool on the platform; default: the robot's own, filled in by `with_tool`.
    unknown : tuple of str
        Which of "frame" and "tool" are unknown, six numbers each, one value for a session.
    frame : str
        Name of the frame; kinds that name the same one share its unknowns.

    Raises
    ------
    DataError
        If one of them is not a pose, or something else is said to be unknown.
    """

    T_base_frame: FloatArray = field(default_factory=lambda: np.eye(4))
    T_platform_tool: FloatArray | None = None
    unknown: tuple[str, ...] = ()
    frame: str = "frame"

    allowed_unknown: ClassVar[tuple[str, ...]] = ("frame", "tool")

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_base_frame", stored_pose(self.T_base_frame, "T_base_frame"))
        object.__setattr__(self, "unknown", chosen(self.unknown, self.allowed_unknown, self.name))
        if self.T_platform_tool is not None:
            object.__setattr__(
                self, "T_platform_tool", stored_pose(self.T_platform_tool, "T_platform_tool")
            )

    def with_tool(self, T_platform_tool: FloatArray) -> Self:
        """The kind with this tool (4, 4), unless it has one of its own."""
        return self if self.has_tool else replace(self, T_platform_tool=T_platform_tool)

    @property
    def has_tool(self) -> bool:
        """Whether the tool is known, or what its unknowns are counted from."""
        return self.T_platform_tool is not None

    @property
    def setup_items(self) -> Mapping[str, tuple[Parameter, ...]]:
        """Six unknowns for each of frame and tool, as far as they are unknown."""
        tool = np.eye(4) if self.T_platform_tool is None else self.T_platform_tool
        stated = {"frame": (self.frame, self.T_base_frame), "tool": ("tool", tool)}
        return {name: parts.frame_part(*stated[name]) for name in self.unknown}

    @property
    def references(self) -> Mapping[str, FloatArray]:
        """The stated orientations."""
        stated = {
            "frame": (self.frame, self.T_base_frame[:3, :3]),
            "tool": ("tool", self._tool()[:3, :3]),
        }
        return dict(stated[name] for name in self.unknown)

    def seen(self, T: FloatArray, values: FloatArray | None = None) -> FloatArray:
        """T_frame_tool (.., 4, 4) at platform poses T_base_platform (.., 4, 4) and values (.., u)
        of the unknowns.
        """
        frame, tool = self._places(self.values(values))
        return geometry.invert_pose(frame) @ (T @ tool)

    def transport(self, T: FloatArray, values: FloatArray | None = None) -> FloatArray:
        """Map (.., 6, 6 + u) to the tool's twist in axes of the frame, from platform twist and
        unknowns.
        """
        values = self.values(values)
        frame, tool = self._places(values)
        Q = np.swapaxes(frame[..., :3, :3], -1, -2)
        arm = (T[..., :3, :3] @ tool[..., :3, 3:])[..., 0]
        blocks = {"twist": geometry.transport_matrix(arm, Q)}
        own = self.item_values(values, "frame")
        if own is not None:
            # what moves the frame moves the tool the other way, seen from it
            lever = arm + T[..., :3, 3] - frame[..., :3, 3]
            blocks["frame"] = -geometry.transport_matrix(lever, Q) @ parts.frame_slope(own)
        own = self.item_values(values, "tool")
        if own is not None:
            blocks["tool"] = geometry.transport_matrix(
                np.zeros(3), Q @ T[..., :3, :3]
            ) @ parts.frame_slope(own)
        return self.columns_of(blocks, (*T.shape[:-2], 6))

    def guess_values(self, T: FloatArray, measured: FloatArray) -> FloatArray:
        """The frame in 24 orientations, spread evenly over all, with the frame's origin where it is
        stated.
        """
        if "frame" not in self.unknown:
            return self.nominal_values[None]
        frames = geometry.make_pose(
            OCTAHEDRAL @ self.T_base_frame[:3, :3], self.T_base_frame[:3, 3]
        )
        return stacked(self, {"frame": parts.frame_values(self.T_base_frame, frames)}, len(frames))

    def _places(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Frame and tool (.., 4, 4)."""
        frame = parts.frame_at(self.T_base_frame, self.item_values(values, "frame"))
        return frame, parts.frame_at(self._tool(), self.item_values(values, "tool"))

    def _tool(self) -> FloatArray:
        if self.T_platform_tool is None:
            raise DataError(
                f"the kind {self.name!r} does not know its tool: use kind.with_tool(robot.tool),"
                " or state T_platform_tool (np.eye(4) for the platform itself)"
            )
        return self.T_platform_tool


def stacked(kind: Kind, found: Mapping[str, FloatArray], count: int) -> FloatArray:
    """Candidates (count, u) from values (count, w) or (w,) of some parts; the others stay nominal."""
    columns = []
    for name, parameters in kind.setup_items.items():
        nominal = np.array([p.nominal for p in parameters])
        columns.append(np.broadcast_to(found.get(name, nominal), (count, len(parameters))))
    return np.concatenate(columns, axis=-1)
