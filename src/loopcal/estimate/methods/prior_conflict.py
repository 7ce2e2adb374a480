# SPDX-License-Identifier: Apache-2.0
"""Test the stated tolerances against the data, and inflate them where the data contradict them.

With the prior z ~ N(0, 1) and unit noise the projections c_i = u_i'b are independent, c_i ~ N(0, 1
+ s_i^2), and the most probable deviation is y_i = s_i c_i / (1 + s_i^2), so that

    Q = z'z = sum y_i^2 = sum w_i chi2_i,   w_i = s_i^2 / (1 + s_i^2)

with independent chi2_i of one degree of freedom. Directions that the data do not determine have no
weight. Q is compared with the scaled chi-square of equal mean and variance (Satterthwaite): (sum
w)^2 / sum w^2 degrees of freedom. Where all s_i are large, Q is the sum of c_i^2 / (1 + s_i^2), the
part of b'(I + AA')^-1 b within the range of A. The part outside the range contains no information
on the prior; it is used for the noise. See docs/theory/uncertainty.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.inference.residual_test import SIGNIFICANCE
from loopcal.estimate.methods.regularization_rules import MarginalLikelihood
from loopcal.findings import Finding, report_finding
from loopcal.numerics.chi_square import compute_chi_square_tail
from loopcal.numerics.decomposition import Decomposition
from loopcal.typing import FloatArray

FAR = 2.0
"""Deviation from nominal, in tolerances, above which a parameter is named."""

NAMED = 3
"""Largest number of parameters that are named."""


@dataclass(frozen=True)
class InflatedTolerances:
    """Choose the factor on all tolerances: 1, or the one of largest marginal likelihood.

    The factor differs from 1 only where the data contradict the tolerances beyond doubt; it is
    never below 1. Data that leave more than their noise outside the range of the parameters (wrong
    sigma, wrong rows, incomplete model) count with the noise that they show, so that they do not
    inflate the tolerances.
    """

    def __call__(self, decomposition: Decomposition) -> FloatArray:
        """Return the factor (t,)."""
        rescaled = decomposition.divided(estimate_excess_noise(decomposition))
        statistic, degrees = compute_prior_statistic(rescaled)
        rejected = compute_chi_square_tail(degrees, statistic) < SIGNIFICANCE
        inflation = np.ones_like(statistic)
        if rejected.any():
            lam = MarginalLikelihood()(rescaled.take(np.flatnonzero(rejected)))
            inflation[rejected] = np.maximum(1.0 / np.sqrt(lam), 1.0)
        return inflation


@dataclass(frozen=True)
class PriorConflict:
    """The stated tolerances against the data.

    Attributes
    ----------
    statistic, degrees, p_value : Q, its degrees of freedom and the probability of a larger Q.
    inflation : factor by which the tolerances were inflated for the estimate.
    conflict : whether the data contradict the tolerances.
    farthest : names of the parameters farthest from nominal, and their deviations in tolerances.
    """

    JSON_FIELDS: ClassVar[Mapping[str, str]] = {
        "statistic": "statistic",
        "degrees": "degrees",
        "p_value": "p_value",
        "spread": "inflation",
        "conflict": "conflict",
        "farthest": "farthest",
        "sentence": "sentence",
    }

    statistic: float
    degrees: float
    p_value: float
    inflation: float
    conflict: bool
    farthest: tuple[tuple[str, float], ...]

    @property
    def finding(self) -> Finding:
        """Whether the tolerances agree with the data, and what the method did."""
        if self.degrees < 0.5:
            return report_finding("prior.untested")
        if not self.conflict:
            return report_finding("prior.consistent")
        inflated = self.inflation > 1.0
        return report_finding(
            "prior.tolerances-inflated" if inflated else "prior.tolerances-too-narrow",
            ratio=float(np.sqrt(self.statistic / self.degrees)),
            names=tuple(name for name, _ in self.farthest),
            deviations=tuple(deviation for _, deviation in self.farthest),
            inflation=self.inflation,
            p_value=self.p_value,
        )

    @property
    def sentence(self) -> str:
        """The text of the finding."""
        return str(self.finding)


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
    penalized = np.isfinite(penalty[0]) & (penalty[0] > 0.0)
    inflation = float(sigma / np.sqrt(penalty[0][penalized][0])) if penalized.any() else np.nan
    p_value = float(compute_chi_square_tail(degrees, statistic))
    order = np.argsort(-np.abs(deviation))
    far = [i for i in order if abs(deviation[i]) > FAR and not free.assumed[i]][:NAMED]
    return PriorConflict(
        statistic=statistic,
        degrees=degrees,
        p_value=p_value,
        inflation=inflation,
        conflict=p_value < SIGNIFICANCE,
        farthest=tuple((free.names[i], float(deviation[i])) for i in far),
    )


def compute_prior_statistic(decomposition: Decomposition) -> tuple[FloatArray, FloatArray]:
    """Return Q (t,), scaled to a chi-square, and its degrees of freedom (t,).

    The sums are over the directions that a prior penalizes.
    """
    unpenalized = decomposition.unpenalized
    penalized = np.ones(1, dtype=bool) if unpenalized is None else ~unpenalized
    square = np.where(penalized, decomposition.singular_values**2, 0.0)
    share = square / (1.0 + square)
    value = (share * decomposition.projections**2 / (1.0 + square)).sum(axis=1)
    first, second = share.sum(axis=1), (share**2).sum(axis=1)
    testable = second > 0.0
    safe = np.where(testable, second, 1.0)
    return np.where(testable, value * first / safe, 0.0), np.where(testable, first**2 / safe, 0.0)


def estimate_excess_noise(decomposition: Decomposition) -> FloatArray:
    """Return the factor (t,) on sigma that the part outside the range shows.

    It is 1 unless that part is larger than the noise beyond doubt.
    """
    left = (decomposition.rows - decomposition.rank).astype(np.float64)
    larger = compute_chi_square_tail(left, decomposition.unexplained) < SIGNIFICANCE
    return np.sqrt(np.where(larger, decomposition.unexplained / np.maximum(left, 1.0), 1.0))
