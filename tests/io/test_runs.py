# SPDX-License-Identifier: Apache-2.0
"""A loaded run has the robots, result and measurements of the saved calibration."""

from pathlib import Path

import numpy as np
import pytest

import loopcal as lc
from loopcal.errors import FileError
from tests.findings.expectations import expect_refusal

DATA = Path("examples/hexapod-42/measurements.csv").resolve()


@pytest.fixture(scope="module")
def calibrated():
    robot = lc.load_robot("hexapod-42")
    data = lc.load_measurements(DATA, robot)
    return robot, lc.calibrate(robot, data, lc.CalibrationOptions(hold_out=0.25))


def test_saved_report_is_loaded_as_a_run(tmp_path, calibrated) -> None:
    robot, report = calibrated
    lc.save_run(report, tmp_path / "run", {"data": DATA}, ["a test"])
    run = lc.load_run(tmp_path / "run")
    np.testing.assert_allclose(run.robot.values, report.robot.values, rtol=0, atol=1e-15)
    np.testing.assert_allclose(run.initial_robot.values, robot.values, rtol=0, atol=1e-15)
    assert run.result["verdict"] == report.verdict.name.lower()
    assert run.result["made_by"]["command"] == ["a test"]
    assert run.load_posterior().names == report.identification.names
    fitted, held_out = run.load_measurements()
    assert fitted.labels == report.split.fitted.labels
    assert report.split.held_out is not None
    assert held_out is not None
    assert held_out.labels == report.split.held_out.labels == run.held_out
    with expect_refusal("files.folder-in-use", FileError):
        lc.save_run(report, tmp_path / "run")


def test_changed_or_missing_measurements_of_a_run_are_refused(tmp_path, calibrated) -> None:
    _, report = calibrated
    copy = tmp_path / "data.csv"
    copy.write_bytes(DATA.read_bytes())
    lc.save_run(report, tmp_path / "run", {"data": copy})
    copy.write_bytes(DATA.read_bytes() + b"\n")
    with pytest.raises(FileError, match="differs from the file of the run"):
        lc.load_run(tmp_path / "run").load_measurements()
    lc.save_run(report, tmp_path / "bare")
    with pytest.raises(FileError, match="names no measurement files"):
        lc.load_run(tmp_path / "bare").load_measurements()
