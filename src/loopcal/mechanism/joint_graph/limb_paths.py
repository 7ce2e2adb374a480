# SPDX-License-Identifier: Apache-2.0
"""Limbs of a mechanism of bodies and joints: paths from base to platform that share nothing else.

Other bodies that branch from the limbs cannot be expressed, with one exception: where they only
keep the platform from turning (the parallelograms of a delta), the freedoms of the platform express
the same, and one path for each motor is left.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from loopcal.mechanism.assembly import AXES
from loopcal.mechanism.joint_graph.graph_blocks import Block
from loopcal.mechanism.joint_graph.graph_joint import GraphJoint
from loopcal.mechanism.joint_graph.home_pose import Freedoms, find_freedoms, list_nearby
from loopcal.mechanism.joint_graph.loop_closure import JointGraph
from loopcal.typing import FloatArray

MOTION = 1e-9
"""Smallest part of a motion that counts [m, rad]; rounding is below 1e-12."""

Path = tuple[GraphJoint, ...]


@dataclass(frozen=True, eq=False)
class LimbPaths:
    """A mechanism as limbs.

    Attributes
    ----------
    graph : its base carries the limbs. home : joint values (j,). platform : its body.
    limbs : joints of each limb, each from the body before it. freedoms : of the platform, in base
        axes. motions : what motors and passive joints can do at home.
    replaced : joints that the freedoms express.
    """

    graph: JointGraph
    home: FloatArray
    platform: str
    limbs: tuple[Path, ...]
    freedoms: tuple[str, ...]
    motions: Freedoms
    replaced: tuple[str, ...] = ()


def find_limbs(block: Block) -> tuple[tuple[Path, ...] | None, bool]:
    """Return the limbs of a block from its base to its platform, and whether they are all of it.

    They are None where a limb branches; limbs that are not all of it need `is_translating`.
    """
    complete = find_complete_limbs(block.graph, block.platform)
    if complete is not None:
        return complete, True
    return _find_driven_limbs(block.graph, block.platform), False


def place_limbs(
    block: Block,
    home: FloatArray,
    limbs: tuple[Path, ...],
    is_complete: bool,
    T_body_frame: FloatArray,
) -> LimbPaths:
    """Return the limbs of a block at its home pose (j,), for a frame (4, 4) of its platform.

    Loops of complete limbs are closed in all components of twist that one of their joints can have,
    so that a planar loop has three equations, and one with a joint across its plane has six.
    """
    graph, platform = block.graph, block.platform
    freedoms = list_freedoms(graph, home, platform, T_body_frame, is_complete)
    limbs = _sort_limbs(limbs, graph.motors)
    used = {joint.name for limb in limbs for joint in limb}
    used |= {joint.origin_b for limb in limbs for joint in limb}
    replaced = tuple(joint.name for joint in graph.joints if joint.name not in used)
    motions = find_freedoms(graph, home, platform)
    limbs = _keep_shifts_in_plane(graph, home, limbs, freedoms)
    return LimbPaths(graph, home, platform, limbs, freedoms, motions, replaced)


def _keep_shifts_in_plane(
    graph: JointGraph, home: FloatArray, limbs: tuple[Path, ...], freedoms: tuple[str, ...]
) -> tuple[Path, ...]:
    """Return limbs without the shifts normal to their plane, which no equation of it contains."""
    normals = [AXES[i + 3] for i in range(3) if AXES[i] in freedoms]
    if len(normals) != 1 or normals[0] in freedoms:
        return limbs
    normal = np.eye(3)[AXES[3:].index(normals[0])]
    placement = graph.place(home[None])

    def keep(joint: GraphJoint) -> GraphJoint:
        R = (graph.get_place(placement, joint.body_a) @ joint.T_a)[0, :3, :3]
        across = [a for a in joint.shifts if abs(normal @ R[:, "xyz".index(a)]) < 1 - MOTION]
        return replace(joint, shifts="".join(across))

    return tuple(tuple(map(keep, limb)) for limb in limbs)


def is_translating(block: Block, home: FloatArray) -> bool:
    """Return whether motors set all freedoms of a platform that does not turn near a home pose."""
    motion = find_freedoms(block.graph, home, block.platform)
    if motion.mobility != len(block.graph.motors):
        return False
    freedoms = list_freedoms(block.graph, home, block.platform, np.eye(4))
    return len(freedoms) == motion.mobility and not any(name.startswith("r") for name in freedoms)


def list_freedoms(
    graph: JointGraph,
    home: FloatArray,
    platform: str,
    T_body_frame: FloatArray,
    of_joints: bool = False,
) -> tuple[str, ...]:
    """Return the components of twist in which a frame of the platform moves, at home or near it.

    With `of_joints`, those in which any joint alone would move it.
    """
    largest = np.zeros(6)
    for q in list_nearby(graph, home):
        motion = graph.find_twists(q, platform, T_body_frame) @ graph.find_motions(q)
        moves = [motion]
        if of_joints:
            moves += _list_joint_twists(graph, q, platform, T_body_frame)
        largest = np.maximum(largest, np.abs(np.column_stack(moves)).max(axis=1, initial=0.0))
    limit = MOTION * np.array([1.0] * 3 + [max(1.0, graph.size)] * 3)
    return tuple(name for name, size in zip(AXES, largest > limit, strict=True) if size)


def _list_joint_twists(
    graph: JointGraph, q: FloatArray, platform: str, T_body_frame: FloatArray
) -> list[FloatArray]:
    """Return the twists (6, 1 or 3) that each joint alone gives a frame of the platform."""
    placement = graph.place(q[None])
    origin = (graph.get_place(placement, platform) @ T_body_frame)[0, :3, 3]
    twists = []
    for joint in graph.joints:
        frame = (graph.get_place(placement, joint.body_a) @ joint.T_a)[0]
        axes = frame[:3, :3] if joint.kind == "S" else (frame[:3, :3] @ joint.axis)[:, None]
        arms = np.cross(axes, origin - frame[:3, 3], axisa=0, axisc=0)
        slides = joint.kind == "P"
        twists.append(np.concatenate([0.0 * axes, axes] if slides else [axes, arms]))
    return twists


def find_complete_limbs(graph: JointGraph, platform: str) -> tuple[Path, ...] | None:
    """Return limbs that contain every body and joint; None where there are none."""
    left, limbs = list(graph.joints), []
    for first in [joint for joint in graph.joints if graph.base in (joint.body_a, joint.body_b)]:
        body, path = graph.base, [first]
        while (body := path[-1].get_other_body(body)) != platform:
            onward = [j for j in graph.joints if j is not path[-1] and body in (j.body_a, j.body_b)]
            if len(onward) != 1 or body == graph.base:
                return None
            path.append(onward[0])
        left = [joint for joint in left if joint not in path]
        limbs.append(_orient_path(path, graph.base))
    return tuple(limbs) if limbs and not left else None


def _sort_limbs(limbs: tuple[Path, ...], motors: tuple[str, ...]) -> tuple[Path, ...]:
    """Return the limbs in the order of their motors, passive ones last."""

    def rank(limb: Path) -> int:
        driven = [motors.index(joint.name) for joint in limb if joint.name in motors]
        return min(driven, default=len(motors))

    return tuple(sorted(limbs, key=rank))


def _find_driven_limbs(graph: JointGraph, platform: str) -> tuple[Path, ...] | None:
    """Return the shortest path through each motor on the base; None where two of them meet."""
    limbs, taken = [], {graph.base}
    for first in [joint for joint in graph.tree if joint.name in graph.motors]:
        path = _find_shortest_path(graph, first, platform)
        if path is None:
            return None
        bodies = {_get_end(path[: i + 1], graph.base) for i in range(len(path) - 1)}
        if taken & bodies:
            return None
        taken |= bodies
        limbs.append(_orient_path(path, graph.base))
    return tuple(limbs)


def _find_shortest_path(graph: JointGraph, first: GraphJoint, platform: str) -> Path | None:
    """Return the shortest path that begins with a joint on the base; None where there is none."""
    if first.body_a != graph.base:
        return None
    queue: list[Path] = [(first,)]
    visited = {graph.base, first.body_b}
    while queue:
        path = queue.pop(0)
        body = _get_end(path, graph.base)
        if body == platform:
            return path
        for joint in graph.joints:
            if body in (joint.body_a, joint.body_b):
                after = joint.get_other_body(body)
                if after not in visited:
                    visited.add(after)
                    queue.append((*path, joint))
    return None


def _orient_path(path: Sequence[GraphJoint], body: str) -> Path:
    """Return the joints of a limb, each from the body before it."""
    oriented = []
    for joint in path:
        oriented.append(joint.orient(body))
        body = joint.get_other_body(body)
    return tuple(oriented)


def _get_end(path: Sequence[GraphJoint], body: str) -> str:
    """Return the body at the end of a path."""
    for joint in path:
        body = joint.get_other_body(body)
    return body
