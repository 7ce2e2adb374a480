# SPDX-License-Identifier: Apache-2.0
"""Elimination of all unknowns of an elimination tree, nodes of equal structure together.

The rows of a node are [own | ancestors | A | r]. The node's own columns are eliminated by
orthogonal projection (`loopcal.numerics.column_elimination`). What is left are rows of its parent,
and what is left of the roots are rows [A | r] of the machine. Columns are scaled by their length
over all rows before anything is eliminated, so that a direction that inner unknowns explain in full
is recognized as unobservable. The best values follow from the roots inwards. Among all best values
those of smallest length in these units are returned: the result equals one dense pseudo-inverse
over a whole cluster. See docs/theory/identification.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from loopcal import engine
from loopcal.numerics.decomposition import NULL_COMPONENT, empty_factor
from loopcal.numerics.elimination_tree import EliminationTree, Structure
from loopcal.numerics.sorted_values import find_distinct
from loopcal.numerics.trial_batch import TrialBatch
from loopcal.typing import BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    from loopcal.numerics.column_elimination import Elimination

SHORTEST_DIRECTION = 0.5
"""Unobservable directions have at least length one when they are carried inwards. Shorter ones are
rounding."""


class NodeFactors:
    """The triangular factors of all nodes: working memory while rows are folded.

    Parameters
    ----------
    tree : of the U unknowns. trials : a. parameters : p of the machine.
    """

    tree: EliminationTree
    trials: int
    parameters: int

    def __init__(self, tree: EliminationTree, trials: int, parameters: int) -> None:
        self.tree, self.trials, self.parameters = tree, trials, parameters
        self._factors: list[FloatArray | None] = [None] * len(tree.structures)
        self._heights = [0] * len(tree.structures)

    def add(self, structure: int, rows: FloatArray, places: IntArray) -> None:
        """Fold rows (a, k, w + p + 1) into the nodes at `places` (k,) of one structure."""
        factor, used = self._factors[structure], self._heights[structure]
        if factor is None:
            count = len(self.tree.structures[structure])
            factor = np.zeros((self.trials, count, 0, rows.shape[-1]))
        height = _folded_height(factor, used, places)
        if height > factor.shape[2]:
            factor = _with_height(factor, height)
        _fold_in_place(factor, used, rows, places)
        self._factors[structure], self._heights[structure] = factor, max(height, used)

    def arrays(self) -> list[FloatArray]:
        """Return the factors (a, n, h, w + p + 1) of every structure; h = 0 without rows."""
        p = self.parameters + 1
        pairs = zip(self._factors, self.tree.structures, strict=True)
        return [
            np.zeros((self.trials, len(s), 0, s.width + p)) if f is None else f for f, s in pairs
        ]

    def sum_of_squares(self) -> FloatArray:
        """Return the sum of squares (a,) of the right-hand sides; infinite if not finite."""
        total = np.zeros(self.trials)
        for factor in self.arrays():
            total = total + (factor[..., -1] ** 2).sum(axis=(1, 2))
        return np.where(np.isfinite(total), total, np.inf)

    def squared_change(self, step: FloatArray) -> FloatArray:
        """Return the squared length (a,) of the change of all rows by a step (a, U)."""
        total = np.zeros(self.trials)
        for factor, structure in zip(self.arrays(), self.tree.structures, strict=True):
            columns = factor[..., : structure.width]
            change = np.matmul(columns, step[:, structure.path][..., None])
            total += (change**2).sum(axis=(1, 2, 3))
        return total


@dataclass(frozen=True, eq=False)
class NodeSolution:
    """Nodes of one structure after their elimination: x = -solution @ [ancestors, z, 1].

    Attributes
    ----------
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

    Attributes
    ----------
    tree : of the unknowns.
    slope : (a, U, p) change of the best values by the machine's deviations.
    shift : (a, U) step from the present values to the best ones at the present machine.
    rank : (a,) number of observable directions.
    is_unobservable : (a, U) unknowns with a part in an unobservable direction.
    nodes : the solution of every structure.
    """

    shared: ClassVar[tuple[str, ...]] = ("tree",)

    tree: EliminationTree
    slope: FloatArray
    shift: FloatArray
    rank: IntArray
    is_unobservable: BoolArray
    nodes: tuple[NodeSolution, ...]

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

    def joint_root(self) -> FloatArray:
        """Return a square root (a, U, U) of the covariance of all unknowns at a known machine.

        Its columns belong to independent standard normal variables; see `roots`.
        """
        joint = np.zeros((*self.shift.shape, self.shift.shape[1]))
        for structure, root in zip(self.tree.structures, self.roots, strict=True):
            u = structure.unknowns.shape[1]
            rows, columns = structure.unknowns[:, :, None], structure.path[:, None, :]
            joint[:, rows, columns] = root[:, :, :u]
        return joint

    def variances(self) -> FloatArray:
        """Return the variance (a, U) of each unknown at a known machine, for unit noise.

        It has no meaning where `is_unobservable`.
        """
        variance = np.zeros(self.shift.shape)
        for structure, root in zip(self.tree.structures, self.roots, strict=True):
            columns = root[:, :, : structure.unknowns.shape[1]]
            variance[:, structure.unknowns] = (columns**2).sum(axis=-1)
        return variance


def eliminate_tree(factors: NodeFactors) -> tuple[TreeElimination, FloatArray]:
    """Eliminate all unknowns.

    Returns
    -------
    elimination : what becomes of the unknowns.
    factor : (a, p + 1, p + 1) of the machine's rows that are left.
    """
    tree, arrays = factors.tree, factors.arrays()
    length = _column_lengths(factors, arrays)
    rest = empty_factor(factors.trials, factors.parameters)
    rank = np.zeros(factors.trials, dtype=np.int64)
    solutions: list[NodeSolution] = []
    for i in reversed(range(len(tree.structures))):
        structure = tree.structures[i]
        done = _eliminate_nodes(arrays[i], length[:, structure.unknowns], structure)
        solutions.append(NodeSolution(done.inverse, done.solution, done.unobservable))
        rank += done.rank.sum(axis=1)
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
    elimination = TreeElimination(
        tree, values[..., :-1], values[..., -1], rank, is_unobservable, nodes
    )
    return elimination, rest


def _eliminate_nodes(factor: FloatArray, length: FloatArray, structure: Structure) -> Elimination:
    """Eliminate the own columns, of length (a, n, u) over all rows, of factors (a, n, h, ..)."""
    from loopcal.numerics.column_elimination import eliminate_from_triangle

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
        return np.sqrt(share) > NULL_COMPONENT, values
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
    return np.sqrt(share) > NULL_COMPONENT, values


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


def fold_at(factor: FloatArray, rows: FloatArray, places: IntArray) -> FloatArray:
    """Return factors (a, n, h, w) with rows (a, k, w) folded in at places (k,)."""
    used = factor.shape[2]
    out = _with_height(factor, max(used, _folded_height(factor, used, places)))
    _fold_in_place(out, used, rows, places)
    return out


def _folded_height(factor: FloatArray, used: int, places: IntArray) -> int:
    """Return the rows of factors after one more fold, of which `used` are in use before."""
    return min(factor.shape[3], used + int(np.bincount(places, minlength=1).max()))


def _with_height(factor: FloatArray, height: int) -> FloatArray:
    """Return factors (a, n, height, w), rows of zeros below."""
    out = np.zeros((*factor.shape[:2], height, factor.shape[3]))
    out[:, :, : factor.shape[2]] = factor
    return out


def _fold_in_place(out: FloatArray, used: int, rows: FloatArray, places: IntArray) -> None:
    """Fold rows (a, k, w) into factors (a, n, height, w) at places (k,).

    The first `used` rows of the factors are in use. Factors that get about as many rows are worked
    on together, padded with rows of zeros. The others are not touched.
    """
    a, n, _, w = out.shape
    count = np.bincount(places, minlength=n)
    order = np.argsort(places, kind="stable")
    within = np.empty(len(places), dtype=np.int64)
    within[order] = np.arange(len(places)) - np.repeat(np.cumsum(count) - count, count)
    size = np.where(count > 0, np.ceil(np.log2(np.maximum(count, 1))), -1)
    for alike in find_distinct(size[size >= 0]):
        chosen = np.flatnonzero(size == alike)
        index = np.full(n, -1)
        index[chosen] = np.arange(len(chosen))
        mine = np.flatnonzero(index[places] >= 0)
        stacked = np.zeros((a, len(chosen), used + int(count[chosen].max()), w))
        stacked[:, :, :used] = out[:, chosen, :used]
        stacked[:, index[places[mine]], used + within[mine]] = rows[:, mine]
        triangle = np.asarray(np.linalg.qr(stacked, mode="r"))
        out[:, chosen, : triangle.shape[2]] = triangle
