# SPDX-License-Identifier: Apache-2.0
"""Kinematics of many trials: forward and inverse solutions as engine states (t, n).

Arrays are (t, n, ..), where t or n may be 1 and then broadcast. The layers above compute with these
functions; `loopcal.forward` and `loopcal.inverse` wrap them for a single robot.

Where one actuator drives joints of several limbs, as a carriage with two rods does, the inverse
solution cannot free each joint: they would part. It solves for the readings instead, as that of
chains does. Source: docs/theory/kinematics.md.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from loopcal import engine
from loopcal.engine import Program, State
from loopcal.mechanism import actuation, stages
from loopcal.mechanism.actuation.driven_joints import DrivenJoints, drive_joints, drive_sums
from loopcal.mechanism.kinematics.reading_paths import (
    Loops,
    clear_sign,
    find_wrong_rows,
    follow_path,
    is_square,
)
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.platform_coordinates import (
    compare_coordinates,
    pose_from_coordinates,
    read_coordinates,
)
from loopcal.mechanism.sensitivity import differentiate_pose
from loopcal.mechanism.states import Status, driven_values, without_poses
from loopcal.mechanism.transmission.sums import apply_weights
from loopcal.mechanism.transmission.terms import (
    find_triangles,
    measure_excess,
    readings_from_joints,
    select_weights,
)
from loopcal.numerics.trial_batch import map_arrays
from loopcal.typing import BoolArray, FloatArray

ITERATIONS = 60
"""Newton steps of an inverse solution, each at most half of the robot's size."""
ANGLES = {"rx": "roll", "ry": "pitch", "rz": "yaw"}


def forward_trials(
    robot: Mechanism,
    values: FloatArray,
    q: FloatArray,
    start: State | None = None,
    follow: bool = True,
    goal: State | None = None,
    driven: DrivenJoints | None = None,
) -> State:
    """Solve forward kinematics for readings q (t | 1, n, a) and values (t | 1, p).

    Newton's method begins at `start` (default: home). A row that fails, or ends beyond a
    singularity, is solved again along the straight path from the start's readings. Rows that still
    fail are marked, see `Status`. Redundant readings contradict each other by their errors; a row
    that they leave wide open is solved again too, and marked if it stays open. Without `follow` all
    these rows are marked at once, in a fraction of the time. With a `goal` (t, n), a row that comes
    close to it ends there as `engine.NEAR_GOAL`. `driven` is that of `drive_joints`, where it is
    known.
    """
    if not q.shape[1]:
        return without_poses(robot.home_state, max(len(values), len(q)))
    if robot.stages:
        return stages.solve_stages(robot, values, q, start, partial(forward_trials, follow=follow))
    if robot.has_open_sums:
        e, sums, weights = drive_sums(robot, values, q)
        return close_at_joints(robot, e, sums, start, follow, weights=weights)
    e, tau, joints = driven or drive_joints(robot, values, q)
    state = close_at_joints(robot, e, joints, start, follow, goal)
    return _mark_out_of_reach(robot, state, q, tau) if len(find_triangles(tau)) else state


def _mark_out_of_reach(robot: Mechanism, state: State, q: FloatArray, tau: FloatArray) -> State:
    """Return a state (t, n) whose rows with a length that no angle reaches are unreachable."""
    excess = np.broadcast_to(measure_excess(q, tau, robot.slots.frequency), state.status.shape)
    is_beyond = (state.status == Status.NOT_FINITE.value) & (excess > 0.0) & np.isfinite(excess)
    return replace(
        state,
        status=np.where(is_beyond, np.int8(Status.UNREACHABLE), state.status),
        residual=np.where(is_beyond, excess, state.residual),
    )


def close_at_joints(
    robot: Mechanism,
    e: FloatArray,
    joints: FloatArray,
    start: State | None = None,
    follow: bool = True,
    goal: State | None = None,
    weights: FloatArray | None = None,
) -> State:
    """Solve forward kinematics like `forward_trials`, for displacements and joint values.

    e : (t | 1, n_displacements). joints : (t | 1, n, n_joints) values of the driven joints, n > 0.
    With `weights` (t | 1, a, n_joints) they are their sums (t | 1, n, a).
    """
    begin = clear_sign(robot, start or robot.home_state)
    if robot.is_serial:
        return stages.solve_serial(robot, e, joints, begin.T.shape[:2])
    loops = Loops(robot, e, weights)
    state = loops.solve(joints, begin, goal)
    wrong = find_wrong_rows(robot, state, begin)
    if not wrong.any():
        return state
    if not follow:
        beyond = wrong & (state.status == Status.CONVERGED.value)
        return replace(state, status=np.where(beyond, np.int8(Status.OTHER_MODE), state.status))
    return follow_path(loops, joints, begin, state, wrong)


def step_towards_closure(
    robot: Mechanism, values: FloatArray, q: FloatArray, begin: State
) -> State:
    """Return the states (t, n) one Newton step from `begin` at readings q (t | 1, n, a).

    For robots without stages.
    """
    if robot.has_open_sums:
        e, sums, weights = drive_sums(robot, values, q)
        return actuation.solve_open_sums(robot.program, e, weights, sums, begin, 1)
    e, _, joints = drive_joints(robot, values, q)
    return engine.solve(robot.program, e, joints, begin, max_iterations=1)


def find_directly_reachable(robot: Mechanism, values: FloatArray, q: FloatArray) -> BoolArray:
    """Return which readings q (t | 1, n, a) are solved from home without following a path, (t, n).

    These solutions lie on home's side of every singularity. The test takes a fraction of the time
    of following.
    """
    return forward_trials(robot, values, q, follow=False).status == Status.CONVERGED.value


def inverse_trials(
    robot: Mechanism, values: FloatArray, target: FloatArray, start: State | None = None
) -> State:
    """Solve inverse kinematics for controlled coordinates (t | 1, n, c), every actuator free.

    `compute_readings` gives the readings of the states.
    """
    state = close_at_coordinates(robot, values, target, start)
    if needs_readings(robot.program):
        return state
    return replace(state, closure_sign=compute_closure_sign(robot, values, state))


def close_at_coordinates(
    robot: Mechanism,
    values: FloatArray,
    target: FloatArray,
    start: State | None = None,
    follow: bool = True,
    max_iterations: int = ITERATIONS,
) -> State:
    """Solve inverse kinematics like `inverse_trials`, without the closure sign of the states.

    Without `follow`, and with few iterations, rows that fail cost less.
    """
    begin = start or robot.home_state
    if not target.shape[1]:
        return without_poses(robot.home_state, max(len(values), len(target)))
    if robot.stages:
        functions = forward_trials, differentiate_pose
        return stages.solve_readings(robot, values, target, begin, *functions, follow=follow)
    if needs_readings(robot.program):
        return _inverse_by_readings(robot, values, target, begin, follow)
    return _close_with_free_actuators(robot, values, target, begin, start, max_iterations)


def _close_with_free_actuators(
    robot: Mechanism,
    values: FloatArray,
    target: FloatArray,
    begin: State,
    start: State | None,
    max_iterations: int = ITERATIONS,
) -> State:
    """Return states (t, n) at controlled coordinates, with every actuated joint free.

    start : as given; without it the platform begins as commanded, where its coordinates state it.
    """
    e, _ = robot.slots(values)
    names, size = robot.controlled, robot.size
    T, guess = pose_from_coordinates(target, names, robot.home), driven_values(robot.program, begin)
    if determine_platform(robot):
        limbs = robot.program.with_fixed_platform
        start = replace(begin, T=T)
        return engine.solve(limbs, e, guess, start, free=True, max_iterations=max_iterations)
    t, n = max(len(values), len(target)), target.shape[1]
    flat = np.broadcast_to(target, (t, n, target.shape[2])).reshape(t * n, -1)

    def command(T: FloatArray, rows: np.ndarray) -> tuple[FloatArray, FloatArray]:
        return compare_coordinates(T, flat[rows], names, size)

    guess = np.broadcast_to(guess, (t, n, len(robot.actuators)))
    T = np.broadcast_to(T if start is None else start.T, (t, n, 4, 4))
    begin = replace(begin, T=T)
    return engine.solve(robot.program, e, guess, begin, command, True, max_iterations)


def determine_platform(robot: Mechanism) -> bool:
    """Return whether the controlled coordinates state the whole pose and no limb adds a condition.

    They are all freedoms of the platform, of which the others keep their values at home, and each
    limb has as many unknown joints as equations.
    """
    if not robot.program.has_square_limbs:
        return False
    if len(robot.controlled) == 6:
        return True
    if set(robot.controlled) != {ANGLES.get(freedom, freedom) for freedom in robot.freedoms}:
        return False
    at_home = read_coordinates(robot.home, robot.controlled)
    same = pose_from_coordinates(at_home, robot.controlled, robot.home)
    return bool(np.abs(same - robot.home).max() < 1e-12)


def compute_closure_sign(robot: Mechanism, values: FloatArray, state: State) -> NDArray[np.int8]:
    """Return the sign of the determinant of closure with locked actuators (t, n).

    It changes only at a singularity. A state with free actuators has another sign. With more
    equations than freedoms the sign is 0. The sign of a chain is the product of those of its
    stages.
    """
    if robot.stages:
        return stages.multiply_signs(robot, values, state, compute_closure_sign)
    if robot.is_serial:
        return np.ones(state.status.shape, np.int8)
    if not is_square(robot):
        return np.zeros(state.status.shape, np.int8)
    e, tau = robot.slots(values)
    joints = driven_values(robot.program, state)
    if robot.has_open_sums:
        weights = select_weights(tau)
        assert weights is not None
        sums = apply_weights(weights, joints)
        return actuation.solve_open_sums(robot.program, e, weights, sums, state, 0).closure_sign
    return engine.solve(robot.program, e, joints, state, max_iterations=0).closure_sign


def compute_readings(robot: Mechanism, values: FloatArray, state: State) -> FloatArray:
    """Return the readings (t, n, a) of a state."""
    _, tau = robot.slots(values)
    joints = driven_values(robot.program, state)
    return readings_from_joints(joints, tau, robot.slots.frequency)


def needs_readings(program: Program) -> bool:
    """Return whether the inverse solution is one for readings: joints with a shared drive would
    part, and where loops may stay open, a free actuator would take a part of the gap.
    """
    return program.may_stay_open or program.shared_drive_count > 0


def _inverse_by_readings(
    robot: Mechanism, values: FloatArray, target: FloatArray, begin: State, follow: bool
) -> State:
    """Return states (t, n) at controlled coordinates (t | 1, n, c) by their readings.

    Newton's method begins with each joint free, which is almost right where loops may stay open.
    With shared drives the platform is then as commanded in all its freedoms, which the limbs of
    many machines can reach one by one; elsewhere, such as where the platform's orientation follows
    its position, the method begins at the start.
    """
    if not begin.closure_sign.any():
        # the guess of a home that is searched for has no sign yet
        t, n = max(len(values), len(begin.T)), begin.T.shape[1]
        whole = map_arrays(lambda a: np.broadcast_to(a, (t, n, *a.shape[2:])), begin)
        begin = replace(whole, closure_sign=compute_closure_sign(robot, values, whole))
    return stages.solve_readings(
        robot,
        values,
        target,
        begin,
        forward_trials,
        differentiate_pose,
        partial(_propose_state, robot),
        follow,
    )


def _propose_state(robot: Mechanism, values: FloatArray, target: FloatArray, start: State) -> State:
    """Return states with every joint free at targets (R, c); all are (1, R) or (R, 1).

    With shared drives, coordinates that are not controlled are those of the start.
    """
    if not robot.program.shared_drive_count:
        shaped = target.reshape(*start.T.shape[:2], -1)
        return _close_with_free_actuators(robot, values, shaped, start, start)
    e, _ = robot.slots(values)
    names = tuple(ANGLES.get(freedom, freedom) for freedom in robot.freedoms)
    T = pose_from_coordinates(target, robot.controlled, start.T.reshape(-1, 4, 4))
    whole = read_coordinates(T, names)

    def command(current: FloatArray, rows: np.ndarray) -> tuple[FloatArray, FloatArray]:
        return compare_coordinates(current, whole[rows], names, robot.size)

    begin = replace(start, T=T.reshape(start.T.shape))
    return engine.solve(
        robot.program, e, driven_values(robot.program, begin), begin, command, free=True
    )
