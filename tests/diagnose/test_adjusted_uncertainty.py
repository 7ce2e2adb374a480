# SPDX-License-Identifier: Apache-2.0
"""The uncertainty of a fit whose residuals are correlated, drift or depend on a session."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import toeplitz
from scipy.special import stdtrit
from scipy.stats import binom

import loopcal as lc
from loopcal.diagnose.adjusted_uncertainty import adjust_uncertainty
from loopcal.diagnose.residual_patterns import (
    RHO,
    SHARE,
    collect_residual_rows,
    estimate_correlated_errors,
)
from loopcal.estimate.fit_linearization import linearize_fit
from loopcal.estimate.identification import identify
from loopcal.estimate.losses import Huber
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import LeastSquares
from loopcal.estimate.residual_test import FALSE_ALARMS
from loopcal.findings import Severity
from loopcal.mechanism.sensitivity import differentiate_pose
from loopcal.mechanism.solutions import forward
from loopcal.mechanism.workspace import sample_workspace
from tests.diagnose.correlated_data import ROBOTS, draw_errors, measure

PATTERNS = {
    "residuals.correlated",
    "residuals.drift",
    "residuals.shared-errors",
    "residuals.trend",
    "residuals.sessions-differ",
    "residuals.depend-on-reading",
    "residuals.depend-on-temperature",
}


def fit_and_adjust(robot, kind, errors, seed, method=None, **context):
    """Return truth, the fit, and the adjusted fit."""
    truth, data = measure(robot, kind, errors, seed, **context)
    fit = identify(ROBOTS[robot], data, method)
    return truth, fit, adjust_uncertainty(fit, data)


def cover_positions(robot, fit, truth):
    """Return whether 95 % intervals (n, 3) of positions elsewhere contain the true errors."""
    q = sample_workspace(robot, 8, 99).solution.q
    estimated, true = forward(fit.robot, q), forward(robot.with_values(truth), q)
    solved = differentiate_pose(fit.robot, fit.robot.values[None], q[None], estimated.state)
    D = solved.parameters[0][:, 3:, fit.posterior.places]
    sd = np.sqrt(((D @ fit.posterior.root) ** 2).sum(axis=-1))
    degrees = np.minimum(fit.posterior.count_degrees(D[:, :, None, :]), 1e6)
    error = estimated.T[:, :3, 3] - true.T[:, :3, 3]
    return np.abs(error) <= stdtrit(degrees, 0.975) * sd


SIZES = [10, pytest.param(25, marks=pytest.mark.evidence)]
"""Machines; each has 24 intervals."""


@pytest.mark.evidence
@pytest.mark.parametrize("machines", SIZES)
@pytest.mark.parametrize(("correlation", "before"), [(0.6, 0.93), (0.9, 0.82)])
def test_poses_are_covered_where_errors_are_correlated(correlation, before, machines):
    robot, inside, adjusted, named = ROBOTS["linear-delta"], [], [], []
    for seed in range(machines):
        errors = draw_errors(20, 3, seed, correlation)
        truth, fit, result = fit_and_adjust("linear-delta", "component", errors, seed)
        inside.append(cover_positions(robot, fit, truth))
        adjusted.append(cover_positions(robot, result, truth))
        named.append(bool({f.code for f in result.findings} & PATTERNS))
        assert (result.standard_deviations >= fit.standard_deviations).all()
        assert (result.estimate == fit.estimate).all()
    assert np.mean(inside) < before
    assert np.mean(adjusted) > 0.93
    assert np.mean(named) >= (0.95 if correlation > 0.8 else 0.7)


@pytest.mark.evidence
def test_poses_are_covered_where_the_instrument_drifts():
    robot, inside, adjusted, named = ROBOTS["3-prs"], [], [], []
    ramp = np.linspace(-2.0, 2.0, 16)[:, None]
    for seed in range(25):
        errors = draw_errors(16, 6, seed) + ramp * np.random.default_rng(seed).normal(size=6)
        truth, fit, result = fit_and_adjust("3-prs", "pose", errors, seed)
        inside.append(cover_positions(robot, fit, truth))
        adjusted.append(cover_positions(robot, result, truth))
        named.append("residuals.trend" in {f.code for f in result.findings})
    assert np.mean(named) >= 0.95
    assert np.mean(adjusted) > max(np.mean(inside), 0.93)


@pytest.mark.parametrize("label", ["session", "block"])
def test_poses_are_covered_where_sessions_have_offsets_whose_mean_no_residual_shows(label):
    robot, covered, pinned, group = ROBOTS["linear-delta"], [], [], np.arange(24) // 6
    for seed in range(6):
        offsets = np.random.default_rng([seed, 7]).normal(0.0, 2.0, (4, 3))
        errors = draw_errors(24, 3, seed) + offsets[group]
        session = np.array([f"s{i}" for i in group]) if label == "session" else None
        truth, data = measure("linear-delta", "component", errors, seed, session)
        if label == "block":
            data = replace(data, block=group)
        fit = identify(robot, data)
        adjusted = adjust_uncertainty(fit, data)
        (found,) = (f for f in adjusted.findings if f.code == "residuals.sessions-differ")
        assert found.data["unit"] == label
        covered += list(cover_positions(robot, adjusted, truth).ravel())
        pinned += list(cover_positions(robot, fit, truth).ravel())
    # 144 intervals of 6 machines; those of one machine err together
    assert np.mean(covered) > 0.93
    assert np.mean(pinned) < 0.85


def test_the_covariance_is_that_of_a_dense_restricted_likelihood():
    errors = draw_errors(14, 3, 3, 0.7)
    _, data = measure("linear-delta", "component", errors, 3)
    fit = identify(ROBOTS["linear-delta"], data)
    rows = collect_residual_rows(linearize_fit(fit, data))
    assert rows is not None
    result = estimate_correlated_errors(rows, 8.0)
    # the likelihood of the rows A r that no parameter changes, A from the full QR of the basis
    basis, gain = rows.basis.toarray(), rows.gain.toarray()
    A = np.linalg.qr(basis, mode="complete")[0][:, basis.shape[1] :].T
    y, logs, parts = A @ rows.residual, [], []
    for rho in RHO:
        for share in SHARE if rho else (1.0,):
            one = share * toeplitz(rho ** np.arange(14.0)) + (1.0 - share) * np.eye(14)
            K = np.kron(np.eye(3), one)
            inside = A @ K @ A.T
            total = 8.0 + y @ np.linalg.solve(inside, y)
            nu = len(y) + 8.0
            logs.append(-0.5 * (np.linalg.slogdet(inside)[1] + nu * np.log(total)))
            parts.append(total / nu * gain.T @ K @ gain)
    weight = np.exp(np.array(logs) - max(logs))
    expected = np.tensordot(weight / weight.sum(), np.array(parts), 1)
    assert np.allclose(result.covariance, expected, rtol=1e-6, atol=1e-9 * expected.max())


def test_exact_sigmas_are_the_limit_of_many_degrees_of_freedom():
    _, data = measure("linear-delta", "component", draw_errors(14, 3, 3, 0.7), 3)
    fit = identify(ROBOTS["linear-delta"], data)
    rows = collect_residual_rows(linearize_fit(fit, data))
    assert rows is not None
    exact = estimate_correlated_errors(rows, np.inf)
    limit = estimate_correlated_errors(rows, 1e8)
    assert np.allclose(exact.covariance, limit.covariance, rtol=1e-5, atol=0.0)
    assert np.isclose(exact.sigma, 1.0, rtol=1e-12)  # a weighted mean of ones
    assert exact.degrees == pytest.approx(limit.degrees, rel=1e-5)


@pytest.mark.parametrize("size", [0.5, 0.7])
def test_a_sigma_that_is_too_large_does_not_widen_the_uncertainty(size):
    ratios = []
    for seed in range(9):
        errors = size * draw_errors(25, 3, seed)
        _, _, result = fit_and_adjust("linear-delta", "component", errors, seed)
        if result.residual_test.exact_p_value > 0.999:
            ratios.append(result.residual_test.sigma_scale)
            assert not PATTERNS & {finding.code for finding in result.findings[-1:]}
    assert len(ratios) >= 5
    # standard deviation of a ratio with 63 degrees of freedom: 9 %, of small ones less
    assert np.mean(ratios) == pytest.approx(size, rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("sets", [10, pytest.param(30, marks=pytest.mark.evidence)])
def test_clean_data_change_nothing(sets):
    changed = 0
    for seed in range(sets):
        errors = draw_errors(12, 3, seed)
        _, fit, result = fit_and_adjust("linear-delta", "component", errors, seed)
        changed += len(result.posterior.parts) > len(fit.posterior.parts)
    # all tests together, slow errors of the poses among them
    assert changed <= binom.isf(1e-3, sets, sum(FALSE_ALARMS.values()))


def test_correlated_residuals_do_not_mean_that_sigma_is_too_large():
    codes = []
    for seed in range(6):
        errors = draw_errors(25, 3, seed, 0.95)
        _, fit, result = fit_and_adjust("linear-delta", "component", errors, seed, LeastSquares())
        before = {f.code for f in fit.findings}
        after = {f.code for f in result.findings}
        if after & PATTERNS:
            assert "noise.residuals-too-small" not in after
        if "noise.residuals-too-small" in before:
            shown = after & PATTERNS
            assert ("noise.not-independent" in after) == bool(shown)
        codes.append("noise.not-independent" in after)
    assert any(codes)


def test_a_calibration_reports_and_uses_the_larger_uncertainty():
    errors = draw_errors(24, 3, 8, 0.95)
    _, data = measure("linear-delta", "component", errors, 8)
    report = lc.calibrate(ROBOTS["linear-delta"], data)
    plain = identify(ROBOTS["linear-delta"], data)
    assert {f.code for f in report.findings} & PATTERNS
    assert (report.identification.standard_deviations > plain.standard_deviations).any()


@pytest.mark.parametrize("case", ["loss", "no intervals", "not converged"])
def test_fits_without_intervals_are_returned_as_they_are(case):
    options = FitOptions()
    n = 20
    if case == "loss":
        options = FitOptions(loss=Huber())
    if case == "no intervals":
        options, n = FitOptions(noise="estimated", method=LeastSquares()), 4
    if case == "not converged":
        options = FitOptions(control=replace(options.control, iterations=1))
    _, data = measure("linear-delta", "component", draw_errors(n, 3, 1, 0.95), 1)
    fit = identify(ROBOTS["linear-delta"], data, options=options)
    assert adjust_uncertainty(fit, data) is fit


def test_data_of_another_fit_are_refused():
    _, data = measure("linear-delta", "component", draw_errors(12, 3, 1), 1)
    _, other = measure("linear-delta", "component", draw_errors(13, 3, 1), 1)
    fit = identify(ROBOTS["linear-delta"], data)
    with pytest.raises(lc.DataError):
        adjust_uncertainty(fit, other)


@pytest.mark.parametrize(("drift", "severity"), [(2.4, Severity.INFO), (4.0, Severity.WARNING)])
def test_only_what_independent_errors_hardly_ever_show_is_a_warning(drift, severity):
    """A drift of z over the series, in sigmas: a weak one is allowed for, but raises no doubt."""
    errors = draw_errors(40, 3, 5)
    errors[:, 2] += drift * np.linspace(-0.5, 0.5, 40)
    _, _, after = fit_and_adjust("linear-delta", "component", errors, 5)
    found = {f.code: f.severity for f in after.findings if f.code in PATTERNS}
    assert found == {"residuals.trend": severity}


def test_large_residuals_that_drift_do_not_ask_for_another_sigma():
    ramp = np.linspace(-12.0, 12.0, 24)[:, None] * np.array([0.0, 0.0, 1.0])
    _, data = measure("linear-delta", "component", draw_errors(24, 3, 2) + ramp, 2)
    report = lc.calibrate(ROBOTS["linear-delta"], data)
    assert report.failures[0].code == "noise.residuals-too-large"
    assert report.next_step.code == "workflow.next-check-residuals"


@pytest.mark.parametrize(
    ("correlation", "severity"), [(0.3, Severity.WARNING), (0.9, Severity.INFO)]
)
def test_a_weak_dependence_does_not_silence_residuals_that_are_too_small(correlation, severity):
    errors = 0.3 * draw_errors(24, 3, 4, correlation)
    _, before, after = fit_and_adjust("linear-delta", "component", errors, 4)
    assert "noise.residuals-too-small" in {f.code for f in before.findings}
    found = {f.code: f.severity for f in after.findings if f.code.startswith("noise.")}
    assert found == {"noise.not-independent": severity}


def test_a_fit_with_a_loss_says_which_tests_are_not_made():
    """It does not say that the noise is not tested beside a finding that it is contradicted."""
    ramp = np.linspace(-4.0, 4.0, 40)[:, None]
    _, data = measure("linear-delta", "component", 2.0 * (draw_errors(40, 3, 1) + ramp), 1)
    fit = identify(ROBOTS["linear-delta"], data, options=FitOptions(loss=Huber()))
    adjusted = adjust_uncertainty(fit, data)
    texts = {f.code: str(f) for f in adjusted.findings}
    assert "noise.loss-contradicted" in texts
    assert not PATTERNS & set(texts)
    assert "omits the chi-square test" in texts["noise.weighted"]
    assert "noise is not tested" not in texts["noise.weighted"]


@pytest.mark.parametrize("kind", ["component", "tracker"])
def test_runs_of_many_poses_stand_for_all_where_causes_are_sought(monkeypatch, kind) -> None:
    from loopcal.diagnose import residual_patterns

    errors = draw_errors(600, 3 if kind == "component" else 9, 4, 0.8)
    _, data = measure("linear-delta", kind, errors, 4)
    fit = identify(ROBOTS["linear-delta"], data)
    whole = adjust_uncertainty(fit, data)
    monkeypatch.setattr(residual_patterns, "EXAMINED", data.n_rows // 2)
    monkeypatch.setattr(residual_patterns, "MOST_POSES", 6)  # runs of 50 poses
    part = adjust_uncertainty(fit, data)
    found = {f.code: f.data for f in part.findings}
    assert found["residuals.examined-part"] == {"count": 300 - 49, "rest": 349}
    ratios = [
        next(f.data["ratio"] for f in each.findings if f.code == "residuals.correlated")
        for each in (whole, part)
    ]
    assert ratios[0] > 1.1
    assert abs(ratios[1] - ratios[0]) < 0.2 * (ratios[0] - 1.0)  # of seven seeds, one had 0.39
    assert "residuals.examined-part" not in {f.code for f in whole.findings}
