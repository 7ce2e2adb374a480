# SPDX-License-Identifier: Apache-2.0
"""Inverse kinematics by the forward one: Newton's method on the readings, c(T(q)) = c*.

Chains have no other way, nor do machines in which one actuator drives joints of several limbs, such
as a carriage with two rods or the cranks of a parallelogram: if each joint were free, they would
part. Each step solves C D dq = c* - c with the derivative C of the coordinates by the platform's
twist and D of the twist by the readings. Steps are limited and shortened until the distance from
the target decreases. Readings of stages that do not carry the end platform stay as they are.
det(C D) changes its sign where the machine passes a position in which its actuators cannot move the
platform in some direction, such as a stretched arm: a solution with another sign than the start is
in another working mode. Rows that fail, or arrive in another mode, are solved again along the
straight path of poses from the start. Derivation: docs/theory/stages.md, docs/theory/kinematics.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol

import numpy as np

from loopcal import geometry
from loopcal.engine import CONVERGED, EXHAUSTED, NOT_FINITE, STALLED, State
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.parameter_units import ParameterUnits
from loopcal.mechanism.platform_coordinates import (
    compare_coordinates,
    pose_from_coordinates,
    read_coordinates,
)
from loopcal.mechanism.stages.chain_kinematics import PoseDerivative
from loopcal.mechanism.stages.chain_reach import measure_target_excess
from loopcal.mechanism.stages.chain_state import find_carrying_actuators
from loopcal.mechanism.states import Status, driven_values
from loopcal.mechanism.transmission.terms import joint_slopes, readings_from_joints
from loopcal.numerics.trial_batch import map_arrays
from loopcal.typing import BoolArray, FloatArray, IntArray

STEPS = 60
"""Newton steps of a row."""
CLOSE, CLOSE_ON_PATH = 1e-12, 1e-4
"""Distance from the target coordinates, relative to the robot's size, of a solved row, and of one
that only begins the next step of its path.

A forward solution is known to 1e-13 of the size.
"""
LONGEST_STEP = 0.5
"""Longest step of a joint: in radians, or relative to the robot's size."""
SHORTEST_SHARE = 1e-3
"""Share of a step that must bring a row closer to its target; below it the target is not
reachable from here."""
PROGRESS, PROGRESS_STEPS = 0.5, 10
"""Share of its distance from the target that a row must lose in so many steps, else it has stalled.

In this time the longest steps turn a joint by 5 rad. Steps close to a stretched arm gain less.
"""
PATH_STEPS = 8
"""Steps of the path from the start's pose to a target."""


class ForwardSolver(Protocol):
    """Solves forward kinematics, as `forward_trials` does."""

    def __call__(
        self,
        robot: Mechanism,
        values: FloatArray,
        q: FloatArray,
        start: State | None = None,
        follow: bool = True,
    ) -> State:
        """Return the state (t, n) at readings q (t | 1, n, a) and values (t | 1, p)."""
        ...


class Proposal(Protocol):
    """Proposes states near targets, whose readings are only almost right."""

    def __call__(self, values: FloatArray, target: FloatArray, start: State) -> State:
        """Return states for targets (R, c); all three are (1, R) or (R, 1), like the start."""
        ...


@dataclass(frozen=True, eq=False)
class _Iterate:
    """Readings of R rows and what follows from them.

    q : (R, a). state : of R rows. gap : (R,) distance from the target [m]. step : (R, a) Newton
    step. sign : (R,) of det(C D).
    """

    q: FloatArray
    state: State
    gap: FloatArray
    step: FloatArray
    sign: FloatArray


@dataclass(frozen=True, eq=False)
class _Rows:
    """R rows of a robot: the parameter values of each, and their targets.

    values : (1, p) of all rows, or (R, p). target : (R, c) controlled coordinates.
    """

    robot: Mechanism
    values: FloatArray
    target: FloatArray
    solve: ForwardSolver
    differentiate: PoseDerivative

    @property
    def axis(self) -> int:
        """Axis of the rows in a state: of poses where all have the same values, else of trials."""
        return 1 if len(self.values) == 1 else 0

    def select(self, rows: IntArray) -> _Rows:
        """Return some rows."""
        values = self.values if self.axis else self.values[rows]
        return replace(self, values=values, target=self.target[rows])

    def take(self, now: _Iterate, rows: IntArray) -> _Iterate:
        """Return some rows of an iterate."""
        state = map_arrays(partial(np.take, indices=rows, axis=self.axis), now.state)
        return _Iterate(now.q[rows], state, now.gap[rows], now.step[rows], now.sign[rows])

    def put(self, now: _Iterate, rows: IntArray, new: _Iterate) -> _Iterate:
        """Return an iterate with some rows replaced."""
        place = (slice(None), rows) if self.axis else (rows,)

        def replaced(old: np.ndarray, part: np.ndarray) -> np.ndarray:
            out = np.array(old)
            out[place] = part
            return out

        state = map_arrays(replaced, now.state, new.state)
        arrays = [np.array(a) for a in (now.q, now.gap, now.step, now.sign)]
        for array, part in zip(arrays, (new.q, new.gap, new.step, new.sign), strict=True):
            array[rows] = part
        q, gap, step, sign = arrays
        return _Iterate(q, state, gap, step, sign)

    def evaluate(self, q: FloatArray, begin: State) -> _Iterate:
        """Return the iterate at readings q (R, a); its gap is infinite where a loop stays open."""
        robot, shown = self.robot, np.expand_dims(q, 1 - self.axis)
        state = self.solve(robot, self.values, shown, begin, follow=False)
        ok = (state.status == CONVERGED).ravel()
        none = ParameterUnits(robot.slots, np.zeros(0, np.int64), np.zeros(0))
        D = self.differentiate(robot, self.values, shown, state, none).readings
        T = state.T.reshape(-1, 4, 4)
        residual, columns = compare_coordinates(T, self.target, robot.controlled, robot.size)
        moving = find_carrying_actuators(robot)
        slope = np.matmul(columns, D.reshape(-1, 6, q.shape[1])[..., moving])
        ok &= np.isfinite(slope).all(axis=(1, 2)) & np.isfinite(residual).all(axis=1)
        slope[~ok], residual[~ok] = np.eye(len(moving)), 0.0
        step = np.zeros_like(q)
        step[:, moving] = -np.matmul(np.linalg.pinv(slope), residual[..., None])[..., 0]
        gap = np.where(ok, np.linalg.norm(residual, axis=1), np.inf)
        sign = np.where(ok, np.sign(np.linalg.det(slope)), 0.0)
        return _Iterate(q, state, gap, self._limit(q, step), sign)

    def _limit(self, q: FloatArray, step: FloatArray) -> FloatArray:
        """Return steps (R, a) of readings, shortened so that no joint moves too far."""
        robot = self.robot
        _, tau = robot.slots(self.values)
        frequency = robot.slots.frequency
        shown = np.expand_dims(q, 1 - self.axis)
        slopes = np.broadcast_to(joint_slopes(shown, tau, frequency), shown.shape).reshape(q.shape)
        length = np.abs(step * slopes) / _find_units(robot)
        longest = np.maximum(length.max(axis=1, initial=0.0), LONGEST_STEP)
        return step * (LONGEST_STEP / longest)[:, None]

    def iterate(self, q: FloatArray, begin: State, on_path: bool = False) -> _Iterate:
        """Return the last iterates from readings q (R, a); a row has arrived if its gap is small.

        The status of a row that has not arrived says why.
        """
        size, R = self.robot.size, len(q)
        close = (CLOSE_ON_PATH if on_path else CLOSE) * size
        done = now = self.evaluate(q, begin)
        rows, alive, share, steps = self, np.arange(R), np.ones(R), np.zeros(R, np.int64)
        status = np.full(R, EXHAUSTED, np.int8)
        before = now.gap
        for count in range(STEPS + 1):
            arrived = now.gap <= close
            broken = ~np.isfinite(now.gap)
            end = arrived | broken | (share < SHORTEST_SHARE)
            if count % PROGRESS_STEPS == 0 and count:
                end |= now.gap > PROGRESS * before
                before = now.gap
            if end.any() or count == STEPS:
                status[alive[end]] = np.where(broken, NOT_FINITE, STALLED)[end]
                status[alive[arrived]] = CONVERGED
                steps[alive] = count
                done = self.put(done, alive, now)
                keep = np.flatnonzero(~end)
                if not len(keep) or count == STEPS:
                    break
                rows, now = rows.select(keep), rows.take(now, keep)
                alive, share, before = alive[keep], share[keep], before[keep]
            trial = rows.evaluate(now.q + share[:, None] * now.step, now.state)
            better = trial.gap <= np.maximum((1 - 1e-4 * share) * now.gap, close)
            share = np.where(better, np.minimum(1.0, 4 * share), 0.25 * share)
            if better.all():
                now = trial
            elif better.any():
                chosen = np.flatnonzero(better)
                now = rows.put(now, chosen, rows.take(trial, chosen))
        shape = done.state.status.shape
        state = replace(
            done.state,
            status=status.reshape(shape),
            residual=done.gap.reshape(shape),
            iterations=steps.reshape(shape),
        )
        return replace(done, state=state)


def solve_readings(
    robot: Mechanism,
    values: FloatArray,
    target: FloatArray,
    begin: State,
    solve: ForwardSolver,
    differentiate: PoseDerivative,
    propose: Proposal | None = None,
    follow: bool = True,
) -> State:
    """Return states (t, n) at controlled coordinates (t | 1, n, c); marks rows that fail.

    Rows are independent of each other. `solve` and `differentiate` are the forward kinematics and
    the derivatives of any robot. With `propose`, rows begin at the states that it returns, if these
    converged. Without `follow`, rows that fail are not solved again along a path.
    """
    t, n = max(len(values), len(target)), target.shape[1]
    if not n:
        return map_arrays(lambda a: np.zeros((t, 0, *a.shape[2:]), a.dtype), begin)
    wanted = np.broadcast_to(target, (t, n, target.shape[2])).reshape(t * n, -1)
    own = values if len(values) == 1 else np.repeat(values, n, axis=0)
    rows = _Rows(robot, own, wanted, solve, differentiate)
    shape = (1, t * n) if rows.axis else (t * n, 1)
    first = map_arrays(
        lambda a: np.broadcast_to(a, (t, n, *a.shape[2:])).reshape(*shape, *a.shape[2:]), begin
    )
    _, tau = robot.slots(own)
    joints = driven_values(robot.program, first)
    q = readings_from_joints(joints, tau, robot.slots.frequency).reshape(t * n, -1)
    start = rows.evaluate(q, first)
    last = _solve_within_reach(rows, start, first, propose, follow)
    status = last.state.status.ravel()
    status = np.where(
        (status == CONVERGED) & _is_in_other_mode(last, start.sign),
        np.int8(Status.OTHER_MODE),
        status,
    )
    status = np.where(np.isfinite(wanted).all(axis=1), status, np.int8(NOT_FINITE))
    T = last.state.T.reshape(-1, 4, 4)
    left = np.linalg.norm(compare_coordinates(T, wanted, robot.controlled, robot.size)[0], axis=1)
    state = replace(
        last.state,
        status=status.reshape(shape),
        residual=np.where(status == CONVERGED, 0.0, left).reshape(shape),
    )
    return map_arrays(lambda a: a.reshape(t, n, *a.shape[2:]), state)


def _solve_within_reach(
    rows: _Rows, start: _Iterate, first: State, propose: Proposal | None, follow: bool
) -> _Iterate:
    """Return the last iterates of rows from their start, whose forward solution began at `first`.

    Rows whose target is farther away than the links span stay at the start.
    """
    is_near = measure_target_excess(rows.robot, rows.values, rows.target) <= 0.0
    solved = replace(start, state=_mark_stalled(start.state))
    near = np.flatnonzero(is_near)
    if not len(near):
        return solved
    own, begin = rows.select(near), rows.take(replace(start, state=first), near)
    direct = own.iterate(*_begin_near_targets(own, begin.q, begin.state, propose))
    solved = rows.put(solved, near, direct)
    wrong = near[_is_wrong(rows.take(solved, near), start.sign[near])]
    if not (follow and len(wrong)):
        return solved
    return rows.put(solved, wrong, _follow_path(rows.select(wrong), rows.take(start, wrong)))


def _mark_stalled(state: State) -> State:
    """Return a state whose rows have stalled."""
    return replace(state, status=np.full_like(state.status, STALLED))


def _begin_near_targets(
    rows: _Rows, q: FloatArray, first: State, propose: Proposal | None
) -> tuple[FloatArray, State]:
    """Return readings (R, a) and states at which rows begin: the proposed ones, or the first."""
    if propose is None:
        return q, first
    robot = rows.robot
    near = propose(rows.values, rows.target, first)
    good = (near.status == CONVERGED).ravel()
    _, tau = robot.slots(rows.values)
    joints = driven_values(robot.program, near)
    own = readings_from_joints(joints, tau, robot.slots.frequency).reshape(q.shape)
    # the start selects the side of the singularities
    near = replace(near, closure_sign=first.closure_sign)

    def choose(new: np.ndarray, old: np.ndarray) -> np.ndarray:
        chosen = good.reshape(new.shape[:2])
        return np.where(chosen.reshape(*chosen.shape, *[1] * (new.ndim - 2)), new, old)

    return np.where(good[:, None], own, q), map_arrays(choose, near, first)


def _is_wrong(solved: _Iterate, sign: FloatArray) -> BoolArray:
    """Return the rows (R,) that failed, or are in another mode than the start with this sign."""
    return (solved.state.status.ravel() != CONVERGED) | _is_in_other_mode(solved, sign)


def _is_in_other_mode(solved: _Iterate, sign: FloatArray) -> BoolArray:
    """Return the rows (R,) whose sign is not that of the start; a start that is open has none."""
    return (solved.sign != sign) & (sign != 0.0)


def _follow_path(rows: _Rows, start: _Iterate) -> _Iterate:
    """Return the last iterates of rows solved along the straight path of poses from their start."""
    robot, now = rows.robot, start
    T = start.state.T.reshape(-1, 4, 4)
    goal = pose_from_coordinates(rows.target, robot.controlled, T)
    twist = geometry.pose_difference(goal, T)
    alive = np.arange(len(T))
    for i in range(1, PATH_STEPS + 1):
        via = geometry.apply_twist(T[alive], (i / PATH_STEPS) * twist[alive])
        target = read_coordinates(via, robot.controlled)
        part, begin = rows.select(alive), rows.take(now, alive)
        moved = replace(part, target=target).iterate(begin.q, begin.state, i < PATH_STEPS)
        now = rows.put(now, alive, moved)
        alive = alive[~_is_wrong(moved, start.sign[alive])]
        if not len(alive):
            break
    return now


def _find_units(robot: Mechanism) -> FloatArray:
    """Return the units (a,) of long steps of joints and of sums: a radian, or the size [m]."""
    turning = {j.actuator for limb in robot.assembly.limbs for j in limb.joints if j.kind == "R"}
    turns = (not turning.isdisjoint(a.driven_joints) for a in robot.actuators)
    return np.array([1.0 if is_angle else robot.size for is_angle in turns])
