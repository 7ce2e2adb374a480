# SPDX-License-Identifier: Apache-2.0
"""A calibration with held-out poses, in memory and as a run folder, for tests of its report."""

from __future__ import annotations

from pathlib import Path

import pytest

import loopcal as lc

EXAMPLE = Path(__file__).parents[2] / "examples" / "hexapod-42" / "measurements.csv"


@pytest.fixture(scope="session")
def calibration() -> lc.CalibrationReport:
    robot = lc.load_robot("hexapod-42")
    data = lc.load_measurements(EXAMPLE, robot)
    return lc.calibrate(
        robot, data, lc.CalibrationOptions(hold_out=0.25, volume={"x": (-0.02, 0.02)})
    )


@pytest.fixture(scope="session")
def run(calibration, tmp_path_factory) -> lc.Run:
    folder = tmp_path_factory.mktemp("runs") / "run"
    lc.save_run(calibration, folder, {"data": EXAMPLE}, ["loopcal", "calibrate", "hexapod-42"])
    return lc.load_run(folder)


@pytest.fixture(scope="session")
def page(run, tmp_path_factory) -> Path:
    """Return the report of the run folder."""
    return lc.save_report(run, tmp_path_factory.mktemp("reports") / "report.html")
