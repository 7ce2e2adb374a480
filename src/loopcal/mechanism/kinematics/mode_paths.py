# SPDX-License-Identifier: Apache-2.0
"""Tell whether a motion of the actuators leads from one state to another, by small steps.

Newton's method from a distant start can jump: it may end in another mode, although it converges,
the closure sign is that of the start, and another iteration from the same start returns the same
pose. A single step from x0 to the solution x is trusted where the iterates come half as near each
time,

    |x - x1| <= |x - x0| / 2   or   |x - x3| <= |x - x0| / 8,

as they do where the theorem of Newton and Kantorovich promises convergence [Deuflhard2004]. The
norm is the largest difference of a joint or of the platform. Other steps are divided. Source:
docs/theory/kinematics.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from loopcal import engine, geometry
from loopcal.engine import State
from loopcal.mechanism.kinematics.batch_kinematics import close_at_coordinates
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.platform_coordinates import read_coordinates
from loopcal.mechanism.states import Status, driven_values, replace_rows, reshape_rows, select_poses
from loopcal.numerics.trial_batch import map_arrays
from loopcal.typing import BoolArray, FloatArray, IntArray

CONTRACTION = {1: 1 / 2, 3: 1 / 8}
"""Number of Newton steps -> largest distance that they leave, per distance of the start."""
FIRST_STEP, GROWTH, SHORTEST = 0.25, 2.0, 1 / 500
"""First step of a path as a share of it, its growth after a safe step, and the shortest step.

A step that is not safe is divided by the square of the growth.
"""
TRIALS = 80
"""Most steps of a path, safe or not."""
ITERATIONS = 12
"""Newton steps of a step of a path: a safe one needs fewer."""
SAME_JOINTS = 1e-6
"""Largest difference of equal joints and poses: lengths per size of the robot, angles [rad]."""

Step = Callable[[IntArray, FloatArray, State], State]
"""Returns states (1, j) at shares (j,) of the paths of rows (j,), from states on these paths."""


def connect_by_readings(robot: Mechanism, first: State, last: State) -> tuple[State, BoolArray]:
    """Follow the straight paths of joint values from states `first` (1, k | 1) to `last` (1, k).

    Returns
    -------
    state : (1, k) the last states, with the passive joints at the end of a path.
    connected : (k,) rows that a single safe step or a path without a singularity leads to.
    """
    return _connect(robot, first, last, contracts(robot, first, last), _move_readings)


def connect_by_poses(robot: Mechanism, first: State, last: State) -> tuple[State, BoolArray]:
    """Follow the straight paths of poses, and return what `connect_by_readings` returns."""
    return _connect(robot, first, last, np.zeros(last.T.shape[1], bool), _move_poses)


def _connect(
    robot: Mechanism,
    first: State,
    last: State,
    connected: BoolArray,
    path: Callable[[Mechanism, State, State], Step],
) -> tuple[State, BoolArray]:
    """Return the last states and which are connected by a kind of path, if not already."""
    rows = np.flatnonzero(~connected)
    if not len(rows):
        return last, connected
    start = select_poses(repeat_poses(first, len(connected)), rows)
    goal = select_poses(last, rows)
    end, arrived = _follow_path(robot, start, path(robot, start, goal))
    arrived &= _is_same_pose(robot, end, goal)
    connected = connected.copy()
    connected[rows] = arrived
    return _take_joints(robot, last, rows[arrived], select_poses(end, arrived)), connected


def contracts(robot: Mechanism, start: State, end: State) -> BoolArray:
    """Return which steps (n,) between states (1, n | 1) and (1, n) Newton's method makes safely."""
    e, _ = robot.slots(robot.values[None])
    joints, whole = driven_values(robot.program, end), measure_distance(robot, start, end)
    rows, done = np.arange(len(whole)), 0
    safe, current = np.zeros(len(whole), bool), start
    for steps, share in CONTRACTION.items():
        if not len(rows):
            break
        q, count = joints[:, rows], steps - done
        current, done = engine.solve(robot.program, e, q, current, max_iterations=count), steps
        left = measure_distance(robot, current, select_poses(end, rows))
        near = left <= share * whole[rows] + SAME_JOINTS
        safe[rows[near]] = True
        rows, current = rows[~near], select_poses(current, ~near)
    return safe


def measure_distance(robot: Mechanism, a: State, b: State) -> FloatArray:
    """Return the largest difference (n,) of poses and joints of states (1, n | 1).

    Lengths count per size of the robot, angles in radians.
    """
    twist = np.abs(geometry.pose_difference(*np.broadcast_arrays(a.T[0], b.T[0])))
    largest = np.maximum(twist[:, :3].max(axis=1), twist[:, 3:].max(axis=1) / robot.size)
    for group, mine, other in zip(robot.program.groups, a.joints, b.joints, strict=True):
        unit = np.array([1.0 if kind == "R" else robot.size for kind in f"{group.joints}P"])
        gap = np.abs(mine - other)[0] / unit
        largest = np.maximum(largest, gap.max(axis=(1, 2), initial=0.0))
    return largest


def repeat_poses(state: State, n: int) -> State:
    """Return a state (1, 1) or (1, n) as (1, n)."""
    return map_arrays(lambda a: np.broadcast_to(a, (1, n, *a.shape[2:])), state)


def _move_readings(robot: Mechanism, first: State, last: State) -> Step:
    """Return the steps along straight paths of joint values between states (1, k)."""
    e, _ = robot.slots(robot.values[None])
    origin, target = driven_values(robot.program, first), driven_values(robot.program, last)

    def step(rows: IntArray, share: FloatArray, current: State) -> State:
        q = origin[:, rows] + (target - origin)[:, rows] * share[:, None]
        return engine.solve(robot.program, e, q, current, max_iterations=ITERATIONS)

    return step


def _move_poses(robot: Mechanism, first: State, last: State) -> Step:
    """Return the steps along straight paths of poses between states (1, k)."""
    values = robot.values[None]
    twist = geometry.pose_difference(last.T[0], first.T[0])

    def step(rows: IntArray, share: FloatArray, current: State) -> State:
        via = geometry.apply_twist(first.T[0, rows], share[:, None] * twist[rows])
        target = read_coordinates(via, robot.controlled)
        cheap = {"follow": False, "max_iterations": ITERATIONS}
        return close_at_coordinates(robot, values, target[None], current, **cheap)

    return step


def _follow_path(robot: Mechanism, first: State, step: Step) -> tuple[State, BoolArray]:
    """Return the states (1, k) that paths from `first` end at, and which (k,) are their ends.

    The length of a step adapts to each row.
    """
    current, n = first, first.T.shape[1]
    share, length = np.zeros(n), np.full(n, FIRST_STEP)
    for _ in range(TRIALS):
        rows = np.flatnonzero((share < 1.0) & (length >= SHORTEST))
        if not len(rows):
            break
        present, wanted = select_poses(current, rows), np.minimum(1.0, share[rows] + length[rows])
        following = step(rows, wanted, present)
        safe = following.status[0] == Status.CONVERGED
        safe[safe] = contracts(robot, select_poses(present, safe), select_poses(following, safe))
        share[rows] = np.where(safe, wanted, share[rows])
        length[rows] *= np.where(safe, GROWTH, GROWTH**-2)
        done, kept = rows[safe], select_poses(following, safe)
        current = replace_rows(current, np.zeros_like(done), done, reshape_rows(kept, len(done), 1))
    return current, share >= 1.0


def _take_joints(robot: Mechanism, state: State, rows: IntArray, end: State) -> State:
    """Return states (1, n) with the joints of the ends (1, j) of paths where they differ."""
    differs = measure_distance(robot, select_poses(state, rows), end) > SAME_JOINTS
    rows, end = rows[differs], select_poses(end, differs)
    old = select_poses(state, rows)
    new = replace(old, T=end.T, joints=end.joints)
    return replace_rows(state, np.zeros_like(rows), rows, reshape_rows(new, len(rows), 1))


def _is_same_pose(robot: Mechanism, a: State, b: State) -> BoolArray:
    """Return which platforms (n,) are equal."""
    gap = np.abs(geometry.pose_difference(a.T[0], b.T[0])) * robot.twist_scale
    return gap.max(axis=1, initial=0.0) <= SAME_JOINTS * robot.size
