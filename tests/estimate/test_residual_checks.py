# SPDX-License-Identifier: Apache-2.0
"""Checks of the residuals: pure error of repeats, lack of fit, correlated parameters, and the
expected gain. Residuals and validations in a run folder are those of the report.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import loopcal as lc
from loopcal.apply.validation import restore_validation
from loopcal.diagnose import fit_examination
from loopcal.diagnose.fit_examination import (
    check_lack_of_fit,
    estimate_calibration_gain,
    find_correlated_groups,
)
from loopcal.estimate.identification import identify
from loopcal.estimate.losses import Tukey
from loopcal.estimate.penalties import LeastSquares
from loopcal.estimate.residual_test import SIGMA_AS_STATED, NoiseKnowledge
from loopcal.estimate.result import residuals_from_arrays
from loopcal.measure.simulation import simulate
from loopcal.report.validation_view import describe_improvements, view_errors
from loopcal.results.serialization import restore_numbers
from tests import zoo
from tests.estimate.problems import (
    MM,
    UM,
    URAD,
    hexapod,
    hexapod_data,
    hexapod_poses,
    tracker,
    with_tolerance,
)


def simulate_repeats(seed: int, times: int = 3, instrument=None, poses: int = 12):
    truth = zoo.hexapod().with_values(zoo.hexapod_truth())
    again = np.repeat(hexapod_poses(poses, seed), times, axis=0)
    return simulate(truth, again, instrument or tracker(), seed)


def test_pure_error_is_the_spread_within_groups_of_repeats():
    data = simulate_repeats(0)
    result = check_lack_of_fit(identify(hexapod(), data, LeastSquares()), data)
    sigma = np.array([5 * URAD] * 3 + [UM] * 3)
    groups = (data.observations[0].measured / sigma).reshape(12, 3, 6)
    expected = ((groups - groups.mean(axis=1, keepdims=True)) ** 2).sum()
    assert result.groups == 12
    assert result.pure_degrees == 12 * 2 * 6
    assert result.pure == pytest.approx(
        expected, rel=1e-2
    )  # rotation residuals are those differences to first order
    assert result.lack_degrees == 12 * 6 - 42
    assert result.is_explained


@pytest.mark.evidence
def test_lack_of_fit_is_rarely_reported_for_a_correct_model_with_wrong_sigma():
    blamed = 0
    for seed in range(60):
        data = simulate_repeats(seed)
        claimed = data.observations[0]
        wrong = replace(data, observations=(replace(claimed, covariance=claimed.covariance / 9.0),))
        result = check_lack_of_fit(identify(hexapod(), wrong, LeastSquares()), wrong)
        assert result.sigma_scale == pytest.approx(3.0, rel=0.3)
        blamed += not result.is_explained
    assert blamed <= 4  # P(binomial(60, 0.01) > 4) = 3e-4


def test_repeatable_error_outside_the_model_is_reported_as_lack_of_fit():
    data = simulate_repeats(1)
    rows = data.observations[0]
    warm = np.array(rows.measured)
    warm[:, 5] += 5 * UM * np.sin(300.0 * data.readings[:, 0])  # the same in all repeats of a pose
    bent = replace(data, observations=(replace(rows, measured=warm),))
    result = check_lack_of_fit(identify(hexapod(), bent, LeastSquares()), bent)
    assert result.is_explained is False
    assert "residuals.lack-of-fit" in [f.code for f in result.findings]
    assert result.sigma_scale == pytest.approx(1.0, abs=0.2)


def test_lack_of_fit_is_undecided_without_repeats_or_with_a_loss():
    data = hexapod_data(20)
    result = check_lack_of_fit(identify(hexapod(), data), data)
    assert result.is_explained is None
    assert [f.code for f in result.findings] == ["residuals.no-repeats"]
    again = simulate_repeats(2)
    assert check_lack_of_fit(identify(hexapod(), again, loss=Tukey()), again).is_explained is None


def test_correlated_parameters_are_grouped_and_named(monkeypatch):
    # small tilts: a leg's length and the heights of its ends act alike
    flat = zoo.make_poses(
        np.random.default_rng(0).uniform(-1, 1, (30, 6)) * [0.01, 0.01, 0.01, 0.05, 0.05, 0.05]
        + [0, 0, 0.2, 0, 0, 0]
    )
    truth = zoo.hexapod().with_values(zoo.hexapod_truth())
    fit = identify(hexapod(), simulate(truth, flat, tracker(), 0), LeastSquares())
    groups = find_correlated_groups(fit)
    assert groups
    assert abs(groups[0].correlation) > 0.9
    assert set(groups[0].pair) <= set(groups[0].names)
    assert groups[0].finding.code == "residuals.correlated-parameters"
    rho = fit.covariance / fit.standard_deviations[:, None] / fit.standard_deviations
    a, b = (fit.names.index(name) for name in groups[0].pair)
    assert groups[0].correlation == pytest.approx(rho[a, b])
    names = [name for group in groups for name in group.names]
    assert len(names) == len(set(names))
    monkeypatch.setattr(fit_examination, "STRONG", 1.0)
    assert find_correlated_groups(fit) == ()


def test_calibration_with_a_coarse_instrument_is_not_worthwhile():
    good, poor = hexapod_data(20), hexapod_data(20, instrument=tracker(2 * MM, 10e-3))
    fine = estimate_calibration_gain(identify(hexapod(), good), good)
    assert fine.is_worthwhile
    assert fine.position_after < 0.1 * fine.position_before
    for name in ("position", "orientation"):  # both sizes are in one unit
        assert len({size.unit for size in fine.finding.data[name]}) == 1
        assert len({str(size).split()[1] for size in fine.finding.data[name]}) == 1
    for method in (None, LeastSquares()):
        useless = estimate_calibration_gain(identify(hexapod(), poor, method), poor)
        assert useless.is_worthwhile is False
        assert useless.finding.code == "model.no-expected-gain"
    assert (
        estimate_calibration_gain(identify(hexapod(), poor, LeastSquares()), poor).position_after
        > 3 * fine.position_before
    )


def test_orientation_that_a_delta_cannot_have_neither_decides_nor_appears():
    """Its expected errors are rounding, 1e-16 degrees before and a third of that after."""
    robot = lc.load_robot("linear-delta")
    for sigma, is_worthwhile in ((1e-5, True), (0.05, False)):
        instrument = lc.Instrument(
            (lc.Sensor(lc.Component(("z",)), lc.Gaussian(np.array([sigma]))),)
        )
        coordinates = lc.sample_workspace(robot, 20, 1).coordinates
        data = simulate(robot, coordinates, instrument, 1)
        gain = estimate_calibration_gain(identify(robot, data), data)
        assert gain.is_worthwhile is is_worthwhile
        assert gain.angle_before == gain.angle_after == 0.0
        assert "orientation" not in str(gain.finding)


def test_expected_error_before_calibration_agrees_with_drawn_robots():
    data, robot = hexapod_data(20), hexapod()
    expected = estimate_calibration_gain(identify(robot, data), data)
    from loopcal.mechanism.solutions import forward

    rng, square = np.random.default_rng(0), []
    still = forward(robot, data.readings).T
    for _ in range(60):
        drawn = robot.with_values(robot.values + 0.035e-3 * rng.standard_normal(42))
        square.append(((forward(drawn, data.readings).T - still)[:, :3, 3] ** 2).sum(axis=1).mean())
    assert np.sqrt(np.mean(square)) == pytest.approx(expected.position_before, rel=0.1)


def test_gain_without_tolerances_is_undecided():
    data = hexapod_data(20)
    assert estimate_calibration_gain(identify(zoo.hexapod(), data), data).is_worthwhile is None
    assert estimate_calibration_gain(
        identify(with_tolerance(zoo.hexapod(), 1e-4), data), data
    ).is_worthwhile


EXAMPLE = Path(__file__).parents[2] / "examples" / "hexapod-42" / "measurements.csv"


@pytest.fixture(scope="module")
def stored(tmp_path_factory) -> tuple[lc.CalibrationReport, lc.Run]:
    robot = lc.load_robot("hexapod-42")
    data = lc.load_measurements(EXAMPLE, robot)
    report = lc.calibrate(robot, data, lc.CalibrationOptions(hold_out=0.25))
    folder = tmp_path_factory.mktemp("runs") / "run"
    lc.save_run(report, folder)
    return report, lc.load_run(folder)


def test_a_stored_run_knows_as_much_of_the_noise_as_its_fit(stored) -> None:
    """Otherwise `loopcal validate` calls errors noise that are none by the fit itself."""
    report, run = stored
    uncertainty = run.load_uncertainty()
    assert uncertainty is not None
    assert uncertainty.noise.degrees > SIGMA_AS_STATED.degrees
    assert uncertainty.noise == NoiseKnowledge.of(report.identification.residual_test)


def test_a_stored_run_with_too_large_residuals_knows_its_noise_as_stated(tmp_path) -> None:
    robot = lc.load_robot("hexapod-42")
    data = lc.load_measurements(EXAMPLE, robot)
    rows = [replace(o, covariance=o.covariance / 100.0) for o in data.observations]
    report = lc.calibrate(
        robot,
        replace(data, observations=tuple(rows)),
        lc.CalibrationOptions(fit=lc.FitOptions(sigma_uncertainty=0.0)),
    )
    lc.save_run(report, tmp_path / "run")
    uncertainty = lc.load_run(tmp_path / "run").load_uncertainty()
    assert uncertainty is not None
    assert uncertainty.noise.scale == 1.0
    assert uncertainty.noise == NoiseKnowledge.of(report.identification.residual_test)


def test_stored_residuals_have_labels_components_and_readings(stored) -> None:
    report, run = stored
    (own,), (read,) = report.identification.residuals, residuals_from_arrays(run.arrays)
    assert (read.kind, read.components, read.poses) == (own.kind, own.components, own.poses)
    assert (read.dimensions, tuple(read.context)) == (own.dimensions, tuple(own.context))
    for name in ("raw", "whitened", "readings"):
        np.testing.assert_array_equal(getattr(read, name), getattr(own, name))
    assert tuple(run.arrays["poses"]) == report.split.fitted.labels


def test_stored_validation_is_shown_as_that_of_the_report(stored) -> None:
    report, run = stored
    content = restore_numbers(run.result)["validation"]
    read, own = restore_validation(content, run.arrays, run.robot), report.validation
    assert own is not None
    assert view_errors(read, "held-out") == view_errors(own, "held-out")
    assert describe_improvements(read) == describe_improvements(own)
    np.testing.assert_array_equal(
        read.after["position"].components, own.after["position"].components
    )


def test_residuals_without_their_labels_are_not_read(stored) -> None:
    arrays = {name: a for name, a in stored[1].arrays.items() if not name.startswith("rows_")}
    assert residuals_from_arrays(arrays) == ()
