# SPDX-License-Identifier: Apache-2.0
"""Base of the kinds that measure the robot's tool in the frame of an instrument."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar, Self

import numpy as np

from loopcal import geometry
from loopcal.errors import DataError
from loopcal.geometry.alignment import OCTAHEDRAL_ROTATIONS
from loopcal.measure.array_checks import check_pose
from loopcal.measure.kinds import setup_parameters as setup
from loopcal.measure.kinds.kind import Kind, check_unknown
from loopcal.parameters import Parameter
from loopcal.typing import FloatArray


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class ToolKind(Kind):
    """A kind that measures the tool in the frame of the instrument.

    Parameters
    ----------
    T_base_frame : (4, 4), optional
        Instrument frame in the base; default: the base itself. If the frame is unknown, this is its
        nominal value.
    T_platform_tool : (4, 4), optional
        Tool on the platform; default: the tool of the robot.
    unknown : tuple of str
        Which of "frame" and "tool" are unknown, six numbers each. One value holds for a session.
    frame : str
        Name of the frame. Kinds that use the same name share its parameters.

    Raises
    ------
    DataError
        If a frame is not a pose, or `unknown` lists something else.
    """

    T_base_frame: FloatArray = field(default_factory=lambda: np.eye(4))
    T_platform_tool: FloatArray | None = None
    unknown: tuple[str, ...] = ()
    frame: str = "frame"

    allowed_unknown: ClassVar[tuple[str, ...]] = ("frame", "tool")

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_base_frame", check_pose(self.T_base_frame, "T_base_frame"))
        object.__setattr__(
            self, "unknown", check_unknown(self.unknown, self.allowed_unknown, self.name)
        )
        if self.T_platform_tool is not None:
            object.__setattr__(
                self, "T_platform_tool", check_pose(self.T_platform_tool, "T_platform_tool")
            )

    def with_tool(self, T_platform_tool: FloatArray) -> Self:
        """Return the kind with this tool (4, 4), unless it states one."""
        return self if self.has_tool else replace(self, T_platform_tool=T_platform_tool)

    @property
    def has_tool(self) -> bool:
        """Whether the tool is stated; if the tool is unknown, its nominal value."""
        return self.T_platform_tool is not None

    @property
    def setup_items(self) -> Mapping[str, tuple[Parameter, ...]]:
        """Frame and tool, if unknown, with six parameters each."""
        tool = np.eye(4) if self.T_platform_tool is None else self.T_platform_tool
        stated = {"frame": (self.frame, self.T_base_frame), "tool": ("tool", tool)}
        return {name: setup.make_frame_parameters(*stated[name]) for name in self.unknown}

    @property
    def references(self) -> Mapping[str, FloatArray]:
        """The stated orientations."""
        stated = {
            "frame": (self.frame, self.T_base_frame[:3, :3]),
            "tool": ("tool", self._tool()[:3, :3]),
        }
        return dict(stated[name] for name in self.unknown)

    def predict_tool(self, T: FloatArray, values: FloatArray | None = None) -> FloatArray:
        """Return T_frame_tool (.., 4, 4) at platform poses T (.., 4, 4) and values (.., u) of the
        nuisance parameters.
        """
        frame, tool = self._frames(self.values_or_nominal(values))
        return geometry.invert_pose(frame) @ (T @ tool)

    def linearize_tool(self, T: FloatArray, values: FloatArray | None = None) -> FloatArray:
        """Return the derivative (.., 6, 6 + u) of the tool's twist, in axes of the frame, by the
        platform twist and the nuisance parameters.
        """
        values = self.values_or_nominal(values)
        frame, tool = self._frames(values)
        Q = np.swapaxes(frame[..., :3, :3], -1, -2)
        arm = (T[..., :3, :3] @ tool[..., :3, 3:])[..., 0]
        blocks = {"twist": geometry.transport_matrix(arm, Q)}
        frame_values = self.item_values(values, "frame")
        if frame_values is not None:
            # a motion of the frame is the opposite motion of the tool in that frame
            lever = arm + T[..., :3, 3] - frame[..., :3, 3]
            blocks["frame"] = -geometry.transport_matrix(lever, Q) @ setup.linearize_frame(
                frame_values
            )
        tool_values = self.item_values(values, "tool")
        if tool_values is not None:
            blocks["tool"] = geometry.transport_matrix(
                np.zeros(3), Q @ T[..., :3, :3]
            ) @ setup.linearize_frame(tool_values)
        return self.join_columns(blocks, (*T.shape[:-2], 6))

    def guess_values(self, T: FloatArray, measured: FloatArray) -> FloatArray:
        """Return 24 evenly spread orientations of the frame, with its origin where it is stated."""
        if "frame" not in self.unknown:
            return self.nominal_values[None]
        stated = self.T_base_frame
        frames = geometry.make_pose(OCTAHEDRAL_ROTATIONS @ stated[:3, :3], stated[:3, 3])
        return self.assemble_values({"frame": setup.encode_frame(stated, frames)}, len(frames))

    def _frames(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return frame and tool (.., 4, 4)."""
        frame = setup.place_frame(self.T_base_frame, self.item_values(values, "frame"))
        return frame, setup.place_frame(self._tool(), self.item_values(values, "tool"))

    def _tool(self) -> FloatArray:
        if self.T_platform_tool is None:
            raise DataError(
                f"the kind {self.name!r} has no tool: use kind.with_tool(robot.tool), or state "
                "T_platform_tool (np.eye(4) for the platform itself)"
            )
        return self.T_platform_tool
