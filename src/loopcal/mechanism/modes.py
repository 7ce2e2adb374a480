# SPDX-License-Identifier: Apache-2.0
"""All poses that one set of readings allows (assembly modes), and all readings that one pose allows
(working modes).

Newton from many random starts at once, as rows of one batch; solutions that agree are merged. New
starts are drawn until a stated number of them in a row has found nothing new. That is evidence, not
proof: a mode that few starts lead to can be missed, so the result says how often each was reached.
Derivation: docs/theory/kinematics.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from loopcal import engine, geometry
from loopcal.engine import State
from loopcal.errors import DataError, MechanismError
from loopcal.mechanism.batch_kinematics import (
    compute_closure_sign,
    compute_readings,
    inverse_trials,
)
from loopcal.mechanism.kinematics import Solution, make_solution
from loopcal.mechanism.model import Mechanism, Status
from loopcal.mechanism.states import driven_values, join_states, select_poses
from loopcal.mechanism.transmission import joints_from_readings
from loopcal.typing import FloatArray, IntArray

BATCH = 2048
"""Starts solved together."""
SAME = 1e-6
"""Largest difference of two solutions that count as one: positions and lengths over the robot's
size, angles in rad.
"""
SCALES = (0.1, 1.0)
"""Starting positions stand off the middle of the base points by about the size times a factor from
this range.
"""


@dataclass(frozen=True)
class Modes:
    """Solutions found from random starts.

    Attributes
    ----------
    solution : one row a mode, the nearest to home first (its pose, or for working modes its
        readings); with `start=` it chooses the mode elsewhere.
    hits : (modes,) starts that led to each. starts : how many were tried. quiet : how many since
        the last new mode.
    """

    solution: Solution
    hits: IntArray
    starts: int
    starts_since_new: int

    def __len__(self) -> int:
        return len(self.hits)

    def __str__(self) -> str:
        found = f"{len(self)} modes found" if len(self) != 1 else "1 mode found"
        rarest = f"; the rarest was reached {self.hits.min()} times" if len(self) else ""
        return f"{found} from {self.starts} random starts, the last {self.starts_since_new} without a new one{rarest}"


def find_assembly_modes(
    robot: Mechanism,
    q: ArrayLike,
    patience: int = 4 * BATCH,
    max_starts: int = 200_000,
    seed: int = 0,
) -> Modes:
    """All poses of the platform that readings q (a,) allow [m or rad].

    Starts have orientations spread evenly over all rotations (about the machine's free axes),
    positions at random distances from the middle of the base points, and random passive joints.
    Poses are told apart, not passive joints.

    Parameters
    ----------
    quiet : stop when so many starts in a row have found no new mode. most : starts before the
        search is given up.
    seed : of the random starts.

    Returns
    -------
    Modes; none where the readings allow no pose.

    Raises
    ------
    DataError
        q has another number of readings than the robot has actuators.
    MechanismError
        `max_starts` starts were not enough for a quiet end.
    """
    readings = np.asarray(q, dtype=float).reshape(-1)
    if len(readings) != len(robot.actuators):
        raise DataError(
            f"{len(readings)} readings were given, but {robot.name} has {len(robot.actuators)} "
            "actuators"
        )
    values = robot.values[None]
    e, tau = robot.slots(values)
    driven = joints_from_readings(readings[None, None], tau, robot.slots.frequency)

    def solved(start: State) -> State:
        state = engine.solve(robot.program, e, driven, start)
        return replace(state, closure_sign=compute_closure_sign(robot, values, state))

    def key(state: State) -> FloatArray:
        return np.concatenate(
            [state.T[0, :, :3, 3] / robot.size, state.T[0, :, :3, :3].reshape(-1, 9)], axis=1
        )

    def far(state: State) -> FloatArray:
        distance = geometry.pose_difference(
            state.T[0], np.broadcast_to(robot.home, state.T[0].shape)
        )
        return distance * np.repeat([robot.size, 1.0], 3)

    return _search(
        robot,
        solved,
        key,
        far,
        lambda state: np.tile(readings, (state.T.shape[1], 1)),
        patience,
        max_starts,
        seed,
    )


def find_working_modes(
    robot: Mechanism,
    target: ArrayLike,
    patience: int = 4 * BATCH,
    max_starts: int = 200_000,
    seed: int = 0,
) -> Modes:
    """All readings that lead to controlled coordinates (c,) [m, rad], whatever strokes and limits
    say.

    Starts have random joints and the platform near the target. Whole turns are taken off readings:
    they lie within half a turn of the middle of the stroke, or of zero where none is stated.
    Readings are told apart, and poses where the machine has fewer controlled coordinates than
    freedoms. Parameters, result and errors as for `assembly_modes`.
    """
    wanted = np.asarray(target, dtype=float).reshape(-1)
    if len(wanted) != len(robot.controlled):
        raise DataError(
            f"{len(wanted)} coordinates were given; {robot.name} has {', '.join(robot.controlled)}"
        )
    values = robot.values[None]
    begun = inverse_trials(robot, values, wanted[None, None])

    def solved(start: State) -> State:
        T = (
            np.broadcast_to(begun.T, start.T.shape)
            if begun.status[0, 0] == Status.CONVERGED
            else start.T
        )
        target = np.broadcast_to(wanted, (1, T.shape[1], len(wanted)))
        return _unwound(robot, inverse_trials(robot, values, target, replace(start, T=T)))

    turning = [a.dimension.value == "angle" for a in robot.actuators]
    home = compute_readings(robot, values, robot.home_state)[0]

    def far(state: State) -> FloatArray:
        return (compute_readings(robot, values, state)[0] - home) * np.where(
            turning, robot.size, 1.0
        )

    def key(state: State) -> FloatArray:
        q = compute_readings(robot, values, state)[0]
        turns = np.concatenate([np.cos(q[:, turning]), np.sin(q[:, turning])], axis=1)
        pose = np.concatenate(
            [state.T[0, :, :3, 3] / robot.size, state.T[0, :, :3, :3].reshape(-1, 9)], axis=1
        )
        return np.concatenate([q[:, np.logical_not(turning)] / robot.size, turns, pose], axis=1)

    return _search(
        robot,
        solved,
        key,
        far,
        lambda state: compute_readings(robot, values, state)[0],
        patience,
        max_starts,
        seed,
    )


def _unwound(robot: Mechanism, state: State) -> State:
    """The state with whole turns taken off its driven joints, as near as possible to the middle of
    their strokes.
    """
    middle = np.array(
        [
            np.mean(a.stroke) if a.stroke and np.isfinite(a.stroke).all() else 0.0
            for a in robot.actuators
        ]
    )
    _, tau = robot.slots(robot.values[None])
    centre = joints_from_readings(middle[None, None], tau, robot.slots.frequency)[0, 0]
    turns = np.round((driven_values(robot.program, state) - centre) / (2 * np.pi))
    for group in robot.program.groups:  # a slide or a screw is elsewhere after a turn
        for j, columns in enumerate(group.actuator):
            if columns[0] >= 0 and (group.joints[j : j + 1] != "R" or group.pitch[:, j].any()):
                turns[..., columns] = 0.0
    joints = []
    for group, old in zip(robot.program.groups, state.joints, strict=True):
        new = np.array(old)
        for j, columns in enumerate(group.actuator):
            if columns[0] >= 0:
                new[..., j] -= 2 * np.pi * turns[..., columns]
        joints.append(new)
    return replace(state, joints=tuple(joints))


def _search(
    robot: Mechanism,
    solved: Callable[[State], State],
    key: Callable[[State], FloatArray],
    far: Callable[[State], FloatArray],
    readings: Callable[[State], FloatArray],
    patience: int,
    max_starts: int,
    seed: int,
) -> Modes:
    """Solve batches of random starts until `patience` of them have found nothing new."""
    rng, tried, last = np.random.default_rng(seed), 0, 0
    found, hits = select_poses(robot.home_state, np.arange(0)), np.zeros(0, np.int64)
    while tried - last < patience:
        if tried >= max_starts:
            raise MechanismError(
                f"{robot.name}: {len(hits)} modes after {tried} random starts, and new ones keep "
                "coming; allow more starts, "
                "or the readings leave the platform free to move"
            )
        new = solved(_starts(robot, rng, BATCH))
        new = select_poses(new, new.status[0] == Status.CONVERGED)
        before = len(hits)
        found, hits = _merged(found, hits, new, key)
        tried += BATCH
        last = tried if len(hits) > before else last
    order = np.argsort(np.linalg.norm(far(found), axis=1))
    found = select_poses(found, order)
    return Modes(make_solution(robot, found, readings(found)), hits[order], tried, tried - last)


def _merged(
    found: State, hits: IntArray, new: State, key: Callable[[State], FloatArray]
) -> tuple[State, IntArray]:
    """The modes with those of new solutions, and how often each was met."""
    keys, known = key(new), key(found)
    alone = np.arange(len(keys))
    for i, mode in enumerate(known):
        same = np.abs(keys[alone] - mode).max(axis=1, initial=0.0) < SAME
        hits[i] += same.sum()
        alone = alone[~same]
    first, counts = [], []
    while len(alone):
        same = np.abs(keys[alone] - keys[alone[0]]).max(axis=1) < SAME
        first.append(alone[0])
        counts.append(int(same.sum()))
        alone = alone[~same]
    if not first:
        return found, hits
    return join_states(found, select_poses(new, np.array(first))), np.concatenate(
        [hits, np.array(counts, np.int64)]
    )


def _starts(robot: Mechanism, rng: np.random.Generator, n: int) -> State:
    """Random starts (1, n): free orientations and positions of the platform, and all joints."""
    free, size = robot.program.freedoms, robot.size
    turns = [f for f in free if f < 3]
    if len(turns) == 3:
        unit = rng.normal(size=(n, 4))
        R = geometry.quaternion_to_matrix(unit / np.linalg.norm(unit, axis=1, keepdims=True))
    else:
        w = np.zeros((n, 3))
        w[:, turns] = rng.uniform(-np.pi, np.pi, (n, len(turns)))
        R = geometry.exp_so3(w) @ robot.home[:3, :3]
    middle = np.mean([limb.links[0].transform[:3, 3] for limb in robot.assembly.limbs], axis=0)
    shift = (
        rng.normal(size=(n, 3))
        * size
        * np.exp(rng.uniform(np.log(SCALES[0]), np.log(SCALES[1]), (n, 1)))
    )
    position = np.tile(robot.home[:3, 3], (n, 1))
    axes = [f - 3 for f in free if f >= 3]
    position[:, axes] = (middle + shift)[:, axes]
    joints = []
    for group, home in zip(robot.program.groups, robot.home_state.joints, strict=True):
        values = np.array(np.broadcast_to(home, (1, n, *home.shape[2:])))
        for j, letter in enumerate(group.joints):
            if letter == "R" and not group.locked[j]:
                values[..., j] = rng.uniform(-np.pi, np.pi, values.shape[:-1])
            elif letter == "P":
                values[..., j] += size * rng.normal(size=values.shape[:-1])
        joints.append(values)
    zero = np.zeros((1, n))
    none = zero.astype(np.int8)
    return State(
        geometry.make_pose(R, position)[None],
        tuple(joints),
        none,
        zero,
        zero.astype(np.int64),
        none,
    )
