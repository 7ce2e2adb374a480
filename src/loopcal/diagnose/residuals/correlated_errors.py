# SPDX-License-Identifier: Apache-2.0
"""The covariance of a fit whose errors are correlated in the order of measurement.

The errors of one series have the covariance s^2 K, K_ij = (1 - a) [i = j] + a rho^|i - j|: white
noise and noise that forgets its past with each row. Let X be everything that is estimated and r the
residuals. The restricted likelihood, which does not depend on the values of the estimated
parameters, and the scale are

    log p(rho, a) = -(log |K| + log |X'K^-1 X| + (nu0 + nu) log(nu0 + S)) / 2 + const
    s^2 = (nu0 + S) / (nu0 + nu),    S = min over b of (r - X b)'K^-1 (r - X b)

nu0 are the degrees of freedom of the stated sigmas, 0 where the residuals contradict them; exact
sigmas, of infinite ones, give S in place of the last term, and s = 1. An estimate root G'e then has
the covariance root (s^2 G'K G) root', averaged over rho and a with this likelihood, so that few
rows, which leave them open, give a wide covariance. Estimates do not change. Source: Harville,
Maximum likelihood approaches to variance component estimation, JASA 72 (1977).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from loopcal.diagnose.residuals.residual_rows import ResidualRows
from loopcal.typing import FloatArray, IntArray

RHO = (0.0, 0.2, 0.4, 0.55, 0.7, 0.8, 0.87, 0.92, 0.96, 0.98, 0.99)
"""Correlations of neighbors between which the average is taken."""

SHARE = (1.0, 0.75, 0.5, 0.3, 0.15)
"""Shares a of the correlated noise."""

LEAST_SCATTER = 1e-9
"""Relative variance of the size of the covariance below which it counts as known."""

LONGEST = 400
"""Rows of a series whose correlation is considered at once; longer series are cut."""


@dataclass(frozen=True, eq=False)
class CorrelatedErrors:
    """The covariance of a fit by correlated errors.

    Attributes
    ----------
    covariance : (k, k) of the directions of the rows' gain. degrees : degrees of freedom of its
        size.
    correlation : of neighboring errors, mean. sigma : their size over the stated sigma, mean.
    """

    covariance: FloatArray
    degrees: float
    correlation: float
    sigma: float


class _Segments(NamedTuple):
    """Segments of equal length n: (S, n) numbers of their rows."""

    rows: IntArray


def estimate_correlated_errors(rows: ResidualRows, sigma_degrees: float) -> CorrelatedErrors:
    """Return the covariance by errors that are correlated within each series.

    Parameters
    ----------
    rows : of a fit. sigma_degrees : degrees of freedom nu0 that the stated sigmas count for,
        infinite where they are exact.
    """
    segments = _cut_series(rows.series)
    nu = rows.degrees + sigma_degrees
    logs, scales, covariances, neighbors = [], [], [], []
    for rho in RHO:
        for share in SHARE if rho > 0.0 else (1.0,):
            log_det, square, explained = _evaluate(rows, segments, rho, share)
            by_size, scale = square, 1.0
            if np.isfinite(nu):
                scale = (sigma_degrees + square) / nu
                by_size = nu * np.log(scale)
            logs.append(-0.5 * (log_det + by_size))
            scales.append(scale)
            covariances.append(scale * explained)
            neighbors.append(share * rho)
    weight = np.exp(np.array(logs) - max(logs))
    weight /= weight.sum()
    covariance = np.einsum("i,ijk->jk", weight, np.array(covariances))
    sizes = np.array([np.trace(c) for c in covariances])
    mean = float(weight @ sizes)
    # without a direction that the data determine there is no covariance, hence no scatter of it
    scatter = float(weight @ (sizes - mean) ** 2) / mean**2 if mean > 0.0 else 0.0
    return CorrelatedErrors(
        covariance,
        2.0 / max(scatter + 2.0 / nu, LEAST_SCATTER),
        float(weight @ np.array(neighbors)),
        float(np.sqrt(weight @ np.array(scales))),
    )


def _cut_series(series: IntArray) -> list[IntArray]:
    """Return the rows (S, n) of the segments of each length."""
    starts = np.flatnonzero(np.r_[True, np.diff(series) != 0])
    by_length: dict[int, list[IntArray]] = {}
    for first, last in zip(starts, np.r_[starts[1:], len(series)], strict=True):
        for part in np.array_split(np.arange(first, last), -(-(last - first) // LONGEST)):
            by_length.setdefault(len(part), []).append(part)
    return [np.array(segments) for segments in by_length.values()]


def _evaluate(
    rows: ResidualRows, segments: list[IntArray], rho: float, share: float
) -> tuple[float, float, FloatArray]:
    """Return log |K| + log |X'K^-1 X|, the sum of squares S, and G'K G (k, k)."""
    from scipy.linalg import solve_triangular

    q, k = rows.basis.shape[1], rows.gain.shape[1]
    columns = np.column_stack([rows.basis, rows.residual])
    log_det, white, spread = 0.0, [], np.zeros((k, k))
    for members in segments:
        count, n = members.shape
        K = share * rho ** np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
        K[np.diag_indices(n)] = 1.0
        L = np.linalg.cholesky(K)
        log_det += 2.0 * count * float(np.log(np.diag(L)).sum())
        # one system for all segments: the triangle is the same for each
        stacked = columns[members.T].reshape(n, count * (q + 1))
        white.append(solve_triangular(L, stacked, lower=True).reshape(n * count, q + 1))
        part = (L.T @ rows.gain[members.T].reshape(n, count * k)).reshape(n * count, k)
        spread += part.T @ part
    R = np.asarray(np.linalg.qr(np.concatenate(white), mode="r"))
    log_det += 2.0 * float(np.log(np.abs(np.diag(R)[:q])).sum())
    return log_det, float(R[-1, -1] ** 2), spread
