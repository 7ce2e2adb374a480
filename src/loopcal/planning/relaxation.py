# SPDX-License-Identifier: Apache-2.0
"""The convex relaxation: units measured a fraction of a time, and from it the bound that no design
of n units can beat.

Maximise the score of M(w) = M_0 + sum w_i X_i'X_i over weights of sum n, 0 <= w_i, and w_i <= 1
where a unit may be measured once only. With d_i the derivative of the score by w_i and d_0 that by
a multiple of the start, every design of n units has

    score <= score(w) + h log((d_0 + sum of the n largest d_i) / h)

(n times the largest d_i with repeats), for whatever w: at the optimum this is the equivalence
theorem of Kiefer and Wolfowitz. The best weights come from a barrier method with exact second
derivatives on the few candidates that matter; others are taken in as long as the bound says that
they could help. Derivation and sources: docs/theory/planning.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopcal.planning.barrier import maximise
from loopcal.planning.criteria import Criterion, efficiency
from loopcal.planning.design import Directions, Start, allowed, directions, require_enough
from loopcal.planning.scoring import Scoring, determines, make_scoring
from loopcal.typing import FloatArray, IntArray

ROUNDS = 40
"""Times at most that candidates are taken in."""

WARM_UP = 12
"""Multiplicative steps over all candidates that find those to begin with."""


@dataclass(frozen=True, eq=False)
class Relaxed:
    """The best design with fractional weights, and its certificate.

    Attributes
    ----------
    weights : (N,) sum n; at most 1 without repeats. slopes : (N,) growth of the score by each
        weight; 0 if not allowed.
    value : of the criterion at these weights.
    bound : no design of n units is better than this. criterion, directions : what is counted, and
        in which space.
    iterations : times that candidates were taken in. converged : whether value and bound are within
        the gap asked for.
    """

    weights: FloatArray
    slopes: FloatArray
    value: float
    bound: float
    criterion: Criterion
    directions: Directions
    iterations: int
    converged: bool

    def efficiency(self, value: float) -> float:
        """Return at least how much of the best possible a design of this value is, 0 to 1."""
        return efficiency(self.criterion, value, self.bound, len(self.directions))


def relaxed_design(
    rows: FloatArray,
    n: int,
    criterion: Criterion,
    start: Start,
    gap: float = 1e-3,
    repeats: bool = False,
) -> Relaxed:
    """Return the best weights and the bound.

    Parameters
    ----------
    rows : (N, r, o + p) whitened and tolerance-scaled; NaN where a unit is not allowed. n : units
        of the design.
    criterion : D, I or A. start : what is known before. gap : of the efficiency at which to stop.
    repeats : whether a unit may be measured more than once; without, weights are at most one and
        the bound is tighter.

    Returns
    -------
    Relaxed; the bound holds whether or not the gap was reached.

    Raises
    ------
    EstimationError
        n units cannot determine the unknowns, or fewer are allowed than asked for.
    """
    space = directions(rows, start)
    require_enough(n, rows, start, space, repeats)
    good = np.flatnonzero(allowed(rows))
    scoring = make_scoring(rows[good], n / len(good), criterion, start, space)
    found = _solve(scoring, scoring.ready(rows[good]), n, gap, repeats)
    weights, slopes = np.zeros(len(rows)), np.zeros(len(rows))
    weights[good], slopes[good] = found.weights, found.slopes
    value, bound = scoring.value(found.score), scoring.value(found.bound)
    converged = bool(found.score >= found.bound + scoring.height * np.log1p(-gap))
    return Relaxed(weights, slopes, value, bound, criterion, space, found.rounds, converged)


@dataclass(frozen=True, eq=False)
class _Solution:
    """Weights (N,), slopes (N,) there, their score, the least bound found, and the rounds made."""

    weights: FloatArray
    slopes: FloatArray
    score: float
    bound: float
    rounds: int


def _solve(scoring: Scoring, ready: FloatArray, n: int, gap: float, repeats: bool) -> _Solution:
    """Maximise by barrier over the candidates that matter, taking in others while the bound says
    that they could help.
    """
    N = len(ready)
    w, bound = np.full(N, n / N), np.inf
    if n == N and not repeats:
        d, _, score = _slopes(scoring, ready, w)
        return _Solution(w, d, score, score, 0)
    for _ in range(WARM_UP):
        d, d0, score = _slopes(scoring, ready, w)
        bound = min(bound, _bound(scoring, d, d0, score, n, repeats))
        w = w * np.sqrt(d)
        if not w.sum() > 0.0:  # no unit tells anything beside the start: all designs are alike
            return _Solution(np.full(N, n / N), d, score, score, 0)
        w *= n / w.sum()
    chosen = _begin(scoring, ready, w, n)
    inside = np.full(len(chosen), n / len(chosen))
    target, rounds = 0.2 * gap, 0
    while True:
        rounds += 1
        inside = maximise(scoring, ready[chosen], inside, None if repeats else 1.0, target)
        w = np.zeros(N)
        w[chosen] = inside
        d, d0, score = _slopes(scoring, ready, w)
        bound = min(bound, _bound(scoring, d, d0, score, n, repeats))
        if rounds == ROUNDS or score >= bound + scoring.height * np.log1p(-gap):
            return _Solution(w, d, score, bound, rounds)
        price = _price(d, w, repeats)
        outside = np.setdiff1d(np.flatnonzero(d > price), chosen)
        if not len(outside):
            target *= 0.2
        more = outside[np.argsort(-d[outside], kind="stable")][:n]
        keep = (inside > 1e-6 * n / N) | (d[chosen] > price)
        chosen, inside = (
            np.concatenate([chosen[keep], more]),
            np.concatenate([inside[keep], np.zeros(len(more))]),
        )
        inside = _away_from_walls(inside, n, repeats)


def _away_from_walls(w: FloatArray, n: int, repeats: bool) -> FloatArray:
    """Weights of sum n mixed with a tenth of the even ones, so that all are inside their limits."""
    w = 0.9 * w * (n / w.sum()) + 0.1 * n / len(w)
    return w if repeats or w.max() < 1.0 else np.full(len(w), n / len(w))


def _factor(scoring: Scoring, ready: FloatArray, w: FloatArray) -> FloatArray:
    """R of the start and units with weights w (N,)."""
    used = w > 0.0
    return scoring.factor(np.sqrt(w[used])[:, None, None] * ready[used])


def _slopes(scoring: Scoring, ready: FloatArray, w: FloatArray) -> tuple[FloatArray, float, float]:
    """Derivatives d (N,) of the score by the weights, d_0 by a multiple of the start, and the
    score.
    """
    R = _factor(scoring, ready, w)
    inverse, o = np.linalg.inv(R), scoring.own
    Y, Y0, scale = (ready @ inverse)[:, :, o:], (scoring.known @ inverse)[:, o:], 1.0
    if scoring.spread is not None:
        P = scoring.spreading(R)
        Y, Y0, scale = Y @ P.T, Y0 @ P.T, float((P**2).sum())
    return (Y**2).sum(axis=(1, 2)) / scale, float((Y0**2).sum()) / scale, scoring.score(R)


def _bound(
    scoring: Scoring, d: FloatArray, d0: float, score: float, n: int, repeats: bool
) -> float:
    """Score that no design of n units exceeds."""
    most = n * d.max() if repeats else np.partition(d, len(d) - n)[len(d) - n :].sum()
    return score + scoring.height * float(np.log((d0 + most) / scoring.height))


def _begin(scoring: Scoring, ready: FloatArray, w: FloatArray, n: int) -> IntArray:
    """Candidates of the largest weights: enough to be more than n and to determine all directions."""
    order, count = np.argsort(-w, kind="stable"), max(2 * n, 40)
    while count < len(w) and not determines(scoring.factor(ready[order[:count]])):
        count *= 2
    return order[:count]


def _price(d: FloatArray, w: FloatArray, repeats: bool) -> float:
    """Slope that a unit must have to be worth a weight: the mean of those partly used, weighted by
    how free they are.
    """
    free = w if repeats else w * np.maximum(1.0 - w, 0.0)
    return float((free * d).sum() / free.sum()) if free.sum() > 0.0 else float(d[w > 0.0].min())
