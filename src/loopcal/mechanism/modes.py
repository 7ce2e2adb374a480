# SPDX-License-Identifier: Apache-2.0
"""Assembly modes (all poses for one set of readings) and working modes (all readings for one pose).

Newton's method runs from many random starts at once, as rows of one batch; solutions that agree are
merged. The search ends after a stated number of starts in a row without a new solution. That is
evidence, not proof: a mode that few starts lead to can be missed, so the result says how often each
mode was reached. Derivation: docs/theory/kinematics.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from loopcal import geometry
from loopcal.engine import State
from loopcal.errors import DataError, MechanismError
from loopcal.mechanism.assembly import BASE
from loopcal.mechanism.chains import has_spare_drives, join_stage_states
from loopcal.mechanism.inverse import inverse_trials
from loopcal.mechanism.kinematics import compute_readings, forward_trials
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import Solution, make_solution
from loopcal.mechanism.states import Status, driven_values, join_states, make_start, select_poses
from loopcal.results.result import Result
from loopcal.typing import FloatArray, IntArray
from loopcal.units import Dimension

BATCH = 2048  # starts solved together
# Largest difference of equal solutions: lengths relative to the robot's size, angles in rad.
SAME = 1e-6
# Range of the distance of starting positions from the middle of the base points, per size.
SCALES = (0.1, 1.0)


@dataclass(frozen=True, eq=False, repr=False)
class Modes(Result):
    """Solutions found from random starts.

    solution : one row for each mode, ordered by the distance from home (of its pose, or for working
        modes of its readings). As `start=` of `forward` or `inverse` it selects the mode.
    hits : (modes,) starts that led to each mode. starts : number of starts.
    starts_since_new : starts since the last new mode.
    """

    solution: Solution
    hits: IntArray
    starts: int
    starts_since_new: int

    def __len__(self) -> int:
        return len(self.hits)

    def __str__(self) -> str:
        count = f"{len(self)} modes" if len(self) != 1 else "1 mode"
        rarest = f"; rarest mode reached {self.hits.min()} times" if len(self) else ""
        return (
            f"{count} from {self.starts} random starts, none new in the last "
            f"{self.starts_since_new}{rarest}"
        )


def find_assembly_modes(
    robot: Mechanism,
    q: ArrayLike,
    patience: int = 4 * BATCH,
    max_starts: int = 200_000,
    seed: int = 0,
) -> Modes:
    """Find all platform poses for readings q (a,) [m or rad].

    Starts have orientations spread evenly over all rotations (about the machine's free axes),
    positions at random distances from the middle of the base points, and random passive joints.
    Modes differ in their poses; passive joints are not compared.

    Parameters
    ----------
    patience : end the search after this number of starts without a new mode. max_starts : starts
        before the search is given up. seed : of the random starts.

    Returns
    -------
    Modes; none if the readings allow no pose.

    Raises
    ------
    DataError : q has another number of readings than the robot has actuators.
    MechanismError : new modes were still found after `max_starts` starts.
    """
    readings = np.asarray(q, dtype=float).reshape(-1)
    if len(readings) != len(robot.actuators):
        raise DataError(
            f"{len(readings)} readings do not fit: {robot.name} has {len(robot.actuators)} "
            "actuators. Give one reading for each"
        )
    values = robot.values[None]

    def solve(start: State) -> State:
        state = forward_trials(robot, values, readings[None, None], start, follow=False)
        is_other = state.status == Status.OTHER_MODE.value
        return replace(state, status=np.where(is_other, np.int8(Status.CONVERGED), state.status))

    def measure(state: State) -> FloatArray:
        home = np.broadcast_to(robot.home, state.T[0].shape)
        return geometry.pose_difference(state.T[0], home) * robot.twist_scale

    def read(state: State) -> FloatArray:
        return np.tile(readings, (state.T.shape[1], 1))

    return _search(robot, solve, read, measure, patience, max_starts, seed)


def find_working_modes(
    robot: Mechanism,
    target: ArrayLike,
    patience: int = 4 * BATCH,
    max_starts: int = 200_000,
    seed: int = 0,
) -> Modes:
    """Find all readings for controlled coordinates (c,) [m, rad], without regard to limits.

    Starts have random joints and the platform close to the target. Full turns are subtracted from
    readings: they lie within half a turn of the middle of the stroke, or of zero without a stroke.
    Modes differ in their readings, and in their poses if the machine has fewer controlled
    coordinates than freedoms. Parameters, result and errors as for `find_assembly_modes`.
    """
    wanted = np.asarray(target, dtype=float).reshape(-1)
    if len(wanted) != len(robot.controlled):
        raise DataError(
            f"{len(wanted)} coordinates do not fit: {robot.name} has {', '.join(robot.controlled)}"
        )
    if has_spare_drives(robot):
        raise DataError(
            f"{robot.name} has more drives than coordinates, so the readings of a pose are "
            "not countable. Name drives to keep at their readings under 'held:'"
        )
    values = robot.values[None]
    begun = inverse_trials(robot, values, wanted[None, None])
    turning = np.array([a.dimension is Dimension.ANGLE for a in robot.actuators])
    home = compute_readings(robot, values, robot.home_state)[0]

    def solve(start: State) -> State:
        if robot.stages:  # a chain moves from a closed start
            start = forward_trials(robot, values, read(start)[None], start, follow=False)
        reached = begun.status[0, 0] == Status.CONVERGED
        T = np.broadcast_to(begun.T, start.T.shape) if reached else start.T
        everywhere = np.broadcast_to(wanted, (1, T.shape[1], len(wanted)))
        state = inverse_trials(robot, values, everywhere, replace(start, T=T))
        return _subtract_turns(robot, state)

    def read(state: State) -> FloatArray:
        return compute_readings(robot, values, state)[0]

    def measure(state: State) -> FloatArray:
        return (read(state) - home) * np.where(turning, robot.size, 1.0)

    return _search(robot, solve, read, measure, patience, max_starts, seed)


def _identify(robot: Mechanism, state: State, q: FloatArray) -> FloatArray:
    """Return numbers (n, k) that agree for equal readings q (n, a) and poses of a state (1, n)."""
    T, turning = state.T[0], np.array([a.dimension is Dimension.ANGLE for a in robot.actuators])
    angles, lengths = q[:, turning], q[:, ~turning] / robot.size
    parts = lengths, np.cos(angles), np.sin(angles), T[:, :3, 3] / robot.size
    return np.concatenate([*parts, T[:, :3, :3].reshape(-1, 9)], axis=1)


def _subtract_turns(robot: Mechanism, state: State) -> State:
    """Return the state with driven joints moved by full turns to the middle of their strokes."""
    if robot.has_open_sums or robot.assembly.couplings:
        return state  # of lengths, which do not repeat, or of joints that turn together
    middle = np.array(
        [
            np.mean(a.stroke) if a.stroke and np.isfinite(a.stroke).all() else 0.0
            for a in robot.actuators
        ]
    )
    _, drives = robot.present
    center = drives.find_joints(middle[None, None])[0, 0]
    driven = driven_values(robot.program, state)
    turns = np.round((driven - center) / (2 * np.pi))
    for group in robot.program.groups:
        for j, columns in enumerate(group.actuator):
            # a slide or a screw has moved after a full turn
            repeats = group.joints[j : j + 1] == "R" and not group.pitch[:, j].any()
            if columns[0] >= 0 and not repeats:
                turns[..., columns] = 0.0
    moved, own = driven - 2 * np.pi * turns, zip(robot.program.groups, state.joints, strict=True)
    return replace(state, joints=tuple(group.insert_driven(old, moved) for group, old in own))


def _search(
    robot: Mechanism,
    solve: Callable[[State], State],
    read: Callable[[State], FloatArray],
    measure: Callable[[State], FloatArray],
    patience: int,
    max_starts: int,
    seed: int,
) -> Modes:
    """Solve batches of random starts until `patience` of them give nothing new.

    read, measure : the readings (n, a) of solutions, and their distance (n, k) from home.
    """
    rng, tried, last = np.random.default_rng(seed), 0, 0
    modes, hits = select_poses(robot.home_state, np.arange(0)), np.zeros(0, np.int64)
    while tried - last < patience:
        if tried >= max_starts:
            raise MechanismError(
                f"{robot.name}: {len(hits)} modes after {tried} random starts, and still new ones; "
                "allow more starts, or check whether the readings leave the platform free to move"
            )
        new = solve(_draw_starts(robot, rng, BATCH))
        new = select_poses(new, new.status[0] == Status.CONVERGED)
        before = len(hits)
        modes, hits = _merge(modes, hits, new, lambda s: _identify(robot, s, read(s)))
        tried += BATCH
        last = tried if len(hits) > before else last
    order = np.argsort(np.linalg.norm(measure(modes), axis=1))
    modes = select_poses(modes, order)
    solution = make_solution(robot, modes, read(modes))
    return Modes(solution, hits[order], tried, tried - last)


def _merge(
    modes: State, hits: IntArray, new: State, identify: Callable[[State], FloatArray]
) -> tuple[State, IntArray]:
    """Return the modes together with those of new solutions, and how often each was reached."""
    whole, counts = join_states(modes, new), np.ones(len(hits) + new.T.shape[1], np.int64)
    keys, rest, first = identify(whole), np.arange(len(counts)), []
    counts[: len(hits)] = hits
    while len(rest):
        same = np.abs(keys[rest] - keys[rest[0]]).max(axis=1) < SAME
        counts[rest[0]] = counts[rest[same]].sum()
        first.append(rest[0])
        rest = rest[~same]
    chosen = np.array(first, np.int64)
    return select_poses(whole, chosen), counts[chosen]


def _draw_starts(robot: Mechanism, rng: np.random.Generator, n: int) -> State:
    """Draw starts (1, n): free orientations and positions of the platform, and all joints."""
    if robot.stages:
        return join_stage_states(
            robot, [_draw_starts(stage.robot, rng, n) for stage in robot.stages]
        )
    T, joints = _draw_poses(robot, rng, n, robot.home), []
    for group, home in zip(robot.program.groups, robot.home_state.joints, strict=True):
        values = np.array(np.broadcast_to(home, (1, n, *home.shape[2:])))
        for j, letter in enumerate(group.joints):
            if letter == "R" and not group.locked[j]:
                values[..., j] = rng.uniform(-np.pi, np.pi, values.shape[:-1])
            elif letter == "P":
                values[..., j] += robot.size * rng.normal(size=values.shape[:-1])
        joints.append(values)
    others = [_draw_poses(robot, rng, n, body[0, 0])[None] for body in robot.home_state.others]
    return make_start(T[None], tuple(joints), tuple(others))


def _draw_poses(robot: Mechanism, rng: np.random.Generator, n: int, home: FloatArray) -> FloatArray:
    """Draw poses (n, 4, 4) of a node with the home pose (4, 4)."""
    free, size = robot.program.freedoms, robot.size
    turns = [f for f in free if f < 3]
    if len(turns) == 3:
        unit = rng.normal(size=(n, 4))
        R = geometry.quaternion_to_matrix(unit / np.linalg.norm(unit, axis=1, keepdims=True))
    else:
        w = np.zeros((n, 3))
        w[:, turns] = rng.uniform(-np.pi, np.pi, (n, len(turns)))
        R = geometry.exp_so3(w) @ home[:3, :3]
    feet = [limb.links[0].transform[:3, 3] for limb in robot.assembly.limbs if limb.on == BASE]
    direction = rng.normal(size=(n, 3)) * size
    shift = direction * np.exp(rng.uniform(np.log(SCALES[0]), np.log(SCALES[1]), (n, 1)))
    position = np.tile(home[:3, 3], (n, 1))
    axes = [f - 3 for f in free if f >= 3]
    position[:, axes] = (np.mean(feet, axis=0) + shift)[:, axes]
    return geometry.make_pose(R, position)
