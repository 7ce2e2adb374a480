# SPDX-License-Identifier: Apache-2.0
"""Whiteners: matrices that give residuals unit variance, with zero rows for absent components."""

import numpy as np

from loopcal.errors import DataError
from loopcal.typing import BoolArray, FloatArray
from loopcal.units import SD_RANGE, is_sd

_SMALLEST_PIVOT = 1e-7
"""Smallest pivot [1] of a correlation matrix. Below it a component equals a combination of
the others to seven digits, and the inverse has fewer digits than a measurement.
"""


def compute_whitener(covariance: FloatArray, present: BoolArray, weight: FloatArray) -> FloatArray:
    """Return matrices W with `W C W' = weight` on the present components.

    Rows and columns of absent components are zero.

    W is the inverse lower Cholesky factor. Without a component, a Gaussian loses its row and column
    of C. Here they are replaced by those of the identity, which keeps the shape and gives the same
    factor for the other components.

    The inverse is formed once, because each step of a fit multiplies residuals and Jacobians of all
    rows by it, and numpy has no triangular solve of stacked blocks. It is accurate: blocks are
    correlation matrices of a few components, whose pivots are bounded from below.

    Parameters
    ----------
    covariance : (r, m, m) [SI]
        Entries of absent components are ignored.
    present : (r, m) bool
    weight : (r,)
        Factor of the squared residuals, not negative; 0 excludes a row.

    Returns
    -------
    W : (r, m, m)

    Raises
    ------
    DataError
        If a covariance is not symmetric or not positive definite; rows are counted from 1.
    """
    both = present[:, :, None] & present[:, None, :]
    diagonal = np.eye(present.shape[1], dtype=bool)
    C = np.where(both, covariance, 0.0) + (diagonal & ~both)
    variance = np.einsum("rii->ri", C)
    sd = np.sqrt(np.maximum(variance, 0.0))
    _refuse(
        ~np.all(np.isfinite(C), axis=(1, 2)) | ~np.all(is_sd(sd), axis=1),
        f"has a variance that is not above 0 (standard deviations {SD_RANGE})",
    )
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        correlation = C / (sd[:, :, None] * sd[:, None, :])
    _refuse(~np.all(np.isfinite(correlation), axis=(1, 2)), "is not positive definite")
    asymmetric = np.abs(correlation - np.swapaxes(correlation, 1, 2)) > 1e-9
    _refuse(np.any(asymmetric, axis=(1, 2)), "is not symmetric")
    W = _invert_factor(correlation) / sd[:, None, :]
    return np.where(both, W, 0.0) * np.sqrt(weight)[:, None, None]


def _invert_factor(correlation: FloatArray) -> FloatArray:
    """Return the inverse lower Cholesky factors (r, m, m) of correlation matrices."""
    diagonal = np.eye(correlation.shape[1], dtype=bool)
    if not np.any(correlation[:, ~diagonal]):  # most files: nothing to factor
        root = np.sqrt(np.where(diagonal, correlation, 1.0))
        return np.where(diagonal, 1.0 / root, 0.0)
    try:
        L = np.linalg.cholesky(correlation)
    except np.linalg.LinAlgError:
        smallest = np.linalg.eigvalsh(correlation)[:, 0]
        _refuse(smallest <= max(float(np.min(smallest)), 0.0), "is not positive definite")
        raise
    _refuse(
        np.min(np.einsum("rii->ri", L), axis=1) < _SMALLEST_PIVOT,
        "is not positive definite to rounding",
    )
    return np.asarray(np.tril(np.linalg.inv(L)), dtype=np.float64)


def _refuse(wrong: BoolArray, what: str) -> None:
    if np.any(wrong):
        row = int(np.flatnonzero(wrong)[0]) + 1
        raise DataError(
            f"the covariance of row {row} {what}; give each component a standard deviation above 0 "
            "and correlations between -1 and 1 that are consistent"
        )
