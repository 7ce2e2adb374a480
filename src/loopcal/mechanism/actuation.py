# SPDX-License-Identifier: Apache-2.0
"""Driven joints: what parameter values and readings make of a robot before its loops are closed."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from loopcal import engine
from loopcal.engine import Program, State
from loopcal.mechanism.limb_rows import (
    differentiate_displacements,
    divide_limbs,
    expand_map,
    join_columns,
    linearize_limbs,
    move_passive_joints,
    name_passive_joints,
    select_block,
    stack_closure_rows,
    stack_driven_columns,
)
from loopcal.mechanism.model import Mechanism, ParameterUnits
from loopcal.mechanism.states import driven_values
from loopcal.mechanism.transmission import (
    apply_weights,
    differentiate_sums,
    evaluate_sums,
    invert_weights,
    joint_slopes,
    joints_from_readings,
    readings_from_joints,
    select_weights,
)
from loopcal.typing import FloatArray


class Derivatives(NamedTuple):
    """Derivatives by parameters (t, n, .., p) and by readings (t, n, .., a)."""

    parameters: FloatArray
    readings: FloatArray


class DrivenJoints(NamedTuple):
    """Displacements e (t | 1, d) [m, rad], terms tau (t | 1, a, k) of the transmissions, and values
    (t | 1, n, J) of the driven joints [m, rad] of a robot of one stage.
    """

    e: FloatArray
    tau: FloatArray
    joints: FloatArray


def drive_joints(robot: Mechanism, values: FloatArray, q: FloatArray) -> DrivenJoints:
    """Return displacements and driven joints for values (t | 1, p) and readings q (t | 1, n, a)."""
    e, tau = robot.slots(values)
    with np.errstate(invalid="ignore"):
        # an infinite reading turns into NaN, and the engine marks its row
        return DrivenJoints(e, tau, joints_from_readings(q, tau, robot.slots.constants))


def differentiate_transmissions(robot: Mechanism, values: FloatArray, q: FloatArray) -> FloatArray:
    """Return the derivatives (t | 1, n | 1, J, p + a) of driven joints, as many as readings q (t |
    1, n, a), by parameters in SI and by readings.
    """
    _, tau = robot.slots(values)
    inputs = robot.all_parameters.linearize(values, tau, q)
    joints = expand_map(robot.program, inputs)[1]
    if robot.has_sums:  # of which the map knows no reading
        turns = differentiate_joints_by_readings(robot, values, q)
        return join_columns(joints[..., : len(robot.parameters)], turns)
    return joints


class DrivenSums(NamedTuple):
    """Displacements e (t | 1, d), sums (t | 1, n, a) of joint values [m, rad], and weights (t | 1,
    a, J) of the joints in them, of a robot whose readings are fewer sums than its joints.
    """

    e: FloatArray
    sums: FloatArray
    weights: FloatArray


def drive_sums(robot: Mechanism, values: FloatArray, q: FloatArray) -> DrivenSums:
    """Return displacements and sums for values (t | 1, p) and readings q (t | 1, n, a)."""
    e, tau = robot.slots(values)
    weights = select_weights(tau, robot.slots.constants)
    assert weights is not None
    with np.errstate(invalid="ignore"):  # as in `drive_joints`
        return DrivenSums(e, evaluate_sums(q, tau, robot.slots.constants), weights)


# Redundant actuation with a prescribed pose: readings and passive joints follow limb by limb.


class PoseDrivenSensitivity(NamedTuple):
    """Derivatives by parameters (.., p) at constant pose, and by the platform's freedoms (.., m).

    names : of the j passive joints.
    readings : (t, n, a, p) and (t, n, a, m). passive : (t, n, j, p) and (t, n, j, m).
    """

    names: tuple[str, ...]
    readings: tuple[FloatArray, FloatArray]
    passive: tuple[FloatArray, FloatArray]


def solve_at_pose(
    robot: Mechanism, values: FloatArray, T: FloatArray, begin: State
) -> tuple[State, FloatArray]:
    """Close every limb with the platform at T (t, n, 4, 4); return states and readings (t, n, a).

    begin : (t, n), whose joints select the branch of each limb.
    """
    e, tau = robot.slots(values)
    guess, limbs = driven_values(robot.program, begin), robot.program.with_fixed_platform
    state = engine.solve(limbs, e, guess, replace(begin, T=T), free=True)
    joints = driven_values(robot.program, state)
    return state, readings_from_joints(joints, tau, robot.slots.constants)


def differentiate_at_pose(
    robot: Mechanism, values: FloatArray, q: FloatArray, state: State
) -> PoseDrivenSensitivity:
    """Differentiate readings and passive joints of redundant actuators at states (t, n)."""
    p, m = len(robot.parameters), len(robot.freedoms)
    joints = _differentiate_joints_at_pose(robot, values, state)
    twists = np.broadcast_to(np.eye(m, p + m, p), (*joints.shape[:2], m, p + m))
    passive = move_passive_joints(robot, values, state, twists, joints)
    by_inputs = differentiate_transmissions(robot, values, q)
    joints[..., :p] -= by_inputs[..., :p]
    with np.errstate(all="ignore"):
        readings = joints / np.einsum("...jj->...j", by_inputs[..., p:])[..., None]
    return PoseDrivenSensitivity(
        name_passive_joints(robot),
        (readings[..., :p], readings[..., p:]),
        (passive[..., :p], passive[..., p:]),
    )


def _differentiate_joints_at_pose(robot: Mechanism, values: FloatArray, state: State) -> FloatArray:
    """Return the derivatives (t, n, J, p + m) of driven joints by parameters at constant pose, and
    by the m freedoms: -(E de + A dy) / Q, of limbs with one drive and one closure row each.
    """
    p, m = len(robot.parameters), len(robot.freedoms)
    displacements = differentiate_displacements(robot, values)
    out = np.zeros((*state.T.shape[:2], robot.program.n_joints, p + m))
    for rows, blocks in linearize_limbs(robot, values, state):
        own = select_block(displacements, rows[:1])
        for limb in divide_limbs(robot.program, blocks):
            by_parameters = np.matmul(limb.E, own[:, None, limb.slots])
            both = np.concatenate([by_parameters, limb.A], axis=3)
            with np.errstate(all="ignore"):
                out[rows][:, :, limb.drives] = -(both / limb.Q)
    return out


# Summed drives: s(q) = W l, with l the values of the driven joints.

ITERATIONS = 25
"""Newton steps of a pose; those within reach need fewer than ten."""


def solve_open_sums(
    program: Program,
    e: FloatArray,
    weights: FloatArray,
    sums: FloatArray,
    begin: State,
    max_iterations: int = ITERATIONS,
) -> State:
    """Return the states (t, n) at which the weighted sums (t | 1, n, a) of driven joints are given,
    by Newton's method from `begin` (t | 1, n | 1).
    """
    t = max(len(e), len(weights), len(sums), begin.T.shape[0])
    n = max(sums.shape[1], begin.T.shape[1])
    wanted = np.broadcast_to(sums, (t, n, sums.shape[2]))
    turns = np.zeros(program.n_joints, dtype=bool)
    for group in program.groups:
        for j, columns in enumerate(group.actuator):
            if columns[0] >= 0:
                turns[columns] = group.joints[j : j + 1] == "R"
    # sums of angles count as lengths at the size of the robot
    is_angle = (weights[0] != 0.0)[:, turns].any(axis=1)
    units = np.where(is_angle, program.size, 1.0)

    def compare(T: FloatArray, rows: np.ndarray) -> tuple[FloatArray, FloatArray]:
        trial, pose = np.divmod(rows, n)
        own = e if len(e) == 1 else e[trial]
        start = begin.select((t, n), trial, pose)
        platform = np.broadcast_to(np.eye(4), (len(rows), 1, 4, 4)).copy()
        platform[:, 0, :3] = T
        start = replace(start, T=platform)
        guess = program.list_drives(start.joints)
        closed = engine.solve(program.with_fixed_platform, own, guess, start, free=True)
        W = weights if len(weights) == 1 else weights[trial]
        lengths = program.list_drives(closed.joints)
        residual = apply_weights(W, lengths)[:, 0] - wanted[trial, pose]
        slopes = np.zeros((len(rows), residual.shape[1], 6))
        by_freedoms = differentiate_lengths(program, own, replace(closed, T=platform))
        slopes[..., list(program.freedoms)] = np.matmul(W, by_freedoms[:, 0])
        return residual * units, slopes * units[:, None]

    guess = np.broadcast_to(program.list_drives(begin.joints), (t, n, program.n_joints))
    return engine.solve(program, e, guess, begin, compare, True, max_iterations)


def differentiate_lengths(program: Program, e: FloatArray, state: State) -> FloatArray:
    """Return the derivatives (t, n, J, m) of the driven joints by the platform's freedoms.

    Each limb has one driven joint and one closure equation: dl = -A dy / Q.
    """
    blocks = engine.linearize(program, e, program.list_drives(state.joints), state)
    A, Q = stack_closure_rows(blocks), stack_driven_columns(program, blocks)
    columns = np.concatenate([g.actuator[g.actuator[:, 0] >= 0][0] for g in program.groups])
    out = np.empty_like(A)
    with np.errstate(all="ignore"):
        out[:, :, columns] = -A / Q.sum(axis=-1, keepdims=True)
    return out


def differentiate_open_sums(
    robot: Mechanism,
    values: FloatArray,
    q: FloatArray,
    state: State,
    columns: ParameterUnits | None = None,
) -> Derivatives:
    """Return the derivatives of the twist of the platform, (t, n, 6, p) and (t, n, 6, a), by
    `columns`, all parameters in SI without it.
    """
    chosen = robot.all_parameters if columns is None else columns
    at_pose = np.split(
        _differentiate_joints_at_pose(robot, values, state), [len(robot.parameters)], axis=3
    )
    by_parameters = at_pose[0][..., chosen.places] * chosen.units
    weights, moved = _differentiate_sums(robot, values, q, state)
    moved = Derivatives(moved.parameters[..., chosen.places] * chosen.units, moved.readings)
    inverse = invert_weights(np.matmul(weights, at_pose[1]))
    own = moved.parameters - np.matmul(weights, by_parameters)
    shape, freedoms = state.T.shape[:2], list(robot.program.freedoms)
    out = []
    for right in (own, moved.readings):
        twist = np.zeros((*shape, 6, right.shape[-1]))
        twist[:, :, freedoms] = np.matmul(inverse, right)
        out.append(twist)
    return Derivatives(*out)


def differentiate_driven_joints(
    robot: Mechanism, values: FloatArray, q: FloatArray, state: State, platform: Derivatives
) -> FloatArray:
    """Return the derivatives (t | 1, n | 1, J, p + a) of the driven joints by all parameters in SI
    and readings, of those of the platform's twist.
    """
    if robot.has_open_sums:
        p, freedoms = len(robot.parameters), list(robot.program.freedoms)
        at_pose = _differentiate_joints_at_pose(robot, values, state)
        joints = np.matmul(at_pose[..., p:], np.concatenate(platform, axis=3)[:, :, freedoms])
        joints[..., :p] += at_pose[..., :p]
        return joints
    return differentiate_transmissions(robot, values, q)


def differentiate_joints_by_readings(
    robot: Mechanism, values: FloatArray, q: FloatArray
) -> FloatArray:
    """Return d joint / d reading (t | 1, n | 1, J, a) of as many readings as joints."""
    _, tau = robot.slots(values)
    weights = select_weights(tau, robot.slots.constants)
    assert weights is not None
    slopes = joint_slopes(q, tau, robot.slots.constants)
    return invert_weights(weights)[:, None] * slopes[:, :, None]


def _differentiate_sums(
    robot: Mechanism, values: FloatArray, q: FloatArray, state: State
) -> tuple[FloatArray, Derivatives]:
    """Return the weights (t | 1, 1, a, J), and the derivatives of s - W l at constant lengths l."""
    slots = robot.slots
    _, tau = slots(values)
    weights = select_weights(tau, robot.slots.constants)
    assert weights is not None
    lengths = driven_values(robot.program, state)
    by_terms = differentiate_sums(q, tau, slots.constants, lengths)
    of_terms = slots.jacobian(values)[:, slots.n_displacements :]
    of_terms = of_terms.reshape(len(of_terms), *slots.terms.shape, -1)
    by_parameters = np.moveaxis(np.matmul(np.moveaxis(by_terms, 2, 1), of_terms), 1, 2)
    slopes = joint_slopes(q, tau, slots.constants)
    by_readings = slopes[..., None] * np.eye(slopes.shape[-1])
    return weights[:, None], Derivatives(by_parameters, by_readings)
