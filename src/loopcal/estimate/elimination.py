# SPDX-License-Identifier: Apache-2.0
"""Triangular factors of nested unknowns, and their elimination from the innermost outwards, nodes
of equal form at once.

The rows of a node are [own | around | A | r]. Its own columns are eliminated by orthogonal
projection; what is left are rows of the node around it, and of the outermost what is left are rows
[A | r] of the machine. Columns are brought to length one before anything is eliminated, so that a
direction that inner unknowns take up whole is seen for what it is. Best values follow from the
outermost inwards. Of all best values those are given that have the smallest length in these units:
the result is that of one dense pseudo-inverse over a whole cluster. See
docs/theory/identification.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from loopcal import engine
from loopcal.estimate.nesting import Form, Nesting
from loopcal.numerics.decomposition import NULL_COMPONENT, empty_factor
from loopcal.typing import FloatArray, IntArray

OWN_RANK = 1e-10
"""Share of the largest singular value (columns of length one) below which a direction of the own
unknowns is none.
"""

SHORT = 0.5
"""Directions that no row sees are at least of length one when they are carried inwards; shorter
ones are absent.
"""


class Factors:
    """The factor of every node while rows are folded into it: working memory of one fold.

    Parameters
    ----------
    nesting : of the U unknowns. trials : a. parameters : p of the machine.
    """

    def __init__(self, nesting: Nesting, trials: int, parameters: int) -> None:
        self.nesting, self.trials, self.parameters = nesting, trials, parameters
        self.factors: list[FloatArray | None] = [None] * len(nesting.forms)
        self.held = [0] * len(nesting.forms)

    def add(self, form: int, rows: FloatArray, places: IntArray) -> None:
        """Fold rows (a, k, width) of nodes of one form; places (k,) tells of which."""
        begun, held = self.factors[form], self.held[form]
        if begun is None:
            begun = np.zeros((self.trials, len(self.nesting.forms[form]), 0, rows.shape[-1]))
        height = _height(begun, held, places)
        if height > begun.shape[2]:
            begun = _taller(begun, height)
        _fold(begun, held, rows, places)
        self.factors[form], self.held[form] = begun, max(height, held)

    def whole(self) -> list[FloatArray]:
        """Factors (a, n, h, width) of the nodes of every form; h = 0 where no row was folded."""
        p = self.parameters + 1
        pairs = zip(self.factors, self.nesting.forms, strict=True)
        return [
            np.zeros((self.trials, len(f), 0, f.path.shape[1] + p)) if r is None else r
            for r, f in pairs
        ]

    def squares(self) -> FloatArray:
        """Sum of squares (a,) of the right-hand sides; infinite where one is not finite."""
        total = sum(
            ((factor[..., -1] ** 2).sum(axis=(1, 2)) for factor in self.whole()),
            start=np.zeros(self.trials),
        )
        return np.where(np.isfinite(total), total, np.inf)

    def moved(self, step: FloatArray) -> FloatArray:
        """By how much (squared) a step (a, U) changes the rows (a,)."""
        total = np.zeros(self.trials)
        for factor, form in zip(self.whole(), self.nesting.forms, strict=True):
            change = np.matmul(factor[..., : form.path.shape[1]], step[:, form.path][..., None])
            total += (change**2).sum(axis=(1, 2, 3))
        return total


def folded(factor: FloatArray, rows: FloatArray, places: IntArray) -> FloatArray:
    """Fold rows (a, k, w) into the factors (a, n, h, w) at places (k,); the result has at most w
    rows each.
    """
    held = factor.shape[2]
    out = _taller(factor, max(held, _height(factor, held, places)))
    _fold(out, held, rows, places)
    return out


def _height(factor: FloatArray, held: int, places: IntArray) -> int:
    """Rows of factors, of which `held` hold anything, after one more fold."""
    return min(factor.shape[3], held + int(np.bincount(places, minlength=1).max()))


def _taller(factor: FloatArray, height: int) -> FloatArray:
    """Factors (a, n, h, w) with rows of zeros below: (a, n, height, w)."""
    out = np.zeros((*factor.shape[:2], height, factor.shape[3]))
    out[:, :, : factor.shape[2]] = factor
    return out


def _fold(out: FloatArray, held: int, rows: FloatArray, places: IntArray) -> None:
    """Fold rows (a, k, w) into the factors (a, n, height, w) at places (k,), the first `held` rows
    of which hold anything.

    Factors that get about as many rows are worked on together, padded with rows of zeros. The
    others are not touched.
    """
    a, n, _, w = out.shape
    count = np.bincount(places, minlength=n)
    order = np.argsort(places, kind="stable")
    within = np.empty(len(places), dtype=np.int64)
    within[order] = np.arange(len(places)) - np.repeat(np.cumsum(count) - count, count)
    size = np.where(count > 0, np.ceil(np.log2(np.maximum(count, 1))), -1)
    for one in np.unique(size[size >= 0]):
        chosen = np.flatnonzero(size == one)
        index = np.full(n, -1)
        index[chosen] = np.arange(len(chosen))
        some = np.flatnonzero(index[places] >= 0)
        stacked = np.zeros((a, len(chosen), held + int(count[chosen].max()), w))
        stacked[:, :, :held] = out[:, chosen, :held]
        stacked[:, index[places[some]], held + within[some]] = rows[:, some]
        triangle = np.asarray(np.linalg.qr(stacked, mode="r"))
        out[:, chosen, : triangle.shape[2]] = triangle


@dataclass(frozen=True, eq=False)
class Solved:
    """Nodes of one form after their elimination: x = -(solution @ [around, z, 1]).

    Attributes
    ----------
    inverse : (a, n, u, u) pseudo-inverse of the triangle of their own columns. solution : (a, n, u,
        w - u + p + 1).
    used : (a, n, u) directions that rows see. unseen : (a, n, u, u) the others, a row each in
        columns of length one, or zero.
    """

    inverse: FloatArray
    solution: FloatArray
    used: np.ndarray
    unseen: FloatArray


@dataclass(frozen=True, eq=False)
class Eliminated:
    """U own unknowns at the point of a fold: their best values are a linear function of the
    machine's.

    Attributes
    ----------
    slope : (a, U, p) change of the best values by the machine's deviations. shift : (a, U) to the
        best values here.
    rank : (a,) directions that rows see. open : (a, U) which have a part in a direction that no row
        sees.
    """

    slope: FloatArray
    shift: FloatArray
    rank: IntArray
    open: np.ndarray
    nesting: Nesting
    nodes: tuple[Solved, ...]

    @cached_property
    def roots(self) -> tuple[FloatArray, ...]:
        """For every form (a, n, w, w): rows times it are in units of standard deviations of the
        path's unknowns.

        With the rows F of a cluster it is a square root of their covariance: T T' = (F'F)^-1 where
        all is seen.
        """
        found: list[FloatArray] = []
        for form, one in zip(self.nesting.forms, self.nodes, strict=True):
            a, n, u, _ = one.inverse.shape
            w = form.path.shape[1]
            root = np.zeros((a, n, w, w))
            root[:, :, :u, :u] = one.inverse
            if w > u:
                outer = found[form.outer][:, form.around]
                root[:, :, u:, u:] = outer
                root[:, :, :u, u:] = -np.matmul(one.solution[..., : w - u], outer)
            found.append(root)
        return tuple(found)

    def at(self, nodes: IntArray) -> tuple[IntArray, FloatArray, FloatArray]:
        """Paths (k, w) of nodes (k,) of one form, their roots (k, w, w) and slopes (k, w, p), of
        the first trial.
        """
        form, places = int(self.nesting.form[nodes[0]]), self.nesting.place[nodes]
        path = self.nesting.forms[form].path[places]
        return path, self.roots[form][0][places], self.slope[0][path]

    def variance(self) -> FloatArray:
        """(a, U) of each at a known machine, in that of the noise; meaningless where `open`."""
        found = np.zeros(self.shift.shape)
        for form, root in zip(self.nesting.forms, self.roots, strict=True):
            found[:, form.own] = (root[:, :, : form.own.shape[1]] ** 2).sum(axis=-1)
        return found


def eliminate(factors: Factors) -> tuple[Eliminated, FloatArray]:
    """Eliminate all unknowns: what they become, and the factor (a, p + 1, p + 1) of the machine's
    rows that are left.
    """
    nesting, whole = factors.nesting, factors.whole()
    norm = _lengths(factors, whole)
    rest = empty_factor(factors.trials, factors.parameters)
    solved: list[Solved] = []
    for i in reversed(range(len(nesting.forms))):
        form = nesting.forms[i]
        one, left = _eliminated(whole[i], norm[:, form.own], form)
        solved.append(one)
        if form.outer < 0:
            rest = engine.fold(rest, left.reshape(len(left), -1, left.shape[-1]))
        else:
            places = np.repeat(form.around, left.shape[2])
            whole[form.outer] = folded(
                whole[form.outer], left.reshape(len(left), -1, left.shape[-1]), places
            )
    nodes = tuple(reversed(solved))
    values = _back(factors, nodes)
    open_, values = _shortest(nesting, nodes, norm, values)
    rank = sum(
        (one.used.sum(axis=(1, 2)) for one in nodes), start=np.zeros(factors.trials, dtype=np.int64)
    )
    return Eliminated(values[..., :-1], values[..., -1], rank, open_, nesting, nodes), rest


def _lengths(factors: Factors, whole: list[FloatArray]) -> FloatArray:
    """Length (a, U) of every unknown's column over all rows; 1 where it has none."""
    squares = np.zeros((len(factors.nesting.node), factors.trials))
    for form, factor in zip(factors.nesting.forms, whole, strict=True):
        part = (factor[..., : form.path.shape[1]] ** 2).sum(axis=2)
        np.add.at(squares, form.path.ravel(), part.reshape(len(part), -1).T)
    return np.sqrt(np.where(squares > 0.0, squares, 1.0)).T


def _eliminated(factor: FloatArray, norm: FloatArray, form: Form) -> tuple[Solved, FloatArray]:
    """Eliminate the own columns, of length norm (a, n, u), of factors (a, n, h, w + p + 1): rows
    left (a, n, h', ...).

    Directions that no row sees are left out of the solution; their rows stay.
    """
    u = form.own.shape[1]
    if factor.shape[2] < u:
        factor = np.concatenate(
            [factor, np.zeros((*factor.shape[:2], u - factor.shape[2], factor.shape[3]))], axis=2
        )
    top, right = factor[:, :, :u, :u], factor[:, :, :u, u:]
    left, s, vt = np.linalg.svd(top / norm[:, :, None, :])
    used = s > OWN_RANK * np.maximum(s[..., :1], 1.0)
    inverse = np.divide(1.0, s, out=np.zeros_like(s), where=used)
    inverse = (
        np.matmul(vt.swapaxes(-1, -2) * inverse[..., None, :], left.swapaxes(-1, -2))
        / norm[..., None]
    )
    rest = factor[:, :, u:, u:]
    if not used.all():
        turned = np.matmul(left.swapaxes(-1, -2), right)
        rest = np.concatenate([rest, np.where(used[..., None], 0.0, turned)], axis=2)
    return Solved(
        inverse, np.matmul(inverse, right), used, np.where(used[..., None], 0.0, vt)
    ), rest


def _back(factors: Factors, nodes: tuple[Solved, ...]) -> FloatArray:
    """Best values (a, U, p + 1) by the machine's deviations, and here, from the outermost inwards."""
    values = np.zeros((factors.trials, len(factors.nesting.node), factors.parameters + 1))
    for form, one in zip(factors.nesting.forms, nodes, strict=True):
        w, u = form.path.shape[1], form.own.shape[1]
        best = one.solution[..., w - u :]
        if w > u:
            best = best + np.matmul(one.solution[..., : w - u], values[:, form.path[:, u:]])
        values[:, form.own] = -best
    return values


def _shortest(
    nesting: Nesting, nodes: tuple[Solved, ...], norm: FloatArray, values: FloatArray
) -> tuple[np.ndarray, FloatArray]:
    """Take out of best values (a, U, q) what lies in directions that no row sees; tell whose part
    in these is not zero.

    A direction unseen in a node has no part in those around it, and moves the nodes within it along
    their best values; all that begin in one cluster are made orthonormal together. Those of the
    innermost nodes have no part in any best value.
    """
    part = np.zeros(norm.shape)
    outer = {form.outer for form in nesting.forms} - {-1}
    for i, (form, one) in enumerate(zip(nesting.forms, nodes, strict=True)):
        if i not in outer:
            part[:, form.own] = (one.unseen**2).sum(axis=2)
    if not any(nodes[i].unseen.any() for i in outer):
        return np.sqrt(part) > NULL_COMPONENT, values
    values = values.copy()
    carried, clusters = _carried(nesting, nodes, norm)
    for c in clusters:
        inside = np.flatnonzero(nesting.cluster == c)
        left, s, _ = np.linalg.svd(carried[:, inside], full_matrices=False)
        basis = np.where((s > SHORT)[:, None, :], left, 0.0)
        scaled = values[:, inside] * norm[:, inside, None]
        along = np.matmul(basis, np.matmul(basis.swapaxes(-1, -2), scaled))
        values[:, inside] = (scaled - along) / norm[:, inside, None]
        part[:, inside] += (basis**2).sum(axis=-1)
    return np.sqrt(part) > NULL_COMPONENT, values


def _carried(
    nesting: Nesting, nodes: tuple[Solved, ...], norm: FloatArray
) -> tuple[FloatArray, IntArray]:
    """Directions (a, U, k) that no row sees, from the nodes where they begin inwards, in columns of
    length one.

    Those of different clusters share the k columns; the clusters that have any are given, too.
    """
    a, U = norm.shape
    outer = {form.outer for form in nesting.forms} - {-1}
    begins = np.zeros(U, dtype=bool)
    for i in outer:
        begins[nesting.forms[i].own] = True
    some = np.flatnonzero(begins)
    count = np.bincount(nesting.cluster[some], minlength=1)
    order = some[np.argsort(nesting.cluster[some], kind="stable")]
    slot = np.zeros(U, dtype=np.int64)
    slot[order] = np.arange(len(order)) - np.repeat(np.cumsum(count) - count, count)
    found = np.zeros((a, U, int(count.max())))
    for i, (form, one) in enumerate(zip(nesting.forms, nodes, strict=True)):
        w, u = form.path.shape[1], form.own.shape[1]
        if w > u:
            around = form.path[:, u:]
            change = np.matmul(
                one.solution[..., : w - u], found[:, around] / norm[:, around][..., None]
            )
            found[:, form.own] = -change * norm[:, form.own][..., None]
        if i in outer:
            found[:, form.own[:, :, None], slot[form.own][:, None, :]] += one.unseen.swapaxes(
                -1, -2
            )
    clusters = np.unique(nesting.cluster[np.flatnonzero(found.any(axis=(0, 2)))])
    return found, clusters
