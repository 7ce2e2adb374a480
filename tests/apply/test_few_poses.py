# SPDX-License-Identifier: Apache-2.0
"""A wrong pose among few is found before poses are held out, and its values are not recommended."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import loopcal as lc
from loopcal.cli.hints import hint_for
from loopcal.estimate.free_parameters import free_only
from tests.findings.expectations import get_finding, list_codes

FREE = ("radius", *(f"tower{i}.stop" for i in (1, 2, 3)), "tower1.angle", "tower2.angle")
SIGMA, WRONG = 20e-6, 0.3e-3


def probe(seed: int, wrong: int | None) -> tuple[lc.Mechanism, lc.Measurements]:
    """Return 14 heights of a delta; one of them is wrong by 0.3 mm."""
    robot = free_only(lc.load_robot("linear-delta"), FREE)
    truth = robot.with_values(lc.sample_truth(robot, 1, seed)[0])
    points = lc.sample_workspace(robot, 14, seed).coordinates
    sensor = lc.Sensor(lc.Component(("z",)), lc.Gaussian(np.array([SIGMA])))
    data = lc.simulate(truth, points, lc.Instrument((sensor,)), seed)
    if wrong is None:
        return robot, data
    (rows,) = data.observations
    measured = np.array(rows.measured)
    measured[wrong] += WRONG
    return robot, replace(data, observations=(replace(rows, measured=measured),))


@pytest.mark.parametrize("hold_out", [0.0, 0.4])
def test_wrong_point_among_fourteen_is_named_and_left_out(hold_out: float) -> None:
    robot, data = probe(3, wrong=3)
    report = lc.calibrate(robot, data, lc.CalibrationOptions(hold_out=hold_out))
    assert "4" in report.list_outliers()
    assert report.recommendation.code == "values.leave-out"
    assert "pose 4" in report.recommendation.data["poses"]
    assert report.next_step.code == "workflow.next-check-outliers"
    assert "--drop 4" in (hint_for(report.next_step) or "")
    if hold_out:  # eight poses alone show nothing
        assert get_finding(report.findings, "outliers.all-poses").data["poses"] == ("4",)
        assert "outliers.none" not in list_codes(report.findings)
    assert report.verdict is not lc.Verdict.CALIBRATED


def test_faultless_points_are_not_left_out() -> None:
    robot, data = probe(4, wrong=None)
    report = lc.calibrate(robot, data, lc.CalibrationOptions(hold_out=0.4))
    assert report.list_outliers() == ()
    assert "outliers.all-poses" not in list_codes(report.findings)
    assert report.recommendation.code != "values.leave-out"


def test_wrong_point_that_is_excluded_is_not_named_again() -> None:
    robot, data = probe(3, wrong=3)
    options = lc.CalibrationOptions(lc.FitOptions(excluded_poses=("4",)), hold_out=0.4)
    report = lc.calibrate(robot, data, options)
    assert "4" not in report.list_outliers()
