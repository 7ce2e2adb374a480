# SPDX-License-Identifier: Apache-2.0
"""Statistics of weighted draws, and how well the draws determine them.

Draws x_i from a proposal q stand for a density p with the normalized weights w_i, in proportion to
p(x_i) / q(x_i). `effective_size` is 1 / sum w_i^2 (Kish); the shape k of the generalized Pareto
distribution of the largest weights says whether their variance exists (Vehtari et al., 2024: above
0.7 the draws do not represent p).

Where a density p0 near p is known exactly, such as a linear posterior, the same draws with its
weights v_i give the error that they make: statistic(w) - statistic(v) + statistic of p0. The two
errors nearly cancel where p is nearly p0 (a control variate).
"""

from __future__ import annotations

import numpy as np

from loopcal.typing import FloatArray

LARGEST_TAIL = 0.2
"""Share of the draws whose weights are the tail, at most; see `fit_tail_shape`."""


def normalize_weights(log_weight: FloatArray) -> FloatArray:
    """Return weights (T,) of sum 1 from their logarithms; zero where these are not finite."""
    finite = np.isfinite(log_weight)
    if not finite.any():
        return np.zeros(len(log_weight))
    shifted = np.where(finite, log_weight - log_weight[finite].max(), -np.inf)
    weight = np.exp(shifted)
    return np.asarray(weight / weight.sum())


def effective_size(weight: FloatArray) -> float:
    """Return the number of independent draws that are worth as much as the weighted ones."""
    total = float((weight**2).sum())
    return 1.0 / total if total > 0.0 else 0.0


def fit_tail_shape(weight: FloatArray) -> float:
    """Return the shape k of the generalized Pareto distribution of the largest weights.

    The estimate of Zhang and Stephens (2009), with the weak prior of Vehtari et al. (2024,
    doi:10.48550/arXiv.1507.02646, appendix C), of the M largest weights over the next one,
    M = min(T / 5, 3 sqrt(T)). NaN with fewer than 5 of them.
    """
    total = len(weight)
    count = int(min(LARGEST_TAIL * total, 3.0 * np.sqrt(total)))
    if count < 5:
        return np.nan
    ordered = np.sort(weight)
    x = ordered[-count:] - ordered[-count - 1]
    x = x[x > 0.0]
    n = len(x)
    if n < 5:
        return np.nan
    m = 30 + int(np.sqrt(n))
    quartile = x[int(n / 4 + 0.5) - 1]
    b = 1.0 / x[-1] + (1.0 - np.sqrt(m / (np.arange(1, m + 1) - 0.5))) / (3.0 * quartile)
    k = np.log1p(-b[:, None] * x).mean(axis=1)
    likelihood = n * (np.log(-b / k) - k - 1.0)
    share = 1.0 / np.exp(likelihood - likelihood[:, None]).sum(axis=1)
    best = float((b * share).sum() / share.sum())
    shape = float(np.log1p(-best * x).mean())
    return (n * shape + 10.0 * 0.5) / (n + 10.0)


def weighted_quantiles(draws: FloatArray, weight: FloatArray, level: FloatArray) -> FloatArray:
    """Return quantiles (len(level), p) of draws (T, p) with weights (T,) of sum 1.

    Between two draws the distribution function is linear, with half the weight of a draw below it.
    """
    order = np.argsort(draws, axis=0, kind="stable")
    values = np.take_along_axis(draws, order, axis=0)
    ordered = weight[order]
    below = np.cumsum(ordered, axis=0) - 0.5 * ordered
    columns = [np.interp(level, below[:, j], values[:, j]) for j in range(draws.shape[1])]
    return np.stack(columns, axis=1)
