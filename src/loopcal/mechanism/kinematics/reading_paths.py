# SPDX-License-Identifier: Apache-2.0
"""Loops closed at joint values or their sums, and along straight paths of these from a start.

A row that Newton's method does not solve at once, or solves beyond a singularity, is solved again
in equal steps. Source: docs/theory/kinematics.md.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from loopcal import engine
from loopcal.engine import State
from loopcal.mechanism import actuation
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.states import Status, driven_values, replace_rows, select_rows
from loopcal.mechanism.transmission.sums import apply_weights
from loopcal.typing import BoolArray, FloatArray

PATH_STEPS = (8, 64)
"""Steps of the path from the start's readings, tried in turn where the direct solution fails."""
WIDE = 1e-2
"""Gap, relative to the robot's size, that the errors of redundant readings do not explain.

A pose that they leave open by more is a wrong minimum.
"""


def is_square(robot: Mechanism) -> bool:
    """Return whether closure with locked actuators has as many equations as freedoms."""
    if robot.stages:
        return all(is_square(stage.robot) for stage in robot.stages)
    return robot.program.is_square or robot.has_open_sums


def clear_sign(robot: Mechanism, state: State) -> State:
    """Return the state with sign 0 if closure is not square: the sign means nothing there."""
    if is_square(robot):
        return state
    return replace(state, closure_sign=np.zeros_like(state.closure_sign))


def _find_open_rows(robot: Mechanism, state: State) -> BoolArray:
    """Return the rows that failed or left a wide gap."""
    return (state.status != Status.CONVERGED.value) | (state.residual > WIDE * robot.size)


def find_wrong_rows(robot: Mechanism, state: State, begin: State) -> BoolArray:
    """Return the rows that failed, ended beyond a singularity or left a wide gap."""
    closed = state.status == Status.CONVERGED.value
    beyond = (state.closure_sign != begin.closure_sign) | (state.residual > WIDE * robot.size)
    failed = (
        ~closed & (state.status != Status.NOT_FINITE.value) & (state.status != engine.NEAR_GOAL)
    )
    return failed | closed & beyond


class Loops(NamedTuple):
    """The loops of trials, closed at values of driven joints, or with `weights` at their sums.

    e : (t | 1, d). weights : (t | 1, a, n_joints).
    """

    robot: Mechanism
    e: FloatArray
    weights: FloatArray | None

    def solve(self, values: FloatArray, begin: State, goal: State | None = None) -> State:
        """Return states (t, n) at joint values or sums (t | 1, n, a)."""
        program = self.robot.program
        if self.weights is not None:
            return actuation.solve_open_sums(program, self.e, self.weights, values, begin)
        return clear_sign(self.robot, engine.solve(program, self.e, values, begin, goal=goal))

    def read(self, state: State) -> FloatArray:
        """Return the joint values or sums (t, n, a) of a state."""
        joints = driven_values(self.robot.program, state)
        return joints if self.weights is None else apply_weights(self.weights, joints)

    def select(self, trials: np.ndarray, count: int | None = None) -> Loops:
        """Return the loops of these trials, of `count` that may have arrays in common."""

        def take(array: FloatArray) -> FloatArray:
            shape = array.shape if count is None else (count, *array.shape[1:])
            return np.broadcast_to(array, shape)[trials]

        weights = None if self.weights is None else take(self.weights)
        return Loops(self.robot, take(self.e), weights)


def follow_path(
    loops: Loops, joints: FloatArray, begin: State, state: State, wrong: BoolArray
) -> State:
    """Solve the wrong rows along the straight path of joint values from the start.

    The steps become smaller until a row arrives.
    """
    robot, shape = loops.robot, (state.T.shape[0], state.T.shape[1])
    trial, pose = np.nonzero(wrong)
    loops = loops.select(trial, shape[0])
    target = np.broadcast_to(joints, (*shape, joints.shape[2]))[trial, pose][:, None]
    first, result = select_rows(begin, shape, trial, pose), select_rows(state, shape, trial, pose)
    origin = loops.read(first)
    alive = np.arange(len(trial))
    for count in PATH_STEPS:
        zero = np.zeros(len(alive), int)
        begun = select_rows(first, (len(trial), 1), alive, zero)
        path = origin[alive], target[alive]
        leave = count == PATH_STEPS[-1]
        current = _take_steps(loops.select(alive), path, begun, count, leave)
        result = replace_rows(result, alive, zero, current)
        alive = alive[find_wrong_rows(robot, current, begun)[:, 0]]
        if not len(alive):
            break
    closed = result.status == Status.CONVERGED.value
    status = np.where(
        closed & (result.residual > WIDE * robot.size), np.int8(Status.UNREACHABLE), result.status
    )
    other = closed & (result.closure_sign != first.closure_sign)
    status = np.where(other, np.int8(Status.OTHER_MODE), status)
    return replace_rows(state, trial, pose, replace(result, status=status))


def _take_steps(
    loops: Loops, path: tuple[FloatArray, FloatArray], begin: State, count: int, leave: bool
) -> State:
    """Solve rows (r, 1) in equal steps of the joint values between the ends of a path (r, 1, a).

    With `leave`, a row that fails or opens wide on the way goes to the end at once: there the path
    leaves the reach of the robot, and each further step would use many iterations for nothing.
    """
    robot, (origin, target) = loops.robot, path
    current, moving = begin, np.arange(len(target))
    for step in range(1, count + 1):
        zero = np.zeros(len(moving), int)
        q = origin[moving] + (target[moving] - origin[moving]) * (step / count)
        begun = select_rows(current, (len(target), 1), moving, zero)
        solved = loops.select(moving).solve(q, begun)
        current = replace_rows(current, moving, zero, solved)
        if leave and step < count:
            failed = moving[_find_open_rows(robot, current)[moving, 0]]
            if len(failed):
                zero = np.zeros(len(failed), int)
                state = select_rows(current, (len(target), 1), failed, zero)
                solved = loops.select(failed).solve(target[failed], state)
                current = replace_rows(current, failed, zero, solved)
                moving = np.setdiff1d(moving, failed)
                if not len(moving):
                    break
    return current
