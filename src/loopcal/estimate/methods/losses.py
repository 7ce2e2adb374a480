# SPDX-License-Identifier: Apache-2.0
"""Losses that give blocks of rows far from the fit less weight, on the Mahalanobis norm d of a
whole block.

For a block of m whitened residuals d^2 = |W r|^2 has a chi-square distribution with m degrees of
freedom if the block belongs to the model. A loss is the weight w(d) that its squares get in
iteratively reweighted least squares. Its constant is stated for one residual and carried to blocks
of m by equal probability: P(|N(0, 1)| > k) = P(chi2_m > limit^2). Huber, Robust Statistics (1981);
the usual constants give 95 % efficiency for one normal residual.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from loopcal.errors import EstimationError
from loopcal.typing import FloatArray


class Loss(Protocol):
    """What reweighting asks of a loss."""

    def weight(self, distance: FloatArray, degrees: FloatArray) -> FloatArray:
        """Return the weight (u,) of blocks at distance d (u,) with this many residuals (u,)."""
        ...


@dataclass(frozen=True)
class Huber:
    """Weight 1 up to the limit and limit / d beyond: far blocks pull with a constant force; the
    minimum is the only one.

    Parameters
    ----------
    k : limit for a single residual, in standard deviations.

    Raises
    ------
    EstimationError
        k is not above 0.
    """

    k: float = 1.345

    def __post_init__(self) -> None:
        _check(self.k, "Huber")

    def weight(self, distance: FloatArray, degrees: FloatArray) -> FloatArray:
        """Return min(1, limit / d)."""
        limit = block_limit(self.k, degrees)
        return np.where(distance > limit, limit / np.maximum(distance, limit), 1.0)


@dataclass(frozen=True)
class Tukey:
    """Weight (1 - (d / limit)^2)^2 below the limit and 0 beyond: far blocks do not count at all.
    Begun from Huber's fit.

    Parameters
    ----------
    c : limit for a single residual, in standard deviations.

    Raises
    ------
    EstimationError
        c is not above 0.
    """

    c: float = 4.685

    def __post_init__(self) -> None:
        _check(self.c, "Tukey")

    def weight(self, distance: FloatArray, degrees: FloatArray) -> FloatArray:
        """Return (1 - (d / limit)^2)^2, or 0 beyond the limit."""
        share = np.minimum(distance / block_limit(self.c, degrees), 1.0)
        return (1.0 - share**2) ** 2


def block_limit(one: float, degrees: FloatArray) -> FloatArray:
    """Return the limit of a block's norm that is as rarely exceeded as `one` by a single normal
    residual.
    """
    from scipy.special import chdtri, ndtr

    return np.sqrt(chdtri(np.maximum(degrees, 1.0), 2.0 * float(ndtr(-one))))


def _check(constant: float, name: str) -> None:
    if not 0.0 < constant <= 8.0:
        raise EstimationError(
            f"{name} loss with constant {constant}: give a number of standard deviations above 0 "
            "and up to 8"
        )
