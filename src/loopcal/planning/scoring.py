# SPDX-License-Identifier: Apache-2.0
"""A design problem in its own coordinates: every row divided by the triangular factor of a mean
design.

With R_ref the factor of that design in the directions that can be known, own unknowns first, rows x
become x R_ref^-1: the mean design then has the unit matrix as its information, and no digits are
lost by scaling. The factor R of a design, partitioned [[R_oo, R_op], [0, R_pp]], gives all that the
algorithms compare, its score, larger being better:

    D: 2 sum log |diag R_pp|        I and A: -log |K R_pp^-1|^2

Scores are concave in the information, and exp((score - score') / h) with h = q directions for D and
h = 1 for I and A is the efficiency of one design against the other. Derivation:
docs/theory/planning.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from loopcal.errors import EstimationError
from loopcal.planning.criteria import Criterion, D, E, I
from loopcal.planning.design import Directions, Start, triangle
from loopcal.typing import FloatArray

SINGULAR = 1e-6
"""A design leaves a direction open of which it knows less, in standard deviations, than this share
of the mean design.
"""

GAIN = 1e-7
"""An exchange or a move must multiply the efficiency by more than 1 + this."""

RIDGE = 1e-3
"""Standard-deviation share of the mean design that is lent to a start that leaves directions open.
"""


@dataclass(frozen=True, eq=False)
class Scoring:
    """What is compared, and in which coordinates.

    Attributes
    ----------
    space : the directions. transform : (o + p, Q) from rows as given to rows ready, Q = o' + q, own
        directions first.
    known : (k, Q) ready rows of the start. spread : (j, q) K of I and A, in the same coordinates;
        None for D.
    offset : value of D where the score is zero.
    """

    space: Directions
    transform: FloatArray
    known: FloatArray
    spread: FloatArray | None
    offset: float

    @property
    def own(self) -> int:
        """Number o' of own directions."""
        return self.space.own.shape[1]

    @property
    def height(self) -> float:
        """Number h: a score grows by h log c where the information grows c times."""
        return float(len(self.space)) if self.spread is None else 1.0

    def ready(self, rows: FloatArray) -> FloatArray:
        """Return rows (..., r, o + p) in these coordinates, (..., r, Q), folded to Q rows where
        there are more.
        """
        found = rows @ self.transform
        return (
            found
            if found.shape[-2] <= found.shape[-1]
            else np.asarray(np.linalg.qr(found, mode="r"))
        )

    def factor(self, ready: FloatArray) -> FloatArray:
        """Return R (Q, Q) of the start and ready rows (..., Q); rows of zeros below where these are
        too few.
        """
        columns = self.known.shape[1]
        R = triangle(np.concatenate([self.known, ready.reshape(-1, columns)]))
        return np.concatenate([R, np.zeros((columns - len(R), columns))])

    def score(self, R: FloatArray) -> float:
        """Return the score of a factor; -inf where it is singular."""
        pivots = np.abs(np.diagonal(R))
        if not (pivots > SINGULAR**2).all():
            return -np.inf
        if self.spread is None:
            return float(2.0 * np.log(pivots[self.own :]).sum())
        return float(-np.log((self.spreading(R) ** 2).sum()))

    def spreading(self, R: FloatArray) -> FloatArray:
        """Return P = K R_pp^-1 (j, q): the sum of its squares is the trace that I and A count."""
        assert self.spread is not None
        return over(self.spread, R[self.own :, self.own :])

    def value(self, score: float) -> float:
        """Return the criterion's value at a score."""
        return score + self.offset if self.spread is None else float(np.exp(-score))

    def lent(self, ridge: float) -> Scoring:
        """Return the same with `ridge`^2 of the mean design known before, in which no design is
        singular.
        """
        return replace(
            self, known=np.concatenate([self.known, ridge * np.eye(self.known.shape[1])])
        )


def over(rows: FloatArray, R: FloatArray) -> FloatArray:
    """Return rows (k, q) divided by a factor (q, q): X R^-1."""
    return np.asarray(np.linalg.solve(R.T, rows.T).T, dtype=np.float64)


def determines(R: FloatArray) -> bool:
    """Tell whether a design of factor R determines all directions, by SINGULAR."""
    return bool(np.linalg.svd(R, compute_uv=False)[-1] > SINGULAR)


def make_scoring(
    rows: FloatArray, weight: float, criterion: Criterion, start: Start, space: Directions
) -> Scoring:
    """Return the scoring whose mean design is the start and rows (N, r, o + p), finite, with this
    weight each.

    Raises
    ------
    EstimationError
        E is asked for, which is a figure only, or I with weights that depend on nothing that can be
        known.
    """
    if isinstance(criterion, E):
        raise EstimationError("E is a figure only; choose the criterion D, I or A to optimise")
    o, p = space.own.shape
    blocks = np.zeros((o + len(space.machine), space.unknowns))
    blocks[:o, :p], blocks[o:, p:] = space.own, space.machine
    stacked = np.concatenate([start.rows, np.sqrt(weight) * rows.reshape(-1, rows.shape[-1])])
    reference = triangle(stacked @ blocks)
    transform = over(blocks, reference)
    inner, spread = reference[p:, p:], None
    if not isinstance(criterion, D):
        L = (
            criterion.weights @ space.machine / np.sqrt(criterion.count)
            if isinstance(criterion, I)
            else np.eye(len(space))
        )
        spread = triangle(over(L, inner))
        if not spread.any():
            raise EstimationError(
                "what is to be predicted depends on no direction that can be known; choose other "
                "weights"
            )
    offset = float(2.0 * np.log(np.abs(np.diagonal(inner))).sum())
    known = triangle(start.rows @ transform)
    return Scoring(space, transform, known, spread, offset)
