# SPDX-License-Identifier: Apache-2.0
"""Base of the kinds that measure the robot's tool in the frame of an instrument."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar, Self

import numpy as np

from loopcal import geometry
from loopcal.errors import DataError
from loopcal.geometry.alignment import OCTAHEDRAL_ROTATIONS
from loopcal.measure.array_checks import check_pose, set_fields
from loopcal.measure.kinds import setup_parameters as setup
from loopcal.measure.kinds.kind import Kind
from loopcal.typing import FloatArray

SMALL_TILT = 0.05
"""Measured tilt [rad] below which the normal replaces phi and theta; the noise of phi is twenty
times that of theta there.
"""


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
    length_error: ClassVar[str] = "position"
    angle_error: ClassVar[str] = "orientation"

    def __post_init__(self) -> None:
        super().__post_init__()
        set_fields(self, T_base_frame=check_pose(self.T_base_frame, "T_base_frame"))
        if self.T_platform_tool is not None:
            tool = check_pose(self.T_platform_tool, "T_platform_tool")
            set_fields(self, T_platform_tool=tool)

    def with_tool(self, T_platform_tool: FloatArray) -> Self:
        """Return the kind with this tool (4, 4), unless it states one."""
        return self if self.has_tool else replace(self, T_platform_tool=T_platform_tool)

    @property
    def has_tool(self) -> bool:
        """Whether the tool is stated; if the tool is unknown, its nominal value."""
        return self.T_platform_tool is not None

    @cached_property
    def possible_setup(self) -> Mapping[str, setup.SetupItem]:
        """Frame and tool, with six parameters each."""
        tool = np.eye(4) if self.T_platform_tool is None else self.T_platform_tool
        return {
            "frame": setup.make_frame_item(self.frame, self.T_base_frame),
            "tool": setup.make_frame_item("tool", tool),
        }

    def locate_tool(self, T: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return T_frame_tool (.., 4, 4) at platform poses T (.., 4, 4), and the derivative
        (.., 6, 6 + u) of its twist, in axes of the frame, by the platform twist and the values.
        """
        if self.measures_platform:
            return T, np.broadcast_to(np.eye(6), (*T.shape[:-2], 6, 6))
        of_frame, of_tool = (self.item_values(values, name) for name in ("frame", "tool"))
        frame = setup.place_frame(self.T_base_frame, of_frame)
        tool = setup.place_frame(self.stated_tool, of_tool)
        inverse = self._stated_inverse if of_frame is None else geometry.invert_pose(frame)
        Q, R = inverse[..., :3, :3], T[..., :3, :3]
        arm = (R @ tool[..., :3, 3:])[..., 0]
        blocks = {"twist": geometry.transport_matrix(arm, Q)}
        if of_frame is not None:
            # a motion of the frame is the opposite motion of the tool in that frame
            lever = arm + T[..., :3, 3] - frame[..., :3, 3]
            by_twist = -geometry.transport_matrix(lever, Q)
            blocks["frame"] = by_twist @ setup.linearize_frame(of_frame)
        if of_tool is not None:
            by_twist = geometry.transport_matrix(np.zeros(3), Q @ R)
            blocks["tool"] = by_twist @ setup.linearize_frame(of_tool)
        return inverse @ (T @ tool), self.join_columns(blocks, (*T.shape[:-2], 6))

    @cached_property
    def measures_platform(self) -> bool:
        """Whether the tool and the frame are those of platform and base, and known to be."""
        same = all(np.array_equal(a, np.eye(4)) for a in (self.T_base_frame, self.stated_tool))
        return same and not self.own_items

    @cached_property
    def _stated_inverse(self) -> FloatArray:
        """The pose (4, 4) of the base in the stated frame."""
        return geometry.invert_pose(self.T_base_frame)

    def guess_values(self, T: FloatArray, measured: FloatArray) -> FloatArray:
        """Return 24 evenly spread orientations of the frame, with its origin where it is stated."""
        if "frame" not in self.unknown:
            return self.nominal_values[None]
        stated = self.T_base_frame
        frames = geometry.make_pose(OCTAHEDRAL_ROTATIONS @ stated[:3, :3], stated[:3, 3])
        return self.assemble_values({"frame": setup.encode_frame(stated, frames)})

    @property
    def stated_tool(self) -> FloatArray:
        """The stated tool (4, 4); DataError where the kind has none."""
        if self.T_platform_tool is None:
            raise DataError(
                f"the kind {self.name!r} has no tool: use kind.with_tool(robot.tool), or state "
                "T_platform_tool (np.eye(4) for the platform itself)"
            )
        return self.T_platform_tool
