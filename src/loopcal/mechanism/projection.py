# SPDX-License-Identifier: Apache-2.0
"""The reachable pose nearest to one asked for.

Gauss-Newton on |log(R R*')|^2 size^2 + |t - t*|^2 along what the controlled coordinates can move,
with the slopes from the closure linearised with every actuator free. Source:
docs/theory/kinematics.md.
"""

from __future__ import annotations

import numpy as np

from loopcal import engine, geometry
from loopcal.engine import State
from loopcal.mechanism.batch_kinematics import inverse_trials, stack_platform_rows
from loopcal.mechanism.coordinates import compare_coordinates, read_coordinates
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.redundant_actuation import (
    count_shared_drives,
    differentiate_through_readings,
)
from loopcal.typing import FloatArray

STEPS = 12


def find_nearest_reachable(
    robot: Mechanism, values: FloatArray, T: FloatArray, start: State | None = None
) -> State:
    """States (t, n) whose platform is nearest to T (t | 1, n, 4, 4), actuators free."""
    target = read_coordinates(T, robot.controlled)
    state = inverse_trials(robot, values, target, start)
    if len(robot.controlled) == 6 or set(robot.controlled) == set(robot.freedoms):
        return state
    for _ in range(STEPS):
        gap = geometry.pose_difference(state.T, np.broadcast_to(T, state.T.shape))
        slope = differentiate_by_coordinates(robot, values, state)
        weight = np.array([robot.size] * 3 + [1.0] * 3)
        step = _least_squares(slope * weight[:, None], -gap * weight)
        step = np.where(np.isfinite(step), step, 0.0)
        moved = geometry.apply_twist(state.T, np.matmul(slope, step[..., None])[..., 0])
        state = inverse_trials(robot, values, read_coordinates(moved, robot.controlled), state)
        if np.abs(step).max(initial=0.0) < 1e-12 * robot.size:
            break
    return state


def differentiate_by_coordinates(robot: Mechanism, values: FloatArray, state: State) -> FloatArray:
    """d twist / d demand (t, n, 6, c) with the actuators free, demands as `coordinates.demands`
    counts them [1/m, 1].
    """
    if count_shared_drives(robot.program):
        return differentiate_through_readings(robot, values, state)
    e, _ = robot.slots(values)
    names, freedoms = robot.controlled, list(robot.program.freedoms)
    t, n = state.T.shape[:2]
    rows = stack_platform_rows(
        engine.linearize(
            robot.program, e, np.zeros((1, n, robot.program.n_joints)), state, free=True
        )
    )
    flat = state.T.reshape(-1, 4, 4)
    _, columns = compare_coordinates(flat, read_coordinates(flat, names), names, robot.size)
    columns = columns.reshape(t, n, len(names), 6)[..., freedoms]
    both = np.concatenate([rows, columns], axis=2)
    right = np.zeros((*both.shape[:3], len(names)))
    right[:, :, rows.shape[2] :] = np.eye(len(names))
    out = np.zeros((t, n, 6, len(names)))
    good = np.asarray(np.isfinite(both).all(axis=(-1, -2)))
    out[good[..., None] & np.isin(np.arange(6), freedoms)] = np.matmul(
        np.linalg.pinv(both[good]), right[good]
    ).reshape(-1, len(names))
    return out


def _least_squares(slope: FloatArray, gap: FloatArray) -> FloatArray:
    """Smallest-residual step (t, n, c)."""
    return np.matmul(np.linalg.pinv(slope), gap[..., None])[..., 0]
