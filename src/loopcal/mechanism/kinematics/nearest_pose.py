# SPDX-License-Identifier: Apache-2.0
"""The reachable pose nearest to a full pose that a machine with fewer freedoms cannot take.

Gauss-Newton on |log(R R*')|^2 size^2 + |t - t*|^2 along the controlled coordinates, with slopes
from closure linearized with every actuator free. Steps begin at the pose before them and are
limited, so that they need no path. Source: docs/theory/kinematics.md.
"""

from __future__ import annotations

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
from loopcal.mechanism.states import is_closed, replace_rows, select_rows
from loopcal.typing import FloatArray

PROJECTION_STEPS, ITERATIONS = 12, 12
"""Gauss-Newton steps of a projection, and Newton steps of each: it begins close to its solution."""
LONGEST_STEP, SHORT_STEP = 0.5, 1e-12
"""Longest of them, which is half a radian, and last one, relative to the robot's size."""


def find_nearest_reachable(
    robot: Mechanism, values: FloatArray, T: FloatArray, start: State | None = None
) -> State:
    """Return states (t, n) with the reachable pose nearest to T (t | 1, n, 4, 4), without signs.

    A row ends where a step becomes short, or leads out of reach.
    """
    state = close_at_coordinates(robot, values, read_coordinates(T, robot.controlled), start)
    if controls_all(robot) or not state.T.size:
        return state
    is_moving = is_closed(state.status)
    for _ in range(PROJECTION_STEPS):
        gap = geometry.pose_difference(state.T, np.broadcast_to(T, state.T.shape))
        slope = np.nan_to_num(differentiate_by_coordinates(robot, values, state))  # of open rows
        inverse_slope = np.linalg.pinv(slope * robot.twist_scale[:, None])
        step = np.nan_to_num(inverse_slope @ (-gap * robot.twist_scale)[..., None])[..., 0]
        longest = np.maximum(np.abs(step).max(axis=-1, keepdims=True), LONGEST_STEP * robot.size)
        step *= LONGEST_STEP * robot.size / longest
        moved = geometry.apply_twist(state.T, np.matmul(slope, step[..., None])[..., 0])
        target = read_coordinates(moved, robot.controlled)
        target[~is_moving] = np.nan
        new = close_at_coordinates(robot, values, target, state, False, ITERATIONS)
        is_moving &= is_closed(new.status)
        rows = np.nonzero(is_moving)
        state = replace_rows(state, *rows, select_rows(new, is_moving.shape, *rows))
        is_moving &= np.abs(step).max(axis=-1) >= SHORT_STEP * robot.size
        if not is_moving.any():
            break
    return state


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
