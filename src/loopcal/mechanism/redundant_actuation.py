# SPDX-License-Identifier: Apache-2.0
"""Inverse kinematics where one actuator drives joints of several limbs, as a carriage that carries
two rods does.

Freed one by one, such joints would part. So the readings are what is solved for: Newton on the
controlled coordinates of the forward solution, c(T(q)) = c*, with dT/dq by the implicit function
theorem. It begins where the platform stands exactly as commanded in all its freedoms, which the
limbs can reach one by one. Source: docs/theory/kinematics.md.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from loopcal import engine
from loopcal.engine import Program, State
from loopcal.mechanism.coordinates import (
    compare_coordinates,
    pose_from_coordinates,
    read_coordinates,
)
from loopcal.mechanism.model import Mechanism, Status
from loopcal.mechanism.sensitivity import differentiate_pose
from loopcal.mechanism.states import driven_values, replace_rows, select_rows
from loopcal.mechanism.transmission import joints_from_readings, readings_from_joints
from loopcal.typing import FloatArray

STEPS = 20
"""Newton steps on the readings."""

CLOSE = 1e-12
"""How near the controlled coordinates must come, of the robot's size: a forward solution is known
to 1e-13 of it.
"""

ANGLES = {"rx": "roll", "ry": "pitch", "rz": "yaw"}


def count_shared_drives(program: Program) -> int:
    """How many driven joints there are beyond one for each actuator."""
    return (
        sum(int((columns >= 0).sum()) for group in program.groups for columns in group.actuator)
        - program.n_joints
    )


def inverse_with_shared_drives(
    robot: Mechanism, values: FloatArray, target: FloatArray, begin: State
) -> State:
    """States (t, n) at controlled coordinates (t | 1, n, c); rows that are not reached are marked.

    Every row is worked on alone: what happens to one does not depend on the others.
    """
    t, n = max(len(values), len(target)), target.shape[1]
    trial, pose = (a.ravel() for a in np.indices((t, n)))
    asked = np.broadcast_to(target, (t, n, target.shape[2])).reshape(t * n, -1)
    own = np.broadcast_to(values, (t, values.shape[1]))[trial]
    state = _as_commanded(robot, own, asked, select_rows(begin, (t, n), trial, pose))
    q = _readings(robot, own, state)
    alive, zero = np.flatnonzero(state.status[:, 0] == Status.CONVERGED), np.zeros(t * n, int)
    for _ in range(STEPS):
        if not len(alive):
            break
        here = _forward(
            robot, own[alive], q[alive], select_rows(state, (t * n, 1), alive, zero[alive])
        )
        state = replace_rows(state, alive, zero[alive], here)
        gap, step = _newton(robot, own[alive], q[alive], asked[alive], here)
        going = (here.status[:, 0] == Status.CONVERGED) & (
            np.abs(gap).max(axis=1) > CLOSE * robot.size
        )
        alive = alive[going]
        q[alive, 0] -= step[going]
    status = state.status.copy()
    status[alive] = Status.NOT_CONVERGED
    return _reshaped(replace(state, status=status), t, n)


def _as_commanded(robot: Mechanism, values: FloatArray, asked: FloatArray, begin: State) -> State:
    """States (rows, 1) with every joint freed, at the platform pose that has the controlled
    coordinates and else is home's.
    """
    e, _ = robot.slots(values)
    names = tuple(ANGLES.get(freedom, freedom) for freedom in robot.freedoms)
    T = pose_from_coordinates(asked, robot.controlled, robot.home)
    whole = read_coordinates(T, names)

    def task(at: FloatArray, rows: np.ndarray) -> tuple[FloatArray, FloatArray]:
        return compare_coordinates(at, whole[rows], names, robot.size)

    guess = driven_values(robot.program, begin)
    return engine.solve(robot.program, e, guess, replace(begin, T=T[:, None]), task, free=True)


def _forward(robot: Mechanism, values: FloatArray, q: FloatArray, start: State) -> State:
    e, tau = robot.slots(values)
    return engine.solve(
        robot.program, e, joints_from_readings(q, tau, robot.slots.frequency), start
    )


def _newton(
    robot: Mechanism, values: FloatArray, q: FloatArray, asked: FloatArray, state: State
) -> tuple[FloatArray, FloatArray]:
    """How far rows are from what is asked (rows, c) [m], and the step of the readings that would
    undo it (rows, a).
    """
    gap, columns = compare_coordinates(state.T[:, 0], asked, robot.controlled, robot.size)
    D = differentiate_pose(robot, values, q, state).readings[:, 0]
    slope = np.nan_to_num(np.matmul(columns, D))
    return gap, np.matmul(np.linalg.pinv(slope), gap[..., None])[..., 0]


def differentiate_through_readings(
    robot: Mechanism, values: FloatArray, state: State
) -> FloatArray:
    """d twist / d demand (t, n, 6, c) through the readings, demands as `coordinates.demands` counts
    them [1/m, 1].
    """
    t, n = state.T.shape[:2]
    flat, names = state.T.reshape(-1, 4, 4), robot.controlled
    _, columns = compare_coordinates(flat, read_coordinates(flat, names), names, robot.size)
    D = differentiate_pose(robot, values, _readings(robot, values, state), state).readings
    slope = np.matmul(columns.reshape(t, n, len(names), 6), D)
    return np.matmul(D, np.linalg.pinv(np.nan_to_num(slope)))


def _readings(robot: Mechanism, values: FloatArray, state: State) -> FloatArray:
    _, tau = robot.slots(values)
    return readings_from_joints(driven_values(robot.program, state), tau, robot.slots.frequency)


def _reshaped(state: State, t: int, n: int) -> State:
    """Rows (t n, 1) as (t, n)."""
    arrays = {
        name: getattr(state, name).reshape(t, n, *getattr(state, name).shape[2:])
        for name in ("T", "status", "residual", "iterations", "closure_sign")
    }
    return State(**arrays, joints=tuple(j.reshape(t, n, *j.shape[2:]) for j in state.joints))
