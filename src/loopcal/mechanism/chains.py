# SPDX-License-Identifier: Apache-2.0
"""Forward kinematics and derivatives of chains; those of a single stage are handed over.

With T_s = T_parent M_s X_s(q_s), M_s the mount and X_s the pose of stage s in its own base, the
twist of the end platform is the sum of the twists of the stages that carry it, each transported:
omega = R_s omega_s, v = R_s v_s + omega x (p_end - p_s). Derivation: docs/theory/stages.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from loopcal import geometry
from loopcal.engine import BASE, CONVERGED, EXHAUSTED, NOT_FINITE, PITCH, PLATFORM, STALLED, State
from loopcal.mechanism.actuation import Derivatives
from loopcal.mechanism.limb_rows import follow_limb, measure_rod
from loopcal.mechanism.model import Mechanism, ParameterUnits, Stage
from loopcal.mechanism.platform_coordinates import (
    POSITION,
    compare_coordinates,
    pose_from_coordinates,
    read_coordinates,
)
from loopcal.mechanism.states import Status, driven_values
from loopcal.mechanism.transmission import joint_slopes, readings_from_joints
from loopcal.numerics.trial_batch import map_arrays
from loopcal.typing import BoolArray, FloatArray, IntArray

# States of a chain: those of its stages, joined, and the frames of its platforms.

SEVERITY = (CONVERGED, EXHAUSTED, STALLED, NOT_FINITE)
"""Statuses of stages, of which the last one in this order is that of the chain. Any other status,
such as that of another mode, is less severe than an open loop."""


@dataclass(frozen=True, eq=False)
class ChainState(State):
    """Positions of a chain for t trials and n poses.

    T is the end platform in the base, `joints` those of all stages one after the other. Status and
    residual are the worst of the stages, the closure sign is the product of theirs.

    poses : for each stage, its platform in its own base (t, n, 4, 4) [m].
    signs : for each stage, its closure sign (t, n).
    """

    poses: tuple[FloatArray, ...] = ()
    signs: tuple[NDArray[np.int8], ...] = ()


def join_stage_states(robot: Mechanism, states: Sequence[State]) -> ChainState:
    """Return the state of a chain (t, n) whose stages have these states (t, n)."""
    poses = tuple(state.T for state in states)

    def rank(status: NDArray[np.int8]) -> NDArray[np.int8]:
        severity = np.ones(status.shape, np.int8)  # of another mode, among others
        for place, known in enumerate(SEVERITY):
            severity[status == known] = 0 if known == CONVERGED else place + 1
        return severity

    status = states[0].status
    for state in states[1:]:
        status = np.where(rank(state.status) > rank(status), state.status, status)
    return ChainState(
        locate_stage_bases(robot.stages, poses)[1][-1],
        tuple(joints for state in states for joints in state.joints),
        status.astype(np.int8),
        np.maximum.reduce([state.residual for state in states]),
        np.maximum.reduce([state.iterations for state in states]),
        np.multiply.reduce([state.closure_sign for state in states]).astype(np.int8),
        tuple(body for state in states for body in state.others),
        poses,
        tuple(state.closure_sign for state in states),
    )


def split_stage_states(robot: Mechanism, state: State) -> list[State]:
    """Return the states of the stages of a chain; each has the status of the chain."""
    assert isinstance(state, ChainState)
    counts = [len(stage.robot.program.others) for stage in robot.stages]
    first = np.cumsum([0, *counts])
    return [
        State(
            pose,
            state.joints[stage.groups],
            state.status,
            state.residual,
            state.iterations,
            sign,
            state.others[first[i] : first[i + 1]],
        )
        for i, (stage, pose, sign) in enumerate(
            zip(robot.stages, state.poses, state.signs, strict=True)
        )
    ]


def locate_stage_bases(
    stages: Sequence[Stage], poses: Sequence[FloatArray]
) -> tuple[list[FloatArray], list[FloatArray]]:
    """Return the bases and the platforms of all stages in the base of the chain, of the poses (..,
    4, 4) of stages; a base that does not move is (4, 4).
    """
    bases: list[FloatArray] = []
    platforms: list[FloatArray] = []
    for stage, pose in zip(stages, poses, strict=True):
        base = stage.mount if stage.parent < 0 else platforms[stage.parent] @ stage.mount
        bases.append(base)
        platforms.append(base @ pose)
    return bases, platforms


def get_platforms(robot: Mechanism, state: State) -> list[FloatArray]:
    """Return the platforms of all stages in the base at a state (t, n), each (t, n, 4, 4)."""
    assert isinstance(state, ChainState)
    return locate_stage_bases(robot.stages, state.poses)[1]


def select_readings(q: FloatArray, stage: Stage, count: int) -> FloatArray:
    """Return the readings of a stage among those (.., a) of a chain with `count` actuators, or
    those (.., 2 a) with the directions of approach.
    """
    own = q[..., :count][..., stage.actuators]
    if q.shape[-1] == count:
        return own
    return np.concatenate([own, q[..., count:][..., stage.actuators]], axis=-1)


def each_stage(
    robot: Mechanism, values: FloatArray, state: State
) -> Iterator[tuple[Stage, FloatArray, State]]:
    """Yield the stages of a chain with their own values and states."""
    for stage, own in zip(robot.stages, split_stage_states(robot, state), strict=True):
        yield stage, values[:, stage.parameters], own


def list_carrying_stages(robot: Mechanism, end: int = -1) -> list[int]:
    """Return the stages that carry the platform of a stage (default: the end), from the base on."""
    carrying, i = [], end % len(robot.stages)
    while i >= 0:
        carrying.append(i)
        i = robot.stages[i].parent
    return carrying[::-1]


def find_carrying_actuators(robot: Mechanism) -> IntArray:
    """Return the places of the actuators that move the end platform."""
    places = np.arange(len(robot.actuators))
    if not robot.stages:
        return places
    stages = [robot.stages[i] for i in list_carrying_stages(robot)]
    return np.concatenate([places[stage.actuators] for stage in stages])


def transport_to_end(robot: Mechanism, state: State, end: int) -> list[tuple[int, FloatArray]]:
    """Return the stages that carry a platform, and the maps (t, n, 6, 6) of their twists to it.

    A twist of a stage is in the axes of its base, at its platform; the result in base axes, at
    `end`.
    """
    assert isinstance(state, ChainState)
    bases, platforms = locate_stage_bases(robot.stages, state.poses)
    transports = []
    for i in list_carrying_stages(robot, end):
        rotation = bases[i][..., :3, :3]
        arm = platforms[end][..., :3, 3] - platforms[i][..., :3, 3]
        own = np.matmul(np.swapaxes(rotation, -1, -2), arm[..., None])[..., 0]
        transports.append((i, geometry.transport_matrix(own, rotation)))
    return transports


StageSolver = Callable[[Mechanism, FloatArray, FloatArray, State | None], State]
"""Solves forward kinematics of one stage at values (t | 1, p) and readings (t | 1, n, a), as
`forward_trials` does.
"""
PoseDerivative = Callable[..., Derivatives]
"""Differentiates the pose of one stage, as `differentiate_pose` does."""
JointDerivative = Callable[[Mechanism, FloatArray, FloatArray, State], Any]
"""Differentiates the passive joints of one stage, as `differentiate_passive_joints` does."""


def solve_stages(
    robot: Mechanism, values: FloatArray, q: FloatArray, start: State | None, solve: StageSolver
) -> ChainState:
    """Solve forward kinematics of a chain for readings q (t | 1, n, a) and values (t | 1, p) from
    `start` (default: home).
    """
    begins = [None] * len(robot.stages) if start is None else split_stage_states(robot, start)
    count = len(robot.actuators)
    states = [
        solve(stage.robot, values[:, stage.parameters], select_readings(q, stage, count), begin)
        for stage, begin in zip(robot.stages, begins, strict=True)
    ]
    return join_stage_states(robot, states)


def judge_stage_modes(
    robot: Mechanism,
    state: State,
    begin: State,
    judge: Callable[[Mechanism, State, State], tuple[State, BoolArray]],
) -> tuple[State, BoolArray]:
    """Return a state (1, n) with closure signs, and its rows in which a stage is in another mode.

    `judge` is the same function of a stage at its present values.
    """
    is_other, judged = np.zeros(state.T.shape[1], bool), []
    states, begins = split_stage_states(robot, state), split_stage_states(robot, begin)
    for stage, own, first in zip(robot.stages, states, begins, strict=True):
        machine = stage.robot.with_values(robot.values[stage.parameters])
        part, is_part_other = judge(machine, own, first)
        judged.append(part)
        is_other |= is_part_other
    whole = join_stage_states(robot, judged)
    return replace(state, closure_sign=whole.closure_sign, signs=whole.signs), is_other


def differentiate_platform(
    robot: Mechanism,
    values: FloatArray,
    q: FloatArray,
    state: State,
    differentiate: PoseDerivative,
    columns: ParameterUnits | None = None,
    end: int = -1,
) -> Derivatives:
    """Return the derivatives of the twist of the platform of a stage (default: the end), by the
    parameters, all in SI or those of `columns`, and the readings: (t, n, 6, p) and (t, n, 6, a).

    Only the stages that carry the platform are differentiated.
    """
    columns = columns or robot.all_parameters
    count, states = len(robot.actuators), split_stage_states(robot, state)
    whole = _make_zeros(robot, state, 6, len(columns.places))
    for i, transport in transport_to_end(robot, state, end):
        stage = robot.stages[i]
        first, last = stage.parameters.start, stage.parameters.stop
        place = np.flatnonzero((columns.places >= first) & (columns.places < last))
        own_columns = ParameterUnits(
            stage.robot.slots, columns.places[place] - first, columns.units[place]
        )
        own = differentiate(
            stage.robot,
            values[:, stage.parameters],
            select_readings(q, stage, count),
            states[i],
            own_columns,
        )
        whole.parameters[..., place] = np.matmul(transport, own.parameters)
        whole.readings[..., stage.actuators] = np.matmul(transport, own.readings)
    return whole


def differentiate_joints(
    robot: Mechanism,
    values: FloatArray,
    q: FloatArray,
    state: State,
    differentiate: JointDerivative,
) -> Derivatives:
    """Return the derivatives of the passive joints of all stages, (t, n, j, p) and (t, n, j, a)."""
    count = len(robot.actuators)
    own = [
        differentiate(stage.robot, of_stage, select_readings(q, stage, count), part)
        for stage, of_stage, part in each_stage(robot, values, state)
    ]
    rows = sum(part.parameters.shape[2] for part in own)
    whole = _make_zeros(robot, state, rows, len(robot.parameters))
    first = 0
    for stage, part in zip(robot.stages, own, strict=True):
        last = first + part.parameters.shape[2]
        whole.parameters[:, :, first:last, stage.parameters] = part.parameters
        whole.readings[:, :, first:last, stage.actuators] = part.readings
        first = last
    return whole


def name_platform_entries(stage: str) -> tuple[str, ...]:
    """Return the names of the twelve numbers of the platform of a stage, [R t] row by row."""
    return tuple(f"{stage}:T{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3, 4))


def select_platform_entries(robot: Mechanism, state: State) -> dict[str, FloatArray]:
    """Return the numbers of the platforms of all stages in the base by name, each (t, n)."""
    entries: dict[str, FloatArray] = {}
    for stage, T in zip(robot.stages, get_platforms(robot, state), strict=True):
        numbers = np.moveaxis(T[..., :3, :].reshape(*T.shape[:-2], 12), -1, 0)
        entries |= dict(zip(name_platform_entries(stage.name), numbers, strict=True))
    return entries


def differentiate_platform_entries(
    robot: Mechanism,
    values: FloatArray,
    q: FloatArray,
    state: State,
    differentiate: PoseDerivative,
    name: str,
) -> Derivatives:
    """Return the derivatives of the numbers of a platform, (t, n, 12, p) and (t, n, 12, a).

    A column r of the rotation moves by omega x r, the origin by v.
    """
    i = [stage.name for stage in robot.stages].index(name)
    twist = differentiate_platform(robot, values, q, state, differentiate, end=i)
    slope = geometry.differentiate_entries(get_platforms(robot, state)[i])
    return Derivatives(*(slope @ part for part in twist))


def _make_zeros(robot: Mechanism, state: State, rows: int, columns: int) -> Derivatives:
    """Return derivatives (t, n, rows, ..) of zero by `columns` parameters and all readings."""
    t, n = state.T.shape[:2]
    return Derivatives(
        np.zeros((t, n, rows, columns)), np.zeros((t, n, rows, len(robot.actuators)))
    )


# A sphere that the platform cannot leave, from the lengths of the links.

ROUNDING = 1e-9
"""Excess, relative to the robot's size, of a target at the bound itself."""


def measure_target_excess(robot: Mechanism, values: FloatArray, target: FloatArray) -> FloatArray:
    """Return how far (R,) coordinates (R, c) lie beyond what links can span [m]; at most 0 within.

    values : (1 | R, p). Coordinates of the position that are not controlled are free.
    """
    columns = [i for i, name in enumerate(robot.controlled) if name in POSITION]
    if not columns:
        return np.full(len(target), -np.inf)
    center, radius = bound_platform(robot, values)
    axes = [POSITION.index(robot.controlled[i]) for i in columns]
    far = np.linalg.norm(target[:, columns] - center[:, axes], axis=1)
    return far - radius - ROUNDING * robot.size


def bound_platform(robot: Mechanism, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return center (t, 3) and radius (t,) of a sphere around all positions of the platform [m].

    values : (t, p). The radius is infinite where no limb bounds it.
    """
    if not robot.stages:
        return _bound_by_limbs(robot, values)
    whole, first = np.zeros(len(values)), np.zeros((len(values), 3))
    for number, i in enumerate(list_carrying_stages(robot)):
        stage = robot.stages[i]
        center, radius = bound_platform(stage.robot, values[:, stage.parameters])
        center = center @ stage.mount[:3, :3].T + stage.mount[:3, 3]
        if number:  # both turn with the platform before
            whole = whole + np.linalg.norm(center, axis=1)
        else:
            first = center
        whole = whole + radius
    return first, whole


def _bound_by_limbs(robot: Mechanism, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the smallest sphere (t, 3), (t,) about the first joint of a limb."""
    center, radius = np.zeros((len(values), 3)), np.full(len(values), np.inf)
    is_exact = robot.is_serial or (robot.program.is_square and not robot.program.may_stay_open)
    if not is_exact:  # loops of redundant actuators, among others, may stay open
        return center, radius
    e, _ = robot.slots(values)
    for group, joints in zip(robot.program.groups, robot.home_state.joints, strict=True):
        displacements = e[:, group.columns].reshape(len(e), len(group.limbs), -1)
        for k in range(len(group.limbs)):
            if (group.on[k], group.to[k]) != (BASE, PLATFORM):
                continue
            slides = "P" in group.joints or bool(group.pitch[k].any()) or group.actuator[-1, k] >= 0
            if slides or any(slot.axis == PITCH for slot in group.slots):
                continue  # a joint changes the distance of its neighbors
            own = displacements[:, k]
            start = np.broadcast_to(joints[:1, :1, k], (len(own), 1, joints.shape[-1]))
            frames, attachment = follow_limb(group, k, own, start)
            points = np.stack([frame[:, 0, :3, 3] for frame in frames], axis=1)
            length = np.linalg.norm(np.diff(points, axis=1), axis=-1).sum(axis=1)
            length = length + np.linalg.norm(attachment[:, 0, :3, 3], axis=-1)
            length = length + measure_rod(group, k, own)
            shorter = length < radius
            center = np.where(shorter[:, None], points[:, 0], center)
            radius = np.where(shorter, length, radius)
    return center, radius


# Inverse kinematics by the forward one: Newton's method on the readings, c(T(q)) = c*.

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


ForwardSolver = Callable[..., State]
"""Solves forward kinematics, as `forward_trials` does."""
Proposal = Callable[[FloatArray, FloatArray, State], State]
"""Returns states near targets (R, c), whose readings are only almost right, from the values and a
start; states are (1, R) or (R, 1), like the start.
"""


@dataclass(frozen=True, eq=False)
class _Iterate:
    """Readings q (R, a) of R rows, their state, distance from the target (R,) [m], Newton step (R,
    a), and sign of det(C D) (R,).
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
        # no joint moves farther than the longest step: in radians, or sizes of the robot
        joints = (joint for limb in robot.assembly.limbs for joint in limb.joints)
        turning = {joint.actuator for joint in joints if joint.kind == "R"}
        turns = [not turning.isdisjoint(a.driven_joints) for a in robot.actuators]
        _, tau = robot.slots(self.values)
        slopes = np.broadcast_to(joint_slopes(shown, tau, robot.slots.frequency), shown.shape)
        length = np.abs(step * slopes.reshape(q.shape)) / np.where(turns, 1.0, robot.size)
        longest = np.maximum(length.max(axis=1, initial=0.0), LONGEST_STEP)
        return _Iterate(q, state, gap, step * (LONGEST_STEP / longest)[:, None], sign)

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

    With `propose`, rows begin at the states that it returns, if these converged. Without `follow`,
    rows that fail are not solved again along a path.
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
    """Return the last iterates of rows from their start, whose forward solution began at `first`;
    rows with a target beyond what the links span stay at the start.
    """
    is_near = measure_target_excess(rows.robot, rows.values, rows.target) <= 0.0
    stalled = np.full_like(start.state.status, STALLED)
    solved = replace(start, state=replace(start.state, status=stalled))
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


# Forward kinematics of a single limb whose joints are all driven: the product of its links.


def solve_serial(
    robot: Mechanism, e: FloatArray, driven: FloatArray, shape: tuple[int, ...] = (1, 1)
) -> State:
    """Return the state (t, n) at driven joint values (t | 1, n, a) and displacements e (t | 1, d).

    Rows whose joint values are not finite are marked. `shape` : (t, n) of the start, 1 broadcasts.
    """
    (group,) = robot.program.groups
    t, n = max(len(e), len(driven), shape[0]), max(driven.shape[1], shape[1])
    joints = np.zeros((t, n, len(group.actuator)))
    joints[..., : len(group.joints)] = driven[..., group.actuator[: len(group.joints), 0]]
    with np.errstate(invalid="ignore"):
        frames, attachment = follow_limb(group, 0, e, joints)
        T = np.broadcast_to(frames[-1] @ geometry.invert_pose(attachment), (t, n, 4, 4))
    finite = np.isfinite(joints).all(axis=2)
    zero = np.zeros((t, n))
    return State(
        np.array(T),
        (joints[:, :, None],),
        np.where(finite, np.int8(CONVERGED), np.int8(NOT_FINITE)),
        np.where(finite, zero, np.nan),
        zero.astype(np.int64),
        np.ones((t, n), np.int8),
    )
