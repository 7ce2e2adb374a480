# SPDX-License-Identifier: Apache-2.0
"""Test whether large residuals are more frequent than normal noise makes them.

The residuals r that no parameter explains (`ResidualRows`) are divided by their standard deviation
for independent errors, and by the root mean square of their series: u_i = r_i / (s sqrt(M_ii)),
M = I - U U'. A wrong sigma of one component therefore changes nothing. The statistic

    T = mean of log(1 + u_i^2 / 3)

is up to constants minus the log likelihood of Student's t with 3 degrees of freedom; a single large
residual has little weight in it. Heavy tails make T small, because most residuals are then small
compared with their root mean square. The distribution of T for normal errors comes from draws that
the same projector M maps, so that it is right for few and correlated residuals.

Poses that are outliers are left out: one gross error is no heavy tail.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from loopcal.diagnose.residuals.residual_rows import ResidualRows, collect_residual_rows
from loopcal.estimate.fit_input import exclude_poses
from loopcal.estimate.fit_linearization import FitLinearization, linearize_fit
from loopcal.estimate.inference.residual_test import choose_severity
from loopcal.estimate.result import Identification
from loopcal.findings import Finding, Severity, report_finding
from loopcal.measure import Measurements, fill_in_reading_sigma
from loopcal.numerics.sorted_values import compute_median, find_distinct
from loopcal.typing import BoolArray, FloatArray

LEVEL = 0.01
"""Probability that normal noise is reported; below `SIGNIFICANCE` it is a warning."""


DRAWS, BATCH = 10_000, 500
"""Draws of normal errors at most, and at once."""

DOUBT = 0.05
"""Probability from which no more draws are needed."""

FEWEST = 5.0
"""Degrees of freedom of the residuals from which the test is made."""

MOST_ROWS = 1000
"""Residuals that are tested at most, evenly chosen."""

TESTABLE = 1e-6
"""Share of its variance that the fit must leave of a row to be tested."""

PATTERNS, NO_PATTERN = "residuals.", "residuals.perhaps-correlated"
"""Beginning of the codes that say what the residuals of a fit depend on, and the one that does not.
"""


@dataclass(frozen=True)
class HeavyTails:
    """The test of the residuals for heavy tails.

    Attributes
    ----------
    rows : number of residuals that are tested. p_value : probability of a smaller T for normal
        noise; NaN where there is no test.
    median, expected : of the absolute residuals in standard deviations, and that of normal noise.
    largest : the largest of them.
    """

    rows: int
    p_value: float
    median: float
    expected: float
    largest: float

    @property
    def findings(self) -> tuple[Finding, ...]:
        """The finding; none where normal noise explains the residuals, or without a test."""
        if not self.p_value < LEVEL:
            return ()
        finding = report_finding(
            "residuals.heavy-tailed",
            severity=choose_severity(self.p_value),
            p_value=self.p_value,
            median=self.median,
            expected=self.expected,
            largest=self.largest,
            level=LEVEL,
        )
        return (finding,)


def check_heavy_tails(
    fit: Identification,
    data: Measurements,
    outliers: Sequence[str] = (),
    linear: FitLinearization | None = None,
) -> HeavyTails:
    """Test whether large residuals are more frequent than normal noise makes them.

    A fit with a loss, without intervals, or with uncertain readings is not tested, nor one whose
    residuals depend on something: this makes some of them larger, and is reported already.

    Parameters
    ----------
    fit : an identification. data : the measurements it was made from.
    outliers : labels of poses that are known to be wrong, such as those of `find_outliers`.
    linear : of both, where the caller has it, see `linearize_fit`.
    """
    nothing = _untested(0)
    if not (fit.converged and fit.residual_test.intervals) or fit.options.loss is not None:
        return nothing
    reported = (f for f in fit.findings if f.severity is Severity.WARNING)
    if any(f.code.startswith(PATTERNS) and f.code != NO_PATTERN for f in reported):
        return nothing
    data = exclude_poses(fill_in_reading_sigma(fit.robot, data), fit.options.excluded_poses)
    linear = linearize_fit(fit, data) if linear is None else linear
    rows = collect_residual_rows(fit, data, linear)
    if rows is None:
        return nothing
    wrong = np.flatnonzero(_belong_to(rows, data, outliers))
    return assess_tails(rows.without(wrong) if wrong.size else rows)


def assess_tails(rows: ResidualRows) -> HeavyTails:
    """Return the test of residuals."""
    n = len(rows.residual)
    kept = np.linspace(0, n - 1, min(n, MOST_ROWS)).astype(int)
    basis = rows.basis[kept]
    left = 1.0 - (basis**2).sum(axis=1)
    testable = left > TESTABLE
    kept, basis, left = kept[testable], basis[testable], left[testable]
    if left.sum() < FEWEST:
        return _untested(len(kept))
    member = rows.series[kept][:, None] == find_distinct(rows.series[kept])
    u = _standardize(rows.residual[kept, None], left, member)
    others = _take_root(np.eye(basis.shape[1]) - basis.T @ basis)
    rng, done, smaller = np.random.default_rng(0), 0, 0
    median, observed = 0.0, _compute_statistic(u)[0]
    while done < DRAWS:
        errors = rng.standard_normal((len(kept), BATCH))
        taken = basis.T @ errors + others @ rng.standard_normal((others.shape[1], BATCH))
        drawn = _standardize(errors - basis @ taken, left, member)
        smaller += int((_compute_statistic(drawn) <= observed).sum())
        median += float(_compute_medians(np.abs(drawn)).sum())
        done += BATCH
        if (1 + smaller) / (1 + done) > DOUBT:
            break
    size = np.abs(u)
    p_value = (1 + smaller) / (1 + done)
    return HeavyTails(len(kept), p_value, compute_median(size), median / done, float(size.max()))


def _compute_medians(values: FloatArray) -> FloatArray:
    """Return the median of each column of (n, c), faster than `np.median` for some hundred rows."""
    ordered, n = np.sort(values, axis=0), len(values)
    return np.asarray(0.5 * (ordered[(n - 1) // 2] + ordered[n // 2]))


def _untested(rows: int) -> HeavyTails:
    """Return that residuals are not tested."""
    return HeavyTails(rows, np.nan, np.nan, np.nan, np.nan)


def _belong_to(rows: ResidualRows, data: Measurements, labels: Sequence[str]) -> BoolArray:
    """Return which residuals (R,) belong to poses with these labels."""
    is_named = np.isin(np.array(data.labels), list(labels))
    result = np.zeros(len(rows.residual), dtype=bool)
    for number, o in enumerate(o for o in data.observations if len(o)):
        own = rows.kind == number
        is_held = np.asarray(is_named[o.rows].reshape(len(o), -1).any(axis=1))
        result[own] = is_held[rows.row[own]]
    return result


def _standardize(residual: FloatArray, left: FloatArray, member: BoolArray) -> FloatArray:
    """Return residuals (k, d) in units of their standard deviation, by the series (k, s)."""
    expected = member.T @ left
    scale = np.sqrt((member.T @ residual**2) / expected[:, None])
    scale = np.where(scale > 0.0, scale, 1.0)
    return np.asarray(residual / (np.sqrt(left)[:, None] * (member @ scale)))


def _compute_statistic(u: FloatArray) -> FloatArray:
    """Return T (d,) of residuals (k, d)."""
    return np.asarray(np.log1p(u**2 / 3.0).mean(axis=0))


def _take_root(covariance: FloatArray) -> FloatArray:
    """Return a root (q, k) of the part of the estimate that other rows determine."""
    square, vectors = np.linalg.eigh(covariance)
    known = square > TESTABLE
    return np.asarray(vectors[:, known] * np.sqrt(square[known]))
