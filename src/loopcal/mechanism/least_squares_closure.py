# SPDX-License-Identifier: Apache-2.0
"""Derivatives of the platform where loops stay open: those of the least-squares closure.

Unknowns u are the freedoms of all nodes and the passive joints, inputs z the displacements and the
driven joints. A Gauss-Newton step s(u, z) of an engine vanishes at a solution, whatever gap it
leaves, so that

    ds/du du/dz = -ds/dz.

Steps contain the change of the slopes times the gap, which linearized closure leaves out. The
derivatives of s are central differences of the steps from displaced solutions, with an error of
about 4e-10. Where the loops close, linearized closure is exact.
Derivation: docs/theory/kinematics.md.
"""

from __future__ import annotations

import numpy as np

from loopcal import engine, geometry
from loopcal.engine import PITCH, Program, State
from loopcal.mechanism.actuation import differentiate_driven_joints, drive_joints
from loopcal.mechanism.limb_rows import differentiate_displacements
from loopcal.mechanism.model import Mechanism, ParameterUnits
from loopcal.mechanism.transmission import invert_weights
from loopcal.typing import BoolArray, FloatArray

POSES = 64  # poses of a trial that are displaced together
CHANGE = 5e-6
"""Change of a central difference, relative to the robot's size or as an angle [rad].

Its error is about the square of the change, and the rounding of 1e-16 over the change.
"""
CLOSED = 1e-12  # gap of the loops, relative to the robot's size, below which they are closed


def find_open_loops(robot: Mechanism, state: State) -> BoolArray:
    """Return where a least-squares closure leaves a gap (t, n)."""
    is_asked = robot.program.may_stay_open and not robot.has_open_sums
    return is_asked & (state.residual > CLOSED * robot.size)


def list_unknown_joints(program: Program) -> list[tuple[int, int, int]]:
    """Return group, limb in it and number of each joint that closure determines."""
    return [
        (g, k, joint)
        for g, group in enumerate(program.groups)
        for k in range(len(group.limbs))
        for joint in group.unknown_joints(False)
    ]


def differentiate_unknowns(
    robot: Mechanism, values: FloatArray, q: FloatArray, state: State, columns: ParameterUnits
) -> FloatArray:
    """Differentiate the unknowns of a least-squares closure, (t, n, u, p + a), by parameters and
    readings: the freedoms of all nodes, then the joints of `list_unknown_joints`; NaN at singular
    poses.
    """
    e, _, driven = drive_joints(robot, values, q)
    displacements = columns.select(differentiate_displacements(robot, values))
    joints = columns.select(differentiate_driven_joints(robot, values, q))
    (t, n), w = state.T.shape[:2], joints.shape[3]
    e, displacements = (np.broadcast_to(a, (t, *a.shape[1:])) for a in (e, displacements))
    driven, joints = (np.broadcast_to(a, (t, n, *a.shape[2:])) for a in (driven, joints))
    u = len(robot.program.unknown_twists) + len(list_unknown_joints(robot.program))
    out = np.empty((t, n, u, w))
    for i in range(t):
        for first in range(0, n, POSES):
            rows = i, slice(first, first + POSES)
            start = state.map(lambda a, rows=rows: a[rows])
            slopes = _difference_steps(
                robot, e[i], driven[rows], start, displacements[i], joints[rows]
            )
            out[rows] = -np.matmul(invert_weights(slopes[..., :u]), slopes[..., u:])
    return out


def _difference_steps(
    robot: Mechanism,
    e: FloatArray,
    q: FloatArray,
    state: State,
    displacements: FloatArray,
    joints: FloatArray,
) -> FloatArray:
    """Return the derivatives (n, u, u + w) of the steps of one trial by unknowns and w inputs, p of
    which are parameters, of arrays without the axis t: displacements (d, p) and driven joints (n,
    J, w) by the inputs, at e (d,) and q (n, J).
    """
    program, size, p, w = robot.program, robot.size, displacements.shape[1], joints.shape[2]
    twists, passive = program.unknown_twists, list_unknown_joints(program)
    letters = [program.groups[g].joints[j] for g, _, j in passive]
    turns = [f < 3 for _, f in twists] + [letter == "R" for letter in letters]
    M, u = len(twists), len(turns)
    # lengths that a unit of each direction counts for, an angle at the robot's size
    slots = [slot for group in program.groups for _ in group.limbs for slot in group.slots]
    units = np.array([[size if slot.axis < 3 or slot.axis == PITCH else 1.0] for slot in slots])
    lengths = np.concatenate([np.where(turns, size, 1.0), np.zeros(w)])
    driven = np.nan_to_num(np.abs(joints), posinf=0.0) * robot.joint_units[:, None]
    lengths[u:] = driven.max(axis=(0, 1), initial=0.0)
    moved = (np.abs(displacements) * units.reshape(-1, 1)).max(axis=0, initial=0.0)
    lengths[u : u + p] = np.maximum(lengths[u : u + p], moved)
    change = CHANGE * size / np.maximum(lengths, 1e-300)
    change = np.concatenate([change, -change])
    E, Q = (np.repeat(a[None], len(change), axis=0) for a in (e, q))
    start = state.map(lambda a: np.repeat(a[None], len(change), axis=0))
    nodes = (start.T, *start.others)
    for i, h in enumerate(change):
        place = i % (u + w)
        if place < M:
            node, f = twists[place]
            nodes[node][i] = geometry.apply_twist(nodes[node][i], h * np.eye(6)[f])
        elif place < u:
            g, k, j = passive[place - M]
            start.joints[g][i, :, k, j] += h
        else:
            Q[i] += h * joints[..., place - u]
            if place < u + p:
                E[i] += h * displacements[:, place - u]
    end = engine.solve(program, E, Q, start, max_iterations=1)
    ends = (end.T, *end.others)
    steps = [geometry.pose_difference(ends[node], nodes[node])[..., f] for node, f in twists]
    steps += [(end.joints[g][:, :, k, j] - start.joints[g][:, :, k, j]) for g, k, j in passive]
    slopes = np.stack(steps, axis=2) / (2 * change)[:, None, None]
    return np.moveaxis(slopes[: u + w] + slopes[u + w :], 0, 2)
