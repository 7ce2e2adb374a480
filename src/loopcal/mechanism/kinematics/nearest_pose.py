# SPDX-License-Identifier: Apache-2.0
"""The reachable pose nearest to a full pose that a machine with fewer freedoms cannot take.

Gauss-Newton on |log(R R*')|^2 size^2 + |t - t*|^2 along the controlled coordinates, with slopes
from closure linearized with every actuator free. Steps begin at the pose before them and are
limited, so that they need no path. A step that does not lower the distance, or leads out of reach,
is halved. Source: docs/theory/kinematics.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from loopcal import engine, geometry
from loopcal.engine import State
from loopcal.mechanism.closure.limb_rows import stack_platform_rows
from loopcal.mechanism.kinematics.batch_kinematics import (
    close_at_coordinates,
    compute_readings,
    needs_readings,
)
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.platform_coordinates import compare_coordinates, read_coordinates
from loopcal.mechanism.sensitivity import differentiate_pose
from loopcal.mechanism.states import Status, is_closed, replace_rows, reshape_rows, select_poses
from loopcal.numerics.gauss_newton import Halving, minimize_by_halving
from loopcal.typing import FloatArray

PROJECTION_STEPS, ITERATIONS = 20, 12
"""Gauss-Newton steps of a projection, and Newton steps of each: it begins close to its solution."""
ATTEMPTS = 5
"""Lengths that are tried for a step, the shortest 1/16 of it: a row ends where none of them lowers
its distance, as at the end of the reach."""
LONGEST_STEP, SHORT_STEP = 0.5, 1e-12
"""The longest step, which is half a radian, and the one after which a row ends, relative to the
robot's size."""
SHORT_SHARE = 1e-9
"""The last step changes the distance from the target by this share to first order."""
STATIONARY = 1e-6
"""A pose is the nearest one where a step changes the distance by at most this share to first order,
or by this share of `REACHED`, where the target itself is reachable."""
REACHED = 1e-3
"""Distance below which a target counts as reachable, relative to the robot's size."""


@dataclass(frozen=True, eq=False)
class _Point:
    """States (1, n), their differences (n, 6) from the targets in lengths [m], and the sums of
    their squares (n,) [m^2], infinite where the loops are open.
    """

    state: State
    gap: FloatArray
    cost: FloatArray


@dataclass(frozen=True, eq=False)
class _Step:
    """Twists (n, 6) [rad, m], their squared change (n,) of the differences to first order [m^2],
    and the share (n, 1) that is no longer than the longest step.
    """

    twist: FloatArray
    change: FloatArray
    share: FloatArray


def find_nearest_reachable(
    robot: Mechanism, values: FloatArray, T: FloatArray, start: State | None = None
) -> State:
    """Return states (1, n) with the reachable poses nearest to T (1, n, 4, 4), without signs.

    values : (1, p). A row whose search ends before the distance is stationary, at the end of the
    reach or after too many steps, is `NOT_CONVERGED`.
    """
    state = close_at_coordinates(robot, values, read_coordinates(T, robot.controlled), start)
    if controls_all(robot) or not state.T.size:
        return state
    control = Halving(
        steps=PROJECTION_STEPS,
        attempts=ATTEMPTS,
        relative=SHORT_SHARE,
        absolute=SHORT_STEP * robot.size,
    )
    propose = partial(_propose, robot, values)
    point, _ = minimize_by_halving(
        _measure(robot, state, T), propose, partial(_move, robot, values, T), control
    )
    smallest = np.maximum(point.cost, (REACHED * robot.size) ** 2)
    is_nearest = propose(point).change <= STATIONARY**2 * smallest
    ended_early = is_closed(point.state.status) & ~is_nearest
    unfinished = np.int8(Status.NOT_CONVERGED)
    status = np.where(ended_early, unfinished, point.state.status)
    return replace(point.state, status=status)


def _measure(robot: Mechanism, state: State, T: FloatArray) -> _Point:
    """Return states (1, n) with their differences from poses T (1, n, 4, 4)."""
    gap = (geometry.pose_difference(state.T, T) * robot.twist_scale)[0]
    cost = np.where(is_closed(state.status[0]), (gap**2).sum(axis=1), np.inf)
    return _Point(state, gap, cost)


def _propose(robot: Mechanism, values: FloatArray, point: _Point) -> _Step:
    """Return the Gauss-Newton steps of all rows; zero where the loops are open."""
    slope = differentiate_by_coordinates(robot, values, point.state)[0]
    slope = np.where(np.isfinite(point.cost)[:, None, None], np.nan_to_num(slope), 0.0)
    scaled = slope * robot.twist_scale[:, None]
    step = np.linalg.pinv(scaled) @ np.nan_to_num(-point.gap)[..., None]
    change = np.matmul(scaled, step)[..., 0]
    limit = LONGEST_STEP * robot.size
    share = limit / np.maximum(np.abs(step[..., 0]).max(axis=1, keepdims=True), limit)
    return _Step(np.matmul(slope, step)[..., 0], (change**2).sum(axis=1), share)


def _move(
    robot: Mechanism,
    values: FloatArray,
    T: FloatArray,
    point: _Point,
    step: _Step,
    share: FloatArray,
) -> _Point:
    """Return the rows after shares (n, 1) of their steps; the others stay as they are."""
    rows = np.flatnonzero(share[:, 0])
    if not len(rows):
        return point
    begin = select_poses(point.state, rows)
    moved = geometry.apply_twist(begin.T, (share * step.twist)[None, rows])
    target = read_coordinates(moved, robot.controlled)
    new = close_at_coordinates(robot, values, target, begin, False, ITERATIONS)
    measured = _measure(robot, new, T[:, rows])
    gap, cost = point.gap.copy(), point.cost.copy()
    gap[rows], cost[rows] = measured.gap, measured.cost
    state = replace_rows(point.state, np.zeros_like(rows), rows, reshape_rows(new, len(rows), 1))
    return _Point(state, gap, cost)


def controls_all(robot: Mechanism) -> bool:
    """Return whether the controlled coordinates state each freedom of the platform."""
    return len(robot.controlled) == 6 or set(robot.controlled) == set(robot.freedoms)


def differentiate_by_coordinates(robot: Mechanism, values: FloatArray, state: State) -> FloatArray:
    """Return d twist / d coordinate (t, n, 6, c), every actuator free [1/m, 1].

    Coordinates are in the units of `compare_coordinates`.
    """
    names, freedoms = robot.controlled, list(robot.program.freedoms)
    t, n = state.T.shape[:2]
    flat = state.T.reshape(-1, 4, 4)
    _, columns = compare_coordinates(flat, read_coordinates(flat, names), names, robot.size)
    columns = columns.reshape(t, n, len(names), 6)
    if robot.stages or needs_readings(robot.program):
        q = compute_readings(robot, values, state)
        D = differentiate_pose(robot, values, q, state).readings
        return np.matmul(D, np.linalg.pinv(np.nan_to_num(np.matmul(columns, D))))
    e, _ = robot.slots(values)
    unused = np.zeros((1, n, robot.program.n_joints))
    rows = stack_platform_rows(engine.linearize(robot.program, e, unused, state, free=True))
    both = np.concatenate([rows, columns[..., freedoms]], axis=2)
    right = np.zeros((*both.shape[:3], len(names)))
    right[:, :, rows.shape[2] :] = np.eye(len(names))
    out = np.zeros((t, n, 6, len(names)))
    good = np.asarray(np.isfinite(both).all(axis=(-1, -2)))
    solved = np.matmul(np.linalg.pinv(both[good]), right[good])
    out[good[..., None] & np.isin(np.arange(6), freedoms)] = solved.reshape(-1, len(names))
    return out
