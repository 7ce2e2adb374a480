# SPDX-License-Identifier: Apache-2.0
"""Repeats: poses whose readings differ by less than shows in the measurements."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import loopcal as lc
from loopcal.diagnose.cross_validation import draw_folds
from loopcal.diagnose.model_discrepancy import check_lack_of_fit
from loopcal.measure.readings import find_repeats
from tests import zoo
from tests.estimate.problems import UM, hexapod, hexapod_poses, tracker

JITTER = 0.1 * UM
POSES, TIMES = 14, 3


def simulate_jitter(jitter: float, sigma: float = 1.0, seed: int = 1) -> lc.Measurements:
    """Return three visits of each pose, of which the recorded readings jitter [m]."""
    truth = zoo.hexapod().with_values(zoo.hexapod_truth())
    data = lc.simulate(truth, np.repeat(hexapod_poses(POSES, 5), TIMES, axis=0), tracker(), seed)
    stream = np.random.default_rng(seed)
    readings = data.readings + stream.normal(0.0, jitter, data.readings.shape)
    rows = data.observations[0]
    noisier = replace(rows, covariance=rows.covariance * sigma**2)
    return replace(data, readings=readings, observations=(noisier,))


@pytest.mark.parametrize("jitter", [0.0, 1e-3 * UM, JITTER])
def test_visits_are_repeats_although_their_recorded_readings_jitter(jitter: float) -> None:
    data = simulate_jitter(jitter)
    visits = np.repeat(np.arange(POSES), TIMES)
    assert len(np.unique(np.column_stack([data.repeats, visits]), axis=0)) == POSES
    assert len(np.unique(data.repeats)) == POSES
    result = check_lack_of_fit(lc.identify(hexapod(), data, lc.LeastSquares()), data)
    assert (result.groups, result.pure_degrees) == (POSES, POSES * (TIMES - 1) * 6)
    for seed in range(5):
        fitted, held_out = data.split(hold_out=0.3, seed=seed)
        label = dict(zip(data.labels, visits, strict=True))
        assert not {label[x] for x in fitted.labels} & {label[x] for x in held_out.labels}
        for fold in draw_folds(data, 4, seed):
            assert all(np.isin(np.flatnonzero(visits == v), fold).all() for v in visits[fold])


def test_near_poses_are_no_repeats_for_an_instrument_that_tells_them_apart() -> None:
    """0.1 um are 30 standard deviations of an interferometer, which has no repeats here."""
    data = simulate_jitter(JITTER, sigma=1e-3)
    assert len(np.unique(data.repeats)) == POSES * TIMES


def test_slow_scan_is_no_cluster_of_repeats_in_any_order() -> None:
    """Steps of 0.05 um are below the tolerance, but their chain is not; equal readings are."""
    scan = np.outer(np.arange(1000), np.full(6, 0.05 * UM))
    alone = np.random.default_rng(2).uniform(-0.1, 0.1, (500, 6))
    visits = np.repeat(np.random.default_rng(3).uniform(-0.1, 0.1, (100, 6)), 5, axis=0)
    visits += np.random.default_rng(4).uniform(-JITTER, JITTER, visits.shape)
    readings = np.concatenate([scan, scan[[500, 500]], alone, visits]).astype(np.float64)
    label = find_repeats(readings, np.full(6, 0.5 * UM))
    assert np.bincount(label)[label[:1000]].tolist() == [1] * 500 + [3] + [1] * 499
    assert (np.bincount(label)[label[1002:1502]] == 1).all()
    assert (np.bincount(label)[label[1502:]] == 5).all()
    order = np.random.default_rng(5).permutation(len(readings))
    assert np.array_equal(find_repeats(readings[order], np.full(6, 0.5 * UM)), label[order])


def test_visits_of_one_pose_are_repeats() -> None:
    """No reading has a range then, with which its jitter could be compared."""
    data = simulate_jitter(JITTER)
    assert len(np.unique(data.take(data.repeats == data.repeats[0]).repeats)) == 1


def test_missing_readings_are_equal_to_each_other_only() -> None:
    readings = np.array([[1.0, np.nan], [1.0, np.nan], [1.0, 2.0]])
    data = lc.Measurements("toy", readings, (), reading_sigma=np.array([0.0, np.inf]))
    assert data.repeats[0] == data.repeats[1] != data.repeats[2]
