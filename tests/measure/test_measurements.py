# SPDX-License-Identifier: Apache-2.0
"""Measurements are split, reduced to some poses and weighted; inconsistent ones are refused."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from loopcal.errors import DataError
from loopcal.measure.kinds.poses import Component
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import Observations

HEIGHT = Component(("z",), T_platform_tool=np.eye(4))
POINT = Component(("x", "y", "z"), T_platform_tool=np.eye(4))


def make_heights(n, block=None, rows=None):
    """Return measurements whose readings, values and labels contain the index of the pose."""
    seen = np.arange(n) if rows is None else np.asarray(rows)
    observations = Observations.from_sigma(HEIGHT, seen, 10.0 * seen[:, None], 1e-3)
    labels = tuple(f"p{i}" for i in range(n))
    together = np.arange(n) if block is None else np.asarray(block)
    return Measurements("toy", np.arange(2.0 * n).reshape(n, 2), (observations,), together, labels)


def get_reading_sigma(data):
    """Return the sigma of readings; it must be stated."""
    assert data.reading_sigma is not None
    return data.reading_sigma


def get_original_poses(data):
    """Return the original indices, after checking that readings, labels and rows agree."""
    original = (data.readings[:, 0] / 2).astype(int)
    assert data.labels == tuple(f"p{i}" for i in original)
    rows = data.observations[0]
    assert np.array_equal(rows.measured[:, 0], 10.0 * original[rows.rows])
    return original


def test_poses_and_residuals_are_counted_without_missing_components():
    data = make_heights(7)
    holed = Observations.from_sigma(POINT, [0, 3], [[0.0, np.nan, 1.0], [1.0, 2.0, 3.0]], 1.0)
    both = Measurements("toy", data.readings, (*data.observations, holed))
    assert (both.n_poses, both.n_rows) == (7, 7 + 5)
    assert both.labels == ("1", "2", "3", "4", "5", "6", "7")
    assert np.array_equal(both.block, np.arange(7))


def test_hold_out_of_a_quarter_gives_30_and_10_of_40_poses():
    fit, held_out = make_heights(40).split(hold_out=0.25, seed=1)
    assert (fit.n_poses, held_out.n_poses) == (30, 10)
    assert sorted([*get_original_poses(fit), *get_original_poses(held_out)]) == list(range(40))
    assert list(get_original_poses(fit)) == sorted(get_original_poses(fit))


@given(
    st.lists(st.integers(0, 6), min_size=2, max_size=40), st.floats(0.01, 0.99), st.integers(0, 99)
)
def test_split_keeps_blocks_whole_and_every_pose(block, fraction, seed):
    data = make_heights(len(block), block)
    if len(set(block)) == 1:
        with pytest.raises(DataError, match="single block"):
            data.split(hold_out=fraction, seed=seed)
        return
    fit, held_out = data.split(hold_out=fraction, seed=seed)
    assert not set(fit.block) & set(held_out.block)
    assert sorted([*get_original_poses(fit), *get_original_poses(held_out)]) == list(
        range(len(block))
    )
    assert fit.n_poses > 0
    assert held_out.n_poses > 0


def test_split_is_repeatable_and_changes_with_the_seed():
    parts = [
        get_original_poses(make_heights(40).split(hold_out=0.5, seed=seed)[0]).tolist()
        for seed in (3, 3, 4)
    ]
    assert parts[0] == parts[1] != parts[2]


@pytest.mark.parametrize("fraction", [0.0, 1.0, 75.0, -0.1, np.nan])
def test_hold_out_outside_zero_to_one_is_refused(fraction):
    with pytest.raises(DataError, match=r"above 0 and below 1, such as 0\.25"):
        make_heights(4).split(hold_out=fraction, seed=0)


def test_take_renumbers_rows_and_drops_those_of_other_poses():
    data = make_heights(5, rows=[4, 0, 4, 2])
    part = data.take([4, 1])
    assert get_original_poses(part).tolist() == [4, 1]
    assert part.observations[0].rows.tolist() == [0, 0]
    assert get_original_poses(data.take(np.array([True, False, False, False, True]))).tolist() == [
        0,
        4,
    ]


@pytest.mark.parametrize("poses", [[5], [-1], [1, 1], []])
def test_take_of_missing_or_repeated_poses_is_refused(poses):
    with pytest.raises(DataError, match="at least one of 0 to 4, each once"):
        make_heights(5).take(poses)


def test_weights_of_poses_apply_to_their_rows():
    data = make_heights(4, rows=[0, 1, 1, 3]).with_weights([1.0, 0.0, 1.0, 0.25])
    assert data.observations[0].weight.tolist() == [1.0, 0.0, 0.0, 0.25]
    assert data.observations[0].whitener.shape == (4, 1, 1)
    assert data.n_rows == 2
    with pytest.raises(DataError, match=r"weight of the poses has shape \(3,\)"):
        make_heights(4).with_weights([1.0, 1.0, 1.0])


def test_sigma_of_readings_follows_take_split_and_weights():
    data = _data_with_sigma(
        [[1e-6, np.inf], [0.0, 2e-6], [3e-6, 3e-6]], [[1.0, np.nan], [2.0, 2.0], [3.0, 3.0]]
    )
    assert get_reading_sigma(data.take([2, 0])).tolist() == [[3e-6, 3e-6], [1e-6, np.inf]]
    fit, held_out = data.split(hold_out=0.4, seed=1)
    assert len(get_reading_sigma(fit)) + len(get_reading_sigma(held_out)) == 3
    weighted = data.with_weights([4.0, 1.0, 0.0])
    assert get_reading_sigma(weighted).tolist() == [[5e-7, np.inf], [0.0, 2e-6], [np.inf, np.inf]]
    assert get_reading_sigma(_data_with_sigma(1e-6, np.ones((3, 2)))).shape == (3, 2)


def _data_with_sigma(sigma, readings):
    return Measurements("r", np.asarray(readings, dtype=float), (), reading_sigma=sigma)
