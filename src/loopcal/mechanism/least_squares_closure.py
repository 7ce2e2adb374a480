# SPDX-License-Identifier: Apache-2.0
"""Derivatives of the platform where loops may stay open: those of the least-squares closure.

With unknowns u (the platform's freedoms and the passive joints), a solution has g = J(u)'r(u) = 0
for the closure residual r and its slopes J. Its derivative by an input p (displacements, driven
joints) solves

    (J'dr/du + (dJ/du)'r) du/dp = -(J'dr/dp + (dJ/dp)'r).

The terms with r are those that a Gauss-Newton step leaves out. They are central differences of J:
their error is about 1e-10 of r, and r is small. J = QR avoids the product J'J:

    (Q'dr/du + R^-T (dJ/du)'r) du/dp = -(Q'dr/dp + R^-T (dJ/dp)'r).

Arrays have N rows of poses, each with the limbs one by one. Derivation:
docs/theory/kinematics.md.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from loopcal import engine, geometry
from loopcal.engine import ParameterMap, Program, State
from loopcal.mechanism.limb_rows import expand_map, follow_limb, measure_rod
from loopcal.mechanism.states import make_start
from loopcal.typing import FloatArray

CHUNK = 512
"""Rows differentiated together."""
CHANGE = 1e-5
"""Change of an angle [rad], or of a length relative to the robot's size, of a central difference.

Its error is about the square of the change, and the rounding of 1e-16 over the change.
"""
CLOSED = 1e-12
"""Gap of the loops, relative to the robot's size, below which its terms are rounding."""
SINGULAR = 1e-13
"""Smallest diagonal of R, relative to its largest one, of a pose that has derivatives."""


@dataclass(frozen=True, eq=False)
class _Rows:
    """N rows: displacements e (N, d), nodes (N, 1, 4, 4), joints of groups (N, 1, k, J + 1).

    program : with every joint driven, so that engines linearize without elimination.
    """

    program: Program
    e: FloatArray
    nodes: tuple[FloatArray, ...]
    joints: tuple[FloatArray, ...]

    def linearize(self) -> list[engine.Block]:
        """Return A, E and Q of each group, (N, k, r, columns), with all rows of the endings."""
        state = make_start(self.nodes[0], self.joints, self.nodes[1:])
        q = self.program.list_drives(self.joints)
        blocks = engine.linearize(self.program, self.e, q, state).closure
        return [engine.Block(*(a[:, 0] for a in (b.U, b.A, b.E, b.Q))) for b in blocks]

    def measure_residual(self, number: int) -> FloatArray:
        """Return the residual (N, k, r) of a group [m], with all rows of its ending."""
        group, joints = self.program.groups[number], self.joints[number]
        own = self.e[:, group.columns].reshape(len(self.e), len(group.limbs), -1)
        bodies, out = (*self.nodes, np.eye(4)), []  # the base has the number -1
        for k in range(len(group.limbs)):
            frames, attachment = follow_limb(group, k, own[:, k], joints[:, :, k])
            tip = (bodies[group.on[k]] @ frames[-1])[:, 0]
            end = (bodies[group.to[k]] @ attachment)[:, 0]
            gap = end[:, :3, 3] - tip[:, :3, 3]
            if group.ending == "distance":
                length = measure_rod(group, k, own[:, k]) + joints[:, 0, k, -1]
                gap = (np.linalg.norm(gap, axis=1) - length)[:, None]
            elif group.ending == "rigid":
                R = end[:, :3, :3] @ tip[:, :3, :3].swapaxes(1, 2)
                v = [R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]]
                # tan(a / 2) along the axis of a rotation by a
                gibbs = np.stack(v, axis=1) / (1 + np.trace(R, axis1=1, axis2=2))[:, None]
                gap = np.concatenate([2 * self.program.size * gibbs, gap], axis=1)
            out.append(gap)
        return np.stack(out, axis=1)

    def move(self, unknown: str, index: int, change: float) -> _Rows:
        """Return the rows after a change of a freedom, by its number among those of all nodes, of
        a joint or of a slot of all limbs.
        """
        if unknown == "freedom":
            node, f = self.program.unknown_twists[index]
            T = self.nodes[node].copy()
            if f < 3:
                turn = geometry.exp_so3(change * np.eye(3)[f])
                T[..., :3, :3] = turn @ T[..., :3, :3]
            else:
                T[..., f - 3, 3] += change
            return replace(self, nodes=(*self.nodes[:node], T, *self.nodes[node + 1 :]))
        if unknown == "joint":
            joints = tuple(a.copy() for a in self.joints)
            for a in joints:
                if index < a.shape[-1]:
                    a[..., index] += change
            return replace(self, joints=joints)
        e = self.e.copy()
        for group in self.program.groups:
            if index < len(group.slots):
                e[:, group.columns.start + index : group.columns.stop : len(group.slots)] += change
        return replace(self, e=e)


def differentiate_open(
    program: Program,
    e: FloatArray,
    q: FloatArray,
    state: State,
    inputs: ParameterMap,
    nodes: int = 1,
) -> tuple[FloatArray, FloatArray]:
    """Differentiate the nodes of a least-squares closure; see `loopcal.engine.differentiate`."""
    by_input, p = differentiate_unknowns(program, e, q, state, inputs), inputs.pattern.parameters
    freedoms = [6 * node + f for node, f in program.unknown_twists if node < nodes]
    out = np.zeros((*state.T.shape[:2], 6 * nodes, by_input.shape[-1]))
    out[:, :, freedoms] = by_input[:, :, : len(freedoms)]
    return out[..., :p], out[..., p:]


def differentiate_unknowns(
    program: Program, e: FloatArray, q: FloatArray, state: State, inputs: ParameterMap
) -> FloatArray:
    """Differentiate the unknowns of a least-squares closure, (t, n, u, p + a): the freedoms of all
    nodes, then the joints of `list_unknown_joints`. Arguments are those of
    `loopcal.engine.differentiate`.
    """
    t, n = state.T.shape[:2]
    joints = [
        np.broadcast_to(g.insert_driven(own, q), (t, n, *own.shape[2:]))
        for g, own in zip(program.groups, state.joints, strict=True)
    ]
    count = len(program.unknown_twists) + len(list_unknown_joints(program))
    out = np.zeros((t * n, count, inputs.pattern.parameters + program.n_joints))
    displacements, driven = expand_map(program, inputs)
    displacements = np.pad(displacements, [(0, 0), (0, 0), (0, program.n_joints)])
    displacements = np.broadcast_to(displacements, (t, *displacements.shape[1:]))
    driven = np.broadcast_to(driven, (t, n, *driven.shape[2:]))
    for first in range(0, t * n, CHUNK):
        trial, pose = np.divmod(np.arange(first, min(first + CHUNK, t * n)), n)
        rows = _Rows(
            program.with_driven_joints,
            e[trial if len(e) > 1 else 0 * trial],
            tuple(T[trial, pose][:, None] for T in (state.T, *state.others)),
            tuple(own[trial, pose][:, None] for own in joints),
        )
        with np.errstate(all="ignore"):
            own = _InputMap(displacements[trial], driven[trial, pose])
            moved = _differentiate_rows(program, rows, own)
        out[first : first + len(trial)] = moved
    return out.reshape(t, n, *out.shape[1:])


def list_unknown_joints(program: Program) -> list[tuple[int, int]]:
    """Return limb and number of each joint that closure determines, group by group."""
    return [
        (limb, joint)
        for group in program.groups
        for limb in group.limbs
        for joint in group.unknown_joints(False)
    ]


@dataclass(frozen=True, eq=False)
class _InputMap:
    """Derivatives by p parameters and a readings: of displacements (N, d, p + a), and of driven
    joints (N, a, p + a).
    """

    displacements: FloatArray
    joints: FloatArray

    def select(self, program: Program, number: int, k: int) -> FloatArray:
        """Return those of the slots and joints of limb k of a group, (N, slots + J + 1, p + a)."""
        group, width = program.groups[number], len(program.groups[number].slots)
        first = group.columns.start + k * width
        columns = group.actuator[:, k]
        joints = np.where((columns >= 0)[:, None], self.joints[:, columns], 0.0)
        return np.concatenate([self.displacements[:, first : first + width], joints], axis=1)


def _differentiate_rows(program: Program, rows: _Rows, inputs: _InputMap) -> FloatArray:
    """Return the unknowns by parameters and readings (N, u, p + a)."""
    m, N, width = len(program.unknown_twists), len(rows.e), inputs.joints.shape[2]
    unknown = [g.unknown_joints(False) for g in program.groups]
    total = m + sum(len(g.limbs) * len(u) for g, u in zip(program.groups, unknown, strict=True))
    moves_slots = bool(inputs.displacements.any())
    residuals = [rows.measure_residual(g) for g in range(len(program.groups))]
    bends = _bend(program, rows, residuals, moves_slots)
    J, dr, bent, first = [], [], np.zeros((N, total, total + width)), m
    for number, block in enumerate(rows.linearize()):
        group, own = program.groups[number], unknown[number]
        exact = _correct_slopes(program, number, block, residuals[number])
        for k in range(len(group.limbs)):
            columns = [*range(m), *range(first, first + len(own))]  # freedoms and unknown joints
            first += len(own)
            moved, chosen = inputs.select(program, number, k), list(group.rows)

            def spread(slopes: Iterable[FloatArray]) -> FloatArray:
                """Return rows by freedoms, slots and joints as rows by all unknowns and inputs."""
                A, E, Q = slopes
                out = np.zeros((*A.shape[:2], total + width))
                out[:, :, columns] = np.concatenate([A, Q[..., own]], axis=2)  # noqa: B023
                out[:, :, total:] = np.concatenate([E, Q], axis=2) @ moved  # noqa: B023
                return out

            J.append(spread(a[:, k, chosen] for a in (block.A, block.E, block.Q))[..., :total])
            dr.append(spread(a[:, k, chosen] for a in exact))
            bent[:, columns] += spread(a[:, k] for a in bends[number])
    return _solve(np.concatenate(J, axis=1), np.concatenate(dr, axis=1), bent)


def _correct_slopes(
    program: Program, number: int, block: engine.Block, residual: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return dr of a group by freedoms, slots and joints (N, k, r, ..), of J.

    J takes the slope of a rotation as if there were no gap. With g = tan(a / 2) along its axis, a
    rotation d of the platform changes 2 g by d - g x d + g (g'd), one of the tip by d + g x d + g
    (g'd).
    """
    group = program.groups[number]
    if group.ending != "rigid":
        return block.A, block.E, block.Q
    gibbs = residual[..., :3] / (2 * program.size)
    last = len(group.joints) + 1
    of_slots = np.array([-1.0 if slot.element == last else 1.0 for slot in group.slots])

    def correct(columns: FloatArray, sign: FloatArray | float) -> FloatArray:
        d = columns[:, :, :3].swapaxes(2, 3)
        g = gibbs[:, :, None]
        turned = d + g * (d @ gibbs[..., None])
        turned += np.cross(np.broadcast_to(g, d.shape), d) * np.reshape(sign, (-1, 1))
        out = columns.copy()
        out[:, :, :3] = turned.swapaxes(2, 3)
        return out

    return correct(block.A, -1.0), correct(block.E, of_slots), correct(block.Q, 1.0)


def _bend(
    program: Program, rows: _Rows, residuals: list[FloatArray], moves_slots: bool
) -> list[tuple[FloatArray, FloatArray, FloatArray]]:
    """Return (dJ)'r of each group by freedoms, slots and joints, (N, k, m + u, ..); zero where the
    loops are closed, and by slots which no input moves.
    """
    m, groups, N = len(program.unknown_twists), program.groups, len(rows.e)
    out = []
    for group in groups:
        lead = N, len(group.limbs), m + len(group.unknown_joints(False))
        widths = m, len(group.slots), len(group.joints) + 1
        out.append(tuple(np.zeros((*lead, width)) for width in widths))
    largest = max(np.nanmax(np.abs(r), initial=0.0) for r in residuals)
    if largest <= CLOSED * program.size:
        return out
    moves = [("freedom", i, i) for i in range(m)]
    moves += [("joint", j, j) for j in range(max(len(g.joints) for g in groups) + 1)]
    if moves_slots:
        moves += [("slot", i, i) for i in range(max(len(g.slots) for g in groups))]
    for kind, index, place in moves:
        part = {"freedom": 0, "slot": 1, "joint": 2}[kind]
        # one length of the change for all limbs; of a joint an angle counts as its arc
        is_turn = kind == "freedom" and program.unknown_twists[index][1] < 3
        change = CHANGE * (1.0 if is_turn else program.size)
        ahead, behind = (rows.move(kind, index, s * change).linearize() for s in (1, -1))
        for g, group in enumerate(groups):
            if place < out[g][part].shape[3]:
                chosen = list(group.rows)
                own = group.unknown_joints(False)
                slopes = [
                    np.concatenate([b.A[:, :, chosen], b.Q[:, :, chosen][..., own]], axis=3)
                    for b in (ahead[g], behind[g])
                ]
                bent = (slopes[0] - slopes[1]).swapaxes(2, 3) @ residuals[g][:, :, chosen, None]
                out[g][part][..., place] = bent[..., 0] / (2 * change)
    return out


def _solve(J: FloatArray, dr: FloatArray, bent: FloatArray) -> FloatArray:
    """Return du / dp (N, u, p), of J (N, c, u), dr (N, c, u + p) and (dJ)'r (N, u, u + p).

    Rows that are not finite, or singular, are NaN.
    """
    u = J.shape[2]
    scale = np.linalg.norm(J, axis=1)
    good = np.isfinite(bent).all(axis=(1, 2)) & np.isfinite(dr).all(axis=(1, 2))
    good &= (scale > 0).all(axis=1)
    out = np.full((len(J), u, dr.shape[2] - u), np.nan)
    Q, R = np.linalg.qr(J[good] / scale[good, None])
    diagonal = np.abs(np.diagonal(R, axis1=1, axis2=2))
    regular = diagonal.min(axis=1) > SINGULAR * diagonal.max(axis=1)
    weights = 1 / scale[good][regular]
    good[good] = regular
    both = Q[regular].swapaxes(1, 2) @ dr[good]
    both += np.linalg.solve(R[regular].swapaxes(1, 2), bent[good] * weights[..., None])
    out[good] = -weights[..., None] * np.linalg.solve(
        both[..., :u] * weights[:, None], both[..., u:]
    )
    return out
