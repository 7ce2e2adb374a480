# SPDX-License-Identifier: Apache-2.0
"""A machine with fewer actuators than coordinates: its limits are no limits on commanded poses."""

import re

import numpy as np
import pytest

import loopcal as lc
from loopcal.measure.instrument import Instrument, Sensor
from loopcal.measure.kinds.poses import Pose
from loopcal.measure.simulation import sample_truth, simulate
from loopcal.mechanism.workspace import sample_workspace
from loopcal.report.calibration_view import view_calibration
from loopcal.report.validation_view import describe_commanded
from loopcal.results.tables import render_text
from tests.estimate.problems import UM, URAD, noise


def calibrate_drawn(name: str) -> lc.CalibrationReport:
    """Return the calibration of a machine drawn from its spreads, against a limit of 20 um."""
    robot = lc.load_robot(name)
    machine = robot.with_values(sample_truth(robot, 1, 3)[0])
    instrument = Instrument((Sensor(Pose(), noise(*[20 * URAD] * 3, *[5 * UM] * 3)),))
    poses = sample_workspace(robot, 30, 7).coordinates
    options = lc.CalibrationOptions(hold_out=0.25, limit_position=20 * UM)
    return lc.calibrate(robot, simulate(machine, poses, instrument, 1), options)


@pytest.mark.usefixtures("do_not_draw")
def test_report_of_a_tripod_says_that_commanded_poses_are_still_missed(tmp_path) -> None:
    report = calibrate_drawn("3-prs")
    errors = report.validation
    assert errors is not None
    assert any(finding.code == "conformity.conforms" for finding in report.findings)
    sentence = describe_commanded(errors)
    rms = 1e3 * np.sqrt(np.mean(errors.not_compensable.position**2))  # [mm]
    (stated,) = re.findall(r"before calibration by ([0-9.]+) mm", sentence)
    assert abs(float(stated) - rms) < 1e-2 * rms
    assert rms > 10.0 * 0.02  # [mm] far above the limit that the predicted poses keep
    text = " ".join(render_text(view_calibration(report), 100).split())
    assert sentence in text
    lc.save_report(report, tmp_path / "report.html")
    assert (tmp_path / "report.html").read_text("utf-8").count(sentence) == 2  # verdict, errors


def test_errors_that_the_actuators_correct_are_not_called_missed() -> None:
    errors = calibrate_drawn("biped-leg").validation  # roll and pitch are commanded, x alone
    assert errors is not None
    (missed,) = re.findall(r"before calibration by (.+) \(rms", describe_commanded(errors))
    assert missed.split()[1:] == ["mm", "in", "position"]


def test_noise_is_no_error_that_readings_cannot_correct() -> None:
    """A 3-PRS without errors: what remains is the noise of the instrument."""
    robot = lc.load_robot("3-prs")
    instrument = Instrument((Sensor(Pose(), noise(*[20 * URAD] * 3, *[5 * UM] * 3)),))
    poses = sample_workspace(robot, 30, 7).coordinates
    exact = robot.with_values(robot.nominal.values)
    report = lc.calibrate(
        exact, simulate(exact, poses, instrument, 1), lc.CalibrationOptions(hold_out=0.25)
    )
    assert report.validation is not None
    stated = re.findall(r"calibration by ([0-9.]+) mm", describe_commanded(report.validation))
    noise_alone = 1e3 * np.sqrt(np.mean(report.validation.commanded_after.position**2))
    assert all(float(value) < 0.5 * noise_alone for value in stated)


def test_a_machine_that_can_correct_everything_has_no_such_sentence() -> None:
    errors = calibrate_drawn("hexapod-42").validation
    assert errors is not None
    assert describe_commanded(errors) == ""
