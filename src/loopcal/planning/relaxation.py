# SPDX-License-Identifier: Apache-2.0
"""Convex relaxation of a design: fractional weights, and a bound for all designs of n groups.

Maximize the score of M(w) = M_0 + sum w_i X_i'X_i over weights of sum n, w_i >= 0, and w_i <= 1
where a group may be measured once only. With d_i the derivative of the score by w_i and d_0 the
derivative by a multiple of the prior, every design of n groups satisfies

    score <= score(w) + h log((d_0 + sum of the n largest d_i) / h)

for any w (with repeats: n times the largest d_i). At the optimum this is the equivalence theorem of
Kiefer and Wolfowitz. The weights of the candidates that matter maximize a logarithmic barrier,

    t score(w) + sum log w_i + sum log(c - w_i)   over sum w = n,   t growing,

by Newton's method; other candidates enter while the bound shows that they could help. With
Y = X R^-1 at the present weights and V = Y P', the second derivatives of the score are

    D: -|Y_i Y_k'|^2 (minus the part of the nuisance columns)
    I, A: d_i d_k - 2 <Y_i Y_k', V_i V_k'> / |P|^2

At the maximum of the barrier the score is within (number of constraints) / t of the best; Boyd and
Vandenberghe, Convex Optimization (2004), chapter 11. Derivations: docs/theory/planning.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopcal.planning.design_space import (
    Criterion,
    ObservableSpace,
    PriorInformation,
    ScaledCandidates,
    Scoring,
    compute_efficiency,
    divide_by_factor,
    scale_candidates,
)
from loopcal.typing import FloatArray

ROUNDS = 40  # largest number of times that candidates enter the barrier problem
WARM_UP = 12  # multiplicative steps over all candidates that select those to begin with
NEWTON_STEPS = 40  # largest number of Newton steps for one t
GROWTH = 20.0  # factor from one t to the next


@dataclass(frozen=True, eq=False)
class RelaxedDesign:
    """The best design with fractional weights, and its certificate."""

    weights: FloatArray  # (N,) of sum n; at most 1 without repeats
    # (N,) derivatives of the score by the weights; 0 where a group is not allowed
    slopes: FloatArray
    value: float  # of the criterion at these weights
    bound: float  # no design of n groups is better than this value
    criterion: Criterion  # what is optimized
    candidates: ScaledCandidates  # the allowed groups
    iterations: int  # number of times that candidates entered
    converged: bool  # whether value and bound agree within the requested gap

    @property
    def space(self) -> ObservableSpace:
        """The directions in which designs count."""
        return self.candidates.scoring.space

    def efficiency(self, value: float) -> float:
        """Return a lower bound on the efficiency of a design with this value, 0 to 1."""
        return compute_efficiency(self.criterion, value, self.bound, len(self.space))


def relax_design(
    rows: FloatArray,
    n: int,
    criterion: Criterion,
    prior: PriorInformation,
    gap: float = 1e-3,
    repeats: bool = False,
) -> RelaxedDesign:
    """Return the best fractional weights and the bound.

    rows : (N, r, o + p) whitened and in tolerances; NaN where a group is not allowed.
    n : number of groups of the design. gap : of the efficiency at which to stop.
    repeats : whether a group may be measured more than once. Without, weights are at most 1 and the
        bound is tighter.
    Returns RelaxedDesign; the bound holds whether or not the gap was reached.
    """
    candidates = scale_candidates(rows, n, criterion, prior, repeats)
    scoring, solution = candidates.scoring, _solve(candidates, n, gap)
    weights, slopes = np.zeros(len(rows)), np.zeros(len(rows))
    weights[candidates.indices] = solution.weights
    slopes[candidates.indices] = solution.slopes
    value, bound = scoring.value(solution.score), scoring.value(solution.bound)
    converged = bool(solution.score >= solution.bound + scoring.height * np.log1p(-gap))
    return RelaxedDesign(
        weights, slopes, value, bound, criterion, candidates, solution.rounds, converged
    )


@dataclass(frozen=True, eq=False)
class _Solution:
    """Weights (N,), slopes (N,), their score, the smallest bound, and the number of rounds."""

    weights: FloatArray
    slopes: FloatArray
    score: float
    bound: float
    rounds: int


def _solve(candidates: ScaledCandidates, n: int, gap: float) -> _Solution:
    """Maximize by barrier over the candidates that matter, adding others while they could help."""
    scoring, scaled, repeats = candidates.scoring, candidates.rows, candidates.repeats
    N, cap = len(scaled), np.inf if repeats else 1.0
    w, bound = np.full(N, n / N), np.inf
    if n == N and not repeats:
        d, _, score = _slopes(scoring, scaled, w)
        return _Solution(w, d, score, score, 0)
    for _ in range(WARM_UP):
        d, d0, score = _slopes(scoring, scaled, w)
        bound = min(bound, _bound(scoring, d, d0, score, n, repeats))
        w = w * np.sqrt(d)
        if not w.sum() > 0.0:  # no group adds information to the prior: all designs are equal
            return _Solution(np.full(N, n / N), d, score, score, 0)
        w *= n / w.sum()
    order, count = np.argsort(-w, kind="stable"), max(2 * n, 40)
    while count < len(w) and not candidates.is_determined(order[:count]):
        count *= 2
    chosen = order[:count]
    inside = np.full(len(chosen), n / len(chosen))
    target, rounds = 0.2 * gap, 0
    while True:
        rounds += 1
        inside = maximize_weights(scoring, scaled[chosen], inside, cap, target)
        w = np.zeros(N)
        w[chosen] = inside
        d, d0, score = _slopes(scoring, scaled, w)
        bound = min(bound, _bound(scoring, d, d0, score, n, repeats))
        if rounds == ROUNDS or score >= bound + scoring.height * np.log1p(-gap):
            return _Solution(w, d, score, bound, rounds)
        price = _price(d, w, cap)
        outside = np.setdiff1d(np.flatnonzero(d > price), chosen)
        if not len(outside):
            target *= 0.2
        entering = outside[np.argsort(-d[outside], kind="stable")][:n]
        keep = (inside > 1e-6 * n / N) | (d[chosen] > price)
        chosen, inside = (
            np.concatenate([chosen[keep], entering]),
            np.concatenate([inside[keep], np.zeros(len(entering))]),
        )
        # a tenth of equal weights moves all of them inside the limits
        inside = 0.9 * inside * (n / inside.sum()) + 0.1 * n / len(inside)
        if inside.max() >= cap:
            inside = np.full(len(inside), n / len(inside))


def _factor(scoring: Scoring, scaled: FloatArray, w: FloatArray) -> FloatArray:
    """Return R of the prior and groups with weights w (N,)."""
    used = w > 0.0
    return scoring.factor(np.sqrt(w[used])[:, None, None] * scaled[used])


def _slopes(scoring: Scoring, scaled: FloatArray, w: FloatArray) -> tuple[FloatArray, float, float]:
    """Return derivatives d (N,) of the score by the weights, d_0 by a multiple of the prior, and
    the score.
    """
    R, o, scale = _factor(scoring, scaled, w), scoring.n_nuisance, 1.0
    Y = divide_by_factor(scaled, R)[:, :, o:]
    Y0 = divide_by_factor(scoring.prior_rows, R)[:, o:]
    if scoring.prediction is not None:
        P = scoring.predict(R)
        Y, Y0, scale = Y @ P.T, Y0 @ P.T, float((P**2).sum())
    return (Y**2).sum(axis=(1, 2)) / scale, float((Y0**2).sum()) / scale, scoring.score(R)


def _bound(
    scoring: Scoring, d: FloatArray, d0: float, score: float, n: int, repeats: bool
) -> float:
    """Return the score that no design of n groups exceeds."""
    most = n * d.max() if repeats else np.partition(d, len(d) - n)[len(d) - n :].sum()
    return score + scoring.height * float(np.log((d0 + most) / scoring.height))


def _price(d: FloatArray, w: FloatArray, cap: float) -> float:
    """Return the slope that a group must exceed to deserve a weight.

    This is the mean slope of the groups that are partly used, weighted by how free they are.
    """
    free = w * np.clip(cap - w, 0.0, 1.0)
    return float((free * d).sum() / free.sum()) if free.sum() > 0.0 else float(d[w > 0.0].min())


def maximize_weights(
    scoring: Scoring, scaled: FloatArray, w: FloatArray, cap: float, gap: float
) -> FloatArray:
    """Return weights (s,) with the same sum whose score is within `gap` of the best, as a share of
    the efficiency.

    scaled : (s, r, Q) of a nonsingular set of groups. w : (s,) inside all constraints.
    cap : c, the largest weight; infinite without.
    """
    constraints = len(w) * (2 if np.isfinite(cap) else 1)
    last = constraints / (gap * scoring.height)
    t = min(constraints / scoring.height, last)
    while True:
        w = _Barrier(scoring, scaled, cap, t).maximize(w)
        if t >= last:
            return w
        t = min(GROWTH * t, last)


@dataclass(frozen=True, eq=False)
class _Barrier:
    """The barrier function of one t for weights w (s,) of scaled rows (s, r, Q), 0 < w < cap."""

    scoring: Scoring
    scaled: FloatArray
    cap: float
    t: float

    def evaluate(self, w: FloatArray) -> float:
        """Return the value of the function."""
        walls = np.log(w).sum() + (np.log(self.cap - w).sum() if np.isfinite(self.cap) else 0.0)
        return self.t * self.scoring.score(_factor(self.scoring, self.scaled, w)) + float(walls)

    def maximize(self, w: FloatArray) -> FloatArray:
        """Return the maximum by Newton's method from w."""
        for _ in range(NEWTON_STEPS):
            slope, curvature = differentiate_score(self.scoring, self.scaled, w)
            gradient = self.t * slope + 1.0 / w - 1.0 / (self.cap - w)
            # In units of each weight's own barrier, so that the system is well scaled however
            # small a weight is.
            unit = 1.0 / np.sqrt(1.0 / w**2 + 1.0 / (self.cap - w) ** 2)
            system = np.eye(len(w)) - self.t * unit[:, None] * curvature * unit
            x, y = np.linalg.solve(system, np.stack([unit * gradient, unit], axis=1)).T
            step = unit * (x - y * (unit @ x) / (unit @ y))
            decrement = float(gradient @ step)
            if decrement < 1e-2:
                moved = w + step
                return moved if (moved > 0.0).all() and (moved < self.cap).all() else w
            w = self.search(w, step, decrement)
        return w

    def search(self, w: FloatArray, step: FloatArray, decrement: float) -> FloatArray:
        """Return the point along a step, inside the limits, where the function has grown by at
        least a tenth of the predicted gain.
        """
        room = np.full(len(w), np.inf)
        np.divide(-w, step, out=room, where=step < 0.0)
        np.divide(self.cap - w, step, out=room, where=step > 0.0)
        length, before = min(1.0, 0.95 * float(room.min())), self.evaluate(w)
        while length > 1e-8:
            trial = w + length * step
            if self.evaluate(trial) >= before + 0.1 * length * decrement:
                return trial
            length *= 0.5
        return w


def differentiate_score(
    scoring: Scoring, scaled: FloatArray, w: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return first (s,) and second (s, s) derivatives of the score by the weights."""
    R, o = _factor(scoring, scaled, w), scoring.n_nuisance
    Y = divide_by_factor(scaled, R)
    if scoring.prediction is None:
        curvature = -_sum_blocks(_products(Y) ** 2, len(w))
        if o:
            curvature += _sum_blocks(_products(Y[:, :, :o]) ** 2, len(w))
        return (Y[:, :, o:] ** 2).sum(axis=(1, 2)), curvature
    P = scoring.predict(R)
    V, trace = Y[:, :, o:] @ P.T, float((P**2).sum())
    slope = (V**2).sum(axis=(1, 2)) / trace
    products = _products(Y) * _products(V)
    return slope, slope[:, None] * slope - 2.0 * _sum_blocks(products, len(w)) / trace


def _products(Y: FloatArray) -> FloatArray:
    """Return all products of rows (s r, s r)."""
    flat = Y.reshape(-1, Y.shape[-1])
    return flat @ flat.T


def _sum_blocks(products: FloatArray, s: int) -> FloatArray:
    """Return the sums over the blocks (s, s) of products (s r, s r)."""
    r = len(products) // s
    return products.reshape(s, r, s, r).sum(axis=(1, 3))
