# SPDX-License-Identifier: Apache-2.0
"""Whether a smooth map of the residuals predicts errors in regions of poses that are left out.

The rows are r = U b + Phi c + e, with U all that is estimated, any b, the smooth errors Phi c with
independent c of variance 1, and noise e of the variance sigma^2. Ridge regression on X = [U, Phi]
with H = X (X'X + diag(0, sigma^2))^-1 X' leaves, of the rows g of a region that it was not made
from,

    (I - H_gg)^-1 (r - H r)_g

Without a map, X = U. The squares of both are compared region by region. Length and amplitude of the
errors are those of all rows.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from loopcal.diagnose.residual_patterns import collect_residual_rows, collect_rows
from loopcal.estimate.fit_linearization import FitLinearization, linearize_smooth_errors
from loopcal.estimate.residual_test import coverage_factor
from loopcal.estimate.smooth_errors import SmoothErrors
from loopcal.numerics.split_columns import SplitColumns
from loopcal.typing import FloatArray, IntArray

FEWEST_REGIONS = 8  # of which each is left out
DETERMINED = 1e-6  # least eigenvalue of I - H_gg; below, the other regions do not predict the rows


class MapTest(NamedTuple):
    """What the map does to errors in regions that it was not made from.

    before, after : root mean square of the whitened rows, without and with the map. lowest : lower
    end of the interval of 95 % of the share of the mean square that the map removes; NaN
    without a test. regions : their number.
    """

    before: float
    after: float
    lowest: float
    regions: int

    @property
    def is_gain(self) -> bool:
        """Whether the map is proven to lower the errors."""
        return self.lowest > 0.0


def check_map(
    linear: FitLinearization, errors: SmoothErrors, noise: float, T: FloatArray
) -> MapTest:
    """Compare the errors in left-out regions of the measured poses T (n, 4, 4) with and without a
    map of these smooth errors; `noise` is sigma^2.
    """
    untested, rows = MapTest(np.nan, np.nan, np.nan, 0), collect_residual_rows(linear)
    if rows is None or len(T) != linear.data.n_poses:
        return untested
    regions = errors.group_regions(T, FEWEST_REGIONS)[rows.locate_poses(linear.data)]
    columns = rows.basis.remove(rows.basis.remove(collect_columns(linear, errors)))
    s, axes = np.linalg.eigh(columns.T @ columns)
    by_errors = columns @ (axes / np.sqrt(np.maximum(s, 0.0) + noise))
    left = [
        _leave_out(each, rows.residual, regions)
        for each in (rows.basis, rows.basis.append(by_errors))
    ]
    known = np.isfinite(left).all(axis=0)
    if known.sum() < FEWEST_REGIONS:
        return untested._replace(regions=int(known.sum()))
    before, after = (squares[known] for squares in left)
    count, removed = len(before), before - after
    half = float(coverage_factor(count - 1.0)) * np.sqrt(count) * removed.std(ddof=1)
    number = np.isin(regions, np.flatnonzero(known)).sum()
    rms = np.sqrt(np.array([before.sum(), after.sum()]) / number).tolist()
    return MapTest(rms[0], rms[1], float((removed.sum() - half) / before.sum()), count)


def collect_columns(linear: FitLinearization, errors: SmoothErrors) -> FloatArray:
    """Return the columns (R, m) of smooth errors in the rows of a fit of exact readings."""
    stacked = collect_rows(linear.data, *linearize_smooth_errors(linear, errors))
    assert stacked is not None
    return stacked.columns.wide[:, -errors.count :]


def _leave_out(X: SplitColumns, residual: FloatArray, regions: IntArray) -> FloatArray:
    """Return the sum of squares of the rows of each region by regression on the others, with
    H = X X', X (R, k); NaN where these do not predict it.
    """
    left, squares = X.remove(residual), np.full(regions.max() + 1, np.nan)
    for region in range(len(squares)):
        own = np.flatnonzero(regions == region)
        part = X.take(own).toarray()
        rest = np.eye(len(own)) - part @ part.T
        if own.size and np.linalg.eigvalsh(rest)[0] > DETERMINED:
            squares[region] = float((np.linalg.solve(rest, left[own]) ** 2).sum())
    return squares
