# SPDX-License-Identifier: Apache-2.0
"""Derivatives of the platform pose and of passive joints in parameters and readings.

Linearized closure without passive joints reads A y + E de + Q dq = 0, so that the platform's twist
is y = -A^-1 (E de/dp + Q dq/dp), which the engine computes. A limb's eliminated joints follow from
U dtheta + A y + E de + Q dq = 0; these equations contain its own displacements and actuators only.
They are computed in blocks that fit the cache. Derivation: docs/theory/engine.md.

Arguments are values (t | 1, p), readings q (t | 1, n, a) and the states (t, n) that they lead to.
Failed rows have NaN.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from loopcal import engine
from loopcal.engine import Block, State
from loopcal.mechanism.model import Columns, LimbMap, Mechanism
from loopcal.mechanism.parameter_units import ParameterUnits
from loopcal.mechanism.stages.chain_kinematics import (
    differentiate_end,
    differentiate_joints,
    differentiate_platform_entries,
    name_platform_entries,
)
from loopcal.mechanism.states import is_closed, select_block
from loopcal.mechanism.transmission import joint_slopes, joints_from_readings, term_derivatives
from loopcal.typing import BoolArray, FloatArray
from loopcal.value_classes import dataclass

BLOCK_ROWS = 1024
"""Rows linearized together."""


@dataclass(frozen=True)
class PoseSensitivity:
    """Derivatives of the platform pose.

    Attributes
    ----------
    parameters : (t, n, 6, p) twist (omega in base axes, velocity of the platform's origin) per unit
        of each parameter.
    readings : (t, n, 6, a) the same per unit of each reading.
    """

    parameters: FloatArray
    readings: FloatArray


def differentiate_pose(
    robot: Mechanism,
    values: FloatArray,
    q: FloatArray,
    state: State,
    columns: ParameterUnits | None = None,
) -> PoseSensitivity:
    """Differentiate the pose by the implicit function theorem, D = -A^-1 [E de/dp + Q dq/dp].

    `columns` : the parameters and their units; all parameters in SI without it. Rows of singular
    states have infinities or NaN.
    """
    if robot.stages:
        whole = differentiate_end(robot, values, q, state, differentiate_pose, columns)
        return PoseSensitivity(*whole)
    e, tau = robot.slots(values)
    joints = joints_from_readings(q, tau, robot.slots.frequency)
    chosen = robot.all_parameters if columns is None else columns
    inputs = chosen.linearize(values, tau, q)
    derivatives = engine.differentiate(robot.program, e, joints, state, inputs)
    lost = ~is_closed(state.status)
    if lost.any():
        for derivative in derivatives:
            derivative[lost] = np.nan
    return PoseSensitivity(*derivatives)


def fold_pose_rows(
    robot: Mechanism,
    values: FloatArray,
    q: FloatArray,
    state: State,
    columns: ParameterUnits,
    observed: Sequence[engine.TwistRows],
    factor: FloatArray,
) -> tuple[FloatArray, BoolArray]:
    """Fold rows of observed poses into factors (t, p + 1, p + 1), without writing derivatives.

    They are [G D | r] with D of `differentiate_pose`; see `engine.fold_poses`, also for the second
    result (t, n). For robots without stages.
    """
    e, tau = robot.slots(values)
    joints = joints_from_readings(q, tau, robot.slots.frequency)
    inputs = columns.linearize(values, tau, q)
    return engine.fold_poses(factor, robot.program, e, joints, state, inputs, observed)


@dataclass(frozen=True)
class PassiveSensitivity:
    """Derivatives of the passive joints.

    Attributes
    ----------
    names : of the j passive joints, as in `Solution.passive_names`.
    parameters : (t, n, j, p) change of each joint [m, rad] per unit of each parameter. readings :
        (t, n, j, a).
    """

    names: tuple[str, ...]
    parameters: FloatArray
    readings: FloatArray


def differentiate_passive_joints(
    robot: Mechanism, values: FloatArray, q: FloatArray, state: State
) -> PassiveSensitivity:
    """Differentiate every passive joint in every parameter and reading.

    A locked joint (one that only spins its limb) has zeros.
    """
    names, (t, n) = name_passive_joints(robot), state.T.shape[:2]
    if robot.stages:
        whole = differentiate_joints(robot, values, q, state, differentiate_passive_joints)
        return PassiveSensitivity(names, *whole)
    parameters = np.zeros((t, n, len(names), len(robot.parameters)))
    readings = np.zeros((t, n, len(names), len(robot.actuators)))
    platform, freedoms = differentiate_pose(robot, values, q, state), list(robot.program.freedoms)
    for rows, limbs in linearize_limbs(robot, values, q, state):
        by_parameter = platform.parameters[rows][:, :, freedoms]
        by_reading = platform.readings[rows][:, :, freedoms]
        for places, U, limb in limbs.passive_joints(names):
            moved, driven = np.matmul(limb.A, by_parameter), np.matmul(limb.A, by_reading)
            moved[..., limb.parameters] += limb.by_parameter
            driven[..., limb.readings] += limb.by_reading
            both = solve_passive_motion(U, np.concatenate([moved, driven], axis=-1))
            cut = moved.shape[-1]
            parameters[rows][:, :, places] = both[..., :cut]
            readings[rows][:, :, places] = both[..., cut:]
        for place, column, by_values in limbs.turned_joints(names):
            parameters[rows][:, :, place] = by_values
            readings[rows][:, :, place, column] = limbs.joints_by_reading[:, :, column]
    parameters[~is_closed(state.status)] = readings[~is_closed(state.status)] = np.nan
    return PassiveSensitivity(names, parameters, readings)


def differentiate_sensed_values(
    robot: Mechanism, values: FloatArray, q: FloatArray, state: State, names: Sequence[str]
) -> PassiveSensitivity:
    """Differentiate passive joints and the numbers of platforms of stages, by name."""
    known: list[str] = []
    parts: list[tuple[FloatArray, FloatArray]] = []
    for stage in robot.stages:
        entries = name_platform_entries(stage.name)
        if not set(entries).isdisjoint(names):
            known += entries
            parts.append(
                differentiate_platform_entries(
                    robot, values, q, state, differentiate_pose, stage.name
                )
            )
    if not set(names) <= set(known):
        joints = differentiate_passive_joints(robot, values, q, state)
        known += joints.names
        parts.append((joints.parameters, joints.readings))
    places = [known.index(name) for name in names]
    whole = (np.concatenate(arrays, axis=2)[:, :, places] for arrays in zip(*parts, strict=True))
    return PassiveSensitivity(tuple(names), *whole)


def name_passive_joints(robot: Mechanism) -> tuple[str, ...]:
    """Return the names `limb.joint` of all joints that no reading states, limb by limb."""
    return tuple(f"{limb.name}.{joint.name}" for limb, joint in robot.assembly.passive_joints)


def solve_passive_motion(U: FloatArray, right: FloatArray) -> FloatArray:
    """Return -U^-1 right for upper triangular U (t, n, u, u) and right (t, n, u, c).

    A pivot of zero gives infinities or NaN.
    """
    out = np.empty_like(right)
    with np.errstate(all="ignore"):
        for i in range(U.shape[-1] - 1, -1, -1):
            known = (U[..., i, i + 1 :, None] * out[..., i + 1 :, :]).sum(axis=-2)
            out[..., i, :] = -(right[..., i, :] + known) / U[..., i, i, None]
    return out


class LimbRows(NamedTuple):
    """Linearized closure rows of one limb.

    A : (t, n, r, m) against the platform's freedoms. by_parameter : (t, n, r, ..) against the
    parameters in `parameters`. by_reading : (t, n, r, ..) against the actuators in `readings`.
    """

    A: FloatArray
    parameters: Columns
    by_parameter: FloatArray
    readings: Columns
    by_reading: FloatArray


def linearize_limbs(
    robot: Mechanism, values: FloatArray, q: FloatArray, state: State
) -> Iterator[tuple[tuple[slice, slice], LinearizedLimbs]]:
    """Linearize all limbs, block by block; yields the trials and poses of each block with it."""
    t, n = state.T.shape[:2]
    poses = max(min(n, BLOCK_ROWS), 1)
    trials = max(1, BLOCK_ROWS // poses)
    for i in range(0, t, trials):
        for j in range(0, n, poses):
            rows = slice(i, min(i + trials, t)), slice(j, min(j + poses, n))
            chosen_values, chosen_q = _select(values, rows[:1]), _select(q, rows)
            yield rows, _linearize_block(robot, chosen_values, chosen_q, select_block(state, rows))


def _linearize_block(
    robot: Mechanism, values: FloatArray, q: FloatArray, state: State
) -> LinearizedLimbs:
    """Linearize all limbs at the states of one block."""
    slots, d = robot.slots, robot.program.n_displacements
    e, tau = slots(values)
    joints = joints_from_readings(q, tau, slots.frequency)
    J = slots.jacobian(values)
    return LinearizedLimbs(
        robot,
        engine.linearize(robot.program, e, joints, state),
        J[:, :d],
        J[:, d:].reshape(len(J), *slots.terms.shape, -1),
        term_derivatives(q, tau, slots.frequency),
        joint_slopes(q, tau, slots.frequency),
    )


def _select(array: FloatArray, rows: tuple[slice, ...]) -> FloatArray:
    """Return a block of an array whose leading axes may be 1 and then broadcast."""
    pairs = zip(rows, array.shape, strict=False)
    return array[tuple(s if length > 1 else slice(None) for s, length in pairs)]


@dataclass(frozen=True)
class LinearizedLimbs:
    """Linearized closure of a block of t trials and n poses, limb by limb.

    Attributes
    ----------
    blocks : of the engine.
    displacements_by_parameter : (t, d, p). terms_by_parameter : (t, a, k, p).
    joints_by_term : k arrays (t, n, a). joints_by_reading : (t, n, a).
    """

    robot: Mechanism
    blocks: engine.ClosureBlocks
    displacements_by_parameter: FloatArray
    terms_by_parameter: FloatArray
    joints_by_term: Sequence[FloatArray]
    joints_by_reading: FloatArray

    def rows(self, blocks: tuple[Block, ...]) -> Iterator[LimbRows]:
        """Yield the rows of each limb in `blocks.closure` or `blocks.passive`."""
        for maps, block in zip(self.robot.limb_maps, blocks, strict=True):
            for k, limb in enumerate(maps):
                yield LimbRows(
                    block.A[:, :, k],
                    limb.parameters,
                    self._differentiate_by_parameters(limb, block, k),
                    limb.readings,
                    self._differentiate_by_readings(limb, block, k),
                )

    def passive_joints(
        self, names: tuple[str, ...]
    ) -> Iterator[tuple[list[int], FloatArray, LimbRows]]:
        """Yield, for each limb, the places of its joints in `names`, their U and their rows."""
        limbs, blocks = self.robot.assembly.limbs, self.blocks
        limb_rows = self.rows(blocks.passive)
        for group, block, joints in zip(
            self.robot.program.groups, blocks.passive, blocks.joints, strict=True
        ):
            for k, i in enumerate(group.limbs):
                rows = next(limb_rows)
                if joints:
                    chosen = [f"{limbs[i].name}.{limbs[i].joints[j].name}" for j in joints]
                    yield [names.index(name) for name in chosen], block.U[:, :, k], rows

    def turned_joints(self, names: tuple[str, ...]) -> Iterator[tuple[int, int, FloatArray]]:
        """Yield, for each joint that a triangle drive turns, its place in `names`, its actuator and
        its derivatives (t, n, p) by the parameters, of which its angle alone depends on those of
        its drive.
        """
        column = {a.name: i for i, a in enumerate(self.robot.actuators) if a.is_triangle}
        for limb, joint in self.robot.assembly.passive_joints:
            if joint.actuator is not None:
                a = column[joint.actuator]
                slopes = self.terms_by_parameter[:, None, a]
                moved = (
                    self.joints_by_term[i][:, :, a, None] * slopes[:, :, i]
                    for i in range(len(self.joints_by_term))
                )
                yield names.index(f"{limb.name}.{joint.name}"), a, sum(moved, start=np.zeros(1))

    def _differentiate_by_parameters(self, limb: LimbMap, block: Block, k: int) -> FloatArray:
        """Return d rows / d parameters of limb k (t, n, r, ..)."""
        right = block.E[:, :, k]
        if not limb.is_plain:
            t, n, r, width = right.shape
            of_slots = self.displacements_by_parameter[:, limb.displacements, limb.parameters]
            product = np.matmul(right.reshape(t, n * r, width), of_slots)
            right = product.reshape(t, n, r, of_slots.shape[-1])
        for j, a, terms in limb.drives:
            for i in terms:
                slopes = self.terms_by_parameter[:, None, None, a, i, limb.parameters]
                driven = block.Q[:, :, k, :, j] * self.joints_by_term[i][:, :, a, None]
                right = right + driven[..., None] * slopes
        return right

    def _differentiate_by_readings(self, limb: LimbMap, block: Block, k: int) -> FloatArray:
        """Return d rows / d readings of limb k (t, n, r, ..)."""
        driven = block.Q[:, :, k][..., [j for j, *_ in limb.drives]]
        return driven * self.joints_by_reading[:, :, None, limb.readings]


def stack_platform_rows(blocks: engine.ClosureBlocks) -> FloatArray:
    """Return all closure rows against the platform's freedoms, (t, n, c, m)."""
    return np.concatenate(
        [b.A.reshape(*b.A.shape[:2], -1, b.A.shape[-1]) for b in blocks.closure], axis=2
    )


def stack_driven_columns(program: engine.Program, blocks: engine.ClosureBlocks) -> FloatArray:
    """Return all closure rows against the actuated joints, (t, n, c, a)."""
    columns_of_limbs = []
    for group, block in zip(program.groups, blocks.closure, strict=True):
        for k in range(len(group.limbs)):
            Q = np.zeros((*block.Q.shape[:2], block.Q.shape[3], program.n_joints))
            for j, columns in enumerate(group.actuator):
                if columns[k] >= 0:
                    Q[..., columns[k]] = block.Q[:, :, k, :, j]
            columns_of_limbs.append(Q)
    return np.concatenate(columns_of_limbs, axis=2)
