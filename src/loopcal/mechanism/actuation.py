# SPDX-License-Identifier: Apache-2.0
"""Driven joints: what parameter values and readings make of a robot before its loops are closed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import numpy as np

from loopcal import engine, geometry
from loopcal.engine import Program, State
from loopcal.mechanism.limb_rows import (
    differentiate_displacements,
    linearize_limbs,
    move_passive_joints,
    name_entries,
    name_passive_joints,
    select_block,
    stack_limb_rows,
)
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.states import driven_values
from loopcal.mechanism.transmission import Transmissions, apply_weights, invert_weights
from loopcal.numerics.trial_batch import map_arrays
from loopcal.typing import FloatArray, IntArray


class Derivatives(NamedTuple):
    """Derivatives by parameters (t, n, .., p) and by readings (t, n, .., a)."""

    parameters: FloatArray
    readings: FloatArray


class DrivenJoints(NamedTuple):
    """Displacements e (t | 1, d) [m, rad], the transmissions, and values (t | 1, n, J) of the
    driven joints [m, rad] of a robot of one stage.
    """

    e: FloatArray
    drives: Transmissions
    joints: FloatArray


def drive_joints(robot: Mechanism, values: FloatArray, q: FloatArray) -> DrivenJoints:
    """Return displacements and driven joints for values (t | 1, p) and readings q (t | 1, n, a)."""
    e, drives = robot.slots(values)
    with np.errstate(invalid="ignore"):
        # an infinite reading turns into NaN, and the engine marks its row
        return DrivenJoints(e, drives, drives.find_joints(q))


@dataclass(frozen=True, eq=False)
class OpenSums:
    """Sums of driven joints: those of commanded readings, at `places` among all readings, and
    behind them others with the values `fixed` (t | 1, 1, ..) [m, rad]. weights : (t | 1, r, J).
    """

    shared: ClassVar[tuple[str, ...]] = ("places",)

    places: IntArray
    fixed: FloatArray
    weights: FloatArray

    @property
    def chosen(self) -> int:
        """How many of the sums commanded readings choose."""
        return len(self.places)

    def complete(self, u: FloatArray) -> FloatArray:
        """Return all sums (t, n, r) of values of all readings (t, n, a)."""
        return self.join(u[..., self.places])

    def join(self, chosen: FloatArray) -> FloatArray:
        """Return all sums (t, n, r) of those of commanded readings."""
        lead = np.broadcast_shapes(chosen.shape[:2], self.fixed.shape[:2])
        parts = (np.broadcast_to(a, (*lead, a.shape[2])) for a in (chosen, self.fixed))
        return np.concatenate([*parts], axis=2)

    def read(self, joints: FloatArray) -> FloatArray:
        """Return the sums (t, n, chosen) of joint values (t, n, J)."""
        return apply_weights(self.weights[:, : self.chosen], joints)


def list_open_sums(
    robot: Mechanism,
    values: FloatArray,
    places: IntArray | None = None,
    q: FloatArray | None = None,
) -> OpenSums:
    """Return the sums for values (t | 1, p); places : of the readings that choose sums, default
    all. q : readings (t | 1, n, a) of conditions, which have their references without them.
    """
    _, drives = robot.slots(values)
    count, weights = int((~drives.fixed_rows).sum()), drives.weights
    if weights is None:
        weights = np.eye(robot.program.n_joints)[None]
    chosen = np.arange(count) if places is None else places
    own = weights[:, [*chosen, *range(count, weights.shape[1])]]
    at = drives.evaluate_references() if q is None else drives.transmit(q)
    return OpenSums(chosen, at[..., count:], own)


def keep_conditions(robot: Mechanism, q: FloatArray, given: FloatArray) -> FloatArray:
    """Return readings (t, n, a) with the conditions of given ones (t | 1, n, a)."""
    return np.where(robot.is_commanded, q, given[..., : q.shape[-1]])


# Redundant actuation with a prescribed pose: all other joints follow.


class PoseDrivenSensitivity(NamedTuple):
    """Derivatives by parameters (.., p) at constant pose, and by the platform's freedoms (.., m).

    names : of the j passive joints, and of the numbers of bodies.
    readings : (t, n, a, p) and (t, n, a, m). passive : (t, n, j, p) and (t, n, j, m).
    """

    names: tuple[str, ...]
    readings: tuple[FloatArray, FloatArray]
    passive: tuple[FloatArray, FloatArray]


def solve_at_pose(
    robot: Mechanism, values: FloatArray, T: FloatArray, begin: State, q: FloatArray | None = None
) -> tuple[State, FloatArray]:
    """Close every limb with the platform at T (t, n, 4, 4); return states and readings (t, n, a).

    begin : (t, n), whose joints select the branch of each limb. q : (t | 1, n, a) readings, of
    which only the conditions count; these have their references without them.
    """
    (e, drives), sums = robot.slots(values), None
    guess, limbs = driven_values(robot.program, begin), robot.program.with_fixed_platform
    if robot.assembly.couplings:
        own = list_open_sums(robot, values, q=q)
        sums = scale_sums(robot, own.weights[:, own.chosen :], own.fixed)
    begin = replace(begin, T=T)
    state = engine.solve(limbs, e, guess, begin, free=sums is None, sums=sums)
    closed = drives.find_readings(driven_values(robot.program, state))
    return state, closed if q is None else keep_conditions(robot, closed, q)


def differentiate_at_pose(
    robot: Mechanism, values: FloatArray, q: FloatArray, state: State
) -> PoseDrivenSensitivity:
    """Differentiate readings and passive joints of redundant actuators at states (t, n). The other
    nodes and driven joints l follow from closure and couplings, A y + E de + Q dl = 0, dc = C dl.
    """
    program, p, m = robot.program, len(robot.parameters), len(robot.freedoms)
    displacements, M = differentiate_displacements(robot, values), len(program.unknown_twists)
    a = len(robot.assembly.rows) - len(robot.assembly.couplings)
    weights, moved = _differentiate_sums(robot, values, q, driven_values(program, state))
    unknown = np.zeros((*state.T.shape[:2], M + program.n_joints, p + m))
    unknown[:, :, :m, p:] = np.eye(m)
    for rows, blocks in linearize_limbs(robot, values, state):
        both = stack_sum_rows(program, blocks, select_block(weights, rows)[:, 0, a:])
        _, opened, _ = stack_limb_rows(program, blocks, select_block(displacements, rows[:1]))
        right = np.concatenate([np.zeros((*both.shape[:3], p)), both[..., :m]], axis=3)
        right[:, :, : opened.shape[2], :p] = opened
        right[:, :, opened.shape[2] :, :p] = -select_block(moved.parameters, rows)[:, :, a:]
        unknown[rows][:, :, m:] = -np.matmul(invert_weights(both[..., m:]), right)
    twists, joints = unknown[:, :, :M], unknown[:, :, M:]
    passive = move_passive_joints(robot, values, state, twists, joints)
    readings = np.zeros((*state.T.shape[:2], len(robot.actuators), p + m))
    own = np.matmul(weights[:, :, :a], joints)
    own[..., :p] -= moved.parameters[:, :, :a]
    with np.errstate(all="ignore"):
        slopes = moved.readings[:, :, :a, robot.is_commanded]
        readings[:, :, robot.is_commanded] = own / np.einsum("...jj->...j", slopes)[..., None]
    names, nodes = [*name_passive_joints(robot)], spread_twists(program, twists, len(program.nodes))
    for i, (body, T) in enumerate(zip(robot.assembly.bodies, state.others, strict=True), 1):
        names += name_entries(body)
        entries = geometry.differentiate_entries(T) @ nodes[:, :, 6 * i : 6 * i + 6]
        passive = np.concatenate([passive, entries], axis=2)
    return PoseDrivenSensitivity(
        tuple(names), (readings[..., :p], readings[..., p:]), (passive[..., :p], passive[..., p:])
    )


def spread_twists(program: Program, moved: FloatArray, nodes: int = 1) -> FloatArray:
    """Return the twists (t, n, 6 nodes, w) of the first nodes, of the freedoms of all nodes first
    among unknowns (t, n, u, w).
    """
    freedoms = [6 * node + f for node, f in program.unknown_twists if node < nodes]
    out = np.zeros((*moved.shape[:2], 6 * nodes, moved.shape[3]))
    out[:, :, freedoms] = moved[:, :, : len(freedoms)]
    return out


# Driven joints l whose sums are given, s(q) = W l, where the sums of readings and of couplings
# alone do not determine them. Closure determines l with the nodes.

ITERATIONS = 60  # newton steps of a pose; those within reach need fewer than ten


# Weight of readings that are more than the freedoms, beside closure: where they contradict each
# other, the loops open by the square of it.
SOFT = 0.1


def measure_sums(robot: Mechanism, weights: FloatArray) -> FloatArray:
    """Return lengths (r,) [m] that a unit of each of the last sums counts for: the motion of the
    joint that has most of it, an angle at the size of the robot. Readings that are more than the
    freedoms count by their standard deviations, if these are known.
    """
    with np.errstate(divide="ignore"):
        lengths = (1.0 / (np.abs(weights[0]) / robot.joint_units).max(axis=1)).clip(max=1e12)
    last = robot.assembly.rows[len(robot.assembly.rows) - len(lengths) :]
    readings = np.array([row.column is None for row in last])
    if robot.has_redundant_sums and readings.any():
        rows = [row for row in robot.assembly.rows if row.column is None]
        sigma = [(row.sigma or 0.0) * abs(row.terms.get("gain", 1.0)) for row in rows]
        own = 1.0 / np.array(sigma) if all(sigma) else lengths[readings]
        lengths[readings] = SOFT * lengths[readings].max() * own / own.max()
    return lengths


def scale_sums(robot: Mechanism, weights: FloatArray, sums: FloatArray) -> engine.Sums:
    """Return sums (t | 1, n, r) of driven joints as the engine takes them, in lengths."""
    units = measure_sums(robot, weights)
    return engine.Sums(weights * units[:, None], sums * units)


def stack_sum_rows(
    program: Program, blocks: engine.ClosureBlocks, weights: FloatArray
) -> FloatArray:
    """Return closure rows, then sums (t, n, c + r, M + J), by freedoms and driven joints."""
    top, *_ = stack_limb_rows(program, blocks)
    low = np.zeros((*top.shape[:2], weights.shape[1], top.shape[3]))
    low[..., len(program.unknown_twists) :] = weights[:, None]
    return np.concatenate([top, low], axis=2)


def differentiate_unknowns_by_sums(
    robot: Mechanism, e: FloatArray, state: State, weights: FloatArray
) -> FloatArray:
    """Return derivatives (t, n, M + J, r) of freedoms and driven joints by weighted sums."""
    joints = driven_values(robot.program, state)
    blocks = engine.linearize(robot.program, e, joints, state)
    return invert_sum_rows(robot, blocks, weights)[..., -weights.shape[1] :]


def invert_sum_rows(
    robot: Mechanism, blocks: engine.ClosureBlocks, weights: FloatArray
) -> FloatArray:
    """Return the inverses (t, n, M + J, c + r) of the rows of `stack_sum_rows`, c + r >= M + J,
    those of least squares with more rows, NaN where one is singular or not finite.
    """
    units = measure_sums(robot, weights)
    rows = stack_sum_rows(robot.program, blocks, weights * units[:, None])
    if rows.shape[2] == rows.shape[3]:
        inverse = invert_weights(rows)
    else:
        orthogonal, triangle = np.linalg.qr(np.nan_to_num(rows))
        inverse = np.matmul(invert_weights(triangle), np.swapaxes(orthogonal, -1, -2))
        inverse[~np.isfinite(rows).all(axis=(-1, -2))] = np.nan
    inverse[..., -len(units) :] *= units
    return inverse


def differentiate_open_sums(
    robot: Mechanism, values: FloatArray, q: FloatArray, state: State
) -> FloatArray:
    """Return the derivatives (t, n, M + J, p + a) of all nodes' freedoms and of driven joints by
    parameters in SI and by readings.
    """
    program, p = robot.program, len(robot.parameters)
    unknown = len(program.unknown_twists) + program.n_joints
    out = np.empty((*state.T.shape[:2], unknown, p + len(robot.actuators)))
    displacements = differentiate_displacements(robot, values)
    for rows, blocks in linearize_limbs(robot, values, state):
        own, readings = select_block(values, rows[:1]), select_block(q, rows)
        block = map_arrays(lambda a, rows=rows: a[rows], state)
        lengths = driven_values(program, block)
        weights, moved = _differentiate_sums(robot, own, readings, lengths)
        inverse = invert_sum_rows(robot, blocks, weights[:, 0])
        _, opened, _ = stack_limb_rows(program, blocks, select_block(displacements, rows[:1]))
        c = opened.shape[2]
        out[rows] = np.matmul(inverse[..., c:], np.concatenate(moved, axis=3))
        out[rows][..., :p] -= np.matmul(inverse[..., :c], opened)
    return out


def differentiate_driven_joints(robot: Mechanism, values: FloatArray, q: FloatArray) -> FloatArray:
    """Return derivatives (t | 1, n | 1, J, p + a) of driven joints, without open sums, by
    parameters in SI and by readings.
    """
    joints = drive_joints(robot, values, q).joints
    weights, moved = _differentiate_sums(robot, values, q, joints)
    with np.errstate(invalid="ignore"):  # as in `drive_joints`
        return np.matmul(invert_weights(weights), np.concatenate(moved, axis=3))


def _differentiate_sums(
    robot: Mechanism, values: FloatArray, q: FloatArray, lengths: FloatArray
) -> tuple[FloatArray, Derivatives]:
    """Return the weights (t | 1, 1, a, J), and the derivatives of s - W l at constant lengths l
    (t, n, J); without sums each reading has its own joint.
    """
    slots, (_, drives) = robot.slots, robot.slots(values)
    weights = drives.weights
    of_terms = slots.jacobian(values)[:, slots.n_displacements :]
    of_terms = of_terms.reshape(len(of_terms), *slots.terms.shape, -1)
    with np.errstate(invalid="ignore"):  # as in `drive_joints`
        if weights is None:
            by_terms = np.stack(drives.differentiate_terms(q), axis=3)
            weights = np.eye(robot.program.n_joints)[None]
        else:
            by_terms = drives.differentiate_sums(q, lengths)
        by_parameters = np.moveaxis(np.matmul(np.moveaxis(by_terms, 2, 1), of_terms), 1, 2)
        by_readings = drives.differentiate_by_readings(q)
    lead = np.broadcast_shapes(*(a.shape[:2] for a in (by_parameters, by_readings, lengths)))
    both = (np.broadcast_to(a, (*lead, *a.shape[2:])) for a in (by_parameters, by_readings))
    return weights[:, None], Derivatives(*both)
