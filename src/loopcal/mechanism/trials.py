# SPDX-License-Identifier: Apache-2.0
"""Kinematics with the trial axis kept: what the layers above compute with. Shapes (t, n, ..), t or n = 1 broadcast."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from loopcal import engine
from loopcal.engine import Array, State
from loopcal.mechanism import coordinates
from loopcal.mechanism.model import Mechanism, Status
from loopcal.mechanism.transmission import joint_values, readings_of, slope, term_columns

STEPS = (8, 64)
"""Steps of the path from the start's readings along which a row is followed when the direct solution fails."""


@dataclass(frozen=True)
class Sensitivity:
    """How the platform moves with parameters and readings.

    Attributes
    ----------
    parameters : (t, n, 6, p) twist (omega in base axes, velocity of the platform's origin) per unit of each parameter.
    readings : (t, n, 6, a) the same per unit of each reading.
    """

    parameters: Array
    readings: Array


def forward_trials(robot: Mechanism, values: Array, q: Array, start: State | None = None) -> State:
    """Poses of readings q (t | 1, n, a) under parameter values (t | 1, p).

    Newton from `start` (default: home); a row that fails, or ends on the far side of a singularity, is followed along the
    straight path from the start's readings. Rows that still fail are marked, see `Status`.
    """
    e, tau = robot.slots(values)
    joints = joint_values(q, tau, robot.slots.frequency)
    begin = robot.home_state if start is None else start
    state = engine.solve(robot.program, e, joints, begin)
    wrong = _astray(state, begin)
    if not wrong.any() or len(robot.actuators) != len(robot.program.freedoms):
        return state
    return _followed(robot, e, joints, begin, state, wrong)


def inverse_trials(robot: Mechanism, values: Array, target: Array, start: State | None = None) -> State:
    """States at controlled coordinates (t | 1, n, c), every actuator free; `readings_at` gives their readings."""
    e, tau = robot.slots(values)
    names, size = robot.controlled, robot.size
    t, n = max(len(values), len(target)), target.shape[1]
    asked = np.broadcast_to(target, (t, n, target.shape[2])).reshape(t * n, -1)

    def task(T: Array, rows: np.ndarray) -> tuple[Array, Array]:
        return coordinates.demands(T, asked[rows], names, size)

    begin = robot.home_state if start is None else start
    guess = np.broadcast_to(_actuated(robot, begin), (t, n, len(robot.actuators)))
    T = coordinates.pose(np.broadcast_to(target, (t, n, target.shape[2])), names, robot.home)
    if start is not None:
        T = np.broadcast_to(start.T, T.shape)
    return engine.solve(robot.program, e, guess, replace(begin, T=T), task, free=True)


def readings_at(robot: Mechanism, values: Array, state: State) -> Array:
    """Readings (t, n, a) of a state."""
    _, tau = robot.slots(values)
    return readings_of(_actuated(robot, state), tau, robot.slots.frequency)


def sensitivity(robot: Mechanism, values: Array, q: Array, state: State) -> Sensitivity:
    """Derivative of the platform's pose by the implicit function theorem, D = -A^-1 [E de/dp + Q dq/dp].

    Parameters
    ----------
    values : (t, p). q : (t | 1, n, a) readings. state : (t, n), converged rows.

    Returns
    -------
    Sensitivity; rows of singular or failed states hold infinities or NaN.
    """
    e, tau = robot.slots(values)
    w = robot.slots.frequency
    blocks = engine.linearise(robot.program, e, joint_values(q, tau, w), state)
    by_slot, by_joint = _solved(robot, blocks)
    J = robot.slots.jacobian(values)
    t, n = state.T.shape[:2]
    D = np.matmul(by_slot.reshape(t, n * 6, -1), J[:, : robot.slots.n_displacements]).reshape(t, n, 6, -1)
    terms = J[:, robot.slots.n_displacements :].reshape(len(J), *robot.slots.terms.shape, -1)
    for i, column in enumerate(term_columns(q, w)):
        if terms[:, :, i].any():
            D = D + np.matmul(by_joint * column[:, :, None, :], terms[:, None, :, i])
    return Sensitivity(D, by_joint * slope(q, tau, w)[:, :, None, :])


def _solved(robot: Mechanism, blocks: engine.Blocks) -> tuple[Array, Array]:
    """Twist per displacement (t, n, 6, s) and per joint value (t, n, 6, a)."""
    program = robot.program
    t, n, c, m = blocks.A.shape
    inverse = _pseudo_inverse(blocks.A)
    by_slot = np.zeros((t, n, m, program.n_displacements))
    by_joint = np.zeros((t, n, m, program.n_joints))
    for group, E, Q, rows in zip(program.groups, blocks.E, blocks.Q, blocks.rows, strict=True):
        k, r = rows.shape
        if not r:
            continue
        part = inverse[:, :, :, rows]
        # sum over the few rows of a limb, element by element
        slots = -sum(part[..., i, None] * E[:, :, None, :, i] for i in range(r))
        by_slot[..., group.columns] = slots.reshape(t, n, m, -1)
        for j, columns in enumerate(group.actuator):
            if columns[0] >= 0:
                by_joint[..., columns] = -sum(part[..., i] * Q[:, :, None, :, i, j] for i in range(r))
    return _as_twist(program, by_slot), _as_twist(program, by_joint)


def _as_twist(program: engine.Program, rows: Array) -> Array:
    """Spread the m freedoms over the six components of a twist."""
    if len(program.freedoms) == 6:
        return rows
    out = np.zeros((*rows.shape[:2], 6, rows.shape[3]))
    out[:, :, list(program.freedoms)] = rows
    return out


def _pseudo_inverse(A: Array) -> Array:
    """Inverse (square) or pseudo-inverse of A (t, n, c, m) -> (t, n, m, c), failed rows as NaN."""
    good = np.isfinite(A).all(axis=(-1, -2))
    safe = np.where(good[..., None, None], A, np.eye(*A.shape[-2:]))
    if A.shape[-1] == A.shape[-2]:
        try:
            out = np.linalg.solve(safe, np.eye(A.shape[-1]))
        except np.linalg.LinAlgError:
            out = np.linalg.pinv(safe)
    else:
        out = np.linalg.pinv(safe)
    return np.where(good[..., None, None], out, np.nan)


def _actuated(robot: Mechanism, state: State) -> Array:
    """Values of the actuated joints (t, n, a)."""
    out = np.zeros((*state.T.shape[:2], robot.program.n_joints))
    for group, joints in zip(robot.program.groups, state.joints, strict=True):
        for j, columns in enumerate(group.actuator):
            if columns[0] >= 0:
                out[..., columns] = joints[..., j]
    return out


def _astray(state: State, begin: State) -> Array:
    """Rows that failed or ended on the other side of a singularity."""
    return (state.status != Status.CONVERGED) & (state.status != Status.NOT_FINITE) | (
        (state.status == Status.CONVERGED) & (state.orientation != begin.orientation)
    )


def _followed(robot: Mechanism, e: Array, joints: Array, begin: State, state: State, wrong: Array) -> State:
    """Follow the wrong rows along the straight path of joint values from the start, in ever smaller steps."""
    t, n = state.T.shape[:2]
    rows = np.flatnonzero(wrong)
    trial, place = np.divmod(rows, n)
    e_rows = e if len(e) == 1 else e[trial]
    full = np.broadcast_to(joints, (t, n, joints.shape[2]))[trial, place][:, None]
    home = np.broadcast_to(_actuated(robot, begin), (t, n, joints.shape[2]))[trial, place][:, None]
    first = _take(begin, trial, place, t, n)
    result, alive = _take(state, trial, place, t, n), np.arange(len(rows))
    for steps in STEPS:
        at = _take_rows(first, alive)
        own = e_rows if len(e_rows) == 1 else e_rows[alive]
        for s in range(1, steps + 1):
            part = home[alive] + (full[alive] - home[alive]) * (s / steps)
            at = engine.solve(robot.program, own, part, at)
        result = _put_rows(result, alive, at)
        alive = alive[_astray(at, _take_rows(first, alive))[:, 0]]
        if not len(alive):
            break
    lost = (result.status == Status.CONVERGED) & (result.orientation != first.orientation)
    status = np.where(lost, np.int8(Status.OTHER_MODE), result.status)
    return _scatter(state, replace(result, status=status), trial, place)


def _take(state: State, trial: Array, place: Array, t: int, n: int) -> State:
    """Chosen rows as (rows, 1)."""

    def pick(a: Array) -> Array:
        return np.broadcast_to(a, (t, n, *a.shape[2:]))[trial, place][:, None]

    return State(
        pick(state.T), tuple(pick(j) for j in state.joints), pick(state.status), pick(state.residual), pick(state.iterations), pick(state.orientation)
    )


def _take_rows(state: State, rows: Array) -> State:
    return State(
        state.T[rows],
        tuple(j[rows] for j in state.joints),
        state.status[rows],
        state.residual[rows],
        state.iterations[rows],
        state.orientation[rows],
    )


def _put_rows(state: State, rows: Array, new: State) -> State:
    """A copy of `state` (rows, 1) with some rows replaced."""
    return _scatter(state, new, rows, np.zeros(len(rows), int))


def _scatter(state: State, new: State, trial: Array, place: Array) -> State:
    """A copy of `state` (t, n) with rows (trial, place) taken from `new` (rows, 1)."""

    def put(a: Array, b: Array) -> Array:
        out = np.array(a)
        out[trial, place] = b[:, 0]
        return out

    return State(
        put(state.T, new.T),
        tuple(put(a, b) for a, b in zip(state.joints, new.joints, strict=True)),
        put(state.status, new.status),
        put(state.residual, new.residual),
        put(state.iterations, new.iterations),
        put(state.orientation, new.orientation),
    )
