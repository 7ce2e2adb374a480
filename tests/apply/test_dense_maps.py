# SPDX-License-Identifier: Apache-2.0
"""Dense maps with slow residuals are held out by region, other data by pose."""

from dataclasses import replace

import numpy as np
import pytest

import loopcal as lc
from loopcal.diagnose.adjusted_uncertainty import adjust_uncertainty
from loopcal.estimate.identification import identify
from loopcal.measure.simulation import sample_truth
from tests.diagnose.test_model_discrepancy import (
    UM,
    bend,
    delta,
    displaced,
    measure,
    places,
    repeat_poses,
    touch_bed,
    touch_uneven_bed,
)

OPTIONS = lc.CalibrationOptions(hold_out=0.25)
BY_REGION = "workflow.regions-held-out"


def share_beside_fitted(report: lc.CalibrationReport, data: lc.Measurements) -> float:
    """Return the share of held-out points whose nearest other point is fitted."""
    assert report.split.held_out is not None
    at = places(delta(), data.readings)[:, :2]
    distance = np.linalg.norm(at[:, None] - at, axis=2) + np.diag(np.full(len(at), np.inf))
    is_held_out = np.isin(data.labels, report.split.held_out.labels)
    return float((~is_held_out)[distance.argmin(axis=1)][is_held_out].mean())


def test_regions_of_a_dense_map_with_slow_residuals_are_held_out():
    data = touch_uneven_bed(6)
    report = lc.calibrate(delta(), data, OPTIONS)
    (finding,) = (f for f in report.findings if f.code == BY_REGION)
    assert finding.data["count"] >= 8
    assert report.split.held_out is not None
    assert 0.15 < report.split.held_out.n_poses / data.n_poses < 0.35
    by_pose = data.split(hold_out=0.25, seed=OPTIONS.seed)[1]
    is_alone = np.isin(by_pose.labels, report.split.held_out.labels)
    assert not is_alone.all()
    assert share_beside_fitted(report, data) < 0.4  # of points drawn one by one: three quarters


@pytest.mark.parametrize(
    ("error", "seeds"),
    [
        (0.0, (6,)),
        (3e-3, (6,)),
        pytest.param(0.0, tuple(range(60)), marks=pytest.mark.evidence),
        pytest.param(3e-3, tuple(range(60)), marks=pytest.mark.evidence),
    ],
)
def test_values_are_applied_where_held_out_regions_show_a_gain_and_elsewhere_kept(error, seeds):
    """Bumps of the bed are no error of the machine, and are in all maps."""
    robot, wrong = delta(), error * (np.array(delta().parameters.names) == "radius")
    options = lc.CalibrationOptions(hold_out=0.25, check_conventions=False)
    applied = 0
    for seed in seeds:
        start = robot.with_values(sample_truth(robot, 1, seed)[0] + wrong)
        report = lc.calibrate(start, touch_uneven_bed(seed), options)
        assert report.validation is not None
        every = report.validation.checked.kinds[-1]
        is_applied = report.recommendation.code == "values.apply"
        assert not (is_applied and every.after > every.before)
        applied += is_applied
    wrong_decisions = len(seeds) - applied if error else applied
    assert wrong_decisions <= len(seeds) // 20  # 5 %


def test_slow_errors_far_above_the_noise_explain_residuals_and_fail_no_calibration():
    data = touch_uneven_bed(6)
    rows = data.observations[0]
    stated = lc.Observations.from_sigma(rows.kind, rows.rows, rows.measured, 3 * UM)
    data = replace(data, observations=(stated,))
    fit = adjust_uncertainty(identify(delta(), data), data)
    codes = {finding.code for finding in fit.findings}
    assert "noise.explained" in codes
    assert "noise.residuals-too-large" not in codes
    assert not fit.residual_test.failed


def test_slow_errors_of_a_raster_count_once():
    """Rows of a raster are neighbors in place: their errors are those of the places."""
    data = touch_uneven_bed(6)
    at = places(delta(), data.readings)
    raster = data.take(np.lexsort((at[:, 0], np.round(at[:, 1] / 15e-3))))
    fit = adjust_uncertainty(identify(delta(), raster), raster)
    codes = {finding.code for finding in fit.findings}
    assert "residuals.model-discrepancy" in codes
    assert not codes & {"residuals.correlated", "residuals.shared-errors"}


def test_clean_or_sparse_data_are_held_out_by_pose():
    data = measure(delta(), 30, 2)
    at = places(delta(), data.readings)
    for each in (touch_bed(5, 140), displaced(data, bend(at, at, 60 * UM, 3))):
        report = lc.calibrate(delta(), each, OPTIONS)
        assert BY_REGION not in [f.code for f in report.findings]
        drawn = each.split(hold_out=0.25, seed=OPTIONS.seed)[1]
        assert report.split.held_out is not None
        assert report.split.held_out.labels == drawn.labels


def test_repeats_stay_together_where_regions_are_held_out():
    data = repeat_poses(1)  # three of each
    regions = np.arange(data.n_poses) // 7  # that divide repeats
    fitted, held_out = data.split(hold_out=0.25, seed=1, regions=regions)
    assert held_out.n_poses
    assert not set(fitted.readings[:, 0]) & set(held_out.readings[:, 0])
