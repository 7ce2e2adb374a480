# SPDX-License-Identifier: Apache-2.0
"""Loops that close but for the rounded digits of their file.

A planar loop has three closure equations more than joints that could fulfil them: it closes only if
its axes are exactly parallel, which axes written with six digits are not. Where the best pose
leaves no larger gap than the rounding explains, axes that are parallel to within the rounding are
made parallel, and the frames of the closing joints are moved by what is left of the gap. A loop
with fewer equations closes by its joints alone and stays as it is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from loopcal import geometry
from loopcal.mechanism.joint_graph.graph_joint import GraphJoint, turn_between
from loopcal.mechanism.joint_graph.home_pose import approach_closure, list_nearby, measure_gap
from loopcal.mechanism.joint_graph.loop_closure import JointGraph
from loopcal.typing import FloatArray


@dataclass(frozen=True)
class Repair:
    """A mechanism whose loops close exactly.

    Attributes
    ----------
    graph : with closed loops. gap, angle : largest gap of a closure before the repair [m, rad].
    turn : largest rotation of an axis [rad].
    """

    graph: JointGraph
    gap: float = 0.0
    angle: float = 0.0
    turn: float = 0.0


def repair_rounded_loops(graph: JointGraph, rounding: tuple[float, float]) -> Repair:
    """Return a mechanism with loops that close; as it is where they do, or where no repair helps.

    Parameters
    ----------
    rounding : error of its lengths [m] and angles [rad] by the rounding of their numbers.
    """
    unchanged = Repair(graph)
    limit = rounding[1] + rounding[0] / graph.size
    start = np.zeros((1, len(graph.tree)))
    if limit == 0.0 or _can_move(graph, graph.close(start)[0]):
        return unchanged
    q = approach_closure(graph, start)[0]
    if np.abs(graph.linearize(q[None])[0]).max(initial=0.0) > limit:
        return unchanged
    repaired, turn = _align_axes(graph, q, limit)
    if not _can_move(repaired, repaired.close(q[None])[0]):
        return unchanged
    placement = graph.place(q[None])
    gaps = [measure_gap(graph, placement, joint) for joint in graph.closing]
    return Repair(repaired, max(gap for gap, _ in gaps), max(angle for _, angle in gaps), turn)


def _can_move(graph: JointGraph, q: FloatArray) -> bool:
    """Return whether the loops are closed at joint values (j,) and let all motors move."""
    if not np.isfinite(q).all() or graph.find_motions(q).shape[1] < len(graph.motors):
        return False
    return len(list_nearby(graph, q)) > 1


def _align_axes(graph: JointGraph, q: FloatArray, limit: float) -> tuple[JointGraph, float]:
    """Return the mechanism with axes parallel and closures without gaps at joint values (j,).

    Bodies stay in their places. Also returns the largest rotation of an axis [rad].
    """
    placement = graph.place(q[None])
    frames = {
        joint: (graph.get_place(placement, joint.body_a) @ joint.T_a)[0] for joint in graph.joints
    }
    moving = [joint for joint in graph.joints if joint.kind != "S"]
    axes = {joint: frames[joint][:3, :3] @ joint.axis for joint in moving}
    known = list(np.eye(3))
    aligned = {}
    for joint in sorted(moving, key=lambda joint: joint.kind == "P"):
        normals = [aligned[other] for other in aligned if other.kind == "R"]
        aligned[joint] = _align(axes[joint], known, normals if joint.kind == "P" else [], limit)
        known.append(aligned[joint])
    tree = {joint.name: float(value) for joint, value in zip(graph.tree, q, strict=True)}

    def move(joint: GraphJoint) -> GraphJoint:
        A, B = (graph.get_place(placement, body)[0] for body in (joint.body_a, joint.body_b))
        frame, far = frames[joint].copy(), B @ joint.T_b
        if joint.kind == "S":
            far[:3, 3] = frame[:3, 3]
            return replace(joint, T_b=geometry.invert_pose(B) @ far)
        frame[:3, :3] = turn_between(axes[joint], aligned[joint]) @ frame[:3, :3]
        near = replace(joint, T_a=geometry.invert_pose(A) @ frame, T_b=np.eye(4))
        if joint in graph.tree:
            value = tree[joint.name]
        elif joint.kind == "R":
            value = float(geometry.log_so3(frame[:3, :3].T @ far[:3, :3]) @ joint.axis)
        else:
            value = float((far[:3, 3] - frame[:3, 3]) @ aligned[joint])
        # the far frame is where the joint moves the near one
        far = A @ near.move(np.array(value))
        return replace(near, T_b=geometry.invert_pose(B) @ far)

    turned = replace(
        graph,
        tree=tuple(move(joint) for joint in graph.tree),
        closing=tuple(move(joint) for joint in graph.closing),
    )
    turns = [np.linalg.norm(np.cross(axes[joint], aligned[joint])) for joint in moving]
    return turned, float(max(turns, default=0.0))


def _align(
    axis: FloatArray, known: list[FloatArray], normals: list[FloatArray], limit: float
) -> FloatArray:
    """Return the known direction (3,) that an axis is parallel to within a limit [rad], or itself.

    Else it is put across the first of the normals that it is almost across.
    """
    for other in known:
        if np.linalg.norm(np.cross(axis, other)) <= limit:
            return other if axis @ other > 0 else -other
    for normal in normals:
        if abs(axis @ normal) <= limit:
            across = axis - normal * (normal @ axis)
            return np.asarray(across / np.linalg.norm(across), dtype=np.float64)
    return axis
