# SPDX-License-Identifier: Apache-2.0
"""Residuals and validations in a run folder are those of the report."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import loopcal as lc
from loopcal.apply.validation import restore_validation
from loopcal.estimate.result import residuals_from_arrays
from loopcal.report.validation_view import describe_improvements, view_errors
from loopcal.results.serialization import restore_numbers

EXAMPLE = Path(__file__).parents[2] / "examples" / "hexapod-42" / "measurements.csv"


@pytest.fixture(scope="module")
def stored(tmp_path_factory) -> tuple[lc.CalibrationReport, lc.Run]:
    robot = lc.load_robot("hexapod-42")
    data = lc.load_measurements(EXAMPLE, robot)
    report = lc.calibrate(robot, data, lc.CalibrationOptions(hold_out=0.25))
    folder = tmp_path_factory.mktemp("runs") / "run"
    lc.save_run(folder, report)
    return report, lc.load_run(folder)


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
    assert read is not None
    assert view_errors(read, "held-out") == view_errors(own, "held-out")
    assert describe_improvements(read) == describe_improvements(own)
    np.testing.assert_array_equal(
        read.after["position"].components, own.after["position"].components
    )
    older = {key: value for key, value in content.items() if key != "judged"}
    assert restore_validation(older, run.arrays, run.robot) is None


def test_runs_of_older_versions_have_no_labeled_residuals(stored) -> None:
    arrays = {name: a for name, a in stored[1].arrays.items() if not name.startswith("rows_")}
    assert residuals_from_arrays(arrays) == ()
