# SPDX-License-Identifier: Apache-2.0
"""Closure rows of several nodes solved together, one node after the other.

A front has the rows of some limbs as columns of the twists of the nodes that they touch, and right
sides. The elimination of a node joins all fronts that touch it, triangularizes its columns by
reflections, and leaves a front of its neighbors. Along a tree of nodes no row gets longer, so that
the cost grows with the number of nodes, not its cube. Derivation: docs/theory/kinematics.md.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from loopcal.engine.numpy_engine import householder
from loopcal.engine.program import BASE, Group, Program
from loopcal.typing import FloatArray


class Front(NamedTuple):
    """Rows (r, columns, N) by the freedoms of nodes, in this order, then right sides."""

    nodes: tuple[int, ...]
    rows: FloatArray


def list_pairs(group: Group) -> list[tuple[tuple[int, ...], list[int] | slice]]:
    """Return the limbs of a group by the nodes that they join; a slice where these are the same."""
    ends = list(zip(group.on, group.to, strict=True))
    pairs: list[tuple[tuple[int, ...], list[int] | slice]] = []
    for pair in dict.fromkeys(ends):
        own = [k for k, other in enumerate(ends) if other == pair]
        nodes = tuple(node for node in pair if node != BASE)
        pairs.append((nodes, slice(None) if len(own) == len(ends) else own))
    return pairs


def factor_nodes(
    program: Program, fronts: Sequence[Front], sides: int, has_sums: bool = False
) -> tuple[list[Front], FloatArray]:
    """Eliminate the nodes in the order of the program; return the triangular rows of each, and the
    sign of the determinant (N,). has_sums : driven joints are unknown too, as a node behind those
    of the program.
    """
    factored, left, sign = [], list(fronts), np.ones(())
    *first, last = program.elimination_order
    for node in (*first, *[len(program.nodes)] * has_sums, last):
        m = program.widths[node]
        nodes, rows = _join(program, node, [f for f in left if node in f.nodes], sides, left[0])
        count = householder.count_reflections(len(rows), m)
        rows = householder.triangularize(rows, m)
        signs = np.sign(np.diagonal(rows[:m, :m]))
        sign = sign * (-1.0) ** count * np.multiply.reduce(signs, axis=-1)
        factored.append(Front(nodes, rows[:m]))
        left = [f for f in left if node not in f.nodes]
        left.append(Front(nodes[1:], rows[m:, m:]))
    return factored, sign


def _join(program: Program, node: int, fronts: Sequence[Front], sides: int, like: Front) -> Front:
    """Return fronts as one, `node` first, with at least as many rows as its freedoms."""
    nodes = (node, *sorted({other for f in fronts for other in f.nodes} - {node}))
    first = np.cumsum([0, *(program.widths[other] for other in nodes)])
    width, N, m = first[-1] + sides, like.rows.shape[-1], program.widths[node]
    parts = []
    for front in fronts:
        part = front.rows
        if front.nodes != nodes:
            part, begin = np.zeros((len(part), width, N)), 0
            for other in front.nodes:
                end, place = begin + program.widths[other], first[nodes.index(other)]
                part[:, place : place + end - begin] = front.rows[:, begin:end]
                begin = end
            part[:, first[-1] :] = front.rows[:, begin:]
        parts.append(part)
    if (missing := m - sum(map(len, parts))) > 0 or not parts:
        parts.append(np.zeros((missing, width, N)))
    return Front(nodes, np.concatenate(parts))


def solve_nodes(
    program: Program, factored: Sequence[Front], sides: int
) -> Iterator[tuple[int, FloatArray]]:
    """Yield each node with the solutions (m, sides, N) of its freedoms, the platform first."""
    known: dict[int, FloatArray] = {}
    for (node, *others), rows in reversed(factored):
        m = first = program.widths[node]
        right = -rows[:, -sides:] if sides else rows[:, :0]
        for other in others:
            for y in known[other]:  # one after the other, whatever the number of rows
                right = right - rows[:, first, None] * y
                first += 1
        known[node] = householder.back_substitute(rows[:, :m], right)
        yield node, known[node]


def gather_unknowns(program: Program, group: Group, y: Mapping[int, FloatArray]) -> FloatArray:
    """Return the freedoms (c, 1 | k, N) of the bodies at which the limbs begin, then end, and
    unknown driven joints.
    """
    parts = []
    for ends in (group.on, group.to):
        if ends[0] != BASE:
            chosen = ends[:1] if len(set(ends)) == 1 else ends
            parts.append(np.stack([y[node] for node in chosen], axis=1))
    if (joints := y.get(len(program.nodes))) is not None:
        parts.append(joints[:, None])
    k = max(part.shape[1] for part in parts)
    return np.concatenate([np.broadcast_to(part, (len(part), k, part.shape[2])) for part in parts])
