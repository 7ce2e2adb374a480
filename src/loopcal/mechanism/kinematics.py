# SPDX-License-Identifier: Apache-2.0
"""Forward kinematics of many trials, as engine states (t, n), and frames along limbs.

Arrays are (t, n, ..), where t or n may be 1 and then broadcast. The layers above compute with these
functions; `loopcal.forward` and `loopcal.inverse` wrap them for a single robot.

Source: docs/theory/kinematics.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from loopcal import engine
from loopcal.engine import State
from loopcal.mechanism.actuation import ITERATIONS, DrivenJoints, drive_joints, scale_sums
from loopcal.mechanism.chains import ChainState, each_stage, join_stage_states, locate_stage_bases
from loopcal.mechanism.limb_rows import Placed, follow_links, place_links, place_serial
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.sensitivity import differentiate_pose
from loopcal.mechanism.states import Status, driven_values, list_bodies, replace_rows, without_poses
from loopcal.mechanism.transmission import LOADED, SOURCE, apply_weights, turn_head
from loopcal.numerics.trial_batch import map_arrays
from loopcal.typing import BoolArray, FloatArray

# Loops closed at joint values or their sums, and along straight paths of these from a start.

# Steps of the path from the start's readings, tried in turn where the direct solution fails.
PATH_STEPS = (8, 64)
PART = 4096  # poses of paths that are solved together
WIDE = 1e-2
"""Gap, relative to the robot's size, that the errors of redundant readings do not explain.

A pose that they leave open by more is a wrong minimum.
"""

LOAD_STEPS, SETTLED = 12, 1e-12
"""Most solutions with which loads are found, and their relative change that ends the search. Each
step multiplies the error by about deflection over size."""


def is_square(robot: Mechanism) -> bool:
    """Return whether closure with locked actuators has as many equations as freedoms."""
    if robot.stages:
        return all(is_square(stage.robot) for stage in robot.stages)
    if not robot.has_open_sums:
        return robot.program.is_square
    rows = robot.program.count_equations(free=False) + len(robot.assembly.rows)
    return rows == len(robot.program.unknown_twists) + robot.program.n_joints


def clear_sign(robot: Mechanism, state: State) -> State:
    """Return the state with sign 0 if closure is not square: the sign means nothing there."""
    if is_square(robot):
        return state
    return replace(state, closure_sign=np.zeros_like(state.closure_sign))


def find_wrong_rows(robot: Mechanism, state: State, sign: NDArray[np.int8]) -> BoolArray:
    """Return the rows that failed, ended beyond a singularity from rows of these closure signs, or
    left a wide gap.
    """
    closed = state.status == Status.CONVERGED.value
    beyond = (state.closure_sign != sign) | (state.residual > WIDE * robot.size)
    failed = ~closed & (state.status != Status.NOT_FINITE.value)
    failed &= state.status != engine.NEAR_GOAL
    return failed | closed & beyond


class Loops(NamedTuple):
    """The loops of trials, closed at values of driven joints, or with `weights` at their sums.

    e : (t | 1, d). weights : (t | 1, a, n_joints).
    """

    robot: Mechanism
    e: FloatArray
    weights: FloatArray | None

    @classmethod
    def place(cls, robot: Mechanism, values: FloatArray | None = None) -> Loops:
        """Return the loops of a robot without stages, for values (t | 1, p), default its own."""
        e, drives = robot.present if values is None else robot.slots(values)
        return cls(robot, e, drives.weights if robot.has_open_sums else None)

    def solve(
        self,
        values: FloatArray,
        begin: State,
        goal: State | None = None,
        max_iterations: int = ITERATIONS,
    ) -> State:
        """Return states (t, n) at joint values or sums (t | 1, n, a), by Newton's method alone."""
        if self.robot.is_serial:
            placed = place_serial(self.robot.program.groups[0], self.e)
            return solve_serial(self.robot, placed, values, begin.T.shape[:2])
        given = values, begin, None, False, max_iterations, goal, self.state_sums(values)
        return clear_sign(self.robot, engine.solve(self.robot.program, self.e, *given))

    def close(
        self,
        values: FloatArray,
        start: State | None = None,
        follow: bool = True,
        goal: State | None = None,
    ) -> State:
        """Solve like `forward_trials` for values of joints or their sums (t | 1, n, a)."""
        begin = clear_sign(self.robot, start or self.robot.home_state)
        state = self.solve(values, begin, goal)
        wrong = find_wrong_rows(self.robot, state, begin.closure_sign)
        if self.robot.is_serial or not wrong.any():
            return state
        if not follow:
            beyond = wrong & (state.status == Status.CONVERGED.value)
            return replace(state, status=np.where(beyond, np.int8(Status.OTHER_MODE), state.status))
        return follow_path(self, values, begin, state, wrong)

    def follow(self, values: FloatArray, begin: State, ends: bool) -> State:
        """Return states (t, n) at joint values or sums (t, n, a) one after the other, from `begin`
        (t, 1); see `engine.follow`.
        """
        given = values, begin, ends, ITERATIONS, self.state_sums(values)
        return clear_sign(self.robot, engine.follow(self.robot.program, self.e, *given))

    def state_sums(self, values: FloatArray) -> engine.Sums | None:
        """Return values (t | 1, n, a) as sums of driven joints, None where they are joints."""
        if self.weights is None:
            return None
        return scale_sums(self.robot, self.weights, values)

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


def drive_loops(
    robot: Mechanism, values: FloatArray, q: FloatArray, driven: DrivenJoints | None = None
) -> tuple[Loops, FloatArray]:
    """Return the loops of a robot without stages for values (t | 1, p), and its driven joints or
    open sums (t | 1, n, a) [m, rad] at readings q (t | 1, n, a); `driven` is that of
    `drive_joints`, where it is known.
    """
    if robot.has_open_sums:
        e, drives = robot.slots(values)
        with np.errstate(invalid="ignore"):  # as in `drive_joints`
            return Loops(robot, e, drives.weights), drives.transmit(q)
    e, _, joints = driven or drive_joints(robot, values, q)
    return Loops(robot, e, None), joints


def follow_path(
    loops: Loops, joints: FloatArray, begin: State, state: State, wrong: BoolArray
) -> State:
    """Solve the wrong rows along the straight path of joint values, in ever smaller steps."""
    robot, shape = loops.robot, (state.T.shape[0], state.T.shape[1])
    trial, pose = np.nonzero(wrong)
    loops = loops.select(trial, shape[0])
    target = np.broadcast_to(joints, (*shape, joints.shape[2]))[trial, pose][:, None]
    first, result = begin.select(shape, trial, pose), state.select(shape, trial, pose)
    origin = loops.read(first)
    alive = np.arange(len(trial))
    for count in PATH_STEPS:
        zero = np.zeros(len(alive), int)
        begun = first.select((len(trial), 1), alive, zero)
        path = origin[alive], target[alive]
        current = _take_steps(loops.select(alive), path, begun, count, count == PATH_STEPS[-1])
        result = replace_rows(result, alive, zero, current)
        alive = alive[find_wrong_rows(robot, current, begun.closure_sign)[:, 0]]
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

    With `leave`, a row that fails, opens wide or passes a singularity on the way goes to the end at
    once: the path leaves the reach or the mode of the robot there.
    """
    (origin, target), parts = path, list[State]()
    shares = np.arange(1, count + 1)[:, None] / count
    size = max(PART // count, 1)
    for first in range(0, len(origin), size):
        rows = np.arange(first, min(first + size, len(origin)))
        own, start = loops.select(rows, len(origin)), map_arrays(lambda a, r=rows: a[r], begin)
        values = origin[rows] + (target - origin)[rows] * shares
        states, last = own.follow(values, start, leave), np.full(len(rows), count - 1)
        wrong = np.zeros(len(rows), bool)
        if leave and count > 1:
            sign = np.concatenate([start.closure_sign, states.closure_sign[:, :-2]], axis=1)
            before = map_arrays(lambda a: a[:, :-1], states)
            failed = find_wrong_rows(loops.robot, before, sign)
            failed |= before.status != Status.CONVERGED.value
            wrong = failed.any(axis=1)
            last = np.where(wrong, failed.argmax(axis=1), last)
        done = states.select(states.status.shape, np.arange(len(rows)), last)
        if wrong.any():
            left = np.flatnonzero(wrong)
            end = own.select(left, len(rows)).solve(
                target[rows[left]], map_arrays(lambda a, r=left: a[r], done)
            )
            done = replace_rows(done, left, np.zeros_like(left), end)
        parts.append(done)
    return map_arrays(lambda *arrays: np.concatenate(arrays), *parts)


def forward_trials(
    robot: Mechanism,
    values: FloatArray,
    q: FloatArray,
    start: State | None = None,
    follow: bool = True,
    driven: DrivenJoints | None = None,
) -> State:
    """Solve forward kinematics for readings q (t | 1, n, a) and values (t | 1, p).

    Newton's method begins at `start` (default: home). A row that fails, or ends beyond a
    singularity, is solved again along the straight path from the start's readings. Rows that still
    fail are marked, see `Status`. Redundant readings contradict each other by their errors; a row
    that they leave wide open is solved again too, and marked if it stays open. Without `follow` all
    these rows are marked at once, in a fraction of the time. `driven` is that of
    `drive_joints`, where it is known.
    """
    if not q.shape[1]:
        return without_poses(robot.home_state, max(len(values), len(q)))
    if robot.stages:
        states = [
            forward_trials(own.stage.robot, own.values, own.readings, own.state, follow)
            for own in each_stage(robot, values, start or robot.home_state, q)
        ]
        return join_stage_states(robot, states)
    loops, joints = drive_loops(robot, values, q, driven)
    state = loops.close(joints, start, follow)
    if not any(actuator.is_triangle for actuator in robot.assembly.rows):
        return state
    # a length of a triangle that no angle reaches
    excess = np.broadcast_to(robot.slots(values)[1].measure_excess(q), state.status.shape)
    is_beyond = (state.status == Status.NOT_FINITE.value) & (excess > 0.0) & np.isfinite(excess)
    return replace(
        state,
        status=np.where(is_beyond, np.int8(Status.UNREACHABLE), state.status),
        residual=np.where(is_beyond, excess, state.residual),
    )


def solve_serial(
    robot: Mechanism, placed: Placed, driven: FloatArray, shape: tuple[int, ...] = (1, 1)
) -> State:
    """Return the state (t, n) at driven joint values (t | 1, n, a) and links of `place_serial`.

    Rows whose joint values are not finite are marked. `shape` : (t, n) of the start, 1 broadcasts.
    """
    (group,), (links, advance) = robot.program.groups, placed
    t, n = max(len(links), len(driven), shape[0]), max(driven.shape[1], shape[1])
    joints = np.zeros((t, n, len(group.actuator)))
    joints[..., :-1] = driven[..., group.actuator[:-1, 0]]
    with np.errstate(invalid="ignore"):
        frames = follow_links(group.joints, links[:, None], advance[:, None], joints)
        T = np.broadcast_to(frames[-1], (t, n, 4, 4))
    finite = np.isfinite(joints).all(axis=2)
    zero = np.zeros((t, n))
    return State(
        np.array(T),
        (joints[:, :, None],),
        np.where(finite, np.int8(engine.CONVERGED), np.int8(engine.NOT_FINITE)),
        np.where(finite, zero, np.nan),
        zero.astype(np.int64),
        np.ones((t, n), np.int8),
    )


def find_directly_reachable(robot: Mechanism, values: FloatArray, q: FloatArray) -> BoolArray:
    """Return which readings q (t | 1, n, a) are solved from home without following a path, on
    home's side of every singularity, (t, n).
    """
    return forward_trials(robot, values, q, follow=False).status == Status.CONVERGED.value


def compute_closure_sign(robot: Mechanism, values: FloatArray, state: State) -> NDArray[np.int8]:
    """Return the sign of the determinant of closure with locked actuators (t, n), 0 with more
    equations than freedoms. It changes only at a singularity.
    """
    if robot.stages:
        parts = each_stage(robot, values, state)
        signs = [compute_closure_sign(own.stage.robot, own.values, own.state) for own in parts]
        return np.multiply.reduce(signs, dtype=np.int8)
    loops = Loops.place(robot, values)
    return loops.solve(loops.read(state), state, max_iterations=0).closure_sign


def compute_readings(robot: Mechanism, values: FloatArray, state: State) -> FloatArray:
    """Return the readings (t, n, a) of a state."""
    _, drives = robot.slots(values)
    joints = driven_values(robot.program, state)
    q = drives.find_readings(joints)
    wrench = np.array(robot.assembly.load.wrench)
    if not (robot.is_elastic and wrench.any()):
        return q
    return drives.find_readings(joints, compute_loads(robot, values, q, state, wrench))


def compute_loads(
    robot: Mechanism, values: FloatArray, q: FloatArray, state: State, wrench: FloatArray
) -> FloatArray:
    """Return the loads (t, n, a) [N, Nm] of drives at states (t, n), of wrenches (6,) or (n, 6) on
    the end platform: the power of the wrench where a drive moves alone, by its speed.

    q : (t | 1, n, a) readings, of which only the slopes of transmissions count. Derivation:
    docs/theory/families.md.
    """
    load = robot.assembly.load
    force, moment = wrench[..., :3], wrench[..., 3:]
    rotation = state.T[..., :3, :3]
    arm = np.matmul(rotation, load.at)
    if load.of_platform:
        force, moment = (np.matmul(rotation, v[..., None])[..., 0] for v in (force, moment))
    moment, force = np.broadcast_arrays(moment + np.cross(arm, force), force)
    twists = differentiate_pose(robot, values, q, state).readings
    power = np.matmul(np.concatenate([moment, force], axis=-1)[..., None, :], twists)[..., 0, :]
    _, drives = robot.slots(values)
    with np.errstate(divide="ignore", invalid="ignore"):  # couplings have no reading
        return power[..., drives.constants[:, SOURCE].astype(int)] / drives.evaluate_slopes(q)


def load_readings(
    robot: Mechanism, values: FloatArray, q: FloatArray, wrench: FloatArray
) -> FloatArray:
    """Return readings (t | 1, n, a) with the loads of drives under wrenches (n, 6), at the pose
    that readings and loads lead to; zero where they lead to none.
    """
    places, q = robot.slots.constants[:, LOADED].astype(int), np.array(q)
    q = np.array(np.broadcast_to(q, (max(len(values), len(q)), *q.shape[1:])))
    q[..., places[places >= 0]] = 0.0
    for _ in range(LOAD_STEPS):
        loads = compute_loads(robot, values, q, forward_trials(robot, values, q), wrench)
        new, old = np.nan_to_num(loads[..., places >= 0]), q[..., places[places >= 0]]
        q[..., places[places >= 0]] = new
        if np.abs(new - old).max(initial=0.0) <= SETTLED * np.abs(new).max(initial=0.0):
            break
    return q


# Frames of the links along each limb, for limits of joints and for pictures.


def compute_limb_frames(
    robot: Mechanism, values: FloatArray, state: State
) -> tuple[FloatArray, ...]:
    """Return the frames along each limb, (t, n, J + 2, 4, 4): T_base_link behind each link 0..J
    (the last one is the tip), then the attachment.
    """
    if robot.stages:
        assert isinstance(state, ChainState)
        bases, _ = locate_stage_bases(robot.stages, state.poses)
        return tuple(
            (base if base.ndim == 2 else base[:, :, None]) @ frames
            for base, own in zip(bases, each_stage(robot, values, state), strict=True)
            for frames in compute_limb_frames(own.stage.robot, own.values, own.state)
        )
    e, _ = robot.slots(values)
    frames: dict[int, FloatArray] = {}
    bodies, shape = list_bodies(state), state.T.shape
    for group, joints in zip(robot.program.groups, state.joints, strict=True):
        displacements = e[:, group.columns].reshape(len(e), len(group.limbs), -1)
        for k, limb in enumerate(group.limbs):
            links, advance = (a[:, None] for a in place_links(group, k, displacements[:, k]))
            chain = follow_links(group.joints, links, advance, joints[:, :, k])
            placed = [bodies[group.on[k]] @ frame for frame in chain]
            placed.append(bodies[group.to[k]] @ links[:, :, -1])
            frames[limb] = np.stack([np.broadcast_to(f, shape) for f in placed], axis=2)
    return tuple(frames[i] for i in sorted(frames))


# Where the anchors of triangle drives are, for pictures and lists.


@dataclass(frozen=True, eq=False)
class Anchors:
    """The anchors of a triangle drive at n poses.

    limb : number of the limb whose joint it turns. actuator : its name.
    points : (n, 2, 3) foot and head in the base [m]. pin : (n, 3) [m] on the axis of the joint.
    """

    limb: int
    actuator: str
    points: FloatArray
    pin: FloatArray


def locate_anchors(robot: Mechanism, state: State) -> tuple[Anchors, ...]:
    """Return the anchors of all triangle drives at a state (1, n)."""
    column = {a.name: i for i, a in enumerate(robot.actuators) if a.is_triangle}
    place = {name: i for i, name in enumerate(robot.assembly.driven_joints)}
    if not column:
        return ()
    _, drives = robot.present
    angles = driven_values(robot.program, state)[0]
    frames = compute_limb_frames(robot, robot.values[None], state)
    located = []
    for i, limb in enumerate(robot.assembly.limbs):
        for j, joint in enumerate(limb.joints):
            if joint.actuator in column:
                triangle = drives.list_triangle_terms(column[joint.actuator])[0, 0]
                head = turn_head(angles[:, place[joint.actuator]], triangle)
                foot = np.broadcast_to(triangle[:3], head.shape)
                own, T = np.stack([foot, head], axis=1), frames[i][0, :, j]
                points = own @ np.swapaxes(T[:, :3, :3], -1, -2) + T[:, None, :3, 3]
                located.append(Anchors(i, joint.actuator, points, T[:, :3, 3]))
    return tuple(located)
