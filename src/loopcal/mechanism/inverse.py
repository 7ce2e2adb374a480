# SPDX-License-Identifier: Apache-2.0
"""Inverse kinematics of many trials: readings that lead to coordinates, as engine states (t, n).

Where the controlled coordinates determine each limb, every actuator is free, and the engine closes
the limbs; others are closed together with the coordinates. A chain of stages has no loop through
its base. There Newton's method on the driven joints, c(T(u)) = c*, uses forward kinematics. Source:
docs/theory/kinematics.md.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from loopcal import engine, geometry
from loopcal.engine import CONVERGED, EXHAUSTED, NOT_FINITE, STALLED, State
from loopcal.mechanism import chains
from loopcal.mechanism.actuation import OpenSums, list_open_sums, scale_sums
from loopcal.mechanism.kinematics import Loops, compute_closure_sign, solve_serial
from loopcal.mechanism.limb_rows import move_joints, place_serial
from loopcal.mechanism.model import Mechanism, Stage
from loopcal.mechanism.platform_coordinates import (
    compare_coordinates,
    pose_from_coordinates,
    read_coordinates,
)
from loopcal.mechanism.sensitivity import differentiate_by_drives
from loopcal.mechanism.states import Status, driven_values, put_poses, without_poses
from loopcal.mechanism.transmission import Transmissions, apply_weights, invert_weights
from loopcal.numerics.gauss_newton import ROUNDING as ROUNDED
from loopcal.numerics.trial_batch import TrialBatch, map_arrays
from loopcal.typing import BoolArray, FloatArray, IntArray

ITERATIONS = 60  # newton steps of an inverse solution, each at most half of the robot's size
ANGLES = {"rx": "roll", "ry": "pitch", "rz": "yaw"}


def inverse_trials(
    robot: Mechanism, values: FloatArray, target: FloatArray, start: State | None = None
) -> State:
    """Solve inverse kinematics for controlled coordinates (t | 1, n, c), every actuator free.

    `compute_readings` gives the readings of the states.
    """
    state = close_at_coordinates(robot, values, target, start)
    if moves_by_drives(robot):
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
    if moves_by_drives(robot):
        return _solve_by_drives(robot, values, target, begin, follow)
    return close_with_free_actuators(robot, values, target, begin, start, max_iterations)


def close_with_free_actuators(
    robot: Mechanism,
    values: FloatArray,
    target: FloatArray,
    begin: State,
    start: State | None = None,
    max_iterations: int = ITERATIONS,
    held: IntArray | None = None,
) -> State:
    """Return states (t, n) at controlled coordinates, all actuated joints free, from `start`; those
    with a shared drive, and coupled ones, stay together, readings at places `held` as they begin.
    """
    (e, _), guess = robot.slots(values), driven_values(robot.program, begin)
    if determine_platform(robot):
        limbs = robot.program.with_fixed_platform
        start = replace(begin, T=pose_from_coordinates(target, robot.controlled, robot.home))
        return engine.solve(limbs, e, guess, start, free=True, max_iterations=max_iterations)
    t, n = max(len(values), len(target)), target.shape[1]
    flat = np.broadcast_to(target, (t, n, target.shape[2])).reshape(t * n, -1)

    def command(T: FloatArray, rows: np.ndarray) -> tuple[FloatArray, FloatArray]:
        return compare_coordinates(T, flat[rows], robot.controlled, robot.size)

    T = pose_from_coordinates(target, robot.controlled, robot.home) if start is None else start.T
    begin, own = replace(begin, T=np.broadcast_to(T, (t, n, 4, 4))), None
    if robot.assembly.couplings or robot.program.shared_drive_count or held is not None:
        sums = list_open_sums(robot, values, np.zeros(0, int) if held is None else held)
        own = scale_sums(robot, sums.weights, sums.join(sums.read(guess)))
    guess = np.broadcast_to(guess, (t, n, robot.program.n_joints))
    given = begin, command, own is None, max_iterations
    return engine.solve(robot.program, e, guess, *given, sums=own)


def determine_platform(robot: Mechanism) -> bool:
    """Return whether the controlled coordinates state the whole pose, and each limb has as many
    unknown joints as equations, none of which other limbs have.
    """
    is_bound = bool(robot.assembly.couplings) or robot.program.shared_drive_count > 0
    if is_bound or not robot.program.has_square_limbs:
        return False
    if len(robot.controlled) == 6:
        return True
    if set(robot.controlled) != {ANGLES.get(freedom, freedom) for freedom in robot.freedoms}:
        return False
    at_home = read_coordinates(robot.home, robot.controlled)
    same = pose_from_coordinates(at_home, robot.controlled, robot.home)
    return bool(np.abs(same - robot.home).max() < 1e-12)


def moves_by_drives(robot: Mechanism) -> bool:
    """Return whether inverse kinematics solves for the drives: each freed, those of a chain would
    close no loop, an actuator of loops that may stay open would take a part of the gap, and spare
    ones would be free.
    """
    is_open = robot.program.may_stay_open and not robot.has_redundant_sums
    return bool(robot.stages or robot.assembly.held) or is_open or chains.has_spare_drives(robot)


# Inverse kinematics by the forward one: Newton's method on the driven joints, c(T(u)) = c*.

STEPS = 60  # newton steps of a row
CLOSE, CLOSE_ON_PATH = 1e-12, 1e-4
"""Distance from the target coordinates, relative to the robot's size, of a solved row, and of one
that only begins the next step of its path.

A forward solution is known to 1e-13 of the size.
"""
LONGEST_STEP = 0.5  # longest step of a joint: in radians, or relative to the robot's size
# Share of a step that must bring a row closer to its target; below it the target is not reachable
# from here.
SHORTEST_SHARE = 1e-3
PROGRESS, PROGRESS_STEPS, PROGRESS_ON_PATH = 0.5, 10, 5
"""Share of its distance from the target that a row must lose in so many steps, else it has stalled;
fewer on a path, whose targets are near.

In ten steps the longest ones turn a joint by 5 rad. Steps close to a stretched arm gain less.
"""
# Share of its distance from the target that a projected row must be able to lose, to first order,
# beside `CLOSE`, to go on.
SHORT_SHARE = 1e-8
# Relative singular value below which a combination of drives does not move the platform.
DEPENDENT = 1e-9
PATH_STEPS = 8  # steps of the path from the start's pose to a target


@dataclass(frozen=True, eq=False)
class _Iterate(TrialBatch):
    """R rows: their driven joints u, the states (R, 1) of the stages with loops, and the rest.

    u : (R, u) values of joints, of a stage with open sums these sums [m, rad].
    T : (R, 4, 4) end platform [m]. D : (R, 6, u) its twists by the drives, NaN with open loops.
    gap : (R,) distance from the target [m]. left : (R,) the part of it that the iteration removes.
    step : (R, u) Newton step. sign : (R,) of det(C D), 1 with more drives than coordinates.
    status, count : (R,) of the iteration.
    """

    u: FloatArray
    loops: tuple[State, ...]
    T: FloatArray
    D: FloatArray
    gap: FloatArray
    left: FloatArray
    step: FloatArray
    sign: FloatArray
    status: NDArray[np.int8]
    count: IntArray


@dataclass(frozen=True, eq=False)
class _Rows:
    """R rows of a robot: what the parameter values make of it, and their targets.

    A robot of one stage is a chain of itself.

    values : (1 | R, p). target : (R, c) controlled coordinates. e, sums, drives, fronts : of each
        stage displacements or `Placed` links without loops, open sums, transmissions, and the frame
        before its first joint, of loops their base, in the platform that carries it, (1 | R, ..).
    serial : (s,) places of the joints of serial stages. behind, advance : (1 | R, s, ..) links
        behind these joints, and their advances.
    sign : (R,) of det(C D) at the start. moving : drives that carry the end platform.
    turns : (u,) whether each drive turns joints, so that its unit counts for the robot's size.
    spans : (u,) strokes of the drives, of which steps take equal shares with more drives than
        coordinates; a full turn or the size without a stroke, and where the step is unique.
    poses : (R, 4, 4) in place of coordinates, of which the nearest ones are searched for.
    known : the iterate of home, once it is known.
    """

    shared: ClassVar[tuple[str, ...]] = ("robot", "serial", "turns", "spans", "moving", "known")

    robot: Mechanism
    values: FloatArray
    target: FloatArray
    e: tuple[Any, ...]
    sums: tuple[OpenSums | None, ...]
    drives: tuple[Transmissions, ...]
    fronts: tuple[FloatArray, ...]
    serial: IntArray
    behind: FloatArray
    advance: FloatArray
    sign: FloatArray
    turns: BoolArray
    spans: FloatArray
    moving: IntArray
    poses: FloatArray | None = None
    known: dict[str, _Iterate] = field(default_factory=dict)

    def select(self, rows: IntArray) -> _Rows:
        """Return some rows by their positions."""
        if np.array_equal(rows, np.arange(len(self.target))):
            return self
        return map_arrays(lambda a: a if len(a) == 1 else a[rows], self)

    def evaluate(self, u: FloatArray, begin: tuple[State, ...]) -> _Iterate:
        """Return the iterate at driven joints u (R, u); its gap is infinite for an open loop."""
        return self.aim(self.locate(u, begin))

    def locate(self, u: FloatArray, begin: tuple[State, ...]) -> _Iterate:
        """Return the iterate at driven joints u (R, u), without the target."""
        ok, loops, states = np.isfinite(u).all(axis=1), iter(begin), list[State]()
        T, platforms, moved = np.eye(4), {-1: np.eye(4)}, list[tuple[Any, ...]]()
        with np.errstate(invalid="ignore"):
            turned = self.turns[self.serial]
            steps = move_joints(turned, u[:, self.serial], self.advance) @ self.behind
            joints = zip(self.serial[:, None], self.advance.T, steps.swapaxes(0, 1), strict=True)
            for i, (stage, sums) in enumerate(zip(self.robot.blocks, self.sums, strict=True)):
                robot, first = stage.robot, stage.actuators.start
                T = platforms[stage.parent] @ self.fronts[i]
                if robot.is_serial:
                    for j, advance, step in islice(joints, robot.program.n_joints):
                        axis = T[..., :3, 2:3]
                        by_joint = axis * self.turns[j], axis * advance[:, None, None]
                        moved.append((i, j, *by_joint, T))
                        T = T @ step
                else:
                    own, weights, by_sums = _select_drives(stage, u), None, None
                    if sums is not None:
                        weights, own = sums.weights, sums.complete(u[:, None, stage.actuators])
                        if not robot.has_open_sums and weights.shape[1] == weights.shape[2]:
                            weights, by_sums = None, invert_weights(weights)
                            own = apply_weights(by_sums, own)
                    state = Loops(robot, self.e[i], weights).close(own, next(loops), follow=False)
                    states.append(state)
                    ok &= state.status[:, 0] == CONVERGED
                    by_drive = differentiate_by_drives(robot, self.e[i], own, state, weights)[:, 0]
                    if by_sums is not None:
                        by_drive = by_drive @ by_sums
                    places = np.arange(by_drive.shape[2]) if sums is None else sums.places
                    twists = by_drive[..., : len(places)].reshape(len(u), 2, 3, -1)
                    twists, T = T[..., None, :3, :3] @ twists, T @ state.T[:, 0]
                    moved.append((i, first + places, twists[:, 0], twists[:, 1], T))
                platforms[i] = T
            D, carrying = np.zeros((len(u), 6, u.shape[1])), chains.list_carrying_stages(self.robot)
            for i, places, turned, shifted, at in moved:
                if i in carrying:
                    arm = T[..., :3, 3] - at[..., :3, 3]
                    D[:, :3, places] = turned
                    D[:, 3:, places] = shifted - geometry.hat(arm) @ turned
        D[~ok] = np.nan
        none = np.zeros(len(u))
        status, zero = none.astype(np.int8), np.zeros_like(u)
        T = np.broadcast_to(T, (len(u), 4, 4))
        parts = tuple(states), T, D, none, none, zero, none, status, none.astype(int)
        return _Iterate(u, *parts)

    def compare(self, T: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return how far poses (R, 4, 4) are from the targets (R, c) [m], and the columns (R, c, 6)
        per twist.
        """
        robot = self.robot
        if self.poses is None:
            return compare_coordinates(T, self.target, robot.controlled, robot.size)
        gap = geometry.pose_difference(T, self.poses) * robot.twist_scale
        return gap, np.broadcast_to(np.diag(robot.twist_scale), (len(T), 6, 6))

    def aim(self, now: _Iterate) -> _Iterate:
        """Return an iterate with the distance from the target and the step towards it."""
        with np.errstate(invalid="ignore"):
            residual, columns = self.compare(now.T)
            slope = np.matmul(columns, now.D)[..., self.moving] * self.spans[self.moving]
        ok = np.isfinite(slope).all(axis=(1, 2)) & np.isfinite(residual).all(axis=1)
        if not ok.all():
            slope[~ok], residual[~ok] = np.eye(*slope.shape[1:]), 0.0
        is_square = slope.shape[1] == slope.shape[2] and self.poses is None
        sign = np.sign(np.linalg.det(slope)) if is_square else np.ones(len(ok))
        inverse = np.linalg.inv(slope) if is_square and sign.all() else _invert_slopes(slope)
        moved = -np.matmul(inverse, residual[..., None])
        step = np.zeros_like(now.u)
        step[:, self.moving] = moved[..., 0]
        step *= self.spans
        gap = left = np.where(ok, np.linalg.norm(residual, axis=1), np.inf)
        if self.poses is not None:
            left = np.where(ok, np.linalg.norm(np.matmul(slope, moved)[..., 0], axis=1), np.inf)
        return replace(
            now, gap=gap, left=left, step=self.limit_steps(step), sign=np.where(ok, sign, 0.0)
        )

    def is_in_other_mode(self, now: _Iterate) -> BoolArray:
        """Return the rows (R,) beyond a singularity, of which an open start knows none, or beyond
        the dead center of a triangle drive.
        """
        beyond = (now.sign != self.sign) & (self.sign != 0.0)
        for stage, drives in zip(self.robot.blocks, self.drives, strict=True):
            triangles, chosen = drives.triangles, stage.robot.determining_readings
            if chosen is not None:
                triangles = np.intersect1d(triangles, chosen)
            if len(triangles):
                u = _select_drives(stage, now.u)
                weights = drives.weights
                if weights is not None and weights.shape[2] == u.shape[2]:
                    u = apply_weights(weights, u)
                beyond |= drives.find_reversed(u, triangles)[:, 0].any(axis=1)
        return beyond

    def iterate(self, start: _Iterate, on_path: bool = False) -> _Iterate:
        """Return the last iterates from a start; a row has arrived if its gap is small.

        The status of a row that has not arrived in its mode says why.
        """
        size, R = self.robot.size, len(start.u)
        close = (CLOSE_ON_PATH if on_path else CLOSE) * size
        period = PROGRESS_STEPS if self.poses is None and not on_path else PROGRESS_ON_PATH
        done = now = start
        rows, alive, share, step = self, np.arange(R), np.ones(R), start.step
        before = now.left
        for count in range(STEPS + 1):
            broken = ~np.isfinite(now.gap)
            arrived = ~broken & (now.left <= close + SHORT_SHARE * now.gap)
            end = arrived | broken | (share < SHORTEST_SHARE)
            if count % period == 0 and count:
                end |= now.left > PROGRESS * before
                before = now.left
            if end.any() or count == STEPS:
                status = np.where(end, np.int8(STALLED), np.int8(EXHAUSTED))
                status[broken], status[arrived] = NOT_FINITE, CONVERGED
                now = replace(now, status=status, count=np.full(len(end), count))
                done = done.put(alive, now)
                keep = np.flatnonzero(~end)
                if not len(keep) or count == STEPS:
                    break
                rows, now = rows.select(keep), now.take(keep)
                alive, share, before, step = alive[keep], share[keep], before[keep], step[keep]
            trial = rows.evaluate(now.u + share[:, None] * step, now.loops)
            square = (1.0 + ROUNDED) * now.gap**2 - 2e-4 * share * now.left**2
            better = trial.gap <= np.maximum(np.sqrt(square.clip(min=0.0)), close)
            share = np.where(better, np.minimum(1.0, 4 * share), 0.25 * share)
            last = now
            if better.all():
                now = trial
            elif better.any():
                chosen = np.flatnonzero(better)
                now = now.put(chosen, trial.take(chosen))
            step = now.step
            if rows.poses is not None:  # a step that failed is followed by a plain one
                share = np.where(better, 1.0, share)
                step = np.where(better[:, None], rows.extrapolate(last, now), step)
        is_other = (done.status == CONVERGED) & self.is_in_other_mode(done)
        return replace(done, status=np.where(is_other, np.int8(Status.OTHER_MODE), done.status))

    def extrapolate(self, last: _Iterate, now: _Iterate) -> FloatArray:
        """Return steps (R, u) to where two iterates let their steps end, in a straight line.

        Gauss-Newton steps towards a pose that is not reachable shrink by a nearly constant share.
        Source: Anderson, J. ACM 12 (1965), with one step before.
        """
        moved, change = now.u - last.u, now.step - last.step
        scaled = change / self.spans**2
        square = (scaled * change).sum(axis=1, keepdims=True)
        share = (scaled * now.step).sum(axis=1, keepdims=True) / np.where(square, square, 1.0)
        return self.limit_steps(now.step - share * (moved + change))

    def limit_steps(self, step: FloatArray) -> FloatArray:
        """Return steps (R, u) that move no joint farther than the longest step."""
        moved = np.abs(step) / np.where(self.turns, 1.0, self.robot.size)
        length = moved.max(axis=1, initial=0.0)
        return step * (LONGEST_STEP / np.maximum(length, LONGEST_STEP))[:, None]

    def join_states(self, now: _Iterate) -> State:
        """Return the state (R, 1) at an iterate."""
        loops = iter(now.loops)
        states = [
            solve_serial(stage.robot, e, _select_drives(stage, now.u))
            if stage.robot.is_serial
            else next(loops)
            for stage, e in zip(self.robot.blocks, self.e, strict=True)
        ]
        return chains.join_stage_states(self.robot, states)


def _invert_slopes(slope: FloatArray) -> FloatArray:
    """Return pseudo-inverses (R, u, c) of slopes (R, c, u), without dependent combinations."""
    if slope.shape[1] <= slope.shape[2]:
        orthogonal, triangle = np.linalg.qr(slope.swapaxes(1, 2))
        pivots = np.abs(np.einsum("...ii->...i", triangle))  # up to 2^c singular values
        if (pivots.min(axis=1) > 2.0 ** slope.shape[1] * DEPENDENT * pivots.max(axis=1)).all():
            return np.matmul(orthogonal, np.linalg.inv(triangle).swapaxes(1, 2))
    return np.asarray(np.linalg.pinv(slope, rcond=DEPENDENT), np.float64)


def _select_drives(stage: Stage, u: FloatArray) -> FloatArray:
    """Return the driven joints (R, 1, a) of a stage."""
    return u[:, None, stage.actuators][..., : stage.robot.program.n_joints]


def _solve_by_drives(
    robot: Mechanism, values: FloatArray, target: FloatArray, begin: State, follow: bool
) -> State:
    """Return states (t, n) at controlled coordinates (t | 1, n, c) by the values of the drives;
    marks rows that fail.

    Rows of loops that may stay open begin with each joint free, which is almost right, and at the
    start where the orientation follows the position. Without `follow`, rows that
    fail are not solved again along a path.
    """
    t, n = max(len(values), len(target)), target.shape[1]
    if not begin.closure_sign.any():
        # the guess of a home that is searched for has no sign yet
        count = max(t, len(begin.T)), begin.T.shape[1]
        whole = map_arrays(lambda a: np.broadcast_to(a, (*count, *a.shape[2:])), begin)
        begin = replace(whole, closure_sign=compute_closure_sign(robot, values, whole))
    wanted = np.broadcast_to(target, (t, n, target.shape[2])).reshape(t * n, -1)
    own = values if len(values) == 1 else np.repeat(values, n, axis=0)
    rows, is_open = _make_rows(robot, own, wanted), robot.program.may_stay_open and not robot.stages
    first = begin
    if is_open or len(values) > 1 or begin.T.shape[:2] != (1, 1):
        first = begin.select((t, n), *np.divmod(np.arange(t * n), n))
    start = _begin(rows, first)
    rows = replace(rows, sign=start.sign)
    last = rows.iterate(_begin_near_targets(rows, start, first) if is_open else start)
    wrong = np.flatnonzero(last.status != CONVERGED)
    if follow and len(wrong):
        last = last.put(wrong, _follow_path(rows.select(wrong), start.take(wrong)))
    status = np.where(np.isfinite(wanted).all(axis=1), last.status, np.int8(NOT_FINITE))
    state, left, failed = rows.join_states(last), np.zeros(len(status)), status != CONVERGED
    if failed.any():
        gap, _ = compare_coordinates(last.T[failed], wanted[failed], robot.controlled, robot.size)
        left[failed] = np.linalg.norm(gap, axis=1)
    state = replace(
        state, status=status[:, None], residual=left[:, None], iterations=last.count[:, None]
    )
    return map_arrays(lambda a: a.reshape(t, n, *a.shape[2:]), state)


def _make_rows(robot: Mechanism, values: FloatArray, target: FloatArray) -> _Rows:
    """Return rows with values (1 | R, p) and targets (R, c). Those of one set are kept."""
    rows: _Rows | None = robot.derived.get("rows")
    if rows is None or not np.array_equal(values, rows.values):
        rows = _place_rows(robot, values)
        if len(values) == 1:
            robot.derived["rows"] = rows
    return replace(rows, target=target, sign=np.zeros(len(target)))


def _place_rows(robot: Mechanism, values: FloatArray) -> _Rows:
    """Return rows with values (1 | R, p), without targets."""
    robot, parts, turns = robot.exact, list[tuple[Any, ...]](), list[bool]()
    serial, behind = [np.zeros(0, np.int64)], [np.zeros((len(values), 0, 4, 4))]
    advance = [np.zeros((len(values), 0))]
    for stage in robot.blocks:
        own, assembly = values[:, stage.parameters], stage.robot.assembly
        (e, drives), front = stage.robot.slots(own), stage.mount[None]
        chosen, has_sums = stage.robot.determining_readings, stage.robot.has_open_sums
        has_sums |= bool(assembly.couplings) or chosen is not None
        if stage.robot.is_serial:
            (group,) = stage.robot.program.groups
            links, advances = e = place_serial(group, e)
            front = stage.mount @ links[:, 0]
            serial.append(stage.actuators.start + group.actuator[:-1, 0])
            behind.append(links[:, 1:])
            advance.append(advances)
        sums = list_open_sums(stage.robot, own, chosen) if has_sums else None
        parts.append((e, sums, drives, front))
        moved = [(name,) for name in assembly.driven_joints]
        if has_sums:
            moved = [actuator.driven_joints for actuator in assembly.actuators]
        moved += [()] * (len(assembly.actuators) - len(moved))  # conditions
        turns += [not assembly.turning_drives.isdisjoint(names) for names in moved]
    (e, sums, drives, fronts), turning = zip(*parts, strict=True), np.array(turns)
    spans, moving = measure_spans(robot, turning), chains.find_carrying_actuators(robot)
    links, advances = (np.concatenate(own, axis=1) for own in (behind, advance))
    fixed = e, sums, drives, fronts, np.concatenate(serial), links, advances
    return _Rows(robot, values, np.zeros((0, 0)), *fixed, np.zeros(0), turning, spans, moving)


def measure_spans(robot: Mechanism, turns: BoolArray) -> FloatArray:
    """Return the `spans` of the drives (u,) of a robot."""
    spans = np.where(turns, 2 * np.pi, robot.size)
    if chains.has_spare_drives(robot):
        _, drives = robot.present
        at_rest = ((np.nan if a.reference is None else a.reference,) * 2 for a in robot.actuators)
        strokes = np.array([a.stroke or e for a, e in zip(robot.actuators, at_rest, strict=True)])
        # else readings are open sums
        has_all = robot.is_commanded.sum() == robot.program.n_joints
        convert = drives.find_joints if has_all else drives.transmit
        ends = convert(strokes.T[None])[0][:, ~drives.fixed_rows]
        stated, own = np.abs(ends[1] - ends[0]), np.flatnonzero(robot.is_commanded)
        spans[own] = np.where(stated > 0.0, stated, spans[own])
    return spans


def _begin(rows: _Rows, first: State) -> _Iterate:
    """Return the iterates of a state (R, 1), or of one (1, 1) for all rows."""
    known, R = rows.known if first is rows.robot.home_state else {}, len(rows.target)
    if "home" not in known:
        u, loops = np.zeros((len(first.T), len(rows.robot.actuators))), list[State]()
        states = chains.split_stage_states(rows.robot, first)
        for stage, own, sums in zip(rows.robot.blocks, states, rows.sums, strict=True):
            joints = driven_values(stage.robot.program, own)
            joints = joints if sums is None else sums.read(joints)
            # a condition behind the joints moves none
            places = np.arange(joints.shape[2]) if sums is None else sums.places
            u[:, stage.actuators.start + places] = joints[:, 0]
            if not stage.robot.is_serial:
                loops.append(own)
        known["home"] = rows.locate(u, tuple(loops))
    if len((now := known["home"]).u) < R:
        now = map_arrays(lambda a: np.broadcast_to(a, (R, *a.shape[1:])), now)
    return rows.aim(now)


def _begin_near_targets(rows: _Rows, start: _Iterate, first: State) -> _Iterate:
    """Return the iterates at which rows begin: the proposed ones, or the first."""
    target = rows.target.reshape(*first.T.shape[:2], -1)
    near = close_with_free_actuators(rows.robot, rows.values, target, first, first)
    good = np.flatnonzero(near.status[:, 0] == CONVERGED)
    if not len(good):
        return start
    # the start selects the side of the singularities
    near = replace(near, closure_sign=first.closure_sign)
    own = _begin(rows.select(good), map_arrays(lambda a: a[good], near))
    return start.put(good, own)


def _follow_path(rows: _Rows, start: _Iterate) -> _Iterate:
    """Return the last iterates of rows solved along the straight path of poses from their start."""
    controlled, now = rows.robot.controlled, start
    goal = pose_from_coordinates(rows.target, controlled, start.T)
    twist = geometry.pose_difference(goal, start.T)
    alive = np.arange(len(goal))
    for i in range(1, PATH_STEPS + 1):
        via = geometry.apply_twist(start.T[alive], (i / PATH_STEPS) * twist[alive])
        part = replace(rows.select(alive), target=read_coordinates(via, controlled))
        moved = part.iterate(part.aim(now.take(alive)), i < PATH_STEPS)
        now = now.put(alive, moved)
        alive = alive[moved.status == CONVERGED]
        if not len(alive):
            break
    return now


# The reachable pose nearest to one that takes more freedoms than the robot has.

# A pose is the nearest one where a step changes the distance by at most this share to first order,
# or by this share of `REACHED`, where the target itself is reachable.
STATIONARY = 1e-6
REACHED = 1e-3  # distance below which a target counts as reachable, relative to the robot's size


def find_nearest_reachable(
    robot: Mechanism, values: FloatArray, T: FloatArray, start: State | None = None
) -> State:
    """Return states (1, n) with the reachable poses nearest to T (1, n, 4, 4), without signs; a row
    whose search ends before the distance is stationary is `NOT_CONVERGED`.
    """
    wanted = read_coordinates(T, robot.controlled)
    state = close_at_coordinates(robot, values, wanted, start)
    closed = np.flatnonzero(state.status[0] == CONVERGED)
    if controls_all(robot) or not len(closed):
        return state
    first = map_arrays(lambda a: a[0, closed, None], state)
    if not moves_by_drives(robot):
        first = replace(first, closure_sign=compute_closure_sign(robot, values, first))
    rows = replace(_make_rows(robot, values, wanted[0, closed]), poses=T[0, closed])
    begin = _begin(rows, first)
    end = rows.iterate(begin)
    ended_early = end.left > STATIONARY * np.maximum(end.gap, REACHED * robot.size)
    moved = np.flatnonzero((end.u != begin.u).any(axis=1))
    state = replace(state, status=state.status.copy())
    if len(moved):
        last = rows.join_states(end)
        last = map_arrays(lambda a: a[None, moved, 0], last)
        near = read_coordinates(last.T, robot.controlled)
        last = close_at_coordinates(robot, values, near, last, follow=False)
        state = put_poses(state, closed[moved], last)
    state.status[0, closed[ended_early]] = Status.NOT_CONVERGED
    return state


def controls_all(robot: Mechanism) -> bool:
    """Return whether the controlled coordinates state each freedom of the platform."""
    return len(robot.controlled) == 6 or set(robot.controlled) == set(robot.freedoms)
