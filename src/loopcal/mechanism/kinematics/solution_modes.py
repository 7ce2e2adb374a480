# SPDX-License-Identifier: Apache-2.0
"""Inverse solutions in the mode of their start: those whose readings lead from there to the target.

Loops that close at a target do not say that the machine gets there: the same readings may close the
loops elsewhere, and the same pose may have several readings. A solution is in the mode of its start
if its closure sign is the start's, forward kinematics from the start returns its pose, and a path
of small steps leads there (`mode_paths`). A solution in another mode is solved again along the
straight path of poses from the start. Source: docs/theory/kinematics.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from loopcal import engine, geometry
from loopcal.engine import NEAR_GOAL, State
from loopcal.mechanism import stages
from loopcal.mechanism.kinematics.batch_kinematics import (
    close_at_coordinates,
    close_at_joints,
    compute_closure_sign,
    compute_readings,
    determine_platform,
    forward_trials,
    needs_readings,
)
from loopcal.mechanism.kinematics.mode_paths import (
    ITERATIONS,
    SAME_JOINTS,
    connect_by_poses,
    connect_by_readings,
    measure_distance,
    repeat_poses,
)
from loopcal.mechanism.kinematics.reading_paths import clear_sign
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.platform_coordinates import read_coordinates, state_target
from loopcal.mechanism.states import Status, driven_values, replace_rows, reshape_rows, select_poses
from loopcal.typing import BoolArray, FloatArray, IntArray

SAME_POSE = 1e-7
"""Largest difference of equal poses: lengths relative to the robot's size, angles in radians.

Rounding grows close to a singularity, up to the square root of the machine precision.
"""
STEPS = 8
"""Steps of the path from the start's pose to a target."""

Solver = Callable[[FloatArray, State | None], tuple[State, BoolArray | None]]
"""Solves inverse kinematics for targets (n, ..) from a start: states (1, n), and where the engine
tells, which of them their readings are known to lead to, see `reach_coordinates`."""


def solve_in_mode(
    robot: Mechanism, solve: Solver, target: FloatArray, start: State | None
) -> State:
    """Return inverse solutions (1, n) for targets (n, ..) in the mode of `start` (default: home).

    A row whose loops close in another mode only is marked `OTHER_MODE`.
    """
    begin = start or robot.home_state
    state, arrives = solve(target, start)
    state, is_other = judge_modes(robot, state, begin, arrives)
    rows = np.flatnonzero(is_other)
    if not len(rows):
        return state
    state = _mark_other(state, is_other)
    if has_one_solution(robot):
        return state
    first = select_poses(repeat_poses(begin, len(is_other)), rows)
    near, arrived = _follow_poses(robot, first, state.T[0, rows])
    near, rows = _select_new(robot, near, state, rows[arrived])
    if not len(rows):
        return state
    again, rows = _select_new(robot, solve(target[rows], near)[0], state, rows)
    if not len(rows):
        return state
    first = select_poses(repeat_poses(begin, len(is_other)), rows)
    again, still_other = judge_modes(robot, again, first)
    good = (again.status[0] == Status.CONVERGED) & ~still_other
    rows, new = rows[good], select_poses(again, good)
    return replace_rows(state, np.zeros_like(rows), rows, reshape_rows(new, len(rows), 1))


def _select_new(
    robot: Mechanism, again: State, state: State, rows: IntArray
) -> tuple[State, IntArray]:
    """Return the solutions (1, k) of rows (k,) that are not those of a state, and their rows.

    What was judged is not judged again.
    """
    if robot.stages or not len(rows):
        return again, rows
    is_new = measure_distance(robot, again, select_poses(state, rows)) > SAME_JOINTS
    return select_poses(again, is_new), rows[is_new]


def _mark_other(state: State, is_other: BoolArray) -> State:
    """Return a state (1, n) with the status of another mode in some rows (n,)."""
    return replace(state, status=np.where(is_other, np.int8(Status.OTHER_MODE), state.status))


def has_one_solution(robot: Mechanism) -> bool:
    """Return whether a pose has one set of readings, whatever the start: those of driven rods."""
    if robot.stages or not determine_platform(robot):
        return False
    return all(g.ending == "distance" and g.actuator[-1, 0] >= 0 for g in robot.program.groups)


def has_bends(robot: Mechanism) -> bool:
    """Return whether limbs that are closed one by one at a pose may have several readings there."""
    if robot.stages or robot.is_serial or needs_readings(robot.program):
        return False
    return determine_platform(robot) and not has_one_solution(robot)


def compute_bend(robot: Mechanism, state: State) -> NDArray[np.int8]:
    """Return the sign (n,) of the determinant of the limbs at their platform, every joint free.

    It changes where a limb is stretched or folded: there its readings have two solutions that
    coincide, and the machine passes from one working mode to another.
    """
    e, _ = robot.slots(robot.values[None])
    limbs, joints = robot.program.with_fixed_platform, driven_values(robot.program, state)
    return engine.solve(limbs, e, joints, state, free=True, max_iterations=0).closure_sign[0]


def reach_coordinates(
    robot: Mechanism, target: FloatArray, start: State | None = None
) -> tuple[State, BoolArray | None]:
    """Solve inverse kinematics like `close_at_coordinates`, for coordinates (n, c).

    Returns
    -------
    state : (1, n), also with the closure signs of `inverse_trials` where the next is not None.
    arrives : (n,) rows whose readings are known to lead from the start to their pose.
    """
    values, target = robot.values[None], target[None]
    is_plain = not (robot.stages or robot.is_serial or needs_readings(robot.program))
    is_plain &= not robot.program.idle_groups
    if not (is_plain and robot.program.is_square and target.shape[1] and determine_platform(robot)):
        return close_at_coordinates(robot, values, target, start), None
    e, _ = robot.slots(values)
    goal = state_target(target, robot.controlled, robot.home)
    reached = engine.reach(robot.program, e, goal, start or robot.home_state)
    return reached.state, reached.arrives[0]


def judge_modes(
    robot: Mechanism, state: State, begin: State, arrives: BoolArray | None = None
) -> tuple[State, BoolArray]:
    """Return a state (1, n) with closure signs, and its closed rows that `begin` does not lead to.

    arrives : as of `reach_coordinates`, where the state has its closure signs already.

    The engine proves for most rows that their readings lead to their pose, which gives their sign,
    too. For the others the sign is computed. Forward kinematics accepts no solution of another
    sign, so rows of another sign are not solved. It ends where it comes close to the pose of the
    state, to which it would converge. A chain is in another mode where a stage is; a serial limb
    has one pose for its readings.
    """
    if robot.stages:
        return stages.judge_stage_modes(robot, state, begin, judge_modes)
    if robot.is_serial:
        return state, np.zeros(state.T.shape[1], bool)
    if robot.has_open_sums:
        return _judge_by_readings(robot, state, begin)
    begin, n = clear_sign(robot, begin), state.T.shape[1]
    closed = state.status[0] == Status.CONVERGED
    if arrives is not None:
        sign, is_sure = state.closure_sign[0], arrives
    else:
        e, _ = robot.slots(robot.values[None])
        sign = engine.certify(robot.program, e, begin, state)[0]
        is_sure = sign != 0
        if not is_sure.all():
            unsure = select_poses(state, ~is_sure)
            sign[~is_sure] = compute_closure_sign(robot, robot.values[None], unsure)[0]
        state = replace(state, closure_sign=sign[None])
    is_other = closed & (sign != begin.closure_sign[0])
    if has_bends(robot) and closed.any():
        is_other |= closed & (compute_bend(robot, state) != compute_bend(robot, begin))
    rows = np.flatnonzero(closed & ~is_other & ~is_sure)
    if not len(rows):
        return state, is_other
    first = select_poses(begin, rows) if begin.T.shape[1] == n > 1 else begin
    judged, is_other[rows] = _judge_paths(robot, first, select_poses(state, rows))
    new = reshape_rows(judged, len(rows), 1)
    return replace_rows(state, np.zeros_like(rows), rows, new), is_other


def _judge_by_readings(robot: Mechanism, state: State, begin: State) -> tuple[State, BoolArray]:
    """Return what `judge_modes` returns, by forward kinematics from `begin` at the readings."""
    values = robot.values[None]
    if not state.T.shape[1]:
        return state, np.zeros(0, bool)
    state = replace(state, closure_sign=compute_closure_sign(robot, values, state))
    closed = state.status[0] == Status.CONVERGED
    is_other = closed & (state.closure_sign[0] != begin.closure_sign[0])
    rows = np.flatnonzero(closed & ~is_other)
    if not len(rows):
        return state, is_other
    goal = select_poses(state, rows)
    start = select_poses(begin, rows) if begin.T.shape[1] == len(closed) > 1 else begin
    back = forward_trials(robot, values, compute_readings(robot, values, goal), start)
    is_other[rows] = ~((back.status[0] == Status.CONVERGED) & _is_near(robot, back, goal))
    return state, is_other


def _is_near(robot: Mechanism, a: State, b: State) -> BoolArray:
    """Return which poses (k,) of states (1, k) are the same."""
    gap = np.abs(geometry.pose_difference(a.T[0], b.T[0]) * robot.twist_scale).max(axis=1)
    return np.asarray(gap <= SAME_POSE * robot.size)


def _judge_paths(robot: Mechanism, first: State, goal: State) -> tuple[State, BoolArray]:
    """Return goals (1, k) of the right sign, and which of them `first` (1, k | 1) does not lead to.

    Newton's method must lead to the pose of a goal from its readings, and a safe path too. A path
    of readings is both. Where it ends before its goal, forward kinematics may still return along
    larger steps, and a path of poses exist.
    """
    returns, needs_path = _solve_from(robot, first, goal)
    start, is_other = repeat_poses(first, len(returns)), np.ones(len(returns), bool)
    rows = np.flatnonzero(returns | needs_path)
    for connect in (connect_by_readings, connect_by_poses):
        if not len(rows):
            break
        solutions, connected = connect(robot, *_select_both(start, goal, rows))
        goal = replace_rows(goal, np.zeros_like(rows), rows, reshape_rows(solutions, len(rows), 1))
        is_other[rows] = ~connected
        rows = rows[~connected]
        unsure = rows[needs_path[rows]]
        if connect is connect_by_readings and len(unsure):
            ends = _select_both(start, goal, unsure)
            returns[unsure] = _solve_from(robot, *ends, follow=True)[0]
            rows = rows[returns[rows]]
    return goal, is_other


def _select_both(first: State, goal: State, rows: IntArray) -> tuple[State, State]:
    """Return rows of two states (1, n)."""
    return select_poses(first, rows), select_poses(goal, rows)


def _solve_from(
    robot: Mechanism, first: State, goal: State, follow: bool = False
) -> tuple[BoolArray, BoolArray]:
    """Return which readings of goals (1, k) lead to their poses from `first`, and which to none."""
    e, _ = robot.slots(robot.values[None])
    joints = driven_values(robot.program, goal)
    back = close_at_joints(robot, e, joints, first, follow, goal)
    closed = back.status[0] == Status.CONVERGED
    is_near = back.status[0] == NEAR_GOAL
    return is_near | closed & _is_near(robot, back, goal), ~(is_near | closed)


def _follow_poses(robot: Mechanism, first: State, T: FloatArray) -> tuple[State, IntArray]:
    """Return solutions (1, k) close to poses T (n, 4, 4), and which of these rows arrived (k,).

    They are reached from the start `first` (1, n) in equal steps.
    """
    values, alive, current = robot.values[None], np.arange(len(T)), first
    twist = geometry.pose_difference(T, first.T[0])
    for i in range(1, STEPS + 1):
        via = geometry.apply_twist(first.T[0, alive], (i / STEPS) * twist[alive])
        target = read_coordinates(via, robot.controlled)
        cheap = {"follow": False, "max_iterations": ITERATIONS}
        current = close_at_coordinates(robot, values, target[None], current, **cheap)
        closed = current.status[0] == Status.CONVERGED
        current, alive = select_poses(current, closed), alive[closed]
        if not len(alive):
            break
    return current, alive
