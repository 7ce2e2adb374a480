# SPDX-License-Identifier: Apache-2.0
"""Kinematics with the trial axis kept: what the layers above compute with. Shapes (t, n, ..), t or n = 1 broadcast."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from loopcal import engine
from loopcal.engine import Array, State
from loopcal.mechanism import coordinates, states
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
    e, _ = robot.slots(values)
    names, size = robot.controlled, robot.size
    t, n = max(len(values), len(target)), target.shape[1]
    asked = np.broadcast_to(target, (t, n, target.shape[2])).reshape(t * n, -1)

    def task(T: Array, rows: np.ndarray) -> tuple[Array, Array]:
        return coordinates.demands(T, asked[rows], names, size)

    begin = robot.home_state if start is None else start
    guess = np.broadcast_to(states.actuated(robot.program, begin), (t, n, len(robot.actuators)))
    T = coordinates.pose(np.broadcast_to(target, (t, n, target.shape[2])), names, robot.home)
    if start is not None:
        T = np.broadcast_to(start.T, T.shape)
    return engine.solve(robot.program, e, guess, replace(begin, T=T), task, free=True)


def readings_at(robot: Mechanism, values: Array, state: State) -> Array:
    """Readings (t, n, a) of a state."""
    _, tau = robot.slots(values)
    return readings_of(states.actuated(robot.program, state), tau, robot.slots.frequency)


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
    t, n = blocks.closure[0].A.shape[:2]
    m = len(program.freedoms)
    inverse = _pseudo_inverse(platform_rows(blocks), _row_weights(program, blocks))
    by_slot = np.zeros((t, n, m, program.n_displacements))
    by_joint = np.zeros((t, n, m, program.n_joints))
    first = 0
    for group, block in zip(program.groups, blocks.closure, strict=True):
        k, r = block.A.shape[2:4]
        part = inverse[..., first : first + k * r].reshape(t, n, m, k, r)
        first += k * r
        # sum over the few rows of a limb, element by element
        slots = (part[..., i, None] * block.E[:, :, None, :, i] for i in range(r))
        by_slot[..., group.columns] = -sum(slots, start=np.zeros(1)).reshape(t, n, m, -1) if r else 0.0
        for j, columns in enumerate(group.actuator):
            if columns[0] >= 0:
                by_joint[..., columns] = -sum(
                    (part[..., i] * block.Q[:, :, None, :, i, j] for i in range(r)), start=np.zeros(1)
                )
    return _as_twist(program, by_slot), _as_twist(program, by_joint)


def platform_rows(blocks: engine.Blocks) -> Array:
    """All closure rows against the platform's freedoms, (t, n, c, m)."""
    return np.concatenate([b.A.reshape(*b.A.shape[:2], -1, b.A.shape[-1]) for b in blocks.closure], axis=2)


def _row_weights(program: engine.Program, blocks: engine.Blocks) -> Array | None:
    """One over the standard deviation that a redundant actuator gives each row, (t, n, c); None without redundancy."""
    if program.sigma is None:
        return None
    weights = []
    for group, block in zip(program.groups, blocks.closure, strict=True):
        j = int(np.flatnonzero(group.actuator[:, 0] >= 0)[0])
        drive = np.abs(block.Q[..., j]) * np.array(program.sigma)[group.actuator[j], None]
        weights.append(1.0 / drive.reshape(*drive.shape[:2], -1))
    return np.concatenate(weights, axis=2)


def _as_twist(program: engine.Program, rows: Array) -> Array:
    """Spread the m freedoms over the six components of a twist."""
    if len(program.freedoms) == 6:
        return rows
    out = np.zeros((*rows.shape[:2], 6, rows.shape[3]))
    out[:, :, list(program.freedoms)] = rows
    return out


def _pseudo_inverse(A: Array, weights: Array | None) -> Array:
    """Inverse, or weighted pseudo-inverse, of A (t, n, c, m) -> (t, n, m, c); rows that cannot be inverted are NaN."""
    if weights is not None:
        A = A * weights[..., None]
    good = np.asarray(np.isfinite(A).all(axis=(-1, -2)))
    safe = np.where(good[..., None, None], A, np.eye(*A.shape[-2:]))
    if A.shape[-1] == A.shape[-2]:
        try:
            out = np.linalg.solve(safe, np.eye(A.shape[-1]))
        except np.linalg.LinAlgError:
            out = np.linalg.pinv(safe)
    else:
        out = np.linalg.pinv(safe)
    out = np.where(good[..., None, None], out, np.nan)
    return out if weights is None else out * weights[..., None, :]


def _astray(state: State, begin: State) -> np.ndarray:
    """Rows that failed or ended on the other side of a singularity."""
    return (state.status != Status.CONVERGED) & (state.status != Status.NOT_FINITE) | (
        (state.status == Status.CONVERGED) & (state.orientation != begin.orientation)
    )


def _followed(robot: Mechanism, e: Array, joints: Array, begin: State, state: State, wrong: np.ndarray) -> State:
    """Follow the wrong rows along the straight path of joint values from the start, in ever smaller steps."""
    shape = state.T.shape[0], state.T.shape[1]
    trial, pose = np.nonzero(wrong)
    own = np.broadcast_to(e, (shape[0], e.shape[1]))[trial]
    target = np.broadcast_to(joints, (*shape, joints.shape[2]))[trial, pose][:, None]
    first, result = states.pick(begin, shape, trial, pose), states.pick(state, shape, trial, pose)
    origin = states.actuated(robot.program, first)
    alive = np.arange(len(trial))
    for count in STEPS:
        zero = np.zeros(len(alive), int)
        here = begun = states.pick(first, (len(trial), 1), alive, zero)
        for step in range(1, count + 1):
            part = origin[alive] + (target[alive] - origin[alive]) * (step / count)
            here = engine.solve(robot.program, own[alive], part, here)
        result = states.put(result, alive, zero, here)
        alive = alive[_astray(here, begun)[:, 0]]
        if not len(alive):
            break
    lost = (result.status == Status.CONVERGED) & (result.orientation != first.orientation)
    marked = np.where(lost, np.int8(Status.OTHER_MODE), result.status)
    return states.put(state, trial, pose, replace(result, status=marked))
