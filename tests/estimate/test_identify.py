# SPDX-License-Identifier: Apache-2.0
"""Identification: estimates, uncertainties, unidentifiable combinations, and refused requests."""

import json
from dataclasses import replace

import numpy as np
import pytest

import loopcal.estimate.problem as problem_module
from loopcal.errors import EstimationError
from loopcal.estimate.descent import StepControl
from loopcal.estimate.identification import identify, identify_trials
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import MAP, LeastSquares, Ridge, TruncatedSVD
from loopcal.io.core.text_file import to_json
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.poses import Component
from loopcal.measure.simulation import sample_truth, simulate, simulate_trials
from loopcal.mechanism.solutions import forward
from loopcal.mechanism.workspace import sample_workspace
from loopcal.numerics.gauss_newton import DescentStatus
from tests import zoo
from tests.estimate.problems import (
    bed_points,
    five_dof,
    hexapod,
    hexapod_data,
    hexapod_poses,
    probe,
    simulate_heights,
    tracker,
    with_tolerance,
)
from tests.findings.expectations import expect_refusal, get_finding, list_codes

MM = 1e-3


@pytest.fixture(scope="module")
def data():
    return hexapod_data()


@pytest.fixture(scope="module")
def fit(data):
    return identify(hexapod(), data, LeastSquares())


def test_true_parameters_are_within_their_uncertainty(fit):
    pull = (fit.estimate - zoo.hexapod_truth()) / fit.standard_deviations
    assert fit.converged
    assert fit.rank == 42
    assert np.abs(pull).max() < 4.5  # 42 correlated normal numbers
    assert 0.5 < np.sqrt(np.mean(pull**2)) < 1.5
    assert 1e-4 < fit.residual_test.p_value < 1 - 1e-4
    assert fit.residual_test.dof == 30 * 6 - 42


def test_corrected_robot_has_the_estimate(fit):
    assert np.array_equal(fit.robot.values, fit.estimate)
    assert np.array_equal(fit.initial.values, zoo.hexapod().values)
    assert np.array_equal(fit.plus_minus, fit.interval())


@pytest.mark.slow
def test_exact_poses_of_the_nategh_hexapod_are_recovered_quadratically():
    # errors up to 5 mm; our bounds on medians and on the worst of 20 draws [mm]
    robot, truth = zoo.load_cached_robot("hexapod-nategh-agheli"), zoo.nategh_truth()
    steps = []
    for seed in range(20):
        T = zoo.nategh_poses(np.random.default_rng(seed))
        exact = simulate(robot.with_values(truth), T, tracker(1e-15, 5e-15), seed)
        fit = identify(robot, exact, LeastSquares(), options=FitOptions(begin="closure"))
        assert fit.converged
        errors = np.abs(fit.history.estimate - truth).max(axis=1) / MM
        steps.append(errors[1:4])
    assert (np.median(steps, axis=0) <= [0.6, 4e-4, 1e-9]).all()
    assert (np.max(steps, axis=0) <= [2.0, 4e-3, 2e-8]).all()


@pytest.mark.parametrize("method", [LeastSquares(), MAP()])
def test_closure_start_gives_the_same_estimate(data, method):
    a, b = (
        identify(hexapod(), data, method),
        identify(hexapod(), data, method, options=FitOptions(begin="closure")),
    )
    np.testing.assert_allclose(a.estimate, b.estimate, rtol=0, atol=1e-12)  # [m]
    assert a.chi_square == pytest.approx(b.chi_square, rel=1e-9)


def test_closure_start_is_not_used_for_incomplete_poses():
    heights = hexapod_data(60, instrument=probe())
    a = identify(hexapod(), heights, MAP())
    b = identify(hexapod(), heights, MAP(), options=FitOptions(begin="closure"))
    assert np.array_equal(a.estimate, b.estimate)
    assert list_codes(b.findings) - list_codes(a.findings) == {"poses.closure-start-unused"}


def test_closure_start_that_runs_out_of_steps_says_so(data):
    exhausted = "poses.closure-start-unused"
    few = FitOptions(begin="closure", control=StepControl(iterations=0))
    assert exhausted in list_codes(identify(hexapod(), data, MAP(), options=few).findings)
    enough = FitOptions(begin="closure")
    assert exhausted not in list_codes(identify(hexapod(), data, MAP(), options=enough).findings)


def test_closure_start_is_not_used_for_uncertain_readings(data):
    few = replace(data.take(np.arange(10)), reading_sigma=2e-6)
    fit = identify(hexapod(), few, MAP(), options=FitOptions(begin="closure"))
    assert "uncertain-readings" in [f.data.get("reason") for f in fit.findings]


def test_weight_zero_equals_removing_the_poses(data):
    weight = np.ones(data.n_poses)
    weight[[3, 17, 29]] = 0.0
    by_weight = identify(hexapod(), data.with_weights(weight), LeastSquares())
    removed = identify(hexapod(), data.take(weight > 0.0), LeastSquares())
    np.testing.assert_allclose(by_weight.estimate, removed.estimate, rtol=0, atol=1e-12)  # [m]
    np.testing.assert_allclose(
        by_weight.standard_deviations, removed.standard_deviations, rtol=1e-9
    )
    assert by_weight.residual_test.dof == removed.residual_test.dof


def test_order_of_poses_changes_rounding_only(data, fit):
    order = np.random.default_rng(0).permutation(data.n_poses)
    shuffled = identify(hexapod(), data.take(order), LeastSquares())
    np.testing.assert_allclose(shuffled.estimate, fit.estimate, rtol=0, atol=1e-12)  # [m]


def test_block_size_of_poses_changes_rounding_only(data, fit, monkeypatch):
    monkeypatch.setattr(problem_module, "BLOCK", 7)
    blocked = identify(hexapod(), data, LeastSquares())
    np.testing.assert_allclose(blocked.estimate, fit.estimate, rtol=0, atol=1e-12)  # [m]
    np.testing.assert_allclose(blocked.residuals[0].raw, fit.residuals[0].raw, rtol=0, atol=1e-12)
    assert blocked.residuals[0].poses == fit.residuals[0].poses


@pytest.mark.parametrize(
    ("method", "begin"), [(LeastSquares(), "kinematics"), (MAP(), "kinematics"), (MAP(), "closure")]
)
def test_identified_trials_equal_single_fits_bit_for_bit(method, begin):
    robot = hexapod()
    trials = simulate_trials(robot, sample_truth(robot, 7, 1), hexapod_poses(15), tracker(), 2)
    together = identify_trials(robot, trials, method, options=FitOptions(begin=begin))
    assert together.converged.all()
    for i in range(7):
        options = FitOptions(begin=begin, sigma_uncertainty=0.0)
        alone = identify(robot, trials.trial(i), method, options=options)
        assert np.array_equal(together.values[i], alone.robot.values)
        assert together.iterations[i] == alone.history.iterations
        np.testing.assert_allclose(
            together.standard_deviations()[i], alone.standard_deviations, rtol=1e-12
        )


def test_unreachable_trial_is_marked_and_does_not_change_others():
    robot = hexapod()
    truth = sample_truth(robot, 3, 1)
    trials = simulate_trials(robot, truth, hexapod_poses(15), tracker(), 2)
    start = np.repeat(robot.values[None], 3, axis=0)
    start[1] += 1.0  # [m]
    result = identify_trials(robot, trials, options=FitOptions(start=start))
    assert result.status[1] == DescentStatus.BAD_START
    assert result.converged[[0, 2]].all()
    # the trials no longer share a start, so this also proves the path without sharing
    np.testing.assert_allclose(
        result.values[2], identify_trials(robot, trials).values[2], rtol=0, atol=1e-13
    )


def test_map_equals_ridge_one_and_reduces_uncertainty(data, fit):
    posterior, ridge = identify(hexapod(), data, MAP()), identify(hexapod(), data, Ridge(1.0))
    np.testing.assert_allclose(posterior.estimate, ridge.estimate, rtol=0, atol=1e-15)
    assert (posterior.standard_deviations < fit.standard_deviations).all()
    assert (posterior.standard_deviations < fit.tolerance).all()
    # no penalty enters the test of the noise
    assert posterior.residual_test.degrees == fit.residual_test.degrees == 138
    assert posterior.chi_square == pytest.approx(fit.chi_square, rel=1e-3)


def test_truncation_at_full_rank_equals_least_squares(data, fit):
    # [m] rounding: the singular values of one fit against the back substitution of the other
    np.testing.assert_allclose(
        identify(hexapod(), data, TruncatedSVD(42)).estimate, fit.estimate, rtol=0, atol=1e-14
    )


def test_fixed_parameters_keep_their_values_without_uncertainty(data):
    robot = hexapod()
    names = [n for n in robot.parameters.names if not n.startswith("leg4")]
    some = replace(robot, parameters=robot.parameters.with_free(names))
    fit = identify(some, data, LeastSquares())
    held = [i for i, n in enumerate(robot.parameters.names) if n.startswith("leg4")]
    assert len(fit.names) == 35
    assert np.array_equal(fit.robot.values[held], robot.values[held])
    assert np.isnan(fit.plus_minus[held]).all()
    assert fit.residual_test.p_value < 1e-6
    assert fit.residual_test.finding.code == "noise.residuals-too-large"


def test_unidentifiable_combination_is_named_and_has_infinite_uncertainty():
    robot, data = hexapod(), hexapod_data(30, instrument=five_dof())
    fit = identify(robot, data, LeastSquares())
    assert fit.rank == 41
    (turn,) = fit.unidentifiable
    assert {
        n for n, sd in zip(fit.names, fit.standard_deviations, strict=True) if np.isinf(sd)
    } == set(turn.names)
    assert get_finding(fit.findings, "fit.unidentifiable").data["names"] == turn.names
    assert np.isnan(
        fit.covariance[np.isinf(fit.standard_deviations)][:, np.isfinite(fit.standard_deviations)]
    ).all()
    # walking along the combination changes no measured value, and only adds to the deviation
    step = np.zeros(42)
    step[[fit.names.index(n) for n in turn.names]] = turn.changes * 1e-6  # [m]
    moved = forward(fit.robot.with_values(fit.robot.values + step), data.readings).T
    still = forward(fit.robot, data.readings).T
    kind = data.observations[0]
    change = kind.evaluate(moved[None]).residual - kind.evaluate(still[None]).residual
    assert np.abs(change).max() < 1e-9  # [m, rad] of second order in 1e-5 rad
    assert np.abs((fit.estimate - fit.nominal) @ step) < 1e-6 * np.linalg.norm(
        step
    ) * np.linalg.norm(fit.estimate - fit.nominal)
    assert identify(robot, data, MAP()).standard_deviations.max() < 0.035 * MM


def test_assumed_tolerances_are_reported(data):
    fit = identify(zoo.hexapod(), data, LeastSquares())
    assumed = get_finding(fit.findings, "fit.default-tolerances").data
    assert (assumed["count"], assumed["total"]) == (42, 42)
    stated = identify(hexapod(), data, LeastSquares()).findings
    assert "fit.default-tolerances" not in list_codes(stated)


def test_too_few_equations_are_refused_without_a_prior_or_the_option(data):
    few = data.take(np.arange(5))
    with expect_refusal(
        "fit.too-few-equations", equations=30, poses=5, unknowns=42, poses_needed=7
    ):
        identify(hexapod(), few, LeastSquares())
    forced = identify(
        hexapod(), few, LeastSquares(), options=FitOptions(allow_fewer_equations=True)
    )
    assert forced.rank == 30
    assert len(forced.unidentifiable) == 12
    assert forced.residual_test.finding.code == "noise.no-degrees-of-freedom"
    assert np.isfinite(identify(hexapod(), few, MAP()).standard_deviations).all()


@pytest.mark.parametrize(
    ("name", "columns", "poses", "rank"),
    [("hexapod-42", "xy", 20, 38), ("rotary-delta", "z", 17, 16), ("3-prs", "xy", 15, 29)],
)
def test_least_squares_takes_what_rank_permits_and_counts_what_is_left(name, columns, poses, rank):
    robot = load_robot(name)
    sensor = Sensor(Component(tuple(columns)), Gaussian(np.full(len(columns), 10e-6)))
    coordinates = sample_workspace(robot, poses, 1).coordinates
    data = simulate(robot, coordinates, Instrument((sensor,)), seed=1)
    equations = poses * len(columns)
    assert rank < equations < len(robot.parameters)
    fit = identify(robot, data, LeastSquares())
    assert (fit.converged, fit.rank) == (True, rank)
    assert fit.residual_test.degrees == equations - rank
    assert np.isinf(fit.standard_deviations).any()
    few = data.take(np.arange(rank // len(columns)))
    with expect_refusal("fit.too-few-equations", equations=len(few.labels) * len(columns)):
        identify(robot, few, LeastSquares())


def test_equations_that_only_the_nominal_symmetry_leaves_over_are_refused():
    robot = load_robot("linear-delta-6")
    coordinates = sample_workspace(robot, 20, 1).coordinates
    height = Instrument((Sensor(Component(("z",)), Gaussian(np.full(1, 10e-6))),))
    with expect_refusal("fit.too-few-equations", equations=20, unknowns=40):
        identify(robot, simulate(robot, coordinates, height, seed=1), LeastSquares())


def test_intervals_of_few_degrees_of_freedom_are_those_of_student():
    robot = with_tolerance(zoo.delta(), 1e-3)
    six = [n for n in robot.parameters.names if "arm" not in n and "angle" not in n][:6]
    some = replace(robot, parameters=robot.parameters.with_free(six))
    data = simulate_heights(robot, bed_points(len(six) + 1))
    estimated, given = (
        identify(some, data, LeastSquares(), options=FitOptions(noise="estimated")),
        identify(some, data, LeastSquares()),
    )
    assert estimated.residual_test.dof == 1
    few = get_finding(estimated.findings, "noise.few-degrees")
    assert few.data["dof"] == 1
    np.testing.assert_allclose(estimated.interval(), 12.706 * estimated.standard_deviations, 1e-4)
    # nine degrees of freedom: eight of the stated sigma, one of the residuals
    np.testing.assert_allclose(given.interval(), 2.2622 * given.standard_deviations, 1e-4)


def test_estimated_noise_scales_the_uncertainty(data):
    quarter = hexapod_data(instrument=tracker(4e-6, 20e-6))
    claimed = quarter.observations[0]
    sharp = replace(quarter, observations=(replace(claimed, covariance=claimed.covariance / 16.0),))
    fit = identify(hexapod(), sharp, LeastSquares(), options=FitOptions(noise="estimated"))
    assert fit.residual_test.sigma_scale == pytest.approx(
        4.0, rel=0.25
    )  # 138 degrees of freedom: sd 6 %
    np.testing.assert_allclose(
        fit.standard_deviations,
        identify(
            hexapod(), quarter, LeastSquares(), options=FitOptions(sigma_uncertainty=0.0)
        ).standard_deviations
        * fit.residual_test.sigma_scale
        / 4.0,
        rtol=1e-3,
    )
    assert np.isnan(fit.residual_test.p_value)
    given = identify(hexapod(), sharp, LeastSquares())
    assert given.residual_test.finding.code == "noise.residuals-too-large"


def test_unreachable_poses_are_refused_by_name_unless_their_weight_is_zero(data):
    readings = data.readings.copy()
    readings[4] = -0.2  # [m]
    broken = replace(data, readings=readings)
    with expect_refusal("fit.poses-out-of-reach", count=1, total=30, poses=("5",)):
        identify(hexapod(), broken, LeastSquares())
    weight = np.ones(30)
    weight[4] = 0.0
    result = identify(hexapod(), broken.with_weights(weight), LeastSquares())
    expected = identify(hexapod(), data.take(weight > 0), LeastSquares())
    np.testing.assert_allclose(result.estimate, expected.estimate, rtol=0, atol=1e-12)


def test_fit_stopped_by_the_iteration_limit_is_reported(data):
    fit = identify(
        hexapod(), data, LeastSquares(), options=FitOptions(control=StepControl(iterations=0))
    )
    assert fit.status is DescentStatus.OUT_OF_ITERATIONS
    assert fit.findings[0].code == "fit.out-of-iterations"
    assert "did not converge" in str(fit)


def test_distant_start_converges_to_the_same_estimate(data, fit):
    start = zoo.hexapod().values + np.random.default_rng(1).uniform(-5 * MM, 5 * MM, 42)
    far = identify(hexapod(), data, LeastSquares(), options=FitOptions(start=start))
    assert far.converged
    np.testing.assert_allclose(
        far.estimate, fit.estimate, rtol=0, atol=1e-9
    )  # [m] 1e-3 of the smallest sd


def test_missing_rows_missing_parameters_and_unknown_noise_are_refused(data):
    with expect_refusal("fit.no-measured-value"):
        identify(hexapod(), data.with_weights(np.zeros(30)), LeastSquares())
    fixed = replace(hexapod(), parameters=hexapod().parameters.with_free([]))
    with expect_refusal("fit.no-free-parameter", total=42):
        identify(fixed, data, LeastSquares())
    with pytest.raises(EstimationError, match="must be one of 'given', 'estimated'"):
        identify(hexapod(), data, LeastSquares(), options=FitOptions(noise="guessed"))  # pyright: ignore[reportArgumentType]


def test_text_and_json_name_every_parameter(fit):
    text = str(fit)
    assert all(name in text for name in fit.names)
    assert "Rank 42 of 42" in text
    assert len(repr(fit).splitlines()) <= 20
    assert len(repr(fit)) < 1000
    document = json.loads(to_json(fit.to_dict()))
    assert [p["name"] for p in document["parameters"]] == list(fit.names)
    assert document["parameters"][0]["unit"] == "mm"
    assert document["status"] == "converged"
    assert set(fit.arrays()) >= {"estimate", "covariance", "residual_0_pose"}
