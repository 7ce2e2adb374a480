# SPDX-License-Identifier: Apache-2.0
"""Linearized closure of limbs by parameters and readings, in blocks that fit the cache.

A limb's rows are A y + E de + Q dq = 0 and, for its eliminated joints, U dtheta + A y + E de + Q dq
= 0; they contain its own displacements and actuators only. With summed drives, dq are changes of
joint values in place of readings. Derivation: docs/theory/engine.md.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from loopcal import engine, geometry
from loopcal.engine import LENGTH, PITCH, Block, Group, State
from loopcal.mechanism.model import Columns, LimbMap, Mechanism
from loopcal.mechanism.states import driven_values
from loopcal.mechanism.transmission import joint_slopes, joints_from_readings, term_derivatives
from loopcal.numerics.trial_batch import map_arrays
from loopcal.typing import FloatArray

BLOCK_ROWS = 1024
"""Rows linearized together."""


def name_passive_joints(robot: Mechanism) -> tuple[str, ...]:
    """Return the names `limb.joint` of all joints that no reading states, limb by limb."""
    return tuple(f"{limb.name}.{joint.name}" for limb, joint in robot.assembly.passive_joints)


def solve_passive_motion(U: FloatArray, right: FloatArray) -> FloatArray:
    """Return -U^-1 right for upper triangular U (t, n, u, u) and right (t, n, u, c); a pivot of
    zero gives infinities or NaN.
    """
    out = np.empty_like(right)
    with np.errstate(all="ignore"):
        for i in range(U.shape[-1] - 1, -1, -1):
            known = (U[..., i, i + 1 :, None] * out[..., i + 1 :, :]).sum(axis=-2)
            out[..., i, :] = -(right[..., i, :] + known) / U[..., i, i, None]
    return out


class LimbRows(NamedTuple):
    """Linearized closure rows of one limb.

    A : (t, n, r, M) against the freedoms of all nodes. by_parameter : (t, n, r, ..) against the
    parameters in `parameters`. by_reading : (t, n, r, ..) against the actuators in `readings`, of
    summed drives against driven joints.
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
            block = map_arrays(lambda a, rows=rows: a[rows], state)
            yield rows, _linearize_block(robot, chosen_values, chosen_q, block)


def _linearize_block(
    robot: Mechanism, values: FloatArray, q: FloatArray, state: State
) -> LinearizedLimbs:
    """Linearize all limbs at the states of one block."""
    slots, d = robot.slots, robot.program.n_displacements
    e, tau = slots(values)
    J = slots.jacobian(values)
    if robot.has_sums:
        joints = driven_values(robot.program, state)
        return LinearizedLimbs(
            robot,
            engine.linearize(robot.program, e, joints, state),
            J[:, :d],
            np.zeros((len(J), 0, 0, J.shape[-1])),
            (),
            np.ones((1, 1, robot.program.n_joints)),
        )
    return LinearizedLimbs(
        robot,
        engine.linearize(robot.program, e, joints_from_readings(q, tau, slots.constants), state),
        J[:, :d],
        J[:, d:].reshape(len(J), *slots.terms.shape, -1),
        term_derivatives(q, tau, slots.constants),
        joint_slopes(q, tau, slots.constants),
    )


def _select(array: FloatArray, rows: tuple[slice, ...]) -> FloatArray:
    """Return a block of an array whose leading axes may be 1 and then broadcast."""
    pairs = zip(rows, array.shape, strict=False)
    return array[tuple(s if length > 1 else slice(None) for s, length in pairs)]


class LinearizedLimbs(NamedTuple):
    """Linearized closure of a block of t trials and n poses, limb by limb.

    blocks : of the engine.
    displacements_by_parameter : (t, d, p). terms_by_parameter : (t, a, k, p).
    joints_by_term : k arrays (t, n, a). joints_by_reading : (t, n, a). With summed drives there
        are no terms, and readings are joint values.
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


def stack_closure_rows(blocks: engine.ClosureBlocks) -> FloatArray:
    """Return all closure rows against the freedoms of all nodes, (t, n, c, M)."""
    return np.concatenate(
        [b.A.reshape(*b.A.shape[:2], -1, b.A.shape[-1]) for b in blocks.closure], axis=2
    )


def reduce_to_platform(
    program: engine.Program, blocks: engine.ClosureBlocks
) -> tuple[FloatArray, FloatArray]:
    """Return the closure rows that contain no twist of other nodes than the platform, against its
    freedoms (t, n, c, m) and the actuated joints (t, n, c, a), by an orthogonal reduction.
    """
    A, Q = stack_closure_rows(blocks), stack_driven_columns(program, blocks)
    if not program.others:
        return A, Q
    m = len(program.freedoms)
    orthogonal, _ = np.linalg.qr(A[..., m:], mode="complete")
    free = np.swapaxes(orthogonal[..., A.shape[-1] - m :], -1, -2)
    return np.matmul(free, A[..., :m]), np.matmul(free, Q)


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


# Frames along a limb for displacements and joint values, and the length of its rod.


def follow_limb(
    group: Group, k: int, displacements: FloatArray, joints: FloatArray
) -> tuple[list[FloatArray], FloatArray]:
    """Return the frames (t, n | 1, 4, 4) behind each link 0..J of limb k in the body where it
    begins, the last one the tip, and the attachment (t, 1, 4, 4) in the body where it ends.

    displacements : (t, s) of this limb. joints : (t, n, J + 1) its joint values.
    """
    links, pitch = place_links(group, k, displacements)
    placed = links[:, None]
    frames = [placed[:, :, 0]]
    for j, letter in enumerate(group.joints):
        motion = move_joint(letter, joints[..., j], pitch[:, None, j])
        frames.append(frames[-1] @ motion @ placed[:, :, j + 1])
    return frames, placed[:, :, -1]


def place_links(group: Group, k: int, displacements: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the displaced links (t, J + 2, 4, 4) of limb k, the attachment last, and the pitches
    (t, J) of its joints, for its displacements (t, s).
    """
    move, pitch = sum_displacements(group, k, displacements)
    displaced = geometry.make_pose(geometry.exp_so3(move[..., :3]), move[..., 3:])
    return group.links[k] @ displaced, pitch


def sum_displacements(
    group: Group, k: int, displacements: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return how the links of limb k move, (t, J + 2, 6) rotations and translations in their own
    frames, the attachment last, and the pitches (t, J) of its joints, for displacements (t, s).
    """
    move = np.zeros((len(displacements), len(group.joints) + 2, 6))
    pitch = np.broadcast_to(group.pitch[k], (len(displacements), len(group.joints))).copy()
    for slot, value in zip(group.slots, displacements.T, strict=True):
        if slot.axis == PITCH:
            pitch[:, slot.element] += value
        elif slot.axis != LENGTH:
            move[:, slot.element, slot.axis] += value
    return move, pitch


def measure_rod(group: Group, k: int, displacements: FloatArray) -> FloatArray:
    """Return the lengths (t,) of the rod that ends limb k of a group [m], without the value of its
    joint; 0 without one.
    """
    length = np.full(len(displacements), group.length[k] if group.ending == "distance" else 0.0)
    for slot, value in zip(group.slots, displacements.T, strict=True):
        if slot.axis == LENGTH:
            length = length + value
    return length


def move_joint(letter: str, value: FloatArray, pitch: FloatArray) -> FloatArray:
    """Return the motion (.., 4, 4) of a joint about (R) or along (P) the z axis."""
    T = np.zeros((*value.shape, 4, 4))
    T[..., 2, 2] = T[..., 3, 3] = 1.0
    if letter == "R":
        T[..., 0, 0] = T[..., 1, 1] = np.cos(value)
        T[..., 1, 0] = np.sin(value)
        T[..., 0, 1] = -T[..., 1, 0]
        T[..., 2, 3] = pitch * value
    else:
        T[..., 0, 0] = T[..., 1, 1] = 1.0
        T[..., 2, 3] = value
    return T
