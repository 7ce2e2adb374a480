# SPDX-License-Identifier: Apache-2.0
"""A variance component of a vector whose elements else have equal, unknown variance.

Independent normal y_i have the variances sigma^2 (1 + tau^2 w_i), with known weights w_i, some of
them zero. The score test of tau = 0 needs neither: it looks at

    Q = sum w_i y_i^2 / sum y_i^2

whose tail probability for tau = 0 is that of a quadratic form in normal variables, here by the
saddlepoint approximation (Kuonen, Biometrika 86(4) 929, 1999, doi 10.1093/biomet/86.4.929). The
size is the mean of sigma^2 tau^2 over its distribution for these y, with tau uniform above 0 and
for sigma^2 a scaled inverse chi-square prior of `known` degrees of freedom about 1. Its degrees of
freedom are those of a scaled chi-square variable of the same mean and variance, at least 1: below,
a quantile of Student's t grows without limit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from loopcal.typing import FloatArray

STEPS, NEWTON = 400, 100
"""Values of tau that are compared, and most steps to the saddlepoint."""

SMALLEST, LARGEST = 1e-3, 1e4
"""Ends of the values of tau: the strongest element gains this share of sigma, and this many."""


class VarianceComponent(NamedTuple):
    """The estimate of a variance component.

    Attributes
    ----------
    variance : mean of sigma^2 tau^2. degrees : its degrees of freedom.
    ratio : of variances, tau^2 at which the likelihood is largest.
    """

    variance: float
    degrees: float
    ratio: float


def compute_component_tail(weights: FloatArray, y: FloatArray) -> float:
    """Return the probability of a larger Q without the component; 1 where there is no test.

    Parameters
    ----------
    weights, y : (k,) elements.
    """
    total, largest = float((y**2).sum()), float(weights.max(initial=0.0))
    if not (total > 0.0 and largest > 0.0):
        return 1.0
    return _tail(weights / largest - float(weights @ y**2) / (largest * total))


def estimate_variance_component(
    weights: FloatArray, y: FloatArray, known: float = 0.0
) -> VarianceComponent:
    """Return the size of a component; arguments as of `compute_component_tail`.

    `known` degrees of freedom say that sigma is 1; infinite ones, that it is exactly 1.
    """
    largest = float(weights.max())
    tau = np.geomspace(SMALLEST, LARGEST, STEPS) / np.sqrt(largest)
    ratio = tau**2
    scale = 1.0 + ratio[:, None] * weights
    square, count = (y**2 / scale).sum(axis=1), len(y) + known
    if np.isinf(known):
        by_size, variance = -0.5 * square, np.ones(STEPS)
    else:
        by_size, variance = -0.5 * count * np.log(square + known), (square + known) / count
    density = by_size - 0.5 * np.log(scale).sum(axis=1)
    share = np.exp(density - density.max()) * np.gradient(tau)
    share /= share.sum()
    values = ratio * variance
    mean = float(share @ values)
    # sigma^2 at each tau has a relative variance of its own
    own = 2.0 / max(count - 4.0, 1.0)
    spread = float(share @ ((values - mean) ** 2 + own * values**2))
    degrees = max(2.0 * mean**2 / spread, 1.0)
    return VarianceComponent(mean, degrees, float(ratio[np.argmax(density)]))


def _tail(values: FloatArray) -> float:
    """Return P(sum of values_i times chi-square of one degree > 0), saddlepoint t:

    K(t) = -1/2 sum log(1 - 2 t values), K'(t) = 0, w = sign(t) sqrt(-2 K(t)),
    v = t sqrt(K''(t)), tail = 1 - Phi(w + log(v / w) / w).
    """
    from loopcal.numerics.special_functions import ndtr

    if not (values.max() > 0.0 > values.min()):
        return 1.0 if values.min() >= 0.0 else 0.0
    low, high = 0.5 / values.min(), 0.5 / values.max()

    def slope(t: float) -> float:
        return float((values / (1.0 - 2.0 * t * values)).sum())

    t = 0.0
    for _ in range(NEWTON):  # K' grows: bisection cannot fail
        low, high = (t, high) if slope(t) < 0.0 else (low, t)
        before, t = t, 0.5 * (low + high)
        if t == before:
            break
    K = -0.5 * float(np.log1p(-2.0 * t * values).sum())
    curvature = 2.0 * float(((values / (1.0 - 2.0 * t * values)) ** 2).sum())
    w, v = np.sign(t) * np.sqrt(max(-2.0 * K, 0.0)), t * np.sqrt(curvature)
    if abs(w) < 1e-4:  # the limit at the mean
        third = 8.0 * float(((values / (1.0 - 2.0 * t * values)) ** 3).sum())
        return float(0.5 - third / (6.0 * np.sqrt(2.0 * np.pi) * curvature**1.5))
    return float(ndtr(-(w + np.log(v / w) / w)))
