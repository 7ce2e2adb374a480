# SPDX-License-Identifier: Apache-2.0
"""The scatter of the errors of blocks against the stated uncertainty of each parameter.

The variance of a parameter over resamples of blocks estimates that of the cluster-robust covariance
(CR2). For independent errors it has the degrees of freedom of Bell and McCaffrey (2002), often far
fewer than there are blocks. They widen intervals, and say whether a ratio of standard deviations is
one of chance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopcal.diagnose.fit_checks.cluster_covariance import FEWEST_DEGREES, compute_robust_spread
from loopcal.diagnose.fit_checks.independent_units import Clusters
from loopcal.estimate.fit_linearization import FitLinearization
from loopcal.estimate.result import Identification
from loopcal.findings import Finding, report_finding
from loopcal.numerics.multiple_tests import compute_single_level
from loopcal.sampling.intervals import NAMED, OFF
from loopcal.typing import BoolArray, FloatArray

FALSE_ALARMS = 0.01
"""Probability that any parameter is reported where errors are independent and as stated."""


@dataclass(frozen=True, eq=False)
class BlockScatter:
    """The scatter of blocks, parameter by parameter (p,).

    Attributes
    ----------
    ratio : cluster-robust standard deviation over the one of independent errors; NaN where the data
        determine none.
    noise_degrees : degrees of freedom of the part of the variance that the blocks show.
    degrees : effective degrees of freedom of the whole variance (Welch-Satterthwaite): what a prior
        contributes is known.
    tail : probability of a larger ratio for independent errors of the stated size.
    unit_sd : standard deviations [SI] for rows of unit variance. noise : factor on the stated
        sigmas that the residuals show; NaN without degrees of freedom.
    """

    ratio: FloatArray
    noise_degrees: FloatArray
    degrees: FloatArray
    tail: FloatArray
    unit_sd: FloatArray
    noise: float

    def report(self, names: tuple[str, ...], ratio: FloatArray, blocks: Clusters) -> Finding:
        """Return whether the ratio (p,) of bootstrapped to stated standard deviations is beyond
        chance for any parameter.
        """
        off = self.find_off(ratio)
        unit = {"unit": blocks.unit, "blocks": blocks.count, "limit": OFF}
        if not off.any():
            return report_finding("sampling.scatter-agrees", **unit)
        order = np.argsort(-np.where(off, np.abs(np.log(ratio)), -1.0))[: int(off.sum())]
        return report_finding(
            "sampling.scatter-differs",
            **unit,
            count=int(off.sum()),
            total=len(names),
            names=tuple(names[i] for i in order[:NAMED]),
            ratio=float(ratio[order[0]]),
        )

    def find_off(self, ratio: FloatArray) -> BoolArray:
        """Return which ratios (p,) are off by more than `OFF`, beyond chance."""
        tested = np.isfinite(self.tail) & (self.noise_degrees >= FEWEST_DEGREES)
        level = 0.5 * compute_single_level(FALSE_ALARMS, int(tested.sum()))
        larger = (ratio > 1.0 + OFF) & (self.tail < level)
        smaller = (ratio < 1.0 / (1.0 + OFF)) & (self.tail > 1.0 - level)
        return np.asarray(tested & (larger | smaller))


def describe_scatter(
    fit: Identification, blocks: Clusters, linear: FitLinearization
) -> BlockScatter:
    """Return the scatter of blocks of a fit; without intervals its degrees are blocks - 1."""
    p = len(fit.names)
    nan = np.full(p, np.nan)
    d, penalty = linear.decomposition, linear.penalty
    unit_sd = d.standard_deviations(penalty)[0] * fit.tolerance
    left = float(d.rows[0] - d.filter_factors(penalty).sum())
    noise = float(np.sqrt(d.remaining(penalty)[0] / left)) if left > 0.5 else np.nan
    if not fit.residual_test.intervals:
        few = np.full(p, float(blocks.count - 1))
        return BlockScatter(nan, few, few, nan, unit_sd, noise)
    spread = compute_robust_spread(fit, blocks, linear)
    ratio, degrees, share, tail = nan.copy(), nan.copy(), nan.copy(), nan.copy()
    tested_rows = spread.scaled_rows * spread.is_tested[:, None, :]
    total = (spread.root**2).sum(axis=1)
    for j, effect in enumerate(np.eye(p)):
        compared = spread.compare(effect[None])
        ratio[j], degrees[j] = compared.ratio, compared.degrees
        by_blocks = float((np.matmul(spread.root[j], tested_rows) ** 2).sum())
        share[j] = by_blocks / total[j] if total[j] > 0.0 else np.nan
        tail[j] = compared.p_value
    safe = np.where(np.isfinite(degrees) & (share > 0.0), share, 1.0)
    effective = np.where(np.isfinite(degrees), degrees / safe**2, np.inf)
    return BlockScatter(ratio, degrees, effective, tail, unit_sd, noise)
