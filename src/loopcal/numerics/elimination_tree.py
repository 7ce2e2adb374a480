# SPDX-License-Identifier: Apache-2.0
"""The elimination tree: in which order unknowns of different scopes are eliminated.

Unknowns that no row uses together, directly or through others, belong to different clusters.
Within a cluster the unknowns of the outermost scope (a probe's offset) form the root node. Without
them the cluster falls apart into components (the surfaces), which are the children of the root, and
so on inwards. A row belongs to the innermost node of its unknowns. It has columns of that node and
of the node's ancestors alone, and these columns are the node's path. Nodes are eliminated from the
innermost to the outermost, so that no factor is wider than one path, however many groups there are.

The scopes may also be taken in another order where that is less work: many targets that are seen
from one station become children of the frame of that station. Nodes of equal structure (the same
parent structure and number of unknowns) are stored and eliminated together.

Poses are the innermost scope. There are as many of them as rows, so that their nodes are not part
of this table: they are eliminated block by block while rows are made, and what is left of their
rows belongs to a node of this tree. See docs/theory/identification.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np

from loopcal.numerics.sorted_values import find_distinct
from loopcal.typing import BoolArray, IntArray

SCOPES = ("machine", "session", "group", "pose")
"""Scopes of unknowns, from the outermost to the innermost."""


@dataclass(frozen=True, eq=False)
class Structure:
    """n nodes with as many unknowns, and as many columns in their paths, each.

    Attributes
    ----------
    unknowns : (n, u) the unknowns of each node.
    path : (n, w) the unknowns of each node, followed by those of its ancestors, innermost first.
    parent : number of the structure of the parents, -1 without any.
    parent_place : (n,) place of each node's parent in that structure.
    """

    unknowns: IntArray
    path: IntArray
    parent: int
    parent_place: IntArray

    def __len__(self) -> int:
        return len(self.unknowns)

    @property
    def width(self) -> int:
        """Number w of columns of a path."""
        return self.path.shape[1]


@dataclass(frozen=True, eq=False)
class EliminationTree:
    """The nodes of U unknowns. A node has a larger number than its ancestors.

    Attributes
    ----------
    node : (U,) node of each unknown, -1 where it is fixed. column : (U,) its column in that node.
    cluster : (U,) cluster of each unknown, -1 where it is fixed.
    width : (nodes,) number of columns of each path.
    structure, place : (nodes,) structure of each node, and its place among the nodes of it.
    structures : from the outermost to the innermost.
    """

    node: IntArray
    column: IntArray
    cluster: IntArray
    width: IntArray
    structure: IntArray
    place: IntArray
    structures: tuple[Structure, ...]

    @property
    def parents(self) -> frozenset[int]:
        """Numbers of the structures that have children."""
        return frozenset(s.parent for s in self.structures) - {-1}

    def columns(self, nodes: IntArray, unknowns: IntArray) -> IntArray:
        """Return the columns (k, u) of unknowns (k, u) in the paths of nodes (k,).

        An unknown outside the path, such as a fixed one, has the column after the last.
        """
        node = self.node[unknowns]
        last = self.width[nodes][:, None]
        return np.where(node >= 0, last - self.width[node] + self.column[unknowns], last)


def build_tree(is_free: BoolArray, scopes: Sequence[str], sets: IntArray) -> EliminationTree:
    """Build the elimination tree of U unknowns.

    Parameters
    ----------
    is_free : (U,) unknowns that are not fixed. scopes : (U,) the scope of each, see `SCOPES`.
    sets : (k, 2) pairs (set, unknown). The unknowns of one set must lie on one path, because a
        row, or rows that are eliminated together, use them.
    """
    if not is_free.any():
        nowhere, nothing = np.full(len(is_free), -1), np.zeros(0, dtype=np.int64)
        return EliminationTree(
            nowhere, np.zeros_like(nowhere), nowhere, nothing, nothing, nothing, ()
        )
    rank = np.array([SCOPES.index(scope) for scope in scopes], dtype=np.int64)
    pairs = sets[is_free[sets[:, 1]]]
    candidates = [
        _assign_nodes(is_free, rank, order, pairs)
        for order in permutations(find_distinct(rank[is_free]).tolist())
    ]
    node, parent = min(candidates, key=_count_multiplications)
    return _sort_by_structure(node, parent, _components(is_free, pairs))


def find_connected_groups(links: IntArray, count: int) -> IntArray:
    """Return the group (count,) of each item, numbered by first items.

    `links` (k, 2) join items directly; items are in one group where links join them. The tests
    compare it with scipy.sparse.csgraph, whose import alone would take 0.2 s.
    """
    lowest = np.arange(count)  # of the items that are known to be in a group with this one
    while (apart := lowest[links[:, 0]] != lowest[links[:, 1]]).any():
        ends = lowest[links[apart]]
        np.minimum.at(lowest, ends.max(axis=1), ends.min(axis=1))
        while (lowest[lowest] != lowest).any():
            lowest = lowest[lowest]
    return np.unique(lowest, return_inverse=True)[1].astype(np.int64)


def _components(chosen: BoolArray, pairs: IntArray) -> IntArray:
    """Return the component (U,) of each chosen unknown, numbered by first ones; -1 for others."""
    U, inside = len(chosen), pairs[chosen[pairs[:, 1]]]
    total = U + int(inside[:, 0].max(initial=-1)) + 1
    links = np.column_stack([U + inside[:, 0], inside[:, 1]])
    group = find_connected_groups(links, total)[:U][chosen]
    component = np.full(U, -1)
    component[chosen] = np.unique(group, return_inverse=True)[1]
    return component


def _assign_nodes(
    is_free: BoolArray, rank: IntArray, order: Sequence[int], pairs: IntArray
) -> tuple[IntArray, IntArray]:
    """Return the node (U,) of each unknown and the parent of each node (-1 without one).

    Scopes are taken out in the given order. A node that is the only child of its parent is merged
    with it.
    """
    U = len(is_free)
    node, above, parent = np.full(U, -1), np.full(U, -1), np.zeros(0, dtype=np.int64)
    left = is_free.copy()
    for scope in order:
        component = _components(left, pairs)
        out = left & (rank == scope)
        having, number = np.unique(component[out], return_inverse=True)
        node[out] = len(parent) + number
        member = np.flatnonzero(np.isin(component, having) & left)
        place = np.searchsorted(having, component[member])
        parents = np.zeros(len(having), dtype=np.int64)
        parents[place] = above[member]
        above[member] = len(parent) + place
        parent = np.concatenate([parent, parents])
        left &= ~out
    children = np.bincount(parent[parent >= 0], minlength=len(parent))
    is_only_child = (parent >= 0) & (children[parent] == 1)
    into = np.arange(len(parent))
    for _ in order:
        into = np.where(is_only_child, into[parent], np.arange(len(parent)))
    merged_parent = np.where(parent >= 0, into[parent], -1)
    kept = into == np.arange(len(into))
    new = np.cumsum(kept) - 1
    node = np.where(node >= 0, new[into[node]], -1)
    return node, np.where(merged_parent[kept] >= 0, new[merged_parent[kept]], -1)


def _measure_nodes(node: IntArray, parent: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """Return the unknowns, the columns of the path and the depth (nodes,) of each node.

    Parents have smaller numbers.
    """
    unknowns = np.bincount(node[node >= 0], minlength=len(parent))
    width, depth = unknowns.copy(), np.zeros(len(parent), dtype=np.int64)
    for _ in SCOPES:
        width = unknowns + np.where(parent >= 0, width[parent], 0)
        depth = np.where(parent >= 0, depth[parent] + 1, 0)
    return unknowns, width, depth


def _count_multiplications(assignment: tuple[IntArray, IntArray]) -> int:
    """Return about how many multiplications an elimination takes: u w^2, summed over nodes."""
    unknowns, width, _ = _measure_nodes(*assignment)
    return int((unknowns * width**2).sum())


def _sort_by_structure(node: IntArray, parent: IntArray, cluster: IntArray) -> EliminationTree:
    """Number the nodes by structure, from the outermost inwards."""
    unknowns, width, depth = _measure_nodes(node, parent)
    structure, place = np.full(len(parent), -1), np.zeros(len(parent), dtype=np.int64)
    order, structures, column = [], [], np.zeros(len(node), dtype=np.int64)
    by_node = np.argsort(node, kind="stable")[int((node < 0).sum()) :]
    start = np.cumsum(unknowns) - unknowns
    for d in range(int(depth.max()) + 1):
        level = np.flatnonzero(depth == d)
        outer = np.where(parent[level] >= 0, structure[parent[level]], -1)
        for key in np.unique(np.column_stack([outer, unknowns[level]]), axis=0):
            chosen = level[(outer == key[0]) & (unknowns[level] == key[1])]
            columns = by_node[start[chosen][:, None] + np.arange(key[1])]
            above = place[parent[chosen]] if d else np.full(len(chosen), -1)
            path = (
                np.concatenate([columns, structures[key[0]].path[above]], axis=1) if d else columns
            )
            column[columns] = np.arange(key[1])
            structure[chosen], place[chosen] = len(structures), np.arange(len(chosen))
            structures.append(Structure(columns, path, int(key[0]), above))
            order.append(chosen)
    sequence = np.concatenate(order)
    new = np.zeros(len(parent), dtype=np.int64)
    new[sequence] = np.arange(len(sequence))
    return EliminationTree(
        node=np.where(node >= 0, new[node], -1),
        column=column,
        cluster=cluster,
        width=width[sequence],
        structure=structure[sequence],
        place=place[sequence],
        structures=tuple(structures),
    )
