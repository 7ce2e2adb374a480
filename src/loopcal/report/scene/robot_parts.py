# SPDX-License-Identifier: Apache-2.0
"""The parts of a robot as points and lines in the base frame: limbs, joints, rods, platform, tool.

The placement of links comes from `mechanism.compute_limb_frames`. Figures and the 3-D view draw the
same parts, each in its own style.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from loopcal.engine import State
from loopcal.mechanism import Mechanism, compute_limb_frames, locate_anchors
from loopcal.typing import FloatArray, IntArray

AXIS, GUIDE = 0.06, 0.12
"""Half the length of the axis of a revolute joint, and the length of a guide beyond its slide, both
as a share of the robot's size.
"""

SPHERE, COINCIDENT = (0.3, 0.2), 1e-9
"""Distances of the first and the last joint from the point in which all axes of a spherical limb
meet, and up to which distance points are one, all as shares of the robot's size.
"""

Role = Literal[
    "limb", "axis", "guide", "joint", "slide", "rod", "rod drive", "end",
    "base", "platform", "arm", "frame", "tool",
]  # fmt: skip
"""What a part is: the line along a limb; the axis and the place of a joint; the guide and the place
of a slide; a rod, where it is driven, the end of a limb; the outlines of base and platform; the
line from the platform to the tool, or from the anchors of a triangle drive to its joint; an axis of
a frame; the tool point.
"""

LINES = ("limb", "axis", "guide", "rod", "base", "platform", "arm", "frame")
"""Roles of lines; all others are single points."""

PLANAR = {"x", "y", "rz"}
"""Freedoms of a platform that moves in the x-y plane."""


@dataclass(frozen=True, eq=False)
class Part:
    """A line through m points, or one point, at n poses.

    Attributes
    ----------
    role : one of `Role`. points : (n, m, 3) [m], in the base frame.
    index : number of its limb, or of the axis of a frame; -1 where it belongs to neither.
    is_driven : whether it is a joint, slide or rod with an actuator.
    """

    role: Role
    points: FloatArray
    index: int = -1
    is_driven: bool = False


def is_planar(robot: Mechanism) -> bool:
    """Return whether the platform moves in the x-y plane only: one view shows everything."""
    return set(robot.freedoms) <= PLANAR


def list_parts(robot: Mechanism, state: State) -> tuple[Part, ...]:
    """Return the parts of a robot at n poses: first the line of each limb, in their order.

    Parameters
    ----------
    state : (1, n), of `robot.home_state` or of a solution.
    """
    T = state.T[0]
    limbs = compute_limb_frames(robot, robot.values[None], state)
    frames, traces = zip(*(_arrange_limb(limb[0], robot.size) for limb in limbs), strict=True)
    foot, top = (np.stack([limb[:, j, :3, 3] for limb in frames], axis=1) for j in (0, -1))
    lines = (Part("limb", trace, i) for i, trace in enumerate(traces))
    joints = (part for i, limb in enumerate(frames) for part in _list_joints(robot, i, limb))
    triangles, bodies = _list_triangles(robot, state), _list_bodies(robot, foot, top, T)
    return (*lines, *joints, *triangles, *bodies)


def _arrange_limb(frames: FloatArray, size: float) -> tuple[FloatArray, FloatArray]:
    """Return the frames (n, J + 2, 4, 4) of a limb as they are drawn, and the line (n, m, 3) along
    it.

    Where all axes of a limb meet in one point, its links have no lengths. They are drawn as arcs
    about this point, each joint on its axis, from the motor inwards.
    """
    points, n_joints = frames[:, :, :3, 3], frames.shape[1] - 2
    center = points[:, :1]
    if n_joints < 2 or np.abs(points - center).max() > COINCIDENT * size:
        return frames, points[:, :-1]
    arms = frames[:, :n_joints, :3, 2] * (size * np.linspace(*SPHERE, n_joints))[:, None]
    arranged = frames.copy()
    arranged[:, :n_joints, :3, 3] += arms
    arranged[:, n_joints:, :3, 3] = arranged[:, n_joints - 1, None, :3, 3]
    share = np.linspace(0.0, 1.0, 13)[:, None]
    first, second = arms[:, :-1, None], arms[:, 1:, None]
    chords = (1 - share) * first + share * second
    lengths = [np.linalg.norm(arm, axis=-1, keepdims=True) for arm in (first, second, chords)]
    radius = (1 - share) * lengths[0] + share * lengths[1]
    arcs = chords * (radius / np.maximum(lengths[2], 1e-9 * size))
    return arranged, center + arcs.reshape(len(frames), -1, 3)


def _list_joints(robot: Mechanism, i: int, frames: FloatArray) -> Iterator[Part]:
    """Yield joints and rod of limb i with frames (n, J + 2, 4, 4)."""
    limb, points = robot.assembly.limbs[i], frames[:, :, :3, 3]
    for j, joint in enumerate(limb.joints):
        axis, is_driven = frames[:, j, :3, 2], bool(joint.actuator)
        if joint.kind == "P":
            slid = ((points[:, j + 1] - points[:, j]) * axis).sum(axis=1)
            reach = GUIDE * robot.size
            ends = np.stack([np.minimum(slid, 0.0) - reach, np.maximum(slid, 0.0) + reach], axis=1)
            yield Part("guide", points[:, j, None] + ends[:, :, None] * axis[:, None], i)
            yield Part("slide", (points[:, j] + slid[:, None] * axis)[:, None], i, is_driven)
        else:
            ends = np.array([[-1.0], [1.0]]) * AXIS * robot.size
            yield Part("axis", points[:, j, None] + ends * axis[:, None], i)
            yield Part("joint", points[:, j, None], i, is_driven)
    if limb.ending == "distance":
        is_driven, rod = bool(limb.actuator), points[:, -2:]
        yield Part("rod", rod, i)
        place = rod.mean(axis=1, keepdims=True) if is_driven else rod[:, :1]
        yield Part("rod drive", place, i, is_driven)
    if limb.ending != "rigid":
        yield Part("end", points[:, -1:], i)


def _list_triangles(robot: Mechanism, state: State) -> Iterator[Part]:
    """Yield the linear actuators that turn joints through two anchors."""
    for anchors in locate_anchors(robot, state):
        foot, head = np.moveaxis(anchors.points, 1, 0)
        yield Part("arm", np.stack([foot, anchors.pin, head], axis=1))
        yield Part("rod", anchors.points, anchors.limb)
        yield Part("rod drive", anchors.points.mean(axis=1, keepdims=True), anchors.limb, True)
        yield Part("end", anchors.points[:, 1:], anchors.limb)


def _list_bodies(
    robot: Mechanism, foot: FloatArray, top: FloatArray, T: FloatArray
) -> Iterator[Part]:
    """Yield base and platforms of points (n, k, 3), the frames of base and tool, and the tool."""
    for role, points in _list_outlines(robot, foot, top):
        yield Part(role, points[:, _order_outline(points[0])])
    tool = T @ robot.tool
    yield Part("arm", np.stack([T[:, :3, 3], tool[:, :3, 3]], axis=1))
    for frame in (np.broadcast_to(np.eye(4), T.shape), tool):
        for axis in range(3):
            end = frame[:, :3, 3] + 2 * AXIS * robot.size * frame[:, :3, axis]
            yield Part("frame", np.stack([frame[:, :3, 3], end], axis=1), axis)
    yield Part("tool", tool[:, None, :3, 3])


def _list_outlines(
    robot: Mechanism, foot: FloatArray, top: FloatArray
) -> Iterator[tuple[Role, FloatArray]]:
    """Yield the points (n, k, 3) of base and platforms.

    The platform of a stage has the ends of its limbs, and the feet of the stages that it carries.
    """
    if not robot.stages:
        yield "base", foot
        yield "platform", top
        return
    owner = np.repeat(
        np.arange(len(robot.stages)), [len(s.robot.assembly.limbs) for s in robot.stages]
    )
    parent = np.array([stage.parent for stage in robot.stages])[owner]
    yield "base", foot[:, parent == -1]
    for i in range(len(robot.stages)):
        yield "platform", np.concatenate([top[:, owner == i], foot[:, parent == i]], axis=1)


def _order_outline(points: FloatArray) -> IntArray:
    """Return the order of points (n, 3) by angle about their center, the first again at the end;
    of points on a line their own order.
    """
    offset = points - points.mean(axis=0)
    _, s, V = np.linalg.svd(offset, full_matrices=True)
    if len(points) < 3 or s[1] < 1e-6 * max(s[0], 1e-300):
        return np.arange(len(points))
    order = np.argsort(np.arctan2(offset @ V[1], offset @ V[0]))
    return np.append(order, order[0])
