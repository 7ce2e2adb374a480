# SPDX-License-Identifier: Apache-2.0
"""Choose by evidence which parts of the tolerances are wider than stated.

Let A be the whitened rows in tolerances, b their data, S the covariance of the prior and K = 1 + A
S A'. A component E adds the variance v to S. With Q = A'K^-1 A and h = A'K^-1 b the logarithm of
the likelihood rises by

    g(v) = 1/2 sum_k (v u_k^2 / (1 + v l_k) - log(1 + v l_k)),   E'Q E = W diag(l) W',  u = W'E'h

so that every candidate is one sum over the few directions of E. How much wider it is, factor^2 = 1
+ v, is not known beforehand: log factor is uniform up to log WIDEST. The evidence is the mean of
exp(g) over it, which penalizes a component that the data do not need by itself. The odds of a kind
of component against none are PRIOR_ODDS beforehand, and its n members have equal shares of them:
the penalty of a search among n candidates is log(n / odds). Components are added while evidence
minus penalty is above 0, the one with the largest first; after each the variances of all are
optimized in turn.

This is the selection of terms of a sparse Bayesian model [Tipping2003]; the single parameters are a
heavy-tailed prior, each deviation being a mixture of the stated and much wider ones. See
docs/theory/uncertainty.md.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from loopcal.estimate.methods.inflated_tolerances import (
    LARGEST_FACTOR,
    WIDEST,
    are_penalized,
    find_most_probable_factor,
)
from loopcal.estimate.methods.tolerance_components import (
    Kind,
    ToleranceComponent,
    compute_prior_covariance,
    compute_symmetric_root,
)
from loopcal.numerics.decomposition import Decomposition, decompose
from loopcal.typing import FloatArray

PRIOR_ODDS: Mapping[Kind, float] = {"shift": 1.0, "group": 1.0 / 3.0, "single": 1.0 / 3.0}
"""Odds of each kind of component against none, before the data: parts of one batch and common zeros
are frequent, the others less so. With these odds and right tolerances about 4 % of data sets get a
component.
"""

MOST_COMPONENTS = 8
"""Components that are chosen at most; more say that the stated tolerances are no prior at all."""

CYCLES = 4
"""Cycles in which the variances of the chosen components are optimized in turn."""

VARIANCES = np.expm1(2.0 * np.linspace(0.0, np.log(WIDEST), 41)[1:])
"""Variances over which the evidence is integrated: factors uniform in their logarithm."""


class PredictedData(NamedTuple):
    """Data as a prior predicts them, in the parameters.

    Attributes
    ----------
    information : (t, p, p) Q = A'K^-1 A. score : (t, p) h = A'K^-1 b.
    """

    information: FloatArray
    score: FloatArray

    def project(self, places: np.ndarray, is_shift: bool) -> tuple[FloatArray, FloatArray]:
        """Return l and u^2 (t, n, k) of n components of k parameters each, places (n, k)."""
        Q = self.information[:, places[:, :, None], places[:, None, :]]
        h = self.score[:, places]
        if is_shift:
            return Q.sum(axis=(2, 3))[..., None], (h.sum(axis=2) ** 2)[..., None]
        if places.shape[1] == 1:
            return Q[..., 0], h**2
        size, axes = np.linalg.eigh(Q)
        return np.maximum(size, 0.0), np.matmul(h[:, :, None, :], axes)[:, :, 0] ** 2


def predict(decomposition: Decomposition, factor: FloatArray) -> PredictedData:
    """Return Q and h (t,) for tolerances `factor` (t,) times those of the decomposition's root."""
    d = decomposition
    s = np.where(are_penalized(d), d.singular_values, 0.0)
    root = np.sqrt(1.0 + (factor[:, None] * s) ** 2)
    rows = (s / root)[:, :, None] * d.inverse / d.scale
    score = np.matmul((d.projections / root)[:, None, :], rows)[:, 0]
    return PredictedData(np.matmul(rows.swapaxes(-1, -2), rows), score)


def compute_evidence(data: PredictedData, candidates: Sequence[ToleranceComponent]) -> FloatArray:
    """Return the logarithm of the evidence (t, n) of each candidate minus its penalty; minus
    infinity where it cannot be above 0.
    """
    result = np.full((len(data.score), len(candidates)), -np.inf)
    alike = Counter(candidate.kind for candidate in candidates)
    shapes: dict[tuple[Kind, int], list[int]] = {}
    for i, candidate in enumerate(candidates):
        shapes.setdefault((candidate.kind, len(candidate.places)), []).append(i)
    for (kind, _), members in shapes.items():
        places = np.array([candidates[i].places for i in members])
        penalty = float(np.log(alike[kind] / PRIOR_ODDS[kind]))
        result[:, members] = _integrate(*data.project(places, kind == "shift"), penalty)
    return result


def _integrate(size: FloatArray, square: FloatArray, penalty: float) -> FloatArray:
    """Return log mean exp(g) over VARIANCES of l and u^2 (.., k) minus the penalty.

    It is computed where the bound of g exceeds the penalty: each direction by itself adds at most
    (r - 1 - log r) / 2, r = u^2 / l > 1, to g.
    """
    result = np.full(size.shape[:-1], -np.inf)
    ratio = np.maximum(np.divide(square, size, out=np.ones_like(size), where=size > 0.0), 1.0)
    is_possible = 0.5 * (ratio - 1.0 - np.log(ratio)).sum(axis=-1) > penalty
    if is_possible.any():
        gain = _gain(size[is_possible], square[is_possible], VARIANCES)
        top = gain.max(axis=-1)
        result[is_possible] = top + np.log(np.exp(gain - top[:, None]).mean(axis=-1)) - penalty
    return result


def _gain(size: FloatArray, square: FloatArray, variance: FloatArray) -> FloatArray:
    """Return g (n, v) at variances (v,) for l and u^2 (n, k)."""
    d = 1.0 + variance[:, None] * size[:, None, :]
    return 0.5 * (variance[:, None] * square[:, None, :] / d - np.log(d)).sum(axis=-1)


def optimize_variance(size: FloatArray, square: FloatArray) -> tuple[float, float]:
    """Return the variance of largest g for l and u^2 (k,), and that g; the variance may be 0."""
    low, high, count = 0.0, float(np.log(LARGEST_FACTOR)), 201
    best, largest = 0.0, 0.0
    for _ in range(4):
        grid = np.linspace(low, high, count)
        gain = _gain(size[None], square[None], np.expm1(2.0 * grid))[0]
        i = int(gain.argmax())
        best, largest = float(np.expm1(2.0 * grid[i])), float(gain[i])
        low, high, count = grid[max(i - 1, 0)], grid[min(i + 1, count - 1)], 21
    return best, largest


def estimate_variance_spread(
    data: PredictedData, component: ToleranceComponent, variance: float
) -> float:
    """Return the root mean square deviation of a component's log factor from that of `variance`.

    Parameters
    ----------
    data : predicted without the component (t = 1). variance : of the component with the factor on
        all tolerances.
    """
    size, square = data.project(np.array([component.places]), component.kind == "shift")
    center = 0.5 * np.log1p(variance)
    grid = np.linspace(0.0, center + np.log(WIDEST), 200)
    gain = _gain(size[0], square[0], np.expm1(2.0 * grid))[0]
    weight = np.exp(gain - gain.max())
    return float(np.sqrt((weight * (grid - center) ** 2).sum() / weight.sum()))


class ComponentSearch(NamedTuple):
    """The search for the components of one prior (t = 1).

    Attributes
    ----------
    rows : decomposition of the rows, their noise 1. correlation : (p, p) as stated, or None.
    unpenalized : (p,) parameters without a prior, or None. candidates : that may be chosen.
    """

    rows: Decomposition
    correlation: FloatArray | None
    unpenalized: np.ndarray | None
    candidates: tuple[ToleranceComponent, ...]

    def choose(self) -> tuple[ToleranceComponent, ...]:
        """Return the chosen components, of the better of two searches: from the stated tolerances,
        and from inflated ones.
        """
        searches = [self._search(is_inflated) for is_inflated in (False, True)]
        return min(searches, key=lambda search: search[0])[1]

    def _search(self, is_inflated: bool) -> tuple[float, tuple[ToleranceComponent, ...]]:
        """Return minus the log evidence, up to a constant, and the components."""
        chosen: dict[int, float] = {}
        factor, penalty = self._find_factor(chosen) if is_inflated else 1.0, 0.0
        while len(chosen) < MOST_COMPONENTS:
            data = predict(self._decompose(chosen), np.array([factor]))
            evidence = compute_evidence(data, self.candidates)[0]
            evidence[list(chosen)] = -np.inf
            best = int(evidence.argmax()) if len(evidence) else 0
            if not len(evidence) or evidence[best] <= 0.0:
                break
            variance, gain = optimize_variance(*self._project(data, best))
            penalty += gain - float(evidence[best])
            chosen = {**chosen, best: variance / factor**2}
            chosen, factor = self._optimize(chosen, factor, is_inflated)
        factor = self._find_factor(chosen)
        components = tuple(replace(self.candidates[i], variance=v) for i, v in chosen.items())
        d = self._decompose(chosen)
        s = np.where(are_penalized(d), d.singular_values, 0.0)[0] * factor
        c = np.where(are_penalized(d), d.projections, 0.0)[0]
        score = 0.5 * float((np.log1p(s**2) + c**2 / (1.0 + s**2)).sum())
        return score + penalty, tuple(c for c in components if c.variance > 0.0)

    def _optimize(
        self, chosen: Mapping[int, float], factor: float, is_inflated: bool
    ) -> tuple[dict[int, float], float]:
        """Return variances and factor, optimized in turn."""
        chosen = dict(chosen)
        for _ in range(CYCLES):
            for i in chosen:
                others = {j: v for j, v in chosen.items() if j != i}
                data = predict(self._decompose(others), np.array([factor]))
                chosen[i] = optimize_variance(*self._project(data, i))[0] / factor**2
            factor = self._find_factor(chosen) if is_inflated else factor
        return chosen, factor

    def _project(self, data: PredictedData, i: int) -> tuple[FloatArray, FloatArray]:
        """Return l and u^2 (k,) of a candidate."""
        candidate = self.candidates[i]
        size, square = data.project(np.array([candidate.places]), candidate.kind == "shift")
        return size[0, 0], square[0, 0]

    def _find_factor(self, chosen: Mapping[int, float]) -> float:
        """Return the most probable factor on all tolerances with the chosen components."""
        return float(find_most_probable_factor(self._decompose(chosen))[0])

    def _decompose(self, chosen: Mapping[int, float]) -> Decomposition:
        """Return the decomposition of the rows for the prior with the chosen components."""
        components = [replace(self.candidates[i], variance=v) for i, v in chosen.items()]
        covariance = compute_prior_covariance(len(self.rows.scale), self.correlation, components)
        return restate(self.rows, covariance, self.unpenalized)


def restate(
    rows: Decomposition, covariance: FloatArray, unpenalized: np.ndarray | None
) -> Decomposition:
    """Return the decomposition of the same rows for a prior of another covariance (p, p)."""
    p = len(rows.scale)
    factor = np.zeros((len(rows.rows), p + 1, p + 1))
    factor[:, :p, :p] = rows.singular_values[:, :, None] * rows.inverse / rows.scale
    factor[:, :p, p] = rows.projections
    factor[:, p, p] = np.sqrt(rows.outside)
    return decompose(
        factor,
        rows.rows,
        tolerance=rows.tolerance,
        unpenalized=unpenalized,
        root=compute_symmetric_root(covariance),
    )
