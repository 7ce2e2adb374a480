# SPDX-License-Identifier: Apache-2.0
"""An earlier calibration as prior: equal to a joint fit, and changes are detected."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from loopcal.errors import EstimationError
from loopcal.estimate.identification import identify
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import LeastSquares
from loopcal.estimate.posterior import posterior_from_arrays
from loopcal.estimate.prior import limb_parameters, prior_from
from loopcal.estimate.recalibration import recalibrate
from loopcal.measure.simulation import simulate
from loopcal.parameters import ParameterTable
from tests import zoo
from tests.estimate.problems import five_dof, hexapod, hexapod_data, hexapod_poses, tracker
from tests.findings.expectations import expect_refusal

LEG3 = slice(14, 21)
EXACT = FitOptions(method=LeastSquares(), sigma_uncertainty=0.0)
"""Options that take the stated sigmas as exact: the residuals do not change them."""


def join_measurements(a, b):
    """Join two sets of measurements."""
    rows = replace(b.observations[0], rows=b.observations[0].rows + a.n_poses)
    return replace(
        a,
        readings=np.vstack([a.readings, b.readings]),
        observations=(*a.observations, rows),
        block=np.arange(a.n_poses + b.n_poses),
        is_held_out=np.zeros(a.n_poses + b.n_poses, dtype=bool),
        labels=tuple(str(i) for i in range(a.n_poses + b.n_poses)),
    )


def test_sequential_fits_with_a_prior_equal_the_joint_fit():
    a, b = hexapod_data(20, seed=1), hexapod_data(15, seed=2)
    first = identify(hexapod(), a, options=EXACT)
    then = identify(hexapod(), b, options=replace(EXACT, prior=prior_from(first.posterior)))
    together = identify(hexapod(), join_measurements(a, b), options=EXACT)
    # the first was linearized at its own estimate, which differs from the last by its sd: relative
    # errors of 1e-4
    np.testing.assert_allclose(
        (then.estimate - together.estimate) / together.standard_deviations, 0, atol=1e-2
    )
    np.testing.assert_allclose(then.standard_deviations, together.standard_deviations, rtol=1e-3)
    assert then.chi_square + first.chi_square == pytest.approx(together.chi_square, rel=1e-3)
    assert (
        then.residual_test.degrees + first.residual_test.degrees == together.residual_test.degrees
    )


def test_fewer_poses_than_parameters_suffice_with_a_prior():
    first = identify(hexapod(), hexapod_data(20, seed=1), options=EXACT)
    options = replace(EXACT, prior=prior_from(first.posterior))
    fit = identify(hexapod(), hexapod_data(2, seed=2), options=options)
    assert fit.converged
    assert (fit.standard_deviations <= first.standard_deviations * (1 + 1e-6)).all()


def test_prior_without_some_parameters_is_the_marginal_of_the_others():
    first = identify(hexapod(), hexapod_data(20, seed=1), LeastSquares())
    names = limb_parameters(first.robot, "leg3")
    B = prior_from(first.posterior).without(names).rows * first.tolerance
    assert np.array_equal(B[:, LEG3], np.zeros_like(B[:, LEG3]))
    others = np.delete(np.arange(42), LEG3)
    scaled = first.covariance / first.tolerance[:, None] / first.tolerance
    information = np.linalg.inv(scaled[np.ix_(others, others)])
    np.testing.assert_allclose(
        (B.T @ B)[np.ix_(others, others)],
        information,
        rtol=0,
        atol=1e-6 * np.abs(information).max(),
    )


def test_prior_does_not_determine_what_the_earlier_fit_did_not():
    first = identify(hexapod(), hexapod_data(20, seed=1, instrument=five_dof()), LeastSquares())
    prior = prior_from(first.posterior)
    assert prior.rows.shape == (41, 42)
    again = identify(
        hexapod(), hexapod_data(10, seed=2, instrument=five_dof()), options=FitOptions(prior=prior)
    )
    assert again.rank == 41  # although the null direction differs by 1e-4 between the two estimates
    assert again.converged
    assert len(again.unidentifiable) == 1
    assert identify(hexapod(), hexapod_data(10, seed=2), options=FitOptions(prior=prior)).rank == 42


def test_arrays_of_a_run_keep_the_posterior():
    first = identify(hexapod(), hexapod_data(20, seed=1), LeastSquares())
    back = posterior_from_arrays(first.robot, first.arrays())
    assert np.array_equal(prior_from(back).rows, prior_from(first.posterior).rows)
    assert back.names == first.names


def simulate_repaired(shift, seed=2, n=12):
    """Simulate the true hexapod with other values in leg 3."""
    truth = zoo.hexapod_truth().copy()
    truth[LEG3] += shift
    return simulate(
        zoo.hexapod().with_values(truth), hexapod_poses(n, seed), tracker(), seed
    ), truth


def test_moved_limb_is_detected_and_other_limbs_keep_their_prior():
    first = identify(hexapod(), hexapod_data(30, seed=1), LeastSquares())
    data, truth = simulate_repaired([0, 0, 0, 0, 0, 0, 0.05e-3])
    fit, change = recalibrate(hexapod(), data, first.posterior, "leg3")
    assert change.moved
    assert change.finding.code == "prior.machine-changed"
    assert change.finding.data["subject"] == "leg3"
    assert change.finding.data["names"] == ("leg3.length",)
    assert change.finding.data["change"].startswith("+0.0")
    assert change.finding in fit.findings
    pull = (fit.estimate - truth) / fit.standard_deviations
    assert np.abs(pull).max() < 4.5  # 42 correlated normal numbers
    others = np.delete(np.arange(42), LEG3)
    assert (fit.standard_deviations[others] <= first.standard_deviations[others] * (1 + 1e-6)).all()
    assert (
        identify(
            hexapod(), data, options=FitOptions(prior=prior_from(first.posterior))
        ).residual_test.p_value
        < 1e-6
    )  # keeping all of it would be wrong


@pytest.mark.evidence
def test_false_alarm_rate_of_a_moved_limb_is_the_stated_one():
    # chi-square of the change over 24 repetitions of both calibrations without any change: mean 7,
    # sd of the mean sqrt(2 * 7 / 24) = 0.76; bounds at 4.5 sd. At 5 % level: binomial(24, 0.05),
    # more than 7 has probability 2e-5
    result = []
    for seed in range(24):
        first = identify(hexapod(), hexapod_data(15, seed=1000 + seed), LeastSquares())
        result.append(
            recalibrate(hexapod(), simulate_repaired(0.0, seed)[0], first.posterior, "leg3")[1]
        )
    assert {c.degrees for c in result} == {7.0}
    values = np.array([c.chi_square for c in result])
    assert abs(values.mean() - 7) < 4.5 * 0.76
    assert (values > chi2.ppf(0.95, 7)).sum() <= 7


def test_recalibration_without_a_limb_tests_the_whole_machine():
    first = identify(hexapod(), hexapod_data(30, seed=1), LeastSquares())
    _, same = recalibrate(hexapod(), hexapod_data(20, seed=2), first.posterior)
    assert same.moved is False
    assert same.degrees == 42
    assert same.finding.code == "prior.machine-unchanged"
    _, other = recalibrate(hexapod(), simulate_repaired(0.02e-3)[0], first.posterior)
    assert other.moved


def test_posterior_of_another_robot_or_without_uncertainty_is_refused():
    first = identify(hexapod(), hexapod_data(20, seed=1), LeastSquares())
    entries = hexapod().parameters.entries
    fixed = replace(
        hexapod(), parameters=ParameterTable((replace(entries[0], free=False), *entries[1:]))
    )
    with expect_refusal("prior.other-parameters", name="leg1.base.x", place="the earlier run"):
        recalibrate(fixed, hexapod_data(20, seed=2), first.posterior)
    with pytest.raises(EstimationError, match=r"no limb 'leg33' .*\(did you mean 'leg3'"):
        recalibrate(hexapod(), hexapod_data(20, seed=2), first.posterior, "leg33")
    unsure = replace(first.posterior, variance=np.full(42, np.nan))
    with expect_refusal("prior.no-uncertainty"):
        prior_from(unsure)
    with expect_refusal("prior.no-posterior"):
        posterior_from_arrays(first.robot, {})
