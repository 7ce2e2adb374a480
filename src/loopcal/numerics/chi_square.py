# SPDX-License-Identifier: Apache-2.0
"""The chi-square and F distributions: tail probabilities and quantiles.

The functions of scipy are imported when a function is called, so that `import loopcal` does not
pay for them.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from loopcal.typing import FloatArray

NODES = 101
"""Values of the true noise of each source over which a probability is averaged."""


def compute_chi_square_tail(degrees: ArrayLike, statistic: ArrayLike) -> FloatArray:
    """Return the probability that chi-square exceeds a statistic; 1 without a degree of freedom.

    Parameters
    ----------
    degrees : degrees of freedom. statistic : sum of squares [1]. Both broadcast.
    """
    from loopcal.numerics.special_functions import chdtrc

    degrees = np.asarray(degrees, dtype=float)
    tail = chdtrc(np.where(degrees > 0.0, degrees, 1.0), statistic)
    return np.where(degrees > 0.0, tail, 1.0)


def compute_f_tail(degrees: ArrayLike, left: ArrayLike, statistic: ArrayLike) -> FloatArray:
    """Return the probability that F exceeds a statistic; NaN without degrees of freedom left.

    F is a chi-square per degree of freedom, where the noise is estimated from residuals.

    Parameters
    ----------
    degrees : degrees of freedom of the statistic; without one the probability is 1.
    left : of the residuals; infinite for known noise. All broadcast.
    """
    from loopcal.numerics.special_functions import fdtrc

    degrees, left = np.asarray(degrees, dtype=float), np.asarray(left, dtype=float)
    tested = np.where(degrees > 0.0, degrees, 1.0)
    is_estimated = (left > 0.0) & np.isfinite(left)
    tail = np.where(
        is_estimated,
        fdtrc(tested, np.where(is_estimated, left, 1.0), statistic),
        compute_chi_square_tail(tested, tested * np.asarray(statistic, dtype=float)),
    )
    return np.where(left > 0.0, np.where(degrees > 0.0, tail, 1.0), np.nan)


def compute_chi_square_quantile(degrees: ArrayLike, probability: ArrayLike) -> FloatArray:
    """Return the statistic that chi-square exceeds with a probability.

    Parameters
    ----------
    degrees : degrees of freedom, above 0. probability : of a larger value [1]. Both broadcast.
    """
    from loopcal.numerics.special_functions import chdtri

    return np.asarray(chdtri(degrees, probability), dtype=float)


def compute_f_quantile(degrees: ArrayLike, left: ArrayLike, probability: ArrayLike) -> FloatArray:
    """Return the statistic that F exceeds with a probability.

    Parameters
    ----------
    degrees : degrees of freedom of the statistic, above 0.
    left : of the estimated noise, above 0; infinite for a known one: chi-square over `degrees`.
    probability : of a larger value [1]. All broadcast.
    """
    from loopcal.numerics.special_functions import fdtri

    left = np.asarray(left, dtype=float)
    is_known = np.isinf(left)
    known = compute_chi_square_quantile(degrees, probability) / np.asarray(degrees)
    estimated = fdtri(degrees, np.where(is_known, 1.0, left), 1.0 - np.asarray(probability))
    return np.where(is_known, known, estimated)


def compute_averaged_tail(
    chi_square: float, degrees: float, sources: Sequence[tuple[float, float]]
) -> float:
    """Return the probability of a larger chi-square where noise was estimated: the mean over the
    true noise, given the estimated one (Behrens and Fisher; with one source the F distribution).

    The true variance of a source is nu / chi-square(nu) times the estimated one.

    Parameters
    ----------
    sources : the part of each source in the degrees of freedom of the chi-square, and the degrees
        of freedom nu of its variance.
    """
    from loopcal.numerics.special_functions import chdtri

    total = sum(part for part, _ in sources)
    probability = (np.arange(NODES) + 0.5) / NODES
    true = np.zeros(1)
    for part, nu in sources:
        times = np.ones(1) if np.isinf(nu) else nu / chdtri(nu, probability)
        true = (true[:, None] + part / total * times).ravel()
    return float(compute_chi_square_tail(degrees, chi_square / true).mean())
