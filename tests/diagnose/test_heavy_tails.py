# SPDX-License-Identifier: Apache-2.0
"""Heavy tails of residuals: level, power, and that other causes are reported as themselves."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import kstest

from loopcal.diagnose.adjusted_uncertainty import (
    LEVEL,
    adjust_uncertainty,
    assess_tails,
    check_heavy_tails,
)
from loopcal.diagnose.fit_examination import examine_fit
from loopcal.estimate.identification import identify
from loopcal.estimate.losses import Huber
from loopcal.findings import Severity
from loopcal.results.serialization import to_json
from tests.diagnose.correlated_data import ROBOTS, draw_errors, make_rows, measure

CODE = "residuals.heavy-tailed"
N = 30


def draw_student(n, m, seed, degrees=3.0):
    """Return errors (n, m) of Student's t with unit variance."""
    drawn = np.random.default_rng([seed, 6]).standard_t(degrees, (n, m))
    return np.sqrt((degrees - 2.0) / degrees) * drawn


def fit_delta(errors, seed=0):
    """Return the fit of a delta to measurements with these errors, and the measurements."""
    _, data = measure("linear-delta", "component", errors, seed)
    return adjust_uncertainty(identify(ROBOTS["linear-delta"], data), data), data


@pytest.mark.slow
@pytest.mark.parametrize(("rows", "taken"), [(30, 18), (60, 20), (1400, 40)])
def test_normal_errors_of_few_correlated_or_many_residuals_have_the_stated_level(rows, taken):
    rng = np.random.default_rng(rows)
    basis = np.linalg.qr(rng.standard_normal((rows, taken)) ** 3)[0]  # uneven leverage
    count = 120 if rows < 1000 else 30
    p = np.array(
        [assess_tails(make_rows(basis, e)).p_value for e in rng.standard_normal((count, rows))]
    )
    # probabilities above 0.05 come from few draws, but are not biased
    assert kstest(p, "uniform").pvalue > 1e-3
    assert (p < 0.01).mean() < 0.035  # P(binomial(120, 0.01) > 4) = 0.8 %


@pytest.mark.slow
def test_students_errors_are_reported_with_what_to_do():
    found = [check_heavy_tails(*fit_delta(draw_student(N, 3, seed), seed)) for seed in range(10)]
    p = np.array([result.p_value for result in found])
    assert (p < LEVEL).mean() > 0.3
    assert np.array_equal(p < LEVEL, [bool(result.findings) for result in found])
    for result in found:
        for finding in result.findings:
            assert finding.code == CODE
            assert (finding.severity is Severity.WARNING) == (result.p_value < 1e-3)
            assert "Use a robust loss" in str(finding)
            assert result.median < result.expected
            assert f"{result.largest:.1f}" in str(finding)


def test_wrong_or_unequal_sigmas_and_drift_are_no_heavy_tails():
    unequal = 3.0 * draw_errors(N, 3, 1) * np.array([1.0, 2.0, 5.0])
    assert not check_heavy_tails(*fit_delta(unequal)).findings
    fit, data = fit_delta(draw_errors(N, 3, 2) + 12.0 * np.linspace(-0.5, 0.5, N)[:, None] ** 3)
    assert any(f.code.startswith("residuals.") for f in fit.findings)
    assert not check_heavy_tails(fit, data).findings


def test_gross_error_is_reported_as_an_outlier_and_not_as_heavy_tails():
    for seed in range(4):
        errors = draw_errors(N, 3, seed)
        errors[7] += 30.0 * np.array([0.6, -0.5, 0.6])
        fit, data = fit_delta(errors, seed)
        seen = examine_fit(fit, data)
        assert data.labels[7] in seen.outliers.names
        assert CODE not in [finding.code for finding in seen.findings]


def test_fits_with_a_loss_or_few_degrees_of_freedom_are_not_tested():
    _, data = measure("linear-delta", "component", draw_student(N, 3, 0), 0)
    robust = identify(ROBOTS["linear-delta"], data, loss=Huber())
    assert np.isnan(check_heavy_tails(robust, data).p_value)
    basis = np.linalg.qr(np.random.default_rng(0).standard_normal((20, 17)))[0]
    rows = make_rows(basis, np.ones(20))
    assert np.isnan(assess_tails(rows).p_value)


def test_examination_contains_the_test():
    fit, data = fit_delta(0.3 * draw_student(N, 3, 3), 3)
    seen = examine_fit(fit, data)
    assert seen.tails.rows > 0
    assert to_json(seen)["heavy_tails"]["rows"] == seen.tails.rows
