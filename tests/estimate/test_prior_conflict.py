# SPDX-License-Identifier: Apache-2.0
"""Stated tolerances that contradict the data: the conflict is reported, and the default method
inflates them.
"""

from dataclasses import replace

import numpy as np
import pytest

from loopcal.estimate import (
    MAP,
    FitOptions,
    InflatedTolerances,
    LeastSquares,
    identify,
    identify_trials,
)
from loopcal.estimate.methods.prior_conflict import compute_prior_statistic
from loopcal.measure import sample_truth, simulate_trials
from loopcal.numerics.decomposition import decompose
from loopcal.parameters import ParameterTable
from tests import zoo
from tests.estimate.problems import (
    fold_rows,
    hexapod,
    hexapod_data,
    hexapod_poses,
    tracker,
    with_tolerance,
)
from tests.findings.expectations import expect_refusal, get_finding

COARSE_TRACKER = tracker(20e-6, 100e-6)  # a prior of 35 um matters to an instrument this poor


def simulate_hexapods(t: int, seed: int = 3):
    robot = hexapod()
    return robot, simulate_trials(
        robot, sample_truth(robot, t, seed), hexapod_poses(20), COARSE_TRACKER, seed
    )


def test_prior_statistic_is_the_share_of_the_prior_in_the_sum_of_squares():
    rng = np.random.default_rng(0)
    A, b = rng.standard_normal((9, 3)) * [30.0, 1.0, 0.1], rng.standard_normal(9)
    d = decompose(fold_rows(np.column_stack([A, b])[None]), np.array([9]))
    z = d.deviation(d.solution(np.ones((1, 3))))[0]
    w = np.linalg.eigvalsh(
        A.T @ A @ np.linalg.inv(np.eye(3) + A.T @ A)
    )  # z = A'(I + AA')^-1 b has these variances
    statistic, degrees = compute_prior_statistic(d)
    assert degrees[0] == pytest.approx(w.sum() ** 2 / (w**2).sum(), rel=1e-12)
    assert statistic[0] == pytest.approx(z @ z * w.sum() / (w**2).sum(), rel=1e-12)


def test_prior_statistic_of_precise_data_equals_the_joint_quadratic_form():
    rng = np.random.default_rng(0)
    A = 1e4 * rng.standard_normal((9, 3))
    b = A @ rng.standard_normal(3) + rng.standard_normal(9)
    d = decompose(fold_rows(np.column_stack([A, b])[None]), np.array([9]))
    statistic, degrees = compute_prior_statistic(d)
    whole = b @ np.linalg.solve(np.eye(9) + A @ A.T, b)
    assert statistic[0] == pytest.approx(whole - d.outside[0], rel=1e-6)
    assert degrees[0] == pytest.approx(3.0)


def test_correct_tolerances_are_rarely_inflated():
    robot, measured = simulate_hexapods(300)
    result = identify_trials(robot, measured)
    held = identify_trials(robot, measured, MAP())
    # at the level 1e-3 three of 300 are allowed: P(binomial(300, 1e-3) > 3) = 3e-4
    widened = (result.penalty != held.penalty).any(axis=1).sum()
    assert widened <= 3


@pytest.mark.parametrize("narrow", [3.0, 10.0])
def test_narrow_tolerances_are_reported_and_inflated_by_the_default_method(narrow):
    robot, measured = simulate_hexapods(40)
    believed = with_tolerance(robot, 0.035e-3 / narrow)
    named = [identify(believed, measured.trial(i)).prior_conflict for i in range(5)]
    for conflict in named:
        assert conflict is not None
        assert conflict.conflict
        assert conflict.inflation > 1.5
        assert conflict.finding.code == "prior.tolerances-inflated"
    held = identify(believed, measured.trial(0), MAP())
    narrow_prior = get_finding(held.findings, "prior.tolerances-too-narrow")
    assert narrow_prior.data["ratio"] > 1.5

    def error(method):
        result = identify_trials(believed, measured, method).values - measured.truth
        return np.median(np.sqrt(np.mean(result**2, axis=1)))

    assert error(None) <= 1.2 * error(LeastSquares())
    assert error(None) < error(MAP())


def test_parameters_without_a_tolerance_are_unpenalized():
    robot, data = hexapod(), hexapod_data(20, instrument=COARSE_TRACKER)
    entries = tuple(
        replace(p, tolerance=None if "length" in p.name else p.tolerance)
        for p in robot.parameters.entries
    )
    mixed = replace(robot, parameters=ParameterTable(entries))
    fit = identify(mixed, data, MAP())
    lengths = np.array(["length" in name for name in fit.names])
    # the same problem with a prior so wide that it holds nothing
    wide = tuple(
        replace(p, tolerance=1e3 * fit.tolerance[0] if "length" in p.name else p.tolerance)
        for p in entries
    )
    expected = identify(replace(robot, parameters=ParameterTable(wide)), data, MAP())
    np.testing.assert_allclose(fit.estimate, expected.estimate, rtol=0, atol=1e-9)
    np.testing.assert_allclose(fit.standard_deviations, expected.standard_deviations, rtol=1e-4)
    assert (fit.standard_deviations[~lengths] < 0.035e-3).all()
    assert fit.rank == 42
    np.testing.assert_allclose(
        fit.spectrum.singular_values,
        identify(mixed, data, LeastSquares()).spectrum.singular_values,
        rtol=1e-2,
    )


def test_default_method_without_tolerances_is_least_squares():
    data = hexapod_data(20)
    a, b = identify(zoo.hexapod(), data), identify(zoo.hexapod(), data, LeastSquares())
    np.testing.assert_allclose(a.estimate, b.estimate, rtol=0, atol=1e-14)
    np.testing.assert_allclose(a.standard_deviations, b.standard_deviations, rtol=1e-9)
    with expect_refusal("fit.too-few-equations", unknowns=42, has_prior=False):
        identify(zoo.hexapod(), data.take(np.arange(5)))


def test_estimated_sigma_weights_the_prior_like_the_true_sigma():
    robot = hexapod()
    measured = simulate_trials(
        robot, sample_truth(robot, 1, 5), hexapod_poses(60), COARSE_TRACKER, 5
    ).trial(0)
    claimed = measured.observations[0]
    sharp = replace(
        measured, observations=(replace(claimed, covariance=claimed.covariance / 25.0),)
    )
    expected, result = (
        identify(robot, measured),
        identify(robot, sharp, options=FitOptions(noise="estimated")),
    )
    assert result.residual_test.sigma_scale == pytest.approx(5.0, rel=0.15)
    np.testing.assert_allclose(result.standard_deviations, expected.standard_deviations, rtol=0.15)
    assert np.abs((result.estimate - expected.estimate) / expected.standard_deviations).max() < 0.3


def test_too_small_sigma_is_not_reported_as_narrow_tolerances():
    robot, measured = simulate_hexapods(1)
    claimed = measured.trial(0).observations[0]
    sharp = replace(
        measured.trial(0), observations=(replace(claimed, covariance=claimed.covariance / 25.0),)
    )
    fit = identify(robot, sharp)
    assert fit.prior_conflict is not None
    assert not fit.prior_conflict.conflict
    assert fit.residual_test.finding.code == "noise.residuals-too-large"


def test_inflation_factor_is_at_least_one():
    robot, measured = simulate_hexapods(10)
    wide = with_tolerance(robot, 0.35e-3)
    assert np.array_equal(
        identify_trials(wide, measured).values, identify_trials(wide, measured, MAP()).values
    )
    assert MAP(InflatedTolerances()) == MAP(InflatedTolerances())
