# SPDX-License-Identifier: Apache-2.0
"""Rules that choose the ridge parameter or the truncation from the decomposition itself.

Each rule is a small value, called with the decomposition. It minimizes a criterion over a fixed
grid, for every trial separately. With c_i = u_i'b, m equations and filter factors f_i:

    GCV                 RSS / (m - sum f_i)^2            (generalized cross-validation)
    MarginalLikelihood  sum_i log(1 + s_i^2 / lam) + c_i^2 / (1 + s_i^2 / lam)

GCV needs no sigma; the marginal likelihood takes the rows as whitened by their true sigma. Golub,
Heath, Wahba, "Generalized cross-validation as a method for choosing a good ridge parameter",
Technometrics 21 (1979).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from loopcal.numerics.decomposition import Decomposition
from loopcal.typing import BoolArray, FloatArray, IntArray

PER_DECADE = 16
"""Grid points per factor of ten; around their minimum the criteria are flat over much more."""

LOWEST, HIGHEST = 1e-12, 1e4
"""Range of lam in units of the largest squared singular value: no effect to hardly any data."""


@dataclass(frozen=True)
class GCV:
    """Choose the ridge parameter that minimizes generalized cross-validation."""

    def __call__(self, decomposition: Decomposition) -> FloatArray:
        """Return lam (t,)."""
        return _minimize(lambda lam: self.score(decomposition, lam), decomposition)

    def score(self, decomposition: Decomposition, lam: FloatArray) -> FloatArray:
        """Return RSS / (m - sum f)^2 (t,) at lam (t,)."""
        penalty = np.broadcast_to(lam[:, None], decomposition.singular_values.shape)
        return _gcv(decomposition, penalty)

    def is_limit(self, decomposition: Decomposition, lam: FloatArray) -> BoolArray:
        """Return which lam (t,) are ends of the range."""
        return _is_end_of_range(decomposition, lam)


@dataclass(frozen=True)
class MarginalLikelihood:
    """Choose the ridge parameter under which the whitened data are most probable."""

    def __call__(self, decomposition: Decomposition) -> FloatArray:
        """Return lam (t,)."""
        return _minimize(lambda lam: self.score(decomposition, lam), decomposition)

    def is_limit(self, decomposition: Decomposition, lam: FloatArray) -> BoolArray:
        """Return which lam (t,) are ends of the range."""
        return _is_end_of_range(decomposition, lam)

    def score(self, decomposition: Decomposition, lam: FloatArray) -> FloatArray:
        """Return minus twice the log density of the data at lam (t,), up to a constant."""
        # directions of unpenalized parameters contain no information on lam
        unpenalized = decomposition.unpenalized
        counted = np.ones(1) if unpenalized is None else ~unpenalized
        square = decomposition.singular_values**2 * counted
        projected = decomposition.projections**2 * counted
        variance = 1.0 + square / lam[:, None]
        return (np.log(variance) + projected / variance).sum(axis=1)


@dataclass(frozen=True)
class TruncationGCV:
    """Choose the truncation k that minimizes generalized cross-validation."""

    def __call__(self, decomposition: Decomposition) -> IntArray:
        """Return k (t,)."""
        count = decomposition.singular_values.shape[1] + 1
        trials = np.ones(len(decomposition.singular_values))
        return np.argmin(
            np.stack([self.score(decomposition, k * trials) for k in range(count)]), axis=0
        )

    def score(self, decomposition: Decomposition, k: FloatArray) -> FloatArray:
        """Return RSS / (m - k)^2 (t,) at k (t,)."""
        order = np.arange(decomposition.singular_values.shape[1])
        kept = (order < k[:, None]) & decomposition.used
        return _gcv(decomposition, np.where(kept, 0.0, np.inf))


def _is_end_of_range(decomposition: Decomposition, lam: FloatArray) -> BoolArray:
    """Return which lam (t,) are within one grid point of an end of the grid."""
    reference = np.maximum(decomposition.singular_values[:, 0] ** 2, np.finfo(np.float64).tiny)
    point = 10.0 ** (1.0 / PER_DECADE)
    return (lam <= LOWEST * reference * point) | (lam >= HIGHEST * reference / point)


def _gcv(decomposition: Decomposition, penalty: FloatArray) -> FloatArray:
    """Return generalized cross-validation (t,); infinite where no equation is left over."""
    left = decomposition.rows - decomposition.filter_factors(penalty).sum(axis=1)
    spare = left > 1e-6
    return np.where(
        spare, decomposition.remaining(penalty) / np.where(spare, left, 1.0) ** 2, np.inf
    )


def _minimize(
    criterion: Callable[[FloatArray], FloatArray], decomposition: Decomposition
) -> FloatArray:
    """Minimize a criterion of lam (t,) over the grid.

    The parabola through the best grid point and its neighbors refines the minimum.
    """
    reference = np.maximum(decomposition.singular_values[:, 0] ** 2, np.finfo(np.float64).tiny)
    decades = np.log10(HIGHEST / LOWEST)
    grid = np.linspace(np.log10(LOWEST), np.log10(HIGHEST), int(PER_DECADE * decades) + 1)
    values = np.stack([criterion(reference * 10.0**g) for g in grid])
    best = np.clip(np.argmin(values, axis=0), 1, len(grid) - 2)
    trial = np.arange(values.shape[1])
    low, middle, high = (values[best + shift, trial] for shift in (-1, 0, 1))
    curvature = low - 2.0 * middle + high
    with np.errstate(invalid="ignore"):
        shift = np.where(
            curvature > 0.0, 0.5 * (low - high) / np.where(curvature > 0.0, curvature, 1.0), 0.0
        )
    shift = np.clip(np.nan_to_num(shift), -1.0, 1.0)
    return reference * 10.0 ** (grid[best] + shift * (grid[1] - grid[0]))
