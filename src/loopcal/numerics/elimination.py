# SPDX-License-Identifier: Apache-2.0
"""Elimination of all unknowns of an elimination tree, nodes of equal structure together.

The rows of a node are [own | ancestors | A | r]. The node's own columns are eliminated by
orthogonal projection (`eliminate_columns`). What is left are rows of its parent,
and what is left of the roots are rows [A | r] of the machine. Columns are scaled by their length
over all rows before anything is eliminated, so that a direction that inner unknowns explain in full
is recognized as unobservable. The best values follow from the roots inwards. Among all best values
those of smallest length in these units are returned: the result equals one dense pseudo-inverse
over a whole cluster. See docs/theory/identification.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import permutations
from typing import ClassVar, NamedTuple

import numpy as np

from loopcal import engine
from loopcal.engine import BlockRows, Structure
from loopcal.numerics import decomposition
from loopcal.numerics.statistics import find_distinct
from loopcal.numerics.trial_batch import TrialBatch
from loopcal.typing import BoolArray, FloatArray, IntArray

# The elimination tree: in which order unknowns of different scopes are eliminated.

TARGET = "target"
# Scopes of unknowns, from the outermost to the innermost.
SCOPES = ("machine", "session", "group", "pose", TARGET)


@dataclass(frozen=True, eq=False)
class EliminationTree:
    """The nodes of U unknowns. A node has a larger number than its ancestors.

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
    """Build the elimination tree of U unknowns, some of them fixed, with their scopes.

    `sets` (k, 2) are pairs (set, unknown). The unknowns of one set must lie on one path, because a
    row, or rows that are eliminated together, use them.
    """
    if not is_free.any():
        nowhere, nothing = np.full(len(is_free), -1), np.zeros(0, dtype=np.int64)
        return EliminationTree(
            nowhere, np.zeros_like(nowhere), nowhere, nothing, nothing, nothing, ()
        )
    rank = np.array([SCOPES.index(scope) for scope in scopes], dtype=np.int64)
    pairs = sets[is_free[sets[:, 1]]]
    orders = permutations(find_distinct(rank[is_free]).tolist())
    cluster = _components(is_free, pairs)
    candidates = (_assign_nodes(cluster, rank, order, pairs) for order in orders)
    node, parent = min(candidates, key=_count_multiplications)
    return _sort_by_structure(node, parent, cluster)


def spread_columns(values: FloatArray, columns: IntArray, width: int) -> FloatArray:
    """Return values (.., k, m, width) by all columns from those (.., k, m, u) at columns (k, u);
    those at column `width` are left out.
    """
    if columns.shape[1] == width and (columns == np.arange(width)).all():
        return values
    wide = np.zeros((*values.shape[:-1], width + 1))
    np.put_along_axis(wide, np.broadcast_to(columns[:, None], values.shape), values, axis=-1)
    return wide[..., :width]


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
    number, inside = np.cumsum(chosen) - 1, pairs[chosen[pairs[:, 1]]]
    count = int(chosen.sum())
    links = np.column_stack([count + inside[:, 0], number[inside[:, 1]]])
    component = np.full(len(chosen), -1)
    component[chosen] = find_connected_groups(links, int(links.max(initial=count)) + 1)[:count]
    return component


def _assign_nodes(
    cluster: IntArray, rank: IntArray, order: Sequence[int], pairs: IntArray
) -> tuple[IntArray, IntArray]:
    """Return the node (U,) of each unknown and the parent of each node (-1 without one).

    Scopes are taken out in the given order. A node that is the only child of its parent is merged
    with it. cluster : (U,) of each free unknown, -1 for others.
    """
    U, left = len(cluster), cluster >= 0
    node, above, parent = np.full(U, -1), np.full(U, -1), np.zeros(0, dtype=np.int64)
    for scope in order:
        component = _components(left, pairs) if len(parent) else cluster
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


# Unobservable directions have at least length one when they are carried inwards. Shorter ones are
# rounding.
SHORTEST_DIRECTION = 0.5


def use_path(structure: Structure, count: int) -> IntArray:
    """Return the columns (count, w) of rows that use the whole path of their node."""
    return np.broadcast_to(np.arange(structure.width), (count, structure.width))


def fill_rows(rows: BlockRows, tree: EliminationTree) -> FloatArray:
    """Return rows (a, k m, w + p + 1), with all columns of the paths of their nodes."""
    width = tree.structures[rows.structure].width
    own = spread_columns(rows.by_unknowns, rows.columns, width)
    whole = np.concatenate([own, rows.machine], axis=-1)
    return whole.reshape(len(whole), -1, whole.shape[-1])


class NodeFactors:
    """The rows of all nodes, folded into triangular factors where they are many: working memory.

    tree : of the U unknowns. trials : a. parameters : p of the machine.
    most : numbers of rows, about, from which they are folded where that leaves fewer.
    """

    tree: EliminationTree
    trials: int
    parameters: int
    most: float

    def __init__(
        self, tree: EliminationTree, trials: int, parameters: int, most: float = 4e6
    ) -> None:
        self.tree, self.trials, self.parameters, self.most = tree, trials, parameters, most
        self._factors: list[FloatArray] = [
            np.zeros((trials, len(s), 0, s.width + parameters + 1)) for s in tree.structures
        ]
        self._rows: list[BlockRows] = []

    def add(self, rows: BlockRows) -> None:
        """Add rows of nodes."""
        self._rows.append(rows)
        if sum(part.machine.size + part.by_unknowns.size for part in self._rows) > self.most:
            self._fold(least=1)

    def _fold(self, least: int) -> None:
        """Fold all rows of structures into their factors that are `least` times as many as those of
        full triangles.
        """
        for structure in sorted({part.structure for part in self._rows}):
            own = [part for part in self._rows if part.structure == structure]
            places = np.concatenate([p.places.repeat(p.machine.shape[2]) for p in own])
            nodes, _, width = self._factors[structure].shape[1:]
            if len(places) < least * nodes * width:
                continue
            filled = [fill_rows(part, self.tree) for part in own]
            rows = filled[0] if len(filled) == 1 else np.concatenate(filled, axis=1)
            self._factors[structure] = fold_at(self._factors[structure], rows, places)
            self._rows = [part for part in self._rows if part.structure != structure]

    def arrays(self) -> list[FloatArray]:
        """Return the factors (a, n, h, w + p + 1) of every structure; h = 0 without rows."""
        self._fold(least=0)
        return list(self._factors)

    def list_rows(self) -> list[BlockRows]:
        """Return all rows, those of the factors first."""
        pairs = enumerate(zip(self._factors, self.tree.structures, strict=True))
        folded = [
            BlockRows(i, np.arange(len(s)), use_path(s, len(s)), *np.split(f, [s.width], axis=-1))
            for i, (f, s) in pairs
            if f.shape[2]
        ]
        return folded + self._rows


class UnknownRoot(NamedTuple):
    """A square root of the covariance of U unknowns by its entries that are not zero: those of an
    unknown are few, because those of one session never meet those of another.
    """

    columns: IntArray  # (U, w) their columns, -1 for none
    values: FloatArray  # (U, w)
    total: int  # number of columns

    @classmethod
    def make_empty(cls, count: int) -> UnknownRoot:
        """Return the root of so many unknowns without a column."""
        return cls(np.zeros((count, 0), dtype=np.int64), np.zeros((count, 0)), 0)

    @classmethod
    def of(cls, columns: IntArray, values: FloatArray) -> UnknownRoot:
        """Return a root whose columns, which have any numbers from 0 on, are counted."""
        numbers, place = np.unique(np.append(-1, columns), return_inverse=True)
        first = int((numbers < 0).sum())
        return cls(place[1:].reshape(columns.shape) - first, values, len(numbers) - first)

    def append(self, others: FloatArray) -> UnknownRoot:
        """Return the root with further columns (U, d)."""
        widest = int((others != 0.0).sum(axis=1).max(initial=0))
        order = np.argsort(others == 0.0, axis=1, kind="stable")[:, :widest]
        values = np.take_along_axis(others, order, axis=1)
        columns = np.where(values != 0.0, self.total + order, -1)
        return UnknownRoot(
            np.hstack([self.columns, columns]),
            np.hstack([self.values, values]),
            self.total + others.shape[1],
        )

    def take(self, rows: IntArray) -> UnknownRoot:
        """Return the root of some unknowns (k,), of which -1 is known."""
        columns = np.pad(self.columns, ((0, 1), (0, 0)), constant_values=-1)[rows]
        return UnknownRoot(columns, np.pad(self.values, ((0, 1), (0, 0)))[rows], self.total)

    def fill(self, rows: IntArray) -> FloatArray:
        """Return some rows (k, c), with the columns that any of them has."""
        used, place = np.unique(self.columns[rows], return_inverse=True)
        filled = np.zeros((len(rows), len(used)))
        np.put_along_axis(filled, place.reshape(len(rows), -1), self.values[rows], axis=1)
        return filled[:, used >= 0]


@dataclass(frozen=True, eq=False)
class NodeSolution:
    """Nodes of one structure after their elimination: x = -solution @ [ancestors, z, 1].

    inverse : (a, n, u, u) pseudo-inverse of the triangle of the node's own columns.
    solution : (a, n, u, w - u + p + 1).
    unobservable : (a, n, u, u) unobservable directions, one per row, in columns of length one; zero
        rows for the others.
    """

    inverse: FloatArray
    solution: FloatArray
    unobservable: FloatArray


@dataclass(frozen=True, eq=False)
class TreeElimination(TrialBatch):
    """U eliminated unknowns: their best values are a linear function of the machine's deviation.

    tree : of the unknowns.
    slope : (a, U, p) change of the best values by the machine's deviations.
    shift : (a, U) step from the present values to the best ones at the present machine.
    rank : (a,) number of observable directions.
    explained : (a,) decrease of the sum of squares by the shift.
    is_unobservable : (a, U) unknowns with a part in an unobservable direction.
    nodes : the solution of every structure. length : (a, U) of the columns over all rows.
    """

    shared: ClassVar[tuple[str, ...]] = ("tree",)

    tree: EliminationTree
    slope: FloatArray
    shift: FloatArray
    rank: IntArray
    explained: FloatArray
    is_unobservable: BoolArray
    nodes: tuple[NodeSolution, ...]
    length: FloatArray

    @cached_property
    def roots(self) -> tuple[FloatArray, ...]:
        """(a, n, w, w) of every structure: square roots of the covariance of each path.

        With the rows F of a cluster, T T' = (F'F)^-1 where everything is observable: rows times T
        are in units of the standard deviations of the path's unknowns.
        """
        roots: list[FloatArray] = []
        for structure, node in zip(self.tree.structures, self.nodes, strict=True):
            a, n, u, _ = node.inverse.shape
            w = structure.width
            root = np.zeros((a, n, w, w))
            root[:, :, :u, :u] = node.inverse
            if w > u:
                above = roots[structure.parent][:, structure.parent_place]
                root[:, :, u:, u:] = above
                root[:, :, :u, u:] = -np.matmul(node.solution[..., : w - u], above)
            roots.append(root)
        return tuple(roots)

    def at_nodes(self, nodes: IntArray) -> tuple[IntArray, FloatArray, FloatArray]:
        """Return paths (k, w), roots (k, w, w) and slopes (k, w, p) of nodes (k,), first trial.

        The nodes must have one structure.
        """
        structure, places = int(self.tree.structure[nodes[0]]), self.tree.place[nodes]
        path = self.tree.structures[structure].path[places]
        return path, self.roots[structure][0][places], self.slope[0][path]

    def list_root(self) -> UnknownRoot:
        """Return a square root (U, U) of the covariance of all unknowns at a known machine, for
        unit noise (first trial): an unknown has entries in the columns of its path, see `roots`.
        """
        widest = max((structure.width for structure in self.tree.structures), default=0)
        columns = np.full((self.shift.shape[1], widest), -1)
        values = np.zeros(columns.shape)
        for structure, root in zip(self.tree.structures, self.roots, strict=True):
            u, w = structure.unknowns.shape[1], structure.width
            columns[structure.unknowns, :w] = structure.path[:, None]
            values[structure.unknowns, :w] = root[0, :, :u]
        return UnknownRoot(columns, values, len(columns))

    def move_unknowns(self, x: FloatArray) -> FloatArray:
        """Return the root of `list_root` times x (U, c)."""
        moved = np.zeros_like(x)
        for structure, root in zip(self.tree.structures, self.roots, strict=True):
            own = root[0, :, : structure.unknowns.shape[1]]
            moved[structure.unknowns] = np.matmul(own, x[structure.path])
        return moved

    def null_directions(self) -> FloatArray:
        """Return the directions (U, d) that no row of the first trial determines, at a known
        machine; the largest entry of each is 1.
        """
        count = sum(int(node.unobservable[0].any(axis=2).sum()) for node in self.nodes)
        null, first = np.zeros((self.shift.shape[1], count)), 0
        for structure, node in zip(self.tree.structures, self.nodes, strict=True):
            own, u = structure.unknowns, structure.unknowns.shape[1]
            if structure.width > u:  # unknowns follow their ancestors
                by_ancestors = node.solution[0, ..., : structure.width - u]
                null[own] = -np.matmul(by_ancestors, null[structure.path[:, u:]])
            places, rows = np.nonzero(node.unobservable[0].any(axis=2))
            columns = first + np.arange(len(places))
            null[own[places], columns[:, None]] = node.unobservable[0][places, rows]
            null[own[places], columns[:, None]] /= self.length[0][own[places]]
            first += len(places)
        return np.asarray(null / np.abs(null).max(axis=0, initial=0.0))


def eliminate_tree(factors: NodeFactors) -> tuple[TreeElimination, FloatArray]:
    """Eliminate all unknowns; return also the factor (a, p + 1, p + 1) of the rows left."""
    tree, limit = factors.tree, decomposition.certain_share(decomposition.NUISANCE_TOLERANCE)
    done = None
    if tree.structures:
        shape = factors.trials, len(tree.node), factors.parameters
        done = engine.eliminate_blocks(tree.structures, factors.list_rows(), shape, limit)
    if done is None:
        return _eliminate_by_decompositions(factors)
    nodes = tuple(
        NodeSolution(inverse, solution, np.zeros_like(inverse))
        for inverse, solution in done.solutions
    )
    values, length = done.values, done.length
    elimination = TreeElimination(
        tree,
        values[..., :-1],
        values[..., -1],
        np.full(factors.trials, (tree.node >= 0).sum()),
        done.explained,
        np.zeros(length.shape, dtype=bool),
        nodes,
        length,
    )
    if done.is_regular.all():
        return elimination, done.factor
    whole, rest = _eliminate_by_decompositions(factors)
    good = np.flatnonzero(done.is_regular)
    rest[good] = done.factor[good]
    return whole.put(good, elimination.take(good)), rest


def _eliminate_by_decompositions(factors: NodeFactors) -> tuple[TreeElimination, FloatArray]:
    """Return `eliminate_tree` where rows may leave directions of the unknowns open."""
    tree, arrays = factors.tree, factors.arrays()
    length = _column_lengths(factors, arrays)
    rest = decomposition.empty_factor(factors.trials, factors.parameters)
    rank, explained = np.zeros(factors.trials, dtype=np.int64), np.zeros(factors.trials)
    solutions: list[NodeSolution] = []
    for i in reversed(range(len(tree.structures))):
        structure = tree.structures[i]
        done = _eliminate_nodes(arrays[i], length[:, structure.unknowns], structure)
        solutions.append(NodeSolution(done.inverse, done.solution, done.unobservable))
        rank += done.rank.sum(axis=1)
        explained += done.explained.sum(axis=1)
        u = structure.unknowns.shape[1]
        left = done.rest[..., u:, :] if done.is_observable.all() else done.rest
        rows = left.reshape(factors.trials, -1, left.shape[-1])
        if structure.parent < 0:
            rest = engine.fold(rest, rows)
        else:
            places = np.repeat(structure.parent_place, left.shape[2])
            arrays[structure.parent] = fold_at(arrays[structure.parent], rows, places)
    nodes = tuple(reversed(solutions))
    values = _back_substitute(factors, nodes)
    is_unobservable, values = _remove_unobservable(tree, nodes, length, values)
    best = tree, values[..., :-1], values[..., -1], rank, explained
    elimination = TreeElimination(*best, is_unobservable, nodes, length)
    return elimination, rest


def _eliminate_nodes(factor: FloatArray, length: FloatArray, structure: Structure) -> Elimination:
    """Eliminate the own columns, of length (a, n, u) over all rows, of factors (a, n, h, ..)."""
    u = structure.unknowns.shape[1]
    if factor.shape[2] < u:
        factor = _with_height(factor, u)
    top, below = factor[:, :, :u], factor[:, :, u:, u:]
    return eliminate_from_triangle(top[..., :u], top[..., u:], below, length)


def _column_lengths(factors: NodeFactors, arrays: list[FloatArray]) -> FloatArray:
    """Return the length (a, U) of every unknown's column over all rows; 1 where it is zero."""
    squares = np.zeros((len(factors.tree.node), factors.trials))
    for structure, factor in zip(factors.tree.structures, arrays, strict=True):
        part = (factor[..., : structure.width] ** 2).sum(axis=2)
        np.add.at(squares, structure.path.ravel(), part.reshape(len(part), -1).T)
    return np.sqrt(np.where(squares > 0.0, squares, 1.0)).T


def _back_substitute(factors: NodeFactors, nodes: tuple[NodeSolution, ...]) -> FloatArray:
    """Return best values (a, U, p + 1): by the machine's deviations, and here."""
    values = np.zeros((factors.trials, len(factors.tree.node), factors.parameters + 1))
    for structure, node in zip(factors.tree.structures, nodes, strict=True):
        w, u = structure.width, structure.unknowns.shape[1]
        best = node.solution[..., w - u :]
        if w > u:
            best = best + np.matmul(node.solution[..., : w - u], values[:, structure.path[:, u:]])
        values[:, structure.unknowns] = -best
    return values


def _remove_unobservable(
    tree: EliminationTree, nodes: tuple[NodeSolution, ...], length: FloatArray, values: FloatArray
) -> tuple[BoolArray, FloatArray]:
    """Take the unobservable directions out of best values (a, U, q); mark unknowns in them.

    A direction that is unobservable in a node has no part in the node's ancestors. It moves the
    node's children along their best values. All directions that begin in one cluster are made
    orthonormal together. Those of the innermost nodes have no part in any best value.
    """
    share = np.zeros(length.shape)
    for i, (structure, node) in enumerate(zip(tree.structures, nodes, strict=True)):
        if i not in tree.parents:
            share[:, structure.unknowns] = (node.unobservable**2).sum(axis=2)
    if not any(nodes[i].unobservable.any() for i in tree.parents):
        return np.sqrt(share) > decomposition.NULL_COMPONENT, values
    values = values.copy()
    carried, clusters = _carry_inwards(tree, nodes, length)
    for c in clusters:
        inside = np.flatnonzero(tree.cluster == c)
        left, s, _ = np.linalg.svd(carried[:, inside], full_matrices=False)
        basis = np.where((s > SHORTEST_DIRECTION)[:, None, :], left, 0.0)
        scaled = values[:, inside] * length[:, inside, None]
        along = np.matmul(basis, np.matmul(basis.swapaxes(-1, -2), scaled))
        values[:, inside] = (scaled - along) / length[:, inside, None]
        share[:, inside] += (basis**2).sum(axis=-1)
    return np.sqrt(share) > decomposition.NULL_COMPONENT, values


def _carry_inwards(
    tree: EliminationTree, nodes: tuple[NodeSolution, ...], length: FloatArray
) -> tuple[FloatArray, IntArray]:
    """Return unobservable directions (a, U, k), from their nodes inwards, columns of length one.

    Directions of different clusters share the k columns. The clusters that have any are returned,
    too.
    """
    a, U = length.shape
    begins = np.zeros(U, dtype=bool)
    for i in tree.parents:
        begins[tree.structures[i].unknowns] = True
    chosen = np.flatnonzero(begins)
    count = np.bincount(tree.cluster[chosen], minlength=1)
    order = chosen[np.argsort(tree.cluster[chosen], kind="stable")]
    slot = np.zeros(U, dtype=np.int64)
    slot[order] = np.arange(len(order)) - np.repeat(np.cumsum(count) - count, count)
    carried = np.zeros((a, U, int(count.max())))
    for i, (structure, node) in enumerate(zip(tree.structures, nodes, strict=True)):
        own, w, u = structure.unknowns, structure.width, structure.unknowns.shape[1]
        if w > u:
            above = structure.path[:, u:]
            change = np.matmul(
                node.solution[..., : w - u], carried[:, above] / length[:, above][..., None]
            )
            carried[:, own] = -change * length[:, own][..., None]
        if i in tree.parents:
            carried[:, own[:, :, None], slot[own][:, None, :]] += node.unobservable.swapaxes(-1, -2)
    clusters = find_distinct(tree.cluster[np.flatnonzero(carried.any(axis=(0, 2)))])
    return carried, clusters


FOLDED = 500_000  # numbers that are folded by one call


def fold_at(factor: FloatArray, rows: FloatArray, places: IntArray) -> FloatArray:
    """Return factors (a, n, h, w) with rows (a, k, w) folded in at places (k,)."""
    used, w = factor.shape[2:]
    order = np.argsort(places, kind="stable")
    count = np.bincount(places, minlength=factor.shape[1])
    first = np.cumsum(count) - count
    out = _with_height(factor, min(w, used + int(count.max(initial=0))))
    for number in find_distinct(count[count > 0]):  # nodes with as many new rows together
        alike = np.flatnonzero(count == number)
        size = max(1, FOLDED // (len(rows) * (used + int(number)) * w))
        for nodes in np.split(alike, range(size, len(alike), size)):
            own = rows[:, order[first[nodes][:, None] + np.arange(number)]]
            whole = np.concatenate([factor[:, nodes], own], axis=2)
            triangles = np.asarray(np.linalg.qr(whole, mode="r"))
            out[:, nodes, : triangles.shape[2]] = triangles
    return out


def _with_height(factor: FloatArray, height: int) -> FloatArray:
    """Return factors (a, n, height, w), rows of zeros below."""
    out = np.zeros((*factor.shape[:2], height, factor.shape[3]))
    out[:, :, : factor.shape[2]] = factor
    return out


# Derivatives that are nothing but rounding.

# Share of the size of its terms below which a sum of a few products is rounding: some thousand
# units of the last place.
ROUNDING = 1e-12


def without_rounding(values: FloatArray, size: FloatArray) -> FloatArray:
    """Return derivatives with zeros where they are at most ROUNDING of the size of the terms whose
    sum they are; with a size of zero, or not finite, they stay.

    A column that is rounding must be set to zero BEFORE columns are scaled to length one: after
    that, a few units of the last place look like any other direction and produce an unbounded step.
    """
    limit = np.where((size > 0.0) & (size < np.inf), ROUNDING * size, -1.0)
    return np.where(np.abs(values) <= limit, 0.0, values)


def has_rounding(values: FloatArray, size: float) -> bool:
    """Return whether any of derivatives may be rounding of terms that are at most this large."""
    limit = ROUNDING * size
    larger = np.count_nonzero(values > limit) + np.count_nonzero(values < -limit)
    return bool(larger < np.count_nonzero(values != 0.0))


# Elimination of leading columns of stacked rows by orthogonal projection.

# Rows that the projection leaves shorter than this share of the largest are rounding.
SMALLEST_ROW = 1e-14


@dataclass(frozen=True, eq=False)
class Elimination:
    """Rows [F | A] without the k columns F.

    rest : (.., m, w) rows left of A, free of the eliminated unknowns.
    solution : (.., k, w); the best eliminated unknowns are x = -solution @ z.
    inverse : (.., k, k) pseudo-inverse of the triangle of F.
    is_observable : (.., k) directions that the rows determine.
    directions : (.., k, k) the directions, one per row, in columns of length one.
    singular_values : (.., k) of F with columns of length one, descending.
    explained : (..,) squared length of the last column of A that the range of F explains.
    """

    rest: FloatArray
    solution: FloatArray
    inverse: FloatArray
    is_observable: BoolArray
    directions: FloatArray
    singular_values: FloatArray
    explained: FloatArray

    @property
    def rank(self) -> IntArray:
        """(..,) number of observable directions."""
        return self.is_observable.sum(axis=-1)

    @property
    def unobservable(self) -> FloatArray:
        """(.., k, k) the unobservable directions, one per row; zero for the observable ones."""
        return np.where(self.is_observable[..., None], 0.0, self.directions)


def eliminate_from_triangle(
    triangle: FloatArray, right: FloatArray, below: FloatArray, length: FloatArray | None = None
) -> Elimination:
    """Eliminate k unknowns from rows [[triangle (.., k, k), right], [0, below (.., m, w)]].

    `length` (.., k) are those of the columns over all rows, where the triangle is what earlier
    eliminations left of them. The `rest` has k + m rows, those of observable directions being zero.
    """
    if length is None:
        norm = np.linalg.norm(triangle, axis=-2)
        length = np.where(norm > 0.0, norm, 1.0)
    return _eliminate(triangle / length[..., None, :], right, below, length)


def _eliminate(
    scaled_triangle: FloatArray, right: FloatArray, below: FloatArray, length: FloatArray
) -> Elimination:
    """Eliminate k unknowns whose triangle (.., k, k) is divided by the lengths of its columns."""
    left, s, vt = np.linalg.svd(scaled_triangle)
    # columns have length one: the largest singular value is at least one, unless earlier
    # eliminations have left nothing but rounding
    used = s > decomposition.NUISANCE_TOLERANCE * np.maximum(s[..., :1], 1.0)
    turned = np.matmul(left.swapaxes(-1, -2), right)
    root = np.divide(1.0, s, out=np.zeros_like(s), where=used)
    scaled = vt.swapaxes(-1, -2) * root[..., None, :] / length[..., None]
    rest = np.concatenate([np.where(used[..., None], 0.0, turned), below], axis=-2)
    return Elimination(
        rest=rest,
        solution=np.matmul(scaled, turned),
        inverse=np.matmul(scaled, left.swapaxes(-1, -2)),
        is_observable=used,
        directions=vt,
        singular_values=s,
        explained=np.where(used, turned[..., -1] ** 2, 0.0).sum(axis=-1),
    )


def eliminate_columns(rows: FloatArray, count: int) -> Elimination:
    """Eliminate the first `count` columns k of rows (.., N, k + w), N >= k.

    What the projection leaves of a column that the eliminated ones explain in full is set to zero,
    so that its rounding does not become a direction. What is left of rows that are not finite is
    NaN.
    """
    # absent rows go last: no reflection touches them there, and they do not mix with the others
    order = np.argsort(~rows.any(axis=-1), axis=-1, kind="stable")
    rows = np.take_along_axis(rows, order[..., None], axis=-2)
    bad = np.asarray(~np.isfinite(rows).all(axis=(-1, -2)))
    if bad.any():
        rows = np.where(bad[..., None, None], 0.0, rows)
    norm = np.linalg.norm(rows[..., :count], axis=-2)
    length = np.where(norm > 0.0, norm, 1.0)
    q, r = np.linalg.qr(rows[..., :count] / length[..., None, :], mode="complete")
    right = np.matmul(q.swapaxes(-1, -2), rows[..., count:])
    done = _eliminate(r[..., :count, :], right[..., :count, :], right[..., count:, :], length)
    rest = done.rest
    before = np.linalg.norm(rows[..., None, count:-1], axis=-3)
    rest[..., :-1] = without_rounding(rest[..., :-1], before)
    size = np.abs(right).max(axis=(-1, -2), keepdims=True, initial=0.0)
    largest = np.abs(rest).max(axis=-1, keepdims=True, initial=0.0)
    rest[...] = np.where(largest > SMALLEST_ROW * size, rest, 0.0)
    if bad.any():
        rest[bad] = np.nan
    return done


def eliminate_from_factor(factor: FloatArray, count: int) -> FloatArray:
    """Eliminate the first `count` columns k of one triangular factor (1, k + c, k + c); return the
    factor (1, c, c) of the rows left.
    """
    if count == 0:
        return factor
    done = eliminate_from_triangle(
        factor[:, :count, :count], factor[:, :count, count:], factor[:, count:, count:]
    )
    return np.asarray(np.linalg.qr(done.rest, mode="r"))
