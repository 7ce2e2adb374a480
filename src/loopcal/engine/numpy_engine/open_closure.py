# SPDX-License-Identifier: Apache-2.0
"""Derivatives of the platform where loops may stay open: those of the least-squares closure.

With unknowns u (the platform's freedoms and the passive joints), a solution has g = J(u)'r(u) = 0
for the closure residual r and its slopes J. Its derivative by an input p (displacements, driven
joints) solves

    (J'dr/du + (dJ/du)'r) du/dp = -(J'dr/dp + (dJ/dp)'r).

The terms with r are those that a Gauss-Newton step leaves out. They are central differences of J:
their error is about 1e-10 of r, and r is small. J = QR avoids the product J'J:

    (Q'dr/du + R^-T (dJ/du)'r) du/dp = -(Q'dr/dp + R^-T (dJ/dp)'r).

Shapes as in closure.py: components first, limbs and rows (k, N) last. Derivation:
docs/theory/over-constraint.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from loopcal.engine.numpy_engine.closure import (
    Chain,
    PlacedLinks,
    cross,
    dot,
    exponential,
    matmul,
    place_links,
)
from loopcal.engine.numpy_engine.input_entries import Entries, pick_rows, select_entries
from loopcal.engine.program import Group, ParameterMap, Program, State
from loopcal.typing import FloatArray, IntArray

CHUNK = 256
"""Rows differentiated together."""
CHANGE = 1e-5
"""Change of an angle [rad], or of a length relative to the robot's size, of a central difference.

Its error is about the square of the change, and the rounding of 1e-16 over the change.
"""
CLOSED = 1e-12
"""Gap of the loops, relative to the robot's size, below which its terms are rounding."""


@dataclass(frozen=True)
class _Place:
    """Where the chains of a group are: its arguments, of which one differs in a difference.

    links : of each row's trial. T : (3, 4, N). theta : (J + 1, k, N).
    """

    links: PlacedLinks
    T: FloatArray
    theta: FloatArray


@dataclass(frozen=True)
class _Limbs:
    """The limbs of a group at N rows, and the inputs that move them.

    e : (t, n_displacements). trial : (N,) of each row. driven : driven joints. moves_slots :
    whether an input moves a slot.
    """

    program: Program
    group: Group
    place: _Place
    e: FloatArray
    trial: IntArray
    driven: tuple[int, ...]
    moves_slots: bool

    def make_chain(self, place: _Place) -> Chain:
        """Return the chains at a place, with all rows of their ending."""
        whole = {"rigid": 6, "ball": 3, "distance": 1}[self.group.ending]
        group = replace(self.group, rows=tuple(range(whole)))
        return Chain(group, place.links, place.T, place.theta, self.program.size)

    def slopes(self, place: _Place) -> FloatArray:
        """Return J of the engine (r, m + u, k, N), against freedoms and passive joints."""
        chain = self.make_chain(place)
        columns = [chain.rows_of_freedom(f) for f in self.program.freedoms]
        columns += [chain.rows_of_joint(j) for j in self.group.unknown_joints(False)]
        return chain.stack(*columns)[self._rows]

    @property
    def _rows(self) -> list[int]:
        """The rows of the ending that count."""
        return list(self.group.rows)

    def residual_slopes(self) -> tuple[FloatArray, FloatArray]:
        """Return r (r, k, N) and dr (r, m + u + inputs, k, N), inputs being slots, driven joints.

        J takes the slope of a rotation as if there were no gap; dr is exact.
        """
        chain, group = self.make_chain(self.place), self.group
        platform = [chain.rows_of_freedom(f) for f in self.program.freedoms]
        joints = [chain.rows_of_joint(j) for j in (*group.unknown_joints(False), *self.driven)]
        slots = [chain.rows_of_slot(s) for s in group.slots]
        residual = chain.residual()
        columns = chain.stack(*platform, *joints, *slots)
        if group.ending == "rigid":
            gibbs = residual[:3] / (2 * chain.size)
            m = len(platform)
            on_platform = [*range(m)]
            on_platform += [
                m + len(joints) + i for i, s in enumerate(group.slots) if s.element == chain.last
            ]
            sign = np.ones(columns.shape[1])
            sign[on_platform] = -1.0
            columns[:3] = _turn_residual(gibbs, columns[:3], sign)
        u = len(platform) + len(joints) - len(self.driven)
        order = [*range(u), *range(u + len(self.driven), columns.shape[1])]
        order += range(u, u + len(self.driven))
        return residual[self._rows], columns[self._rows][:, order]

    def bend(self, residual: FloatArray) -> FloatArray:
        """Return (dJ)'r (m + u, m + u + inputs, k, N) by differences; that of slots which no
        input moves is 0, and all is 0 where the loops are closed.
        """
        m, u = len(self.program.freedoms), len(self.group.unknown_joints(False))
        moves = self._list_moves()
        out = np.zeros((m + u, len(moves), *residual.shape[1:]))
        if np.abs(residual).max(initial=0.0) <= CLOSED * self.program.size:
            return out
        slots = range(m + u, m + u + len(self.group.slots))
        for i, (move, change) in enumerate(moves):
            if i not in slots or self.moves_slots:
                ahead, behind = self.slopes(move(change)), self.slopes(move(-change))
                out[:, i] = ((ahead - behind) * residual[:, None]).sum(axis=0) / (2 * change)
        return out

    def _list_moves(self) -> list[tuple[Callable[[float], _Place], float]]:
        """Return the place after a change, and the change, of each unknown and input."""
        place, group, size = self.place, self.group, self.program.size
        long = CHANGE * size

        def freedom(f: int) -> Callable[[float], _Place]:
            def move(change: float) -> _Place:
                T = place.T.copy()
                if f < 3:
                    T[:, :3] = matmul(_rotate(f, change), place.T[:, :3])
                else:
                    T[f - 3, 3] += change
                return replace(place, T=T)

            return move

        def joint(j: int) -> Callable[[float], _Place]:
            def move(change: float) -> _Place:
                theta = place.theta.copy()
                theta[j] += change
                return replace(place, theta=theta)

            return move

        def slot(s: int) -> Callable[[float], _Place]:
            def move(change: float) -> _Place:
                e, width = self.e.copy(), len(group.slots)
                first = group.columns.start + s
                e[:, first : group.columns.stop : width] += change
                return replace(place, links=place_links(group, e).select(self.trial))

            return move

        def step(j: int) -> float:
            return CHANGE if group.joints[j : j + 1] == "R" else long

        unknown = group.unknown_joints(False)
        moves = [(freedom(f), CHANGE if f < 3 else long) for f in self.program.freedoms]
        moves += [(joint(j), step(j)) for j in unknown]
        moves += [(slot(i), CHANGE if s.axis < 3 else long) for i, s in enumerate(group.slots)]
        return moves + [(joint(j), step(j)) for j in self.driven]


def _rotate(axis: int, angle: float) -> FloatArray:
    """Return the rotation (3, 3, 1) about an axis of the base."""
    w = np.zeros((3, 1))
    w[axis] = angle
    return exponential(w)


def _turn_residual(gibbs: FloatArray, columns: FloatArray, sign: FloatArray) -> FloatArray:
    """Return the rows (3, c, k, N) of 2 tan(a / 2) along the axis, of those of its rotations d.

    With g = tan(a / 2) along the axis (3, k, N): d - g x d + g (g'd) on the platform (sign -1), and
    d + g x d + g (g'd) on the tip.
    """
    g = np.broadcast_to(gibbs[:, None], columns.shape)
    turned = cross(g, columns) * sign[:, None, None]
    return columns + turned + g * dot(g, columns)


def differentiate_open(
    program: Program, e: FloatArray, q: FloatArray, state: State, inputs: ParameterMap
) -> tuple[FloatArray, FloatArray]:
    """Differentiate the platform of a least-squares closure; see `loopcal.engine.differentiate`."""
    t, n = state.T.shape[:2]
    p, a = inputs.pattern.parameters, program.n_joints
    out = np.zeros((t * n, 6, p + a))
    entries = [select_entries(g, inputs) for g in program.groups]
    values = [
        g.insert_driven(joints, q).reshape(t * n, len(g.limbs), -1).transpose(2, 1, 0)
        for g, joints in zip(program.groups, state.joints, strict=True)
    ]
    links = [place_links(g, e) for g in program.groups]
    T = state.T.reshape(-1, 4, 4)[:, :3].transpose(1, 2, 0)
    for first in range(0, t * n, CHUNK):
        rows = np.arange(first, min(first + CHUNK, t * n))
        limbs = [
            _Limbs(
                program,
                g,
                _Place(placed.select(rows // n), T[..., rows], v[..., rows]),
                e,
                rows // n,
                own.driven,
                bool((own.column < len(g.slots)).any()),
            )
            for g, placed, v, own in zip(program.groups, links, values, entries, strict=True)
        ]
        with np.errstate(all="ignore"):
            moved = _differentiate_chunk(limbs, entries, inputs, np.divmod(rows, n))
        out[rows[:, None], list(program.freedoms)] = moved
    return out[..., :p].reshape(t, n, 6, p), out[..., p:].reshape(t, n, 6, a)


def _differentiate_chunk(
    limbs: list[_Limbs],
    entries: list[Entries],
    inputs: ParameterMap,
    rows: tuple[IntArray, IntArray],
) -> FloatArray:
    """Return the platform's freedoms by parameters and readings (N, m, p + a) of (trial, pose)."""
    program, N = limbs[0].program, len(rows[0])
    m, p, a = len(program.freedoms), inputs.pattern.parameters, program.n_joints
    unknowns = m + sum(len(g.limbs) * len(g.unknown_joints(False)) for g in program.groups)
    J, dr, first = [], [], m
    bent = np.zeros((N, unknowns, unknowns + p + a))
    for own, entry in zip(limbs, entries, strict=True):
        residual, slopes = own.residual_slopes()
        u, k = len(own.group.unknown_joints(False)), len(own.group.limbs)
        joints = first + np.arange(u * k).reshape(u, k)
        columns = np.concatenate([np.arange(m)[:, None].repeat(k, 1), joints])
        first += u * k
        J.append(_spread(own.slopes(own.place), columns, unknowns))
        whole = []
        for block in (slopes, own.bend(residual)):
            inside = _spread(block[:, : m + u], columns, unknowns)
            by_input = block[:, m + u :].transpose(3, 0, 1, 2)
            readings = pick_rows(inputs.readings, *rows)
            outside = entry.by_parameter(by_input, p, *rows)
            driven = entry.by_reading(by_input, readings, own.group)
            whole.append(np.concatenate([inside, outside, driven], axis=2))
        dr.append(whole[0])
        of_limbs = whole[1].reshape(N, m + u, k, -1)
        for limb in range(k):
            bent[:, columns[:, limb]] += of_limbs[:, :, limb]
    return _solve(np.concatenate(J, axis=1), np.concatenate(dr, axis=1), bent)[:, :m]


def _spread(block: FloatArray, columns: IntArray, width: int) -> FloatArray:
    """Return the rows of a block (r, c, k, N) in their columns (c, k) of all, (N, r k, width)."""
    r, _, k, N = block.shape
    whole = np.zeros((N, r, k, width))
    for limb in range(k):
        whole[:, :, limb, columns[:, limb]] = block[:, :, limb].transpose(2, 0, 1)
    return whole.reshape(N, r * k, width)


def _solve(J: FloatArray, dr: FloatArray, bent: FloatArray) -> FloatArray:
    """Return du / dp (N, u, p), of J (N, c, u), dr (N, c, u + p) and (dJ)'r (N, u, u + p).

    Rows that are not finite, or singular, are NaN.
    """
    u = J.shape[2]
    scale = np.linalg.norm(J, axis=1)
    good = (
        np.isfinite(bent).all(axis=(1, 2)) & np.isfinite(dr).all(axis=(1, 2)) & (scale > 0).all(1)
    )
    out = np.full((len(J), u, dr.shape[2] - u), np.nan)
    Q, R = np.linalg.qr(J[good] / scale[good, None])
    weights = 1 / scale[good]
    diagonal = np.abs(np.diagonal(R, axis1=1, axis2=2))
    regular = diagonal.min(axis=1) > 1e-13 * diagonal.max(axis=1)
    good[good] = regular
    Q, R, weights = Q[regular], R[regular], weights[regular]
    both = Q.swapaxes(1, 2) @ dr[good]
    both += np.linalg.solve(R.swapaxes(1, 2), bent[good] * weights[..., None])
    left = both[..., :u] * weights[:, None]
    out[good] = -weights[..., None] * np.linalg.solve(left, both[..., u:])
    return out
