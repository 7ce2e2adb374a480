# SPDX-License-Identifier: Apache-2.0
"""In which order unknowns that measurements bring with them are eliminated, so that no factor is
wider than it must be.

Unknowns that no row uses together, directly or through others, are different clusters. Within one,
those of the outermost scope (a probe's offset) are taken out; what is left falls apart into
components (the surfaces), which are nested in them, and so on inwards: a tree of nodes. A row
belongs to the innermost node of its unknowns and has columns of this node and of those around it,
its path, alone. Nodes are eliminated from the innermost outwards. Scopes may also be taken out in
another order, where that is less work: many targets seen from one station are nested in its frame.
Nodes of equal form are worked on together. See docs/theory/identification.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np

from loopcal.typing import IntArray

SCOPES = ("machine", "session", "group", "pose")
"""From the outermost to the innermost."""


@dataclass(frozen=True, eq=False)
class Form:
    """n nodes with as many unknowns and columns each.

    Attributes
    ----------
    own : (n, u) unknowns of each. path : (n, w) the same, then those of the nodes around it, the
        innermost first.
    outer : form of the nodes around these, -1 without any. around : (n,) which of them is around
        each.
    """

    own: IntArray
    path: IntArray
    outer: int
    around: IntArray

    def __len__(self) -> int:
        return len(self.own)


@dataclass(frozen=True, eq=False)
class Nesting:
    """The nodes of U unknowns, numbered so that one has a larger number than those around it.

    Attributes
    ----------
    node : (U,) of each unknown, -1 where it is fixed. column : (U,) its column in its node. cluster
        : (U,), -1 where fixed.
    width : (nodes,) columns of its path. form, place : (nodes,) its form, and its place there.
    forms : from the outermost to the innermost.
    """

    node: IntArray
    column: IntArray
    cluster: IntArray
    width: IntArray
    form: IntArray
    place: IntArray
    forms: tuple[Form, ...]

    def columns(self, nodes: IntArray, unknowns: IntArray) -> IntArray:
        """Columns (k, u) of unknowns (k, u) in the paths of nodes (k,); the one after the last
        where they are not in it.
        """
        of = self.node[unknowns]
        last = self.width[nodes][:, None]
        return np.where(of >= 0, last - self.width[of] + self.column[unknowns], last)


def nest(free: np.ndarray, scopes: Sequence[str], sets: IntArray) -> Nesting:
    """Nest the unknowns.

    Parameters
    ----------
    free : (U,) those not fixed. scopes : (U,) of each. sets : (k, 2) pairs (set, unknown): unknowns
        in one set must lie on one path, because a row, or rows that stand side by side, use them.
    """
    if not free.any():
        nowhere, nothing = np.full(len(free), -1), np.zeros(0, dtype=np.int64)
        return Nesting(nowhere, np.zeros_like(nowhere), nowhere, nothing, nothing, nothing, ())
    rank = np.array([SCOPES.index(scope) for scope in scopes], dtype=np.int64)
    pairs = sets[free[sets[:, 1]]]
    found = [
        _nested(free, rank, order, pairs) for order in permutations(np.unique(rank[free]).tolist())
    ]
    node, parent = min(found, key=_work)
    return _formed(node, parent, _components(free, pairs))


def _components(chosen: np.ndarray, pairs: IntArray) -> IntArray:
    """Component (U,) of each chosen unknown, numbered from 0 by their first ones; -1 of the others."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    U, inside = len(chosen), pairs[chosen[pairs[:, 1]]]
    nodes = U + int(inside[:, 0].max(initial=-1)) + 1
    graph = coo_array(
        (np.ones(len(inside)), (U + inside[:, 0], inside[:, 1])), shape=(nodes, nodes)
    )
    name = connected_components(graph, directed=False)[1][:U][chosen]
    _, first, name = np.unique(name, return_index=True, return_inverse=True)
    found = np.full(U, -1)
    found[chosen] = np.argsort(np.argsort(first))[name]
    return found


def _nested(
    free: np.ndarray, rank: IntArray, order: Sequence[int], pairs: IntArray
) -> tuple[IntArray, IntArray]:
    """Node (U,) of each unknown, and the node around each node (-1 without one), scopes taken out
    in this order.

    A node that is the only one within another is made one with it.
    """
    U = len(free)
    node, above, parent = np.full(U, -1), np.full(U, -1), np.zeros(0, dtype=np.int64)
    left = free.copy()
    for scope in order:
        component = _components(left, pairs)
        out = left & (rank == scope)
        having, number = np.unique(component[out], return_inverse=True)
        node[out] = len(parent) + number
        member = np.flatnonzero(np.isin(component, having) & left)
        of = np.searchsorted(having, component[member])
        around = np.zeros(len(having), dtype=np.int64)
        around[of] = above[member]
        above[member] = len(parent) + of
        parent = np.concatenate([parent, around])
        left &= ~out
    inner = np.bincount(parent[parent >= 0], minlength=len(parent))
    alone = (parent >= 0) & (inner[parent] == 1)
    into = np.arange(len(parent))
    for _ in order:
        into = np.where(alone, into[parent], np.arange(len(parent)))
    around = np.where(parent >= 0, into[parent], -1)
    kept = into == np.arange(len(into))
    new = np.cumsum(kept) - 1
    node = np.where(node >= 0, new[into[node]], -1)
    return node, np.where(around[kept] >= 0, new[around[kept]], -1)


def _widths(node: IntArray, parent: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """Unknowns, columns of the path and depth (nodes,) of each node; those around it have smaller
    numbers.
    """
    own = np.bincount(node[node >= 0], minlength=len(parent))
    width, depth = own.copy(), np.zeros(len(parent), dtype=np.int64)
    for _ in SCOPES:
        width = own + np.where(parent >= 0, width[parent], 0)
        depth = np.where(parent >= 0, depth[parent] + 1, 0)
    return own, width, depth


def _work(nested: tuple[IntArray, IntArray]) -> int:
    """Multiplications of eliminating all nodes, about: unknowns times squared width of each."""
    own, width, _ = _widths(*nested)
    return int((own * width**2).sum())


def _formed(node: IntArray, parent: IntArray, cluster: IntArray) -> Nesting:
    """Sort nodes by their forms, from the outermost inwards."""
    own, width, depth = _widths(node, parent)
    form, place = np.full(len(parent), -1), np.zeros(len(parent), dtype=np.int64)
    order, forms, column = [], [], np.zeros(len(node), dtype=np.int64)
    by_node = np.argsort(node, kind="stable")[int((node < 0).sum()) :]
    start = np.cumsum(own) - own
    for d in range(int(depth.max()) + 1):
        here = np.flatnonzero(depth == d)
        outer = np.where(parent[here] >= 0, form[parent[here]], -1)
        for key in np.unique(np.column_stack([outer, own[here]]), axis=0):
            chosen = here[(outer == key[0]) & (own[here] == key[1])]
            columns = by_node[start[chosen][:, None] + np.arange(key[1])]
            around = place[parent[chosen]] if d else np.full(len(chosen), -1)
            path = np.concatenate([columns, forms[key[0]].path[around]], axis=1) if d else columns
            column[columns] = np.arange(key[1])
            form[chosen], place[chosen] = len(forms), np.arange(len(chosen))
            forms.append(Form(columns, path, int(key[0]), around))
            order.append(chosen)
    every = np.concatenate(order)
    new = np.zeros(len(parent), dtype=np.int64)
    new[every] = np.arange(len(every))
    node = np.where(node >= 0, new[node], -1)
    return Nesting(node, column, cluster, width[every], form[every], place[every], tuple(forms))
