# SPDX-License-Identifier: Apache-2.0
"""Kinematics with the trial axis kept: what the layers above compute with. Shapes (t, n, ..), t or
n = 1 broadcast.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from loopcal import engine
from loopcal.engine import State
from loopcal.mechanism.coordinates import compare_coordinates, pose_from_coordinates
from loopcal.mechanism.model import Mechanism, Status
from loopcal.mechanism.redundant_actuation import count_shared_drives, inverse_with_shared_drives
from loopcal.mechanism.sensitivity import PoseSensitivity, differentiate_pose, stack_platform_rows
from loopcal.mechanism.states import driven_values, replace_rows, select_rows
from loopcal.mechanism.transmission import joints_from_readings, readings_from_joints
from loopcal.typing import BoolArray, FloatArray

# fmt: off
__all__ = ["PoseSensitivity", "forward_trials", "inverse_trials", "compute_closure_sign", "stack_platform_rows", "compute_readings", "differentiate_pose"]
# fmt: on

STEPS = (8, 64)
"""Steps of the path from the start's readings along which a row is followed when the direct
solution fails.
"""
WIDE = 1e-2
"""Share of the size: a pose that redundant readings leave open by more is not what their errors
mean, but a wrong minimum.
"""


def forward_trials(
    robot: Mechanism,
    values: FloatArray,
    q: FloatArray,
    start: State | None = None,
    follow: bool = True,
) -> State:
    """Poses of readings q (t | 1, n, a) under parameter values (t | 1, p).

    Newton from `start` (default: home); a row that fails, or ends on the far side of a singularity,
    is followed along the straight path from the start's readings. Rows that still fail are marked,
    see `Status`. Redundant readings contradict each other by their errors; a row that they leave
    wide open is followed too, and marked where it stays open. Without `follow` all these rows are
    marked at once, at a fraction of the time.
    """
    e, tau = robot.slots(values)
    with np.errstate(
        invalid="ignore"
    ):  # an infinite reading turns into NaN, and the engine marks its row
        joints = joints_from_readings(q, tau, robot.slots.frequency)
    begin = _signed(robot, robot.home_state if start is None else start)
    state = _signed(robot, engine.solve(robot.program, e, joints, begin))
    wrong = _astray(robot, state, begin)
    if not wrong.any():
        return state
    if not follow:
        beside = wrong & (state.status == Status.CONVERGED)
        return replace(state, status=np.where(beside, np.int8(Status.OTHER_MODE), state.status))
    return _followed(robot, e, joints, begin, state, wrong)


def find_directly_reachable(robot: Mechanism, values: FloatArray, q: FloatArray) -> BoolArray:
    """Which readings q (t | 1, n, a) Newton solves from home at once, on home's side of every
    singularity, (t, n).

    What `forward_trials` would have to follow is not reached plainly; to find that out takes a
    fraction of following it.
    """
    return forward_trials(robot, values, q, follow=False).status == Status.CONVERGED


def inverse_trials(
    robot: Mechanism, values: FloatArray, target: FloatArray, start: State | None = None
) -> State:
    """States at controlled coordinates (t | 1, n, c), every actuator free; `readings_at` gives
    their readings.
    """
    if count_shared_drives(robot.program):
        return inverse_with_shared_drives(
            robot, values, target, robot.home_state if start is None else start
        )
    e, _ = robot.slots(values)
    names, size = robot.controlled, robot.size
    t, n = max(len(values), len(target)), target.shape[1]
    asked = np.broadcast_to(target, (t, n, target.shape[2])).reshape(t * n, -1)

    def task(T: FloatArray, rows: np.ndarray) -> tuple[FloatArray, FloatArray]:
        return compare_coordinates(T, asked[rows], names, size)

    begin = robot.home_state if start is None else start
    guess = np.broadcast_to(driven_values(robot.program, begin), (t, n, len(robot.actuators)))
    T = pose_from_coordinates(np.broadcast_to(target, (t, n, target.shape[2])), names, robot.home)
    if start is not None:
        T = np.broadcast_to(start.T, T.shape)
    state = engine.solve(robot.program, e, guess, replace(begin, T=T), task, free=True)
    return replace(state, closure_sign=compute_closure_sign(robot, values, state))


def compute_closure_sign(robot: Mechanism, values: FloatArray, state: State) -> NDArray[np.int8]:
    """Sign of the determinant of closure with the actuators held (t, n): it changes only through a
    singularity.

    The orientation of a state with free actuators is another one. With more equations than freedoms
    it is zero.
    """
    if not _square(robot):
        return np.zeros(state.status.shape, np.int8)
    e, _ = robot.slots(values)
    return engine.solve(
        robot.program, e, driven_values(robot.program, state), state, max_iterations=0
    ).closure_sign


def _square(robot: Mechanism) -> bool:
    """Has closure with the actuators held as many equations as the platform has freedoms?"""
    return sum(
        len(g.limbs) * (len(g.rows) - len(g.unknown_joints(False))) for g in robot.program.groups
    ) == len(robot.freedoms)


def _signed(robot: Mechanism, state: State) -> State:
    """The state, its orientation zero where closure is not square: the sign of a reduced matrix
    then means nothing.
    """
    return (
        state if _square(robot) else replace(state, closure_sign=np.zeros_like(state.closure_sign))
    )


def compute_readings(robot: Mechanism, values: FloatArray, state: State) -> FloatArray:
    """Readings (t, n, a) of a state."""
    _, tau = robot.slots(values)
    return readings_from_joints(driven_values(robot.program, state), tau, robot.slots.frequency)


def _astray(robot: Mechanism, state: State, begin: State) -> np.ndarray:
    """Rows that failed, ended on the other side of a singularity or left a wide gap."""
    closed = state.status == Status.CONVERGED
    beside = (state.closure_sign != begin.closure_sign) | (state.residual > WIDE * robot.size)
    return ~closed & (state.status != Status.NOT_FINITE) | closed & beside


def _followed(
    robot: Mechanism,
    e: FloatArray,
    joints: FloatArray,
    begin: State,
    state: State,
    wrong: np.ndarray,
) -> State:
    """Follow the wrong rows along the straight path of joint values from the start, in ever smaller
    steps.
    """
    shape = state.T.shape[0], state.T.shape[1]
    trial, pose = np.nonzero(wrong)
    own = np.broadcast_to(e, (shape[0], e.shape[1]))[trial]
    target = np.broadcast_to(joints, (*shape, joints.shape[2]))[trial, pose][:, None]
    first, result = select_rows(begin, shape, trial, pose), select_rows(state, shape, trial, pose)
    origin = driven_values(robot.program, first)
    alive = np.arange(len(trial))
    for count in STEPS:
        zero = np.zeros(len(alive), int)
        here = begun = select_rows(first, (len(trial), 1), alive, zero)
        for step in range(1, count + 1):
            part = origin[alive] + (target[alive] - origin[alive]) * (step / count)
            here = _signed(robot, engine.solve(robot.program, own[alive], part, here))
        result = replace_rows(result, alive, zero, here)
        alive = alive[_astray(robot, here, begun)[:, 0]]
        if not len(alive):
            break
    lost = (result.status == Status.CONVERGED) & (result.closure_sign != first.closure_sign)
    wide = (result.status == Status.CONVERGED) & (result.residual > WIDE * robot.size)
    marked = np.where(
        lost, np.int8(Status.OTHER_MODE), np.where(wide, np.int8(Status.UNREACHABLE), result.status)
    )
    return replace_rows(state, trial, pose, replace(result, status=marked))
