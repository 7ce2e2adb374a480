# SPDX-License-Identifier: Apache-2.0
"""Derivatives of the platform where loops may stay open: those of the least-squares closure.

With unknowns u (the platform's freedoms and the passive joints), a solution has g = J(u)'r(u) = 0
for the closure residual r and its slopes J. Its derivative by an input p (displacements, driven
joints) solves

    (J'dr/du + (dJ/du)'r) du/dp = -(J'dr/dp + (dJ/dp)'r).

The terms with r are those that a Gauss-Newton step leaves out. They are central differences of J:
their error is about 1e-10 of r, and r is small. J = QR avoids the product J'J:

    (Q'dr/du + R^-T (dJ/du)'r) du/dp = -(Q'dr/dp + R^-T (dJ/dp)'r).

Rows U dtheta + A y + E de + Q dq are those with every joint driven, so that an engine eliminates
none. Their columns are the freedoms of all nodes, then all joints, then all displacements. Arrays
have N rows of poses. Derivation: docs/theory/kinematics.md.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from loopcal import engine, geometry
from loopcal.engine import Group, Program, State
from loopcal.mechanism.limb_rows import divide_limbs, follow_limb, measure_rod
from loopcal.mechanism.states import make_start
from loopcal.typing import FloatArray, IntArray

CHUNK = 512  # rows differentiated together
CHANGE = 1e-5
"""Change of an angle [rad], or of a length relative to the robot's size, of a central difference.

Its error is about the square of the change, and the rounding of 1e-16 over the change.
"""
CLOSED = 1e-12  # gap of the loops, relative to the robot's size, below which its terms are rounding
# Smallest diagonal of R, relative to its largest one, of a pose that has derivatives.
SINGULAR = 1e-13


class _Rows(NamedTuple):
    """N rows: nodes (N, 1, 4, 4), all joints, then displacements, x (N, joints + d)."""

    program: Program
    nodes: tuple[FloatArray, ...]
    x: FloatArray

    def list_limbs(self) -> Iterator[tuple[Group, int, IntArray]]:
        """Yield all limbs: a group, the number in it, and the columns of x."""
        whole = self.program.with_driven_joints
        for group, driven in zip(self.program.groups, whole.groups, strict=True):
            for k, drives in enumerate(driven.actuator.T):
                first = whole.n_joints + group.columns.start + k * len(group.slots)
                slots = np.arange(first, first + len(group.slots))
                yield group, k, np.concatenate([drives[drives >= 0], slots])

    def linearize(self) -> list[FloatArray]:
        """Return the rows (N, r, M + columns) of each limb by freedoms and its columns of x."""
        whole, (T, *others), q = self.program.with_driven_joints, self.nodes, self.x[:, None]
        groups = self.program.groups
        joints = tuple(np.zeros((len(T), 1, len(g.limbs), len(g.joints) + 1)) for g in groups)
        start, J = make_start(T, joints, tuple(others)), whole.n_joints
        blocks = engine.linearize(whole, self.x[:, J:], q[..., :J], start)
        limbs = divide_limbs(whole, blocks)
        return [np.concatenate([own.A, own.Q, own.E], axis=3)[:, 0] for own in limbs]

    def measure_residual(self) -> Iterator[FloatArray]:
        """Yield the residual (N, r) of each limb [m], with all rows of its ending."""
        bodies, N = (*self.nodes, np.eye(4)), len(self.x)  # the base has the number -1
        for group, k, columns in self.list_limbs():
            theta, count = np.zeros((N, 1, len(group.joints) + 1)), len(columns) - len(group.slots)
            theta[:, 0, :count] = self.x[:, columns[:count]]
            own = self.x[:, columns[count:]]
            frames, attachment = follow_limb(group, k, own, theta)
            tip = (bodies[group.on[k]] @ frames[-1])[:, 0]
            end = (bodies[group.to[k]] @ attachment)[:, 0]
            gap = end[:, :3, 3] - tip[:, :3, 3]
            if group.ending == "distance":
                length = measure_rod(group, k, own) + theta[:, 0, -1]
                gap = (np.linalg.norm(gap, axis=1) - length)[:, None]
            elif group.ending == "rigid":
                R = end[:, :3, :3] @ tip[:, :3, :3].swapaxes(1, 2)
                v = [R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]]
                # tan(a / 2) along the axis of a rotation by a
                gibbs = np.stack(v, axis=1) / (1 + np.trace(R, axis1=1, axis2=2))[:, None]
                gap = np.concatenate([2 * self.program.size * gibbs, gap], axis=1)
            yield gap

    def move(self, columns: Sequence[int], change: float) -> _Rows:
        """Return the rows after a change of one freedom, or of several columns of x."""
        twists = self.program.unknown_twists
        if columns[0] >= len(twists):
            x = self.x.copy()
            x[:, np.subtract(columns, len(twists))] += change
            return self._replace(x=x)
        (node, f), nodes = twists[columns[0]], list(self.nodes)
        nodes[node] = geometry.apply_twist(nodes[node], change * np.eye(6)[f])
        return self._replace(nodes=tuple(nodes))


def differentiate_unknowns(
    program: Program,
    e: FloatArray,
    q: FloatArray,
    state: State,
    displacements: FloatArray,
    joints: FloatArray,
) -> FloatArray:
    """Differentiate the unknowns of a least-squares closure, (t, n, u, w): the freedoms of all
    nodes, then the joints of `list_unknown_joints`.

    Arguments are those of `loopcal.engine.differentiate`, and the derivatives of displacements
    (t | 1, d, p) and driven joints (t | 1, n | 1, J, w) by w inputs, p parameters first.
    """
    (t, n), whole, p = state.T.shape[:2], program.with_driven_joints, displacements.shape[2]
    values = whole.list_drives(
        tuple(
            np.broadcast_to(g.insert_driven(own, q), (t, n, *own.shape[2:]))
            for g, own in zip(program.groups, state.joints, strict=True)
        )
    )
    drive = np.full(whole.n_joints, -1)  # of each joint
    for group, driven in zip(program.groups, whole.groups, strict=True):
        drive[driven.actuator[driven.actuator >= 0]] = group.actuator[driven.actuator >= 0]
    displacements = np.broadcast_to(displacements, (t, *displacements.shape[1:]))
    joints = np.broadcast_to(joints, (t, n, *joints.shape[2:]))
    count = len(program.unknown_twists) + len(list_unknown_joints(program))
    out = np.zeros((t * n, count, joints.shape[3]))
    for first in range(0, t * n, CHUNK):
        trial, pose = np.divmod(np.arange(first, min(first + CHUNK, t * n)), n)
        own = e[trial if len(e) > 1 else 0 * trial]
        nodes = tuple(T[trial, pose][:, None] for T in (state.T, *state.others))
        rows = _Rows(program, nodes, np.concatenate([values[trial, pose], own], axis=1))
        moved = np.zeros((*rows.x.shape, out.shape[2]))
        moved[:, np.flatnonzero(drive >= 0)] = joints[trial, pose][:, drive[drive >= 0]]
        moved[:, len(drive) :, :p] = displacements[trial]
        with np.errstate(all="ignore"):
            out[first : first + len(trial)] = _differentiate_rows(rows, moved)
    return out.reshape(t, n, *out.shape[1:])


def list_unknown_joints(program: Program) -> list[tuple[int, int]]:
    """Return limb and number of each joint that closure determines, group by group."""
    return [
        (limb, joint)
        for group in program.groups
        for limb in group.limbs
        for joint in group.unknown_joints(False)
    ]


class _Limb(NamedTuple):
    """The rows of a limb that count: slopes J and dr of `_correct_slopes` (N, r, c) by its columns,
    and the residual (N, r).

    rows : which of its ending they are. columns : (c,) among all. unknown, places : those that
        closure determines, in columns and among the unknowns. moved : how many columns inputs or
        the unknowns move.
    """

    J: FloatArray
    dr: FloatArray
    residual: FloatArray
    rows: list[int]
    columns: IntArray
    unknown: list[int]
    places: list[int]
    moved: int


def _differentiate_rows(rows: _Rows, moved: FloatArray) -> FloatArray:
    """Return the unknowns by parameters and readings (N, u, p + a), for derivatives of x by them
    (N, joints + d, p + a).
    """
    M, J = len(rows.program.unknown_twists), rows.program.with_driven_joints.n_joints
    limbs, u, moves_slots = list[_Limb](), M, bool(moved[:, J:].any())
    of_limbs = zip(rows.list_limbs(), rows.linearize(), rows.measure_residual(), strict=True)
    for (group, k, own), slopes, residual in of_limbs:
        passive, counted = group.unknown_joints(False), list(group.rows)
        exact = _correct_slopes(rows.program, group, k, slopes, residual)
        columns = np.concatenate([np.arange(M), M + own])
        unknown = [*range(M), *(M + j for j in passive)]
        places = [*range(M), *range(u, u + len(passive))]
        width = len(columns) - (0 if moves_slots else len(group.slots))
        parts = slopes[:, counted], exact[:, counted], residual[:, counted]
        limbs.append(_Limb(*parts, counted, columns, unknown, places, width))
        u += len(passive)
    N, _, width = moved.shape
    J, dr, bent = [], [], np.zeros((N, u, u + width))
    for limb, bend in zip(limbs, _bend(rows, limbs), strict=True):
        by_all = np.zeros((N, len(limb.columns), u + width))  # its columns, by unknowns and inputs
        by_all[:, limb.unknown, limb.places] = 1.0
        by_all[:, M:, u:] = moved[:, limb.columns[M:] - M]
        J.append(limb.J @ by_all[..., :u])
        dr.append(limb.dr @ by_all)
        bent[:, limb.places] += bend @ by_all
    return _solve(np.concatenate(J, axis=1), np.concatenate(dr, axis=1), bent)


def _correct_slopes(
    program: Program, group: Group, k: int, J: FloatArray, residual: FloatArray
) -> FloatArray:
    """Return dr (N, r, c) of limb k of a group, of J.

    J takes the slope of a rotation as if there were no gap. With g = tan(a / 2) along its axis, a
    rotation d of the body where the limb ends changes 2 g by d - g x d + g (g'd), any other, which
    turns the tip, by d + g x d + g (g'd).
    """
    if group.ending != "rigid":
        return J
    at_end = [node == group.to[k] for node, _ in program.unknown_twists]
    at_end += [False] * (J.shape[2] - len(at_end) - len(group.slots))
    at_end += [slot.element == len(group.joints) + 1 for slot in group.slots]
    d, g, out = J[:, :3], residual[:, :3] / (2 * program.size), J.copy()
    turned = np.where(at_end, -1.0, 1.0) * (geometry.hat(g) @ d)
    out[:, :3] += turned + g[:, :, None] * (g[:, None] @ d)
    return out


def _bend(rows: _Rows, limbs: list[_Limb]) -> list[FloatArray]:
    """Return (dJ)'r (N, own unknowns, c) of each limb by its columns; zero where the loops are
    closed, and by displacements which no input moves.
    """
    twists, size = rows.program.unknown_twists, rows.program.size
    out = [np.zeros((len(rows.x), len(own.unknown), len(own.columns))) for own in limbs]
    largest = max(np.nanmax(np.abs(limb.residual), initial=0.0) for limb in limbs)
    if largest <= CLOSED * size:
        return out
    for i in range(max(limb.moved for limb in limbs)):
        # one length of the change for all limbs; of a joint an angle counts as its arc
        change = CHANGE * (1.0 if i < len(twists) and twists[i][1] < 3 else size)
        columns = sorted({int(limb.columns[i]) for limb in limbs if i < limb.moved})
        ahead, behind = (rows.move(columns, sign * change).linearize() for sign in (1, -1))
        for limb, bend, more, less in zip(limbs, out, ahead, behind, strict=True):
            if i < limb.moved:
                slopes = (more - less)[:, limb.rows][:, :, limb.unknown].swapaxes(1, 2)
                bend[..., i] = (slopes @ limb.residual[..., None])[..., 0] / (2 * change)
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
