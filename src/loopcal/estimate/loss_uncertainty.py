# SPDX-License-Identifier: Apache-2.0
"""The uncertainty of a fit with a loss, where its residuals exceed the stated noise.

With the weight w(d) of a block of m residuals at distance d, the estimate solves sum A' w r = 0.
Its covariance is (Huber, Robust Statistics, 1981, section 7.6)

    K^2 (sum w^2 d^2 / (N - p)) / h^2 (A'A)^-1        h = sum (m w + d w'(d)) / N

with N residuals, p parameters, and K = 1 + p / N var((m w + d w') / m) / h^2. The weighted rows
give (A'WA)^-1 = (A'A)^-1 / mean w, for unit noise. See docs/theory/uncertainty.md.
"""

from __future__ import annotations

import numpy as np

from loopcal.estimate.added_covariance import add_covariance
from loopcal.estimate.descent import Descent
from loopcal.estimate.losses import Loss
from loopcal.estimate.posterior import NOISE
from loopcal.estimate.problem import Problem
from loopcal.estimate.residual_test import SIGNIFICANCE
from loopcal.estimate.result import Identification
from loopcal.estimate.robust_descent import estimate_scale_of, measure_block_distances
from loopcal.findings import report_finding
from loopcal.numerics.statistics import compute_chi_square_tail
from loopcal.typing import FloatArray, IntArray

STEP = 1e-4
"""Relative change of a distance for the derivative of a weight."""


def add_loss_uncertainty(
    result: Identification, fit: Descent, problem: Problem, weighted: Problem, blocks: IntArray
) -> Identification:
    """Return a fit with a loss whose covariance allows for residuals that exceed the noise in it.

    Without a loss, or where the residuals agree with the noise (p > 0.001), it stays as it is.

    Parameters
    ----------
    result, fit : of the weighted problem. problem : unweighted. blocks : (n,) of each pose.
    """
    loss, test = result.options.loss, result.residual_test
    if loss is None or not (result.converged and test.intervals):
        return result
    member = np.unique(blocks, return_inverse=True)[1]
    distance, counts = measure_block_distances(problem, fit.deviation, fit.start, member, weighted)
    unit = estimate_scale_of(distance, counts) if test.noise == "estimated" else 1.0
    variance, left = compute_loss_variance(loss, distance, counts, result.rank, unit)
    times = variance / test.sigma_scale**2
    if left < 1.0 or compute_chi_square_tail(left, left * times) >= SIGNIFICANCE:
        return result
    roots = [part.root for part in result.posterior.parts if part.source == NOISE]
    root = np.sqrt(times - 1.0) * np.concatenate(roots, axis=1)
    finding = report_finding("noise.loss-contradicted", ratio=float(np.sqrt(times)))
    return add_covariance(result, root, left, finding)


def compute_loss_variance(
    loss: Loss, distance: FloatArray, counts: FloatArray, rank: int, unit: float = 1.0
) -> tuple[float, float]:
    """Return the variance of the noise that the covariance of the weighted rows must contain, and
    its degrees of freedom.

    Parameters
    ----------
    distance, counts : (u,) norm and number of whitened residuals of each block. rank : of the rows.
    unit : noise by which the loss divides distances.
    """
    weight, slope = (
        loss.weight(distance / unit, counts),
        (
            loss.weight(distance * (1.0 + STEP) / unit, counts)
            - loss.weight(distance * (1.0 - STEP) / unit, counts)
        )
        / (2.0 * STEP),
    )
    total, is_tested = float(counts.sum()), counts > 0.0
    left = total - rank
    influence = counts * weight + slope
    gain = float(influence.sum()) / total
    mean_weight = float((counts * weight).sum()) / total
    if left < 1.0 or gain <= 0.0:
        return np.nan, 0.0
    each = influence[is_tested] / counts[is_tested]
    correction = 1.0 + rank / total * float(np.var(each)) / gain**2
    square = float(((weight * distance) ** 2).sum()) / left
    return correction**2 * square * mean_weight / gain**2, left
