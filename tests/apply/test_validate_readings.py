# SPDX-License-Identifier: Apache-2.0
"""Validation where readings are missing, or are all that was measured, and the setup before."""

from dataclasses import replace

import numpy as np
import pytest

from loopcal.apply.calibration import calibrate
from loopcal.apply.calibration_options import CalibrationOptions, split_data
from loopcal.apply.calibration_report import Verdict
from loopcal.apply.validation import validate
from loopcal.errors import DataError, FileError
from loopcal.estimate.identification import identify
from loopcal.estimate.options import FitOptions
from loopcal.io.data.measurement_file import load_measurements, save_measurements
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.poses import Component
from loopcal.measure.kinds.position import Position
from loopcal.measure.observations import Observations
from loopcal.measure.simulation import simulate
from loopcal.mechanism.workspace import sample_workspace
from loopcal.report.validation_view import view_validation
from tests.estimate.problems import UM, hexapod, hexapod_data, hexapod_poses
from tests.estimate.uncertain_reading_problems import build_hexapod_with_seven_legs
from tests.findings.expectations import get_finding, list_codes

MM = 1e-3
PLACES = np.array([[0.1, 0.0, 0.0], [0.0, 0.12, 0.0], [-0.1, -0.1, 0.05]])
TARGETS = Instrument(
    (Sensor(Position(targets=("a", "b", "c"), places=PLACES), Gaussian(np.full(9, 5 * UM))),)
)


def without_readings(data, missing):
    """Return measurements without some readings (n, a)."""
    readings = np.where(missing, np.nan, data.readings)
    return replace(data, readings=readings, reading_sigma=np.where(missing, np.inf, 0.0))


def test_pose_with_a_missing_reading_is_estimated_with_its_rows():
    robot = hexapod()
    data = hexapod_data(40, 0, TARGETS)
    fitted, held_out = data.split(hold_out=0.25, seed=1)
    fit = identify(robot, fitted)
    missing = np.zeros(held_out.readings.shape, dtype=bool)
    missing[2, 1] = missing[5, [0, 3]] = True
    whole, part = validate(fit, held_out), validate(fit, without_readings(held_out, missing))
    assert part.judged == whole.judged == 10
    assert part.absorbed == 3  # three unknown readings
    assert part.values_left == whole.values_left - 3
    other = ~np.isin(whole.after["position"].rows, [2, 5])
    np.testing.assert_allclose(part.after.position[other], whole.after.position[other], rtol=1e-6)
    estimated = get_finding(part.findings, "validation.poses-estimated")
    assert estimated.data["absorbed"] == 3
    # least squares over the unknown leg by hand: nine residuals, one direction
    changed, leg = np.array(held_out.readings), 1
    h = 1e-6
    changed[2, leg] += h
    moved = replace(held_out, readings=changed)
    base, step = (_residuals(fit, d)[2] for d in (held_out, moved))
    slope = (step - base) / h
    left = base - slope * (slope @ base) / (slope @ slope)
    rows = part.after["position"]
    size = np.linalg.norm(left.reshape(3, 3), axis=1)
    np.testing.assert_allclose(rows.size[rows.rows == 2], size, rtol=1e-3, atol=1e-9)


def _residuals(fit, data):
    """Return the residuals (r, 9) of held-out rows."""
    errors = validate(fit, data).after["position"]
    n = data.n_poses
    return errors.components.reshape(3, n, 3).transpose(1, 0, 2).reshape(n, 9)


def test_pose_that_needs_all_its_rows_is_not_validated():
    robot = load_robot("linear-delta")
    heights = Instrument((Sensor(Component(("z",)), Gaussian(np.array([5 * UM]))),))
    poses = sample_workspace(robot, 8, 1).coordinates
    data = simulate(robot, poses, heights, 1)
    missing = np.zeros(data.readings.shape, dtype=bool)
    missing[3, 0] = True
    result = validate(robot, without_readings(data, missing))
    assert result.judged == 7
    assert get_finding(result.findings, "validation.missing-readings").data["names"] == ("pose 4",)
    missing[:, 0] = True
    with pytest.raises(DataError) as error:
        validate(robot, without_readings(data, missing))
    assert error.value.code == "residuals.readings-missing"
    options = CalibrationOptions(held_out=("1", "2", "3", "4", "5", "6"))
    some = np.zeros(data.readings.shape, dtype=bool)
    some[:6, 0] = True
    many = simulate(robot, sample_workspace(robot, 30, 2).coordinates, heights, 2)
    some = np.zeros(many.readings.shape, dtype=bool)
    some[:6, 0] = True
    report = calibrate(robot, without_readings(many, some), options)
    assert report.verdict is Verdict.UNDECIDED  # and not "not calibrated: check units"
    assert "workflow.nothing-to-validate" in list_codes(report.findings)


def test_redundant_readings_alone_are_validated_in_units_of_their_sigma():
    """Seven legs must agree on one pose: each pose leaves one value, of variance 1."""
    robot = build_hexapod_with_seven_legs()
    instrument = Instrument((Sensor(Position(), Gaussian(np.full(3, 5 * UM))),))
    poses = hexapod_poses(40, 1)
    data = simulate(robot, poses, instrument, 1)
    empty = replace(data.observations[0], measured=np.full((40, 3), np.nan))
    alone = replace(data, observations=(empty,))
    result = validate(robot, alone)
    assert result.quantities == ()
    assert (result.judged, result.poses) == (40, ())
    readings, every = result.kinds
    assert (readings.kind, readings.count, every.count) == ("actuator readings", 40, 40)
    assert readings.after == pytest.approx(1.0, abs=4 / np.sqrt(80))
    assert result.blunders == ()
    wrong = np.array(data.readings)
    wrong[7, 2] += 1 * MM
    (blunder,) = validate(robot, replace(alone, readings=wrong)).blunders
    assert blunder.poses == ("8",)
    text = "\n".join(map(str, view_validation(result, False, True)))
    assert "divided by sigma" in text


def test_setup_before_fits_the_initial_robot_wherever_the_fit_starts():
    """Before is a baseline of the setup alone, also where the fit starts at another geometry."""
    kind = Position(targets=("a", "b", "c"), places=PLACES, unknown=("frame",), frame="trk")
    tracker = Instrument((Sensor(kind, Gaussian(np.full(9, 5 * UM))),))
    robot, data = hexapod(), hexapod_data(30, 0, tracker)
    fitted, held_out = data.split(hold_out=0.25, seed=1)
    usual = identify(robot, fitted)
    near = identify(robot, fitted, options=FitOptions(start=usual.robot.values))
    np.testing.assert_allclose(near.nuisance.start, usual.nuisance.start, rtol=0, atol=1e-9)
    before = [validate(fit, held_out).before.statistics("position").rms for fit in (usual, near)]
    assert before[1] == pytest.approx(before[0], rel=1e-6)


def test_few_poses_and_noise_are_not_called_larger():
    """A single pose that the nominal geometry meets by construction is no evidence."""
    robot, data = hexapod(), hexapod_data(30)
    result = validate(robot, data.take([0]), before=robot)
    assert "larger" not in "\n".join(map(str, view_validation(result, True, False)))
    report = calibrate(robot, data, CalibrationOptions(held_out=("1",)))
    assert report.verdict is Verdict.UNDECIDED
    # an exact geometry: both errors are noise, and a growth by 10 % is no failure
    exact = simulate(robot, hexapod_poses(40, 1), TARGETS, 3)
    calibrated = calibrate(robot, exact, CalibrationOptions(hold_out=0.25))
    assert "gates.errors-grew" not in list_codes(calibrated.findings)
    assert calibrated.validation is not None
    assert all(change.is_noise for change in calibrated.validation.changes().values())


def test_repeats_of_a_pose_stay_on_one_side_of_a_split():
    data = hexapod_data(12)
    twice = replace(data, readings=np.repeat(data.readings[:6], 2, axis=0), block=np.arange(12))
    for seed in range(8):
        split = split_data(twice, hold_out=0.4, seed=seed)
        assert split.repeats == ()
    named = split_data(twice, held_out=("1", "3", "4"))
    assert named.repeats == ("1",)


def test_assumed_noise_survives_a_file_and_decides_nothing(tmp_path):
    robot = load_robot("linear-delta")
    heights = Instrument((Sensor(Component(("z",)), Gaussian(np.array([50 * UM]))),))
    data = simulate(robot, sample_workspace(robot, 30, 1).coordinates, heights, 1)
    rows = data.observations[0]
    assumed = Observations.from_sigma(rows.kind, rows.rows, rows.measured, 5 * UM)
    data = replace(data, observations=(replace(assumed, is_noise_assumed=True),))
    save_measurements(data, tmp_path / "heights.csv", robot)
    read = load_measurements(tmp_path / "heights.csv", robot)
    assert read.noise_source == "assumed"
    fit = identify(robot, read)
    noise = get_finding(fit.findings, "noise.assumed-replaced")
    estimated = noise.data["sigmas"][0]["estimated"]
    assert estimated.value == pytest.approx(0.05, rel=0.4)  # mm
    stated = replace(data, observations=(replace(data.observations[0], is_noise_assumed=False),))
    assert "noise.residuals-too-large" in list_codes(identify(robot, stated).findings)
    text = (tmp_path / "heights.csv").read_text().replace("assumed", "guessed")
    (tmp_path / "wrong.csv").write_text(text)
    with pytest.raises(FileError, match="noise_source is 'guessed'"):
        load_measurements(tmp_path / "wrong.csv", robot)
