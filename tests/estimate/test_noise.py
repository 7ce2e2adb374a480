# SPDX-License-Identifier: Apache-2.0
"""The noise: tested on what no parameter explains, and partly known; intervals by Student's t."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2
from scipy.stats import f as f_distribution
from scipy.stats import t as student

import loopcal as lc
from loopcal.apply.accuracy import pose_uncertainty
from loopcal.errors import EstimationError
from loopcal.estimate.fit_linearization import linearize_fit
from loopcal.estimate.identification import identify
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import MAP, LeastSquares, Ridge, TruncatedSVD
from loopcal.estimate.posterior import combine_degrees
from loopcal.estimate.residual_test import count_sigma_degrees, coverage_factor, run_residual_test
from loopcal.measure.simulation import sample_truth, simulate
from loopcal.mechanism.solutions import forward, inverse
from loopcal.numerics.decomposition import decompose
from tests import zoo
from tests.estimate.problems import UM, hexapod, hexapod_data, hexapod_poses, tracker


def scale_sigma(data, factor):
    """Return measurements whose stated sigmas are multiplied by a factor."""
    (rows,) = data.observations
    return replace(data, observations=(replace(rows, covariance=rows.covariance * factor**2),))


@pytest.mark.parametrize("method", [MAP(), Ridge(1.0), Ridge(10.0), TruncatedSVD(20)], ids=repr)
def test_a_wrong_prior_is_not_reported_as_noise(method):
    """True errors of ten tolerances: the penalty leaves large residuals that are no noise."""
    robot = hexapod()
    nominal = robot.parameters.nominal
    truth = robot.with_values(nominal + 10.0 * (sample_truth(robot, 1, 3)[0] - nominal))
    data = simulate(truth, hexapod_poses(15), tracker(20 * UM, 1e-4), 3)
    fit = identify(robot, data, method)
    test = fit.residual_test
    squares = sum((r.whitened**2).sum() for r in fit.residuals)
    assert squares > 1.3 * test.chi_square  # the residuals contain the penalty
    assert test.degrees == 90 - 42
    assert test.finding.code == "noise.consistent"
    assert not test.failed


def test_a_wrong_sigma_is_reported_with_every_method():
    for method in (LeastSquares(), MAP(), Ridge(3.0), TruncatedSVD(30)):
        codes = [
            identify(hexapod(), scale_sigma(hexapod_data(15), factor), method).residual_test.finding
            for factor in (0.25, 2.0)
        ]
        assert [f.code for f in codes] == ["noise.residuals-too-large", "noise.residuals-too-small"]
        assert all(f.severity.value == "warning" for f in codes)


def test_stated_sigmas_count_as_eight_degrees_of_freedom():
    data = hexapod_data(10)
    fit = identify(hexapod(), data, LeastSquares())
    exact = identify(hexapod(), data, options=FitOptions(LeastSquares(), sigma_uncertainty=0.0))
    test = fit.residual_test
    assert (test.degrees, test.noise_degrees) == (18.0, 26.0)
    square = (8.0 + test.chi_square) / 26.0
    assert test.sigma_scale**2 == pytest.approx(square)
    assert exact.residual_test.sigma_scale == 1.0
    np.testing.assert_allclose(fit.estimate, exact.estimate, rtol=0, atol=0)
    np.testing.assert_allclose(fit.covariance, square * exact.covariance, rtol=1e-9)
    np.testing.assert_allclose(fit.interval(), student.ppf(0.975, 26) * fit.standard_deviations)
    np.testing.assert_allclose(exact.interval(), 1.959964 * exact.standard_deviations, rtol=1e-6)
    half = identify(hexapod(), data, options=FitOptions(LeastSquares(), sigma_uncertainty=0.5))
    assert half.residual_test.noise_degrees == 20.0


@pytest.mark.parametrize(
    ("noise", "u", "degrees"),
    [("given", 0.25, 8.0), ("given", 0.1, 50.0), ("given", 0.0, np.inf), ("given", 1e-300, np.inf),
     ("estimated", 0.25, 0.0),
     ("assumed", 0.25, 2.0), ("assumed", 0.0, np.inf)],
)  # fmt: skip
def test_all_checks_count_stated_sigmas_alike(noise, u, degrees):
    """The noise scale, correlated errors and the model discrepancy use one definition."""
    assert count_sigma_degrees(noise, u) == pytest.approx(degrees)
    rng = np.random.default_rng(0)
    rows = np.column_stack([rng.standard_normal((30, 4)), rng.standard_normal(30)])
    factor = np.asarray(np.linalg.qr(rows, mode="r"))[None]
    d = decompose(factor, np.array([30.0]))
    test = run_residual_test(d, np.zeros((1, 4)), noise, u)
    assert test.sigma_degrees == pytest.approx(degrees)
    wrong = factor.copy()
    wrong[..., -1] *= 10.0
    test = run_residual_test(decompose(wrong, np.array([30.0])), np.zeros((1, 4)), noise, u)
    assert test.sigma_degrees == 0.0  # the residuals contradict the stated sigmas


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_contradicted_sigmas_are_replaced_by_those_of_the_residuals(factor):
    test = identify(hexapod(), scale_sigma(hexapod_data(15), factor), LeastSquares()).residual_test
    assert test.noise_degrees == test.degrees == 48.0
    assert test.sigma_scale**2 == pytest.approx(test.chi_square / 48.0)


@pytest.mark.parametrize(("rows", "is_replaced"), [(6, False), (9, True)])
def test_few_residuals_that_are_small_by_chance_replace_no_sigma(rows, is_replaced):
    """Of two degrees of freedom, one fit in 2000 leaves 2 % of the noise: no instrument is that."""
    A = np.random.default_rng(3).normal(size=(rows, 4))
    left = np.linalg.svd(A)[0][:, 4:] @ np.full(rows - 4, 0.02)
    factor = np.asarray(np.linalg.qr(np.column_stack([A, left]), mode="r"))[None]
    d = decompose(factor, np.array([float(rows)]))
    test = run_residual_test(d, np.zeros((1, 4)), "given")
    assert test.degrees == rows - 4
    assert (test.sigma_scale < 0.1) == is_replaced


def test_computed_values_without_noise_keep_the_stated_sigma():
    """Residuals of exactly zero would state no uncertainty, and divide by zero."""
    data = hexapod_data(15)
    fit = identify(hexapod(), scale_sigma(data, 1e4), LeastSquares())
    assert fit.residual_test.sigma_scale == 1.0
    assert "Intervals assume 1 times" in str(fit.residual_test.finding)


@pytest.mark.parametrize("scale", [0.5, 1.0, 2.0])
def test_variance_of_map_is_the_sandwich(scale):
    """B (s^2 A'A + 1) B, and not s^2 B, for noise that is s times the stated one."""
    data = scale_sigma(hexapod_data(15, instrument=tracker(20 * UM, 1e-4)), scale)
    fit = identify(hexapod(), data, MAP())
    triangle = linearize_fit(fit, data).linearization.factor[0, :-1, :-1]
    A = triangle.T @ triangle
    B = np.linalg.inv(A + np.eye(len(A)))
    square = fit.residual_test.sigma_scale**2
    assert square == pytest.approx(scale**-2, rel=0.6)  # 48 degrees of freedom: 20 %, 3 sigmas
    expected = B @ (square * A + np.eye(len(A))) @ B
    found = fit.covariance / fit.tolerance / fit.tolerance[:, None]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6 * np.diag(expected).max())
    (noise,) = fit.posterior.parts
    root = noise.root / fit.tolerance[:, None]
    np.testing.assert_allclose(root @ root.T, square * B @ A @ B, rtol=0, atol=1e-6)


@pytest.mark.parametrize("lam", [pytest.param(3.0, marks=pytest.mark.evidence), 10.0])
def test_intervals_of_a_ridge_contain_the_truth(lam):
    """The bias is that of the stated spreads, not of 1 / lam: coverage was 51 to 84 %."""
    robot, held = lc.load_robot("linear-delta"), []
    sensor = lc.Sensor(lc.Component(("x", "y", "z")), lc.Gaussian(np.full(3, 100 * UM)))
    for seed in range(20):
        truth = robot.with_values(sample_truth(robot, 1, seed)[0])
        commanded = lc.sample_workspace(robot, 8, seed).coordinates
        data = simulate(truth, commanded, lc.Instrument((sensor,)), seed)
        fit = identify(robot, data, Ridge(lam))
        off = np.abs(fit.estimate - truth.values[fit.free_parameters.places])
        held.append((off <= fit.interval()).mean())
    assert np.mean(held) == pytest.approx(0.955, abs=0.04)


def test_a_ridge_without_stated_tolerances_has_no_intervals():
    data = hexapod_data(15)
    unequal = Ridge(tuple(float(i) for i in range(1, 43)))
    for robot, method, lacking in ((zoo.hexapod(), Ridge(1.0), 42), (hexapod(), unequal, 0)):
        fit = identify(robot, data, method)
        assert np.isnan(fit.standard_deviations).all()
        assert not fit.residual_test.intervals
        (finding,) = (f for f in fit.findings if f.code == "fit.ridge-without-intervals")
        assert len(finding.data["names"]) == lacking
    # where all that is penalized has a spread, there are intervals
    assert np.isfinite(identify(hexapod(), data, Ridge(1.0)).standard_deviations).all()
    free = identify(zoo.hexapod(), data, Ridge((0.0,) * 42))
    assert np.isfinite(free.standard_deviations).all()


def test_poses_have_the_coverage_of_six_degrees_of_freedom():
    """U of estimated noise covered 89 to 91 %: k was 2 whatever the degrees of freedom."""
    robot, held, lengths = hexapod(), [], []
    poses, result = hexapod_poses(6, seed=77), None
    for seed in range(30):
        truth = robot.with_values(sample_truth(robot, 1, seed)[0])
        data = simulate(truth, hexapod_poses(8, seed), tracker(), seed)
        options = FitOptions(LeastSquares(), noise="estimated")
        fit = identify(robot, data, options=options)
        assert fit.residual_test.degrees == 6
        solution = inverse(fit.robot, poses)
        result = pose_uncertainty(fit, solution, frame="base", point="platform")
        off = forward(truth, solution.q).T[:, :3, 3] - solution.T[:, :3, 3]
        held.append((np.abs(off) <= result.expanded[:, 3:]).mean())
        lengths.append((np.linalg.norm(off, axis=1) <= result.expanded_position).mean())
        np.testing.assert_allclose(result.degrees.position, 6.0)
    assert result is not None
    np.testing.assert_allclose(result.coverage_factor, student.ppf(0.975, 6), rtol=1e-5)
    for shares in (held, lengths):
        assert np.mean(shares) > 0.925
        assert np.mean(shares) < 0.98


def test_degrees_of_freedom_follow_monte_carlo():
    """t with Welch-Satterthwaite degrees covers a mean of a known and of an estimated part."""
    rng = np.random.default_rng(2)
    for share in (0.2, 0.5, 0.9):
        s2 = np.asarray(chi2.rvs(6, size=40000, random_state=rng)) / 6.0
        off = rng.standard_normal(40000)  # variance 1: share of the noise, the rest of the prior
        estimated = share * s2
        total = estimated + (1.0 - share)
        nu = combine_degrees(total, [(estimated, 6.0)])
        covered = np.abs(off) <= coverage_factor(nu) * np.sqrt(total)
        assert covered.mean() == pytest.approx(0.95, abs=0.012)


def test_wrong_sigma_uncertainties_are_refused():
    for wrong in (-0.1, 1.5):
        with pytest.raises(EstimationError, match="sigma_uncertainty is"):
            FitOptions(sigma_uncertainty=wrong)


@pytest.mark.parametrize(
    ("times", "u", "failed", "code"),
    [
        (1.25, 0.0, True, "noise.residuals-too-large"),
        (1.25, 0.25, False, "noise.consistent"),
        (2.0, 0.25, False, "noise.doubtful"),
        (2.0, 0.05, True, "noise.residuals-too-large"),
        (4.0, 0.25, True, "noise.residuals-too-large"),
        (0.9, 0.25, False, "noise.consistent"),
        (0.4, 0.25, False, "noise.residuals-too-small"),
    ],
)
def test_the_gate_of_residuals_allows_for_the_stated_uncertainty_of_sigma(times, u, failed, code):
    """Residuals per degree of freedom have the distribution F(m - rank, 1 / (2 u^2))."""
    data = scale_sigma(hexapod_data(40), 1.0 / times)
    test = identify(hexapod(), data, options=FitOptions(sigma_uncertainty=u)).residual_test
    assert (test.failed, test.finding.code) == (failed, code)
    if u:
        expected = f_distribution.sf(test.chi_square / test.degrees, test.degrees, 0.5 / u**2)
        assert test.p_value == pytest.approx(expected, rel=1e-9)
    assert test.exact_p_value == pytest.approx(chi2.sf(test.chi_square, test.degrees))
