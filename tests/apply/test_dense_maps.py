# SPDX-License-Identifier: Apache-2.0
"""Dense maps with slow residuals are held out by region, other data by pose."""

import numpy as np

import loopcal as lc
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
