# SPDX-License-Identifier: Apache-2.0
"""The stated tolerances against the data: conflict named, the default freed from it, nothing
invented held back.
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
    folded,
    hexapod,
    hexapod_data,
    hexapod_poses,
    tracker,
    with_tolerance,
)
from tests.findings.reported import one_of, refused

WEAK = tracker(20e-6, 100e-6)  # a prior of 35 um matters to an instrument this poor


def trials(t: int, seed: int = 3):
    robot = hexapod()
    return robot, simulate_trials(
        robot, sample_truth(robot, t, seed), hexapod_poses(20), WEAK, seed
    )


def test_the_statistic_is_the_priors_part_of_the_sum_of_squares():
    rng = np.random.default_rng(0)
    A, b = rng.standard_normal((9, 3)) * [30.0, 1.0, 0.1], rng.standard_normal(9)
    d = decompose(folded(np.column_stack([A, b])[None]), np.array([9]))
    z = d.deviation(d.solution(np.ones((1, 3))))[0]
    w = np.linalg.eigvalsh(
        A.T @ A @ np.linalg.inv(np.eye(3) + A.T @ A)
    )  # z = A'(I + AA')^-1 b has these variances
    statistic, degrees = compute_prior_statistic(d)
    assert degrees[0] == pytest.approx(w.sum() ** 2 / (w**2).sum(), rel=1e-12)
    assert statistic[0] == pytest.approx(z @ z * w.sum() / (w**2).sum(), rel=1e-12)


def test_well_seen_it_is_the_part_within_the_range_of_the_joint_form_of_data_and_prior():
    rng = np.random.default_rng(0)
    A = 1e4 * rng.standard_normal((9, 3))
    b = A @ rng.standard_normal(3) + rng.standard_normal(9)
    d = decompose(folded(np.column_stack([A, b])[None]), np.array([9]))
    statistic, degrees = compute_prior_statistic(d)
    whole = b @ np.linalg.solve(np.eye(9) + A @ A.T, b)
    assert statistic[0] == pytest.approx(whole - d.outside[0], rel=1e-6)
    assert degrees[0] == pytest.approx(3.0)


def test_true_tolerances_are_hardly_ever_doubted():
    robot, measured = trials(300)
    found = identify_trials(robot, measured)
    held = identify_trials(robot, measured, MAP())
    # at the level 1e-3 three of 300 are allowed: P(binomial(300, 1e-3) > 3) = 3e-4
    widened = (found.penalty != held.penalty).any(axis=1).sum()
    assert widened <= 3


@pytest.mark.parametrize("narrow", [3.0, 10.0])
def test_too_narrow_a_prior_is_named_and_the_default_is_not_held_by_it(narrow):
    robot, measured = trials(40)
    believed = with_tolerance(robot, 0.035e-3 / narrow)
    named = [identify(believed, measured.trial(i)).prior_conflict for i in range(5)]
    for conflict in named:
        assert conflict is not None
        assert conflict.conflict
        assert conflict.inflation > 1.5
        assert conflict.finding.code == "prior.tolerances-inflated"
    held = identify(believed, measured.trial(0), MAP())
    narrow_prior = one_of(held.findings, "prior.tolerances-too-narrow")
    assert narrow_prior.data["ratio"] > 1.5

    def error(method):
        found = identify_trials(believed, measured, method).values - measured.truth
        return np.median(np.sqrt(np.mean(found**2, axis=1)))

    assert error(None) <= 1.2 * error(LeastSquares())
    assert error(None) < error(MAP())


def test_a_parameter_without_a_tolerance_is_not_held_back_and_the_others_are():
    robot, data = hexapod(), hexapod_data(20, instrument=WEAK)
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


def test_without_any_tolerance_the_default_is_least_squares():
    data = hexapod_data(20)
    a, b = identify(zoo.hexapod(), data), identify(zoo.hexapod(), data, LeastSquares())
    np.testing.assert_allclose(a.estimate, b.estimate, rtol=0, atol=1e-14)
    np.testing.assert_allclose(a.standard_deviations, b.standard_deviations, rtol=1e-9)
    with refused("fit.too-few-equations", unknowns=42, has_prior=False):
        identify(zoo.hexapod(), data.take(np.arange(5)))


def test_an_estimated_sigma_weighs_the_prior_as_the_true_one_would():
    robot = hexapod()
    measured = simulate_trials(robot, sample_truth(robot, 1, 5), hexapod_poses(60), WEAK, 5).trial(
        0
    )
    claimed = measured.observations[0]
    sharp = replace(
        measured, observations=(replace(claimed, covariance=claimed.covariance / 25.0),)
    )
    expected, found = (
        identify(robot, measured),
        identify(robot, sharp, options=FitOptions(noise="estimated")),
    )
    assert found.residual_test.sigma_scale == pytest.approx(5.0, rel=0.15)
    np.testing.assert_allclose(found.standard_deviations, expected.standard_deviations, rtol=0.15)
    assert np.abs((found.estimate - expected.estimate) / expected.standard_deviations).max() < 0.3


def test_a_sigma_that_is_too_small_does_not_pass_for_a_narrow_prior():
    robot, measured = trials(1)
    claimed = measured.trial(0).observations[0]
    sharp = replace(
        measured.trial(0), observations=(replace(claimed, covariance=claimed.covariance / 25.0),)
    )
    fit = identify(robot, sharp)
    assert fit.prior_conflict is not None
    assert not fit.prior_conflict.conflict
    assert fit.residual_test.finding.code == "noise.residuals-too-large"


def test_the_factor_by_rule_is_never_below_one():
    robot, measured = trials(10)
    wide = with_tolerance(robot, 0.35e-3)
    assert np.array_equal(
        identify_trials(wide, measured).values, identify_trials(wide, measured, MAP()).values
    )
    assert MAP(InflatedTolerances()) == MAP(InflatedTolerances())
