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

from loopcal.planning.design_space import DesignProblem, ScaledCandidates, Scoring, divide_by_factor
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
    candidates: ScaledCandidates  # the allowed groups
    converged: bool  # whether value and bound agree within the requested gap

    def efficiency(self, value: float) -> float:
        """Return a lower bound on the efficiency of a design with this value, 0 to 1."""
        return self.candidates.problem.compare(value, self.bound)


def relax_design(problem: DesignProblem, n: int, gap: float = 1e-3) -> RelaxedDesign:
    """Return the best fractional weights of n groups, and the bound.

    gap : of the efficiency at which to stop. The bound holds whether or not it was reached.
    """
    candidates = problem.scale_candidates(n)
    scoring, indices = candidates.scoring, candidates.indices
    w, d, score, best = _solve(candidates, n, gap)
    weights, slopes = np.zeros(len(problem.rows)), np.zeros(len(problem.rows))
    weights[indices], slopes[indices] = w, d
    converged = bool(score >= best + scoring.height * np.log1p(-gap))
    value, bound = scoring.value(score), scoring.value(best)
    return RelaxedDesign(weights, slopes, value, bound, candidates, converged)


def _solve(
    candidates: ScaledCandidates, n: int, gap: float
) -> tuple[FloatArray, FloatArray, float, float]:
    """Maximize by barrier over the candidates that matter, adding others while they could help.

    Returns weights (N,), slopes (N,), their score, and the smallest bound of the score.
    """
    scoring, scaled, repeats = candidates.scoring, candidates.rows, candidates.repeats
    N, cap = len(scaled), np.inf if repeats else 1.0

    def measure(w: FloatArray) -> tuple[FloatArray, float, float]:
        """Return the slopes at weights, their score, and the bound that follows."""
        d, d0, score = _slopes(scoring, scaled, w)
        most = n * d.max() if repeats else np.partition(d, N - n)[N - n :].sum()
        return d, score, score + scoring.height * float(np.log((d0 + most) / scoring.height))

    w, bound = np.full(N, n / N), np.inf
    if n == N and not repeats:
        d, score, _ = measure(w)
        return w, d, score, score
    for _ in range(WARM_UP):
        d, score, limit = measure(w)
        bound = min(bound, limit)
        w = w * np.sqrt(d)
        if not w.sum() > 0.0:  # no group adds information to the prior: all designs are equal
            return np.full(N, n / N), d, score, score
        w *= n / w.sum()
    order, count = np.argsort(-w, kind="stable"), max(2 * n, 40)
    while count < len(w) and not candidates.is_determined(order[:count]):
        count *= 2
    chosen = order[:count]
    inside = np.full(len(chosen), n / len(chosen))
    target, rounds = 0.2 * gap, 0
    while True:
        rounds += 1
        inside = _maximize_weights(scoring, scaled[chosen], inside, cap, target)
        w = np.zeros(N)
        w[chosen] = inside
        d, score, limit = measure(w)
        bound = min(bound, limit)
        if rounds == ROUNDS or score >= bound + scoring.height * np.log1p(-gap):
            return w, d, score, bound
        # The slope that a group must exceed to deserve a weight: the mean of those partly used,
        # weighted by how free they are.
        free = w * np.clip(cap - w, 0.0, 1.0)
        price = float((free * d).sum() / free.sum()) if free.sum() > 0.0 else float(d[w > 0].min())
        outside = np.setdiff1d(np.flatnonzero(d > price), chosen)
        if not len(outside):
            target *= 0.2
        entering = outside[np.argsort(-d[outside], kind="stable")][:n]
        keep = (inside > 1e-6 * n / N) | (d[chosen] > price)
        chosen = np.concatenate([chosen[keep], entering])
        inside = np.concatenate([inside[keep], np.zeros(len(entering))])
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


def _maximize_weights(
    scoring: Scoring, scaled: FloatArray, w: FloatArray, cap: float, gap: float
) -> FloatArray:
    """Return weights (s,) with the same sum, 0 < w < cap, whose score is within `gap` of the best,
    as a share of the efficiency.

    scaled : (s, r, Q) of a nonsingular set of groups.
    """
    constraints = len(w) * (2 if np.isfinite(cap) else 1)
    last = constraints / (gap * scoring.height)
    t = min(constraints / scoring.height, last)
    while True:
        w = _maximize_barrier(scoring, scaled, w, cap, t)
        if t >= last:
            return w
        t = min(GROWTH * t, last)


def _maximize_barrier(
    scoring: Scoring, scaled: FloatArray, w: FloatArray, cap: float, t: float
) -> FloatArray:
    """Return the maximum of the barrier function of one t by Newton's method from w (s,)."""

    def evaluate(w: FloatArray) -> float:
        walls = np.log(w).sum() + (np.log(cap - w).sum() if np.isfinite(cap) else 0.0)
        return t * scoring.score(_factor(scoring, scaled, w)) + float(walls)

    def search(w: FloatArray, step: FloatArray, decrement: float) -> FloatArray:
        """Return the point along a step, inside the limits, where the function has grown by at
        least a tenth of the predicted gain.
        """
        room = np.full(len(w), np.inf)
        np.divide(-w, step, out=room, where=step < 0.0)
        np.divide(cap - w, step, out=room, where=step > 0.0)
        length, before = min(1.0, 0.95 * float(room.min())), evaluate(w)
        while length > 1e-8:
            trial = w + length * step
            if evaluate(trial) >= before + 0.1 * length * decrement:
                return trial
            length *= 0.5
        return w

    for _ in range(NEWTON_STEPS):
        slope, curvature = differentiate_score(scoring, scaled, w)
        gradient = t * slope + 1.0 / w - 1.0 / (cap - w)
        # In units of each weight's own barrier, so that the system is well scaled however small a
        # weight is.
        unit = 1.0 / np.sqrt(1.0 / w**2 + 1.0 / (cap - w) ** 2)
        system = np.eye(len(w)) - t * unit[:, None] * curvature * unit
        x, y = np.linalg.solve(system, np.stack([unit * gradient, unit], axis=1)).T
        step = unit * (x - y * (unit @ x) / (unit @ y))
        decrement = float(gradient @ step)
        if decrement < 1e-2:
            moved = w + step
            return moved if (moved > 0.0).all() and (moved < cap).all() else w
        w = search(w, step, decrement)
    return w


def differentiate_score(
    scoring: Scoring, scaled: FloatArray, w: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return first (s,) and second (s, s) derivatives of the score by the weights."""
    R, o, s = _factor(scoring, scaled, w), scoring.n_nuisance, len(w)
    Y = divide_by_factor(scaled, R)

    def products(Y: FloatArray) -> FloatArray:
        """Return all products of rows (s r, s r)."""
        flat = Y.reshape(-1, Y.shape[-1])
        return flat @ flat.T

    def sum_blocks(products: FloatArray) -> FloatArray:
        """Return the sums (s, s) over the blocks of products (s r, s r)."""
        return products.reshape(s, len(products) // s, s, -1).sum(axis=(1, 3))

    if scoring.prediction is None:
        curvature = -sum_blocks(products(Y) ** 2)
        if o:
            curvature += sum_blocks(products(Y[:, :, :o]) ** 2)
        return (Y[:, :, o:] ** 2).sum(axis=(1, 2)), curvature
    P = scoring.predict(R)
    V, trace = Y[:, :, o:] @ P.T, float((P**2).sum())
    slope = (V**2).sum(axis=(1, 2)) / trace
    return slope, slope[:, None] * slope - 2.0 * sum_blocks(products(Y) * products(V)) / trace
