# SPDX-License-Identifier: Apache-2.0
"""Uncertain readings and unmeasured poses: the limit of exact readings, the dense solution, and
coverage of intervals.
"""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.optimize import least_squares
from scipy.stats import binom, chi2

import loopcal.estimate.pose_rows as blocks_module
from loopcal.apply.validation import validate
from loopcal.diagnose.cross_validation import cross_validate
from loopcal.diagnose.fit_examination import examine_fit
from loopcal.diagnose.identifiable_parameters import identifiability
from loopcal.diagnose.outliers import find_outliers
from loopcal.errors import DataError, EstimationError
from loopcal.estimate.identification import exclude_poses, identify, identify_trials
from loopcal.estimate.losses import Huber, Tukey
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import LeastSquares
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.instrument import Instrument, Sensor
from loopcal.measure.kinds.distance import Separation
from loopcal.measure.kinds.joints import JointSensor
from loopcal.measure.kinds.poses import Pose
from loopcal.measure.kinds.position import Position
from loopcal.measure.measurements import Measurements
from loopcal.measure.simulation import sample_truth, simulate, simulate_trials
from loopcal.mechanism.solutions import forward, inverse
from loopcal.mechanism.workspace import sample_workspace
from tests.estimate.problems import UM, hexapod, hexapod_poses, noise, tracker
from tests.estimate.uncertain_reading_problems import (
    build_hexapod_with_seven_legs,
    build_ups_hexapod,
    free_only,
    simulate_hexapod,
    solve_dense,
)

TINY_SIGMA = 1e-11  # [m]: (TINY / sigma of the tracker)^2 = 1e-10 is what it may change


def copy_reading_sigma(data):
    """Return a copy of the sigma of the readings."""
    assert data.reading_sigma is not None
    return data.reading_sigma.copy()


def pose_estimates(fit):
    """Return the pose estimates of a fit with uncertain readings."""
    assert fit.poses is not None
    return fit.poses


def largest_difference(a, b):
    """Return the largest differences of estimates and covariances, in sd of the second fit."""
    return np.abs((a.estimate - b.estimate) / b.standard_deviations).max(), np.abs(
        (a.covariance - b.covariance) / np.outer(b.standard_deviations, b.standard_deviations)
    ).max()


def make_case(name):
    """Return a robot and its measurements with exact readings."""
    if name == "hexapod":
        return hexapod(), simulate_hexapod(12, None)
    if name == "hexapod, frame unknown":
        return hexapod(), simulate_hexapod(
            12, None, sensors=(Sensor(Pose(unknown=("frame",)), noise(*[5e-6] * 3, *[UM] * 3)),)
        )
    robot = load_robot("3-prs")
    truth = robot.with_values(sample_truth(robot, 1, 1)[0])
    passive = inverse(robot, sample_workspace(robot, 1, 0).coordinates).passive_names[0]
    sensors = (
        *tracker().sensors,
        Sensor(JointSensor(joints=(passive, "q2"), measures="angle"), noise(5e-6, 5e-6)),
    )
    if robot.actuators[1].name != "q2" or "angle" not in robot.actuators[1].dimension.value:
        sensors = (
            *tracker().sensors,
            Sensor(JointSensor(joints=(passive,), measures="angle"), noise(5e-6)),
        )
    return robot, simulate(
        truth, sample_workspace(robot, 20, 2).coordinates, Instrument(sensors), 0
    )


@pytest.mark.parametrize(
    "name", ["hexapod", "hexapod, frame unknown", "3-prs with a passive joint"]
)
def test_vanishing_reading_sigma_gives_the_fit_of_exact_readings(name):
    robot, data = make_case(name)
    exact = identify(robot, data, LeastSquares(), options=FitOptions(rank_tolerance=1e-9))
    for sigma in (TINY_SIGMA, np.where(np.arange(data.readings.shape[1]) == 1, 0.0, TINY_SIGMA)):
        result = identify(
            robot,
            replace(data, reading_sigma=sigma),
            LeastSquares(),
            options=FitOptions(rank_tolerance=1e-9),
        )
        assert result.rank == exact.rank
        assert result.residual_test.dof == exact.residual_test.dof
        if np.isfinite(exact.standard_deviations).all():
            assert max(largest_difference(result, exact)) < 1e-9
        else:  # a frame is known only together with the machine: what is known is the same
            known = exact.posterior.directions[:, exact.posterior.determined]
            change = known.T @ ((result.estimate - exact.estimate) / exact.posterior.unit)
            assert (
                np.abs(change / np.sqrt(exact.posterior.variance[exact.posterior.determined])).max()
                < 1e-9
            )
            assert_allclose(
                result.spectrum.singular_values[: result.rank],
                exact.spectrum.singular_values[: result.rank],
                rtol=1e-9,
            )


def test_reading_sigma_zero_equals_no_reading_sigma_bit_for_bit():
    data = simulate_hexapod(10, None)
    plain, stated = (
        identify(hexapod(), d, LeastSquares()) for d in (data, replace(data, reading_sigma=0.0))
    )
    assert stated.poses is None
    assert_array_equal(stated.estimate, plain.estimate)
    assert_array_equal(stated.covariance, plain.covariance)


def test_noisy_and_missing_readings_and_linked_poses_equal_the_dense_solution():
    robot = free_only(
        hexapod(),
        (
            "leg1.base.x",
            "leg2.base.z",
            "leg3.platform.y",
            "leg4.length",
            "leg5.length",
            "leg6.base.y",
        ),
    )
    full = Sensor(Pose(), noise(*[5e-6] * 3, *[UM] * 3), rows=np.array([0, 1, 2]))
    ball = Sensor(Separation(), noise(2 * UM), rows=np.array([[1, 3], [3, 4], [0, 5]]))
    data = simulate_hexapod(
        6,
        3 * UM,
        sensors=(full, ball, Sensor(Position(), noise(UM, UM, UM), rows=np.array([3, 4, 5]))),
    )
    readings, sigma = data.readings.copy(), copy_reading_sigma(data)
    readings[2, 4], sigma[2, 4] = np.nan, np.inf
    sigma[5, 0] = 0.0
    data = replace(data, readings=readings, reading_sigma=sigma)
    expected, covariance = solve_dense(robot, data, copy_reading_sigma(data))
    result = identify(robot, data, LeastSquares())
    assert result.converged
    sd = np.sqrt(np.diag(covariance))
    assert_allclose(result.estimate, expected, atol=1e-4 * sd.min(), rtol=0)  # [m], differences
    stated = (
        result.covariance / result.residual_test.sigma_scale**2
    )  # six of 42 wrong parameters are free: it is widened
    assert_allclose(stated, covariance, atol=1e-4 * sd.max() ** 2, rtol=0)
    assert pose_estimates(result).to_dict() == {
        "exact": 1,
        "uncertain": 34,
        "not_taken": 1,
        "open": [],
        "calm": True,
    }
    assert {r.kind for r in result.residuals} == {"pose", "separation", "position", "readings"}
    whitened = result.residuals[-1].whitened
    assert whitened[2, 4] == 0.0
    assert np.isnan(result.residuals[-1].raw[2, 4])
    total = sum(float((r.whitened**2).sum()) for r in result.residuals)
    assert total == pytest.approx(result.chi_square, rel=1e-6)


@pytest.fixture(scope="module")
def cable():
    """Return a four-line robot, the true one, and positions in its workspace."""
    robot = load_robot("cable-4")
    return (
        robot,
        robot.with_values(sample_truth(robot, 1, 3)[0]),
        sample_workspace(robot, 30, 5).coordinates,
    )


def test_redundant_readings_equal_the_dense_solution(cable):
    robot, truth, positions = cable
    data = simulate(
        truth,
        positions[:12],
        Instrument((Sensor(Position(), noise(*[1e-3] * 3), rows=np.arange(8)),)),
        1,
    )
    result = identify(robot, data, LeastSquares(), options=FitOptions(sigma_uncertainty=0.0))
    sigma = np.array([a.sigma for a in robot.actuators])
    p, unit, names = len(result.names), robot.parameters.tolerance, robot.parameters.names
    lengths = np.array([limb.length for limb in robot.assembly.limbs])
    nominal = np.array([limb.links[-1].transform[:3, 3] for limb in robot.assembly.limbs])
    radius = np.array([a.terms["gain"] for a in robot.actuators])

    def rows(x):
        change = dict(zip(names, unit * x[:p], strict=True))
        anchors = nominal + [[change[f"{limb}.anchor.{axis}"] for axis in "xyz"] for limb in "ABCD"]
        length = lengths + [change[f"{limb}.length"] for limb in "ABCD"]
        spool = radius + [change[f"{a.name}.radius"] for a in robot.actuators]
        at = x[p:].reshape(-1, 3)
        q = (np.linalg.norm(at[:, None] - anchors, axis=2) - length) / spool
        seen = (at[:8] - data.observations[0].measured) / 1e-3
        return np.concatenate([seen.ravel(), ((q - data.readings) / sigma).ravel()])

    start = np.concatenate([np.zeros(p), positions[:12].ravel()])
    fit = least_squares(
        rows, start, jac="3-point", x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15
    )
    inverse_r = np.linalg.inv(np.linalg.qr(fit.jac)[1])
    sd = np.linalg.norm(inverse_r, axis=1)[:p] * unit
    distance = result.estimate - (robot.parameters.nominal + unit * fit.x[:p])
    # both descents end where a step hardly changes the residuals
    assert np.abs(distance / sd).max() < 1e-3
    assert_allclose(
        result.standard_deviations, sd, rtol=1e-4
    )  # at two solutions that differ by the noise's curvature
    assert_allclose(
        pose_estimates(result).poses[:, :3, 3], fit.x[p:].reshape(-1, 3), atol=1e-7
    )  # [m]


def test_readings_alone_determine_a_cable_robot_up_to_its_gauge(cable):
    robot, truth, positions = cable
    q = inverse(truth, positions).q
    data = Measurements(robot.name, q, ())
    fit = identify(robot, data, LeastSquares())
    assert fit.converged
    assert fit.rank == 13  # 20 parameters less six of the frame and one of scale
    assert fit.chi_square < 1e-12
    unseen = inverse(truth, sample_workspace(robot, 20, 9).coordinates).q
    gap = forward(fit.robot, unseen).residual.max()
    assert gap < 1e-9 * robot.size  # [m]: with the right geometry four lines meet in a point
    assert forward(robot, unseen).residual.max() > 1e-3
    result = identifiability(robot, data)
    assert (result.rank, result.n_equations) == (13, 30)
    checked = cross_validate(robot, data, LeastSquares(), count=3)
    assert checked.poses == ()
    assert checked.fold.max() < 1e-3 * checked.before_fold.min()


def test_leg_sensors_determine_all_but_the_frames_with_and_without_noise():
    """42 parameters less six of the platform frame and three of the base position; joint axes
    determine the base orientation.
    """
    robot = build_ups_hexapod()
    legs = tuple(f"leg{i}.universal{j}" for i in (1, 3, 5) for j in (1, 2))
    sensors = Instrument((Sensor(JointSensor(joints=legs, measures="angle"), noise(*[1e-5] * 6)),))
    for sigma in (None, 2 * UM):
        result = identifiability(
            robot, simulate(robot, hexapod_poses(30), sensors, 0, reading_sigma=sigma)
        )
        assert result.rank == 33
        assert result.gap > 1e6


def test_readings_of_seven_legs_determine_all_but_two_frames():
    robot = build_hexapod_with_seven_legs()
    truth = robot.with_values(sample_truth(robot, 1, 0)[0])
    data = Measurements(robot.name, inverse(truth, hexapod_poses(60)).q, ())
    fit = identify(robot, data, LeastSquares())
    assert fit.converged
    assert fit.rank == 49 - 12
    unseen = inverse(truth, hexapod_poses(20, 7)).q
    assert forward(fit.robot, unseen).residual.max() < 1e-9 * robot.size  # [m]
    assert forward(robot, unseen).residual.max() > 1e-5


def count_covered(robot, trials):
    """Count the trials whose 95 % ellipsoid contains the truth."""
    fits = identify_trials(robot, trials, LeastSquares())
    assert fits.converged.all()
    places = fits.free_parameters.places
    covariance = fits.decomposition.covariance(fits.penalty) * np.outer(
        fits.free_parameters.tolerance, fits.free_parameters.tolerance
    )
    error = fits.values[:, places] - trials.truth[:, places]
    square = np.einsum("ti,tij,tj->t", error, np.linalg.inv(covariance), error)
    return int((square <= chi2.ppf(0.95, len(places))).sum())


def test_ellipsoids_cover_as_stated_only_if_reading_noise_is_modeled():
    robot = load_robot("linear-delta")
    n = 100
    trials = simulate_trials(
        robot, sample_truth(robot, n, 4), sample_workspace(robot, 12, 4).coordinates,
        Instrument((Sensor(Position(), noise(10 * UM, 10 * UM, 10 * UM)),)), 4, reading_sigma=20 * UM,  # noqa: E501
    )  # fmt: skip
    inside = count_covered(robot, trials)
    assert binom.ppf(0.0005, n, 0.95) <= inside <= binom.ppf(0.9995, n, 0.95)
    ignored = 0
    for i in range(10):
        data = replace(trials.trial(i), reading_sigma=0.0)
        fit = identify(robot, data, LeastSquares())
        error = fit.estimate - trials.truth[i, fit.free_parameters.places]
        stated = (
            fit.covariance / fit.residual_test.sigma_scale**2
        )  # a residual that noise does not explain has widened it
        ignored += bool(error @ np.linalg.solve(stated, error) <= chi2.ppf(0.95, len(error)))
    assert ignored < binom.ppf(0.0005, 10, 0.95)


def test_ellipsoids_cover_as_stated_with_redundant_readings(cable):
    robot, _, positions = cable
    n = 60
    seen = Instrument((Sensor(Position(), noise(1e-4, 1e-4, 1e-4), rows=np.arange(8)),))
    inside = count_covered(
        robot, simulate_trials(robot, sample_truth(robot, n, 6), positions, seen, 6)
    )
    assert binom.ppf(0.0005, n, 0.95) <= inside <= binom.ppf(0.9995, n, 0.95)


def test_simulated_readings_differ_from_the_true_ones_by_the_stated_noise(cable):
    robot, _, positions = cable
    truth = sample_truth(robot, 40, 2)
    seen = Instrument((Sensor(Position(), noise(UM, UM, UM)),))
    trials = simulate_trials(robot, truth, positions, seen, 2)
    assert trials.recorded is not None
    sigma = np.array([a.sigma for a in robot.actuators])
    assert_array_equal(trials.reading_sigma, np.tile(sigma, (30, 1)))  # as the robot states
    true = np.stack(
        [inverse(robot.with_values(v), T[:, :3, 3]).q for v, T in zip(truth, trials.T, strict=True)]
    )
    error = (trials.recorded - true) / sigma
    m = error.size
    assert chi2.ppf(1e-4, m) < (error**2).sum() < chi2.ppf(1 - 1e-4, m)
    few = simulate_trials(robot, truth[:3], positions, seen, 2)
    assert_array_equal(few.recorded, trials.recorded[:3])
    exact = simulate_trials(
        hexapod(),
        hexapod().values[None],
        hexapod_poses(3),
        tracker(),
        0,
        reading_sigma=[0.0, np.inf, *[UM] * 4],
    )
    assert exact.recorded is not None
    assert_array_equal(exact.recorded[0, :, 0], exact.readings[:, 0])
    assert np.isnan(exact.recorded[0, :, 1]).all()


def test_trial_with_uncertain_readings_equals_a_single_fit():
    robot = hexapod()
    trials = simulate_trials(
        robot, sample_truth(robot, 3, 0), hexapod_poses(10), tracker(), 0, reading_sigma=2 * UM
    )
    assert trials.recorded is not None
    assert not np.array_equal(trials.recorded[0], trials.recorded[1])
    together = identify_trials(robot, trials, LeastSquares())
    for i in (0, 2):
        alone = identify(robot, trials.trial(i), LeastSquares())
        assert_allclose(
            together.values[i, together.free_parameters.places],
            alone.estimate,
            atol=1e-6 * alone.standard_deviations.min(),
            rtol=0,
        )


def test_undetermined_pose_adds_no_information_and_is_reported():
    data = simulate_hexapod(12, 2 * UM)
    known = identify(hexapod(), data.take(np.arange(11)), LeastSquares())
    seen = replace(data.observations[0], measured=np.where(
        (np.arange(12) == 11)[:, None] & (np.arange(6) < 3), np.nan, data.observations[0].measured))  # fmt: skip  # noqa: E501
    unread = (np.arange(12) == 11)[:, None]
    lost = replace(data, observations=(seen,), readings=np.where(unread, np.nan, data.readings),
                   reading_sigma=np.where(unread, np.inf, copy_reading_sigma(data)))  # fmt: skip
    result = identify(hexapod(), lost, LeastSquares())
    assert (
        max(largest_difference(result, known)) < 1e-6
    )  # both fits end where steps are a millionth of the residual
    assert result.residual_test.dof == known.residual_test.dof
    assert pose_estimates(result).is_undetermined.tolist() == [False] * 11 + [True]
    (lost,) = (f for f in result.findings if f.code == "poses.undetermined")
    assert "12" in str(lost)


def test_reading_of_infinite_sigma_is_estimated_from_the_pose():
    data = simulate_hexapod(12, 2 * UM)
    sigma = copy_reading_sigma(data)
    sigma[7, 3] = np.inf
    for wrong in (5e-3, np.nan):
        readings = data.readings.copy()
        readings[7, 3] += wrong
        result = identify(
            hexapod(), replace(data, readings=readings, reading_sigma=sigma), LeastSquares()
        )
        assert pose_estimates(result).readings[7, 3] == pytest.approx(
            data.readings[7, 3], abs=20 * UM
        )
        held = validate(result, replace(data, readings=readings, reading_sigma=sigma))
        assert "8" in held.poses  # estimated together with the row, which takes up one residual
        (estimated,) = [f for f in held.findings if f.code == "validation.poses-estimated"]
        assert (estimated.data["names"], estimated.data["absorbed"]) == (("pose 8",), 1)


@pytest.fixture(scope="module")
def wrong_reading():
    """Return measurements with a wrong reading (1 mm) in pose 5."""
    data = simulate_hexapod(16, 2 * UM)
    readings = data.readings.copy()
    readings[4, 1] += 1e-3
    return replace(data, readings=readings)


@pytest.mark.slow
def test_wrong_reading_is_named_and_corrected_by_exclusion_or_a_loss(wrong_reading):
    plain = identify(hexapod(), wrong_reading, LeastSquares())
    assert find_outliers(plain, wrong_reading).names == ("5",)
    dropped = identify(
        hexapod(), wrong_reading, LeastSquares(), options=FitOptions(excluded_poses=("5",))
    )
    without = identify(hexapod(), wrong_reading.take(np.arange(16) != 4), LeastSquares())
    assert max(largest_difference(dropped, without)) < 1e-6
    assert dropped.residual_test.dof == without.residual_test.dof
    assert np.abs((plain.estimate - without.estimate) / without.standard_deviations).max() > 30.0
    for loss, most in ((Huber(), 4.0), (Tukey(), 1.5)):
        robust = identify(hexapod(), wrong_reading, LeastSquares(), loss=loss)
        assert robust.pose_weights[4] < 0.05
        assert (
            np.abs((robust.estimate - without.estimate) / without.standard_deviations).max() < most
        )
    assert examine_fit(dropped, wrong_reading).outliers.outliers == ()


def test_outlier_distance_is_the_decrease_of_chi_square_without_the_pose():
    data = simulate_hexapod(14, 2 * UM)
    fit = identify(hexapod(), data, LeastSquares())
    result = find_outliers(fit, data).influence
    assert result.leverage.sum() == pytest.approx(42, abs=1e-6)
    assert (
        int(result.residuals.sum()) == 14 * 6
    )  # six readings and six numbers of a pose, less its six freedoms
    for i in (3, 11):
        without = identify(hexapod(), data.take(np.arange(14) != i), LeastSquares())
        assert fit.chi_square - without.chi_square == pytest.approx(
            result.distance[i], rel=1e-3
        )  # what is not linear


def test_pose_blocks_do_not_change_a_fit_of_uncertain_readings(monkeypatch):
    sensors = (
        Sensor(Pose(unknown=("frame",)), noise(*[5e-6] * 3, *[UM] * 3)),
        Sensor(Separation(), noise(UM), np.array([[0, 7], [2, 3]])),
    )
    data = simulate_hexapod(12, 2 * UM, sensors=sensors)
    whole = identify(hexapod(), data, LeastSquares())
    monkeypatch.setattr(blocks_module, "BLOCK", 5)
    parts = identify(hexapod(), data, LeastSquares())
    assert parts.chi_square == pytest.approx(whole.chi_square, rel=1e-9)
    assert_allclose(
        parts.spectrum.singular_values[:36], whole.spectrum.singular_values[:36], rtol=1e-9
    )
    assert_allclose(pose_estimates(parts).readings, pose_estimates(whole).readings, atol=1e-9 * UM)


def test_unknown_frame_with_noisy_readings_has_rank_36_and_the_expected_chi_square():
    sensor = Sensor(Pose(unknown=("frame",)), noise(*[5e-6] * 3, *[UM] * 3))
    data = simulate_hexapod(14, 2 * UM, sensors=(sensor,))
    fit = identify(hexapod(), data, LeastSquares())
    assert fit.converged
    assert fit.rank == 36
    assert fit.residual_test.dof == 14 * 6 - 42
    assert (
        chi2.ppf(1e-4, fit.residual_test.dof)
        < fit.chi_square
        < chi2.ppf(1 - 1e-4, fit.residual_test.dof)
    )


def test_exact_readings_of_redundant_actuators_are_refused(cable):
    robot, truth, positions = cable
    data = replace(
        simulate(truth, positions[:9], Instrument((Sensor(Position(), noise(UM, UM, UM)),)), 1),
        reading_sigma=0.0,
    )
    with pytest.raises(
        DataError, match=r"redundant actuators cannot be exact. Give each a sigma above 0"
    ):
        identify(robot, data, LeastSquares())


def test_too_few_readings_and_too_many_linked_poses_are_refused(cable, monkeypatch):
    robot, truth, positions = cable
    with pytest.raises(EstimationError, match="9 equations from 9 poses cannot determine 20"):
        identify(
            robot, Measurements(robot.name, inverse(truth, positions[:9]).q, ()), LeastSquares()
        )
    alone = replace(simulate_hexapod(6, UM), observations=())
    with pytest.raises(EstimationError, match="No equation remains"):
        identify(hexapod(), alone, LeastSquares())
    monkeypatch.setattr(blocks_module, "LARGEST", 30)
    data = simulate_hexapod(6, UM, sensors=(Sensor(Separation(), noise(UM)), *tracker().sensors))
    with pytest.raises(EstimationError, match="link 6 poses"):
        identify(hexapod(), data, LeastSquares())


def test_excluded_pose_is_not_reported_as_undetermined_or_missing():
    data = simulate_hexapod(12, 2 * UM)
    fit = identify(hexapod(), data, options=FitOptions(excluded_poses=("3", "9")))
    result, out = pose_estimates(fit), np.isin(np.arange(12), (2, 8))
    assert "poses.undetermined" not in {f.code for f in fit.findings}
    assert result.to_dict() == {
        "exact": 0,
        "uncertain": 60,
        "not_taken": 0,
        "open": [],
        "calm": True,
    }
    assert_array_equal(np.isnan(result.poses).all(axis=(1, 2)), out)
    assert_array_equal(np.isnan(result.readings).all(axis=1), out)
    assert examine_fit(fit, data).gain.is_worthwhile
    held = validate(fit, exclude_poses(data, ("3", "9")))
    assert not [f for f in held.findings if f.code == "validation.missing-readings"]
