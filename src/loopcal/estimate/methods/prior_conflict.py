# SPDX-License-Identifier: Apache-2.0
"""Do the stated tolerances fit the data? The prior's own part of the sum of squares, against its
distribution.

With the prior z ~ N(0, 1) and unit noise the projections c_i = u_i'b are independent, c_i ~ N(0, 1
+ s_i^2), and the most probable deviation is y_i = s_i c_i / (1 + s_i^2), so that

    Q = z'z = sum y_i^2 = sum w_i chi2_i,   w_i = s_i^2 / (1 + s_i^2)

with independent chi2_i of one degree of freedom. Directions that the data do not see have no
weight. It is compared with the scaled chi-square of equal mean and variance (Satterthwaite): (sum
w)^2 / sum w^2 degrees of freedom. Where all s_i are large it is the sum of c_i^2 / (1 + s_i^2), the
part of b'(I + AA')^-1 b within the range of A. What lies outside the range says nothing about the
prior; it is used for the noise. See docs/theory/uncertainty.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.inference.residual_test import DOUBT
from loopcal.estimate.methods.regularization_rules import MarginalLikelihood
from loopcal.numerics.decomposition import Decomposition
from loopcal.typing import FloatArray

FAR = 2.0
"""A parameter further from nominal than this many tolerances is named."""

SHOWN = 3
"""Parameters that are named at most."""


@dataclass(frozen=True)
class InflatedTolerances:
    """Factor (t,) on all tolerances: 1, or where data contradict them beyond doubt, that of largest
    marginal likelihood.

    The tolerances are never narrowed. Data that leave more than their noise outside the range of
    the parameters (wrong sigma, wrong rows, a poor model) count with the noise that they show, and
    so do not widen the tolerances.
    """

    def __call__(self, decomposition: Decomposition) -> FloatArray:
        """Return the factor (t,)."""
        shown = decomposition.divided(estimate_excess_noise(decomposition))
        statistic, degrees = compute_prior_statistic(shown)
        doubted = _tail(degrees, statistic) < DOUBT
        spread = np.ones_like(statistic)
        if doubted.any():
            chosen = 1.0 / np.sqrt(MarginalLikelihood()(shown.take(np.flatnonzero(doubted))))
            spread[doubted] = np.maximum(chosen, 1.0)
        return spread


@dataclass(frozen=True)
class PriorConflict:
    """The tolerances against the data.

    Attributes
    ----------
    statistic, degrees, p_value : Q, its degrees of freedom and the probability of a larger one.
    spread : factor by which the tolerances were widened for the estimate.
    conflict : whether the data contradict the tolerances.
    farthest : names of the parameters furthest from nominal, and how many stated tolerances that
        is.
    sentence : what this means.
    """

    statistic: float
    degrees: float
    p_value: float
    spread: float
    conflict: bool
    farthest: tuple[tuple[str, float], ...]
    sentence: str

    def to_dict(self) -> dict[str, Any]:
        """Return the attributes by name for JSON."""
        return {**vars(self), "farthest": [list(pair) for pair in self.farthest]}


def assess_prior_conflict(
    free: FreeParameters,
    decomposition: Decomposition,
    penalty: FloatArray,
    sigma: float,
    deviation: FloatArray,
) -> PriorConflict:
    """Test the prior of a fit (t = 1).

    Parameters
    ----------
    free : the parameters. decomposition, penalty : of the fit, columns scaled by tolerance.
    sigma : factor on the stated sigmas. deviation : (p,) of the estimate, in tolerances.
    """
    scaled = decomposition.divided(np.full(1, sigma))
    statistic, degrees = (
        float(value[0])
        for value in compute_prior_statistic(scaled.divided(estimate_excess_noise(scaled)))
    )
    held = np.isfinite(penalty[0]) & (penalty[0] > 0.0)
    spread = float(sigma / np.sqrt(penalty[0][held][0])) if held.any() else np.nan
    p_value = float(_tail(np.array([degrees]), np.array([statistic]))[0])
    conflict = p_value < DOUBT
    far = [
        i for i in np.argsort(-np.abs(deviation)) if abs(deviation[i]) > FAR and not free.assumed[i]
    ][:SHOWN]
    farthest = tuple((free.names[i], float(deviation[i])) for i in far)
    return PriorConflict(
        statistic,
        degrees,
        p_value,
        spread,
        conflict,
        farthest,
        _sentence(statistic, degrees, spread, conflict, farthest),
    )


def compute_prior_statistic(decomposition: Decomposition) -> tuple[FloatArray, FloatArray]:
    """Return Q (t,), scaled to a chi-square, and its degrees of freedom (t,), over the directions
    that a prior holds.
    """
    held = np.ones(1, dtype=bool) if decomposition.flat is None else ~decomposition.flat
    square = np.where(held, decomposition.singular_values**2, 0.0)
    share = square / (1.0 + square)
    value = (share * decomposition.projections**2 / (1.0 + square)).sum(axis=1)
    first, second = share.sum(axis=1), (share**2).sum(axis=1)
    there = second > 0.0
    safe = np.where(there, second, 1.0)
    return np.where(there, value * first / safe, 0.0), np.where(there, first**2 / safe, 0.0)


def estimate_excess_noise(decomposition: Decomposition) -> FloatArray:
    """Return the factor (t,) on sigma that the part outside the range shows, 1 unless that is
    beyond doubt above 1.
    """
    left = (decomposition.rows - decomposition.rank).astype(np.float64)
    larger = _tail(left, decomposition.unexplained) < DOUBT
    return np.sqrt(np.where(larger, decomposition.unexplained / np.maximum(left, 1.0), 1.0))


def _tail(degrees: FloatArray, statistic: FloatArray) -> FloatArray:
    """Probability (t,) of a larger chi-square; 1 without a degree of freedom."""
    from scipy.special import chdtrc

    return np.where(degrees > 0.0, chdtrc(np.where(degrees > 0.0, degrees, 1.0), statistic), 1.0)


def _sentence(
    statistic: float,
    degrees: float,
    spread: float,
    conflict: bool,
    farthest: tuple[tuple[str, float], ...],
) -> str:
    """Say whether the tolerances fit the data, and what was done."""
    if degrees < 0.5:
        return "no tolerance is stated for what the data see, so there is no prior to check"
    if not conflict:
        return "the data agree with the stated tolerances"
    ratio = np.sqrt(statistic / degrees)
    names = ", ".join(f"{name} {value:+.3g}" for name, value in farthest)
    done = (
        f"they were widened {spread:.3g} times for this estimate"
        if spread > 1.0
        else "the estimate is held too close to nominal: state wider tolerances, or use the "
        "default method"
    )
    return (
        f"the data contradict the stated tolerances (deviations are {ratio:.3g} times what these "
        "allow"
        f"{'; in tolerances: ' + names if names else ''}): {done}"
    )
