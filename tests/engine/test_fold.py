# SPDX-License-Identifier: Apache-2.0
"""`fold` adds rows to a triangular factor and gives the factor of one QR of all rows."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal


def gram(R):
    """R'R, which does not depend on the signs of the factor's rows."""
    return R.swapaxes(-1, -2) @ R


@pytest.fixture
def rows():
    return np.random.default_rng(5).normal(size=(3, 40, 7)) * 10.0 ** np.arange(-3, 4)


@pytest.mark.parametrize(
    "cuts", [(11, 12, 30), (1, 3, 20), tuple(range(1, 40))], ids=["large", "small", "single rows"]
)
def test_folding_blocks_gives_the_factor_of_all_rows(engine, rows, cuts):
    factor = np.zeros((3, 7, 7))
    for part in np.split(rows, cuts, axis=1):
        factor = engine.fold(factor, part)
    assert_array_equal(factor, np.triu(factor))
    scale = np.linalg.norm(rows, axis=1, keepdims=True)
    whole = np.linalg.qr(rows, mode="r")
    # columns of length one, 40 rows
    assert_allclose(np.abs(factor / scale), np.abs(whole / scale), atol=1e-14)


def test_rows_of_zeros_equal_missing_rows(engine, rows):
    kept = rows.copy()
    kept[:, 5:9] = 0.0
    a = engine.fold(np.zeros((3, 7, 7)), kept)
    b = engine.fold(np.zeros((3, 7, 7)), np.delete(rows, np.s_[5:9], axis=1))
    scale = np.linalg.norm(rows, axis=1, keepdims=True)
    assert_allclose(np.abs(a / scale), np.abs(b / scale), atol=1e-14)


def test_null_directions_have_singular_values_at_rounding(engine, rows):
    rows[..., 6] = rows[..., 5] * 2 - rows[..., 4]
    scaled = rows / np.linalg.norm(rows, axis=1, keepdims=True)
    factor = engine.fold(engine.fold(np.zeros((3, 7, 7)), scaled[:, :20]), scaled[:, 20:])
    s = np.linalg.svd(factor, compute_uv=False)
    assert (s[:, -1] <= 1e-14 * s[:, 0]).all()


def test_folded_trials_equal_single_trials_bit_for_bit(engine, rows):
    together = engine.fold(np.zeros((3, 7, 7)), rows)
    for i in range(3):
        assert_array_equal(together[i], engine.fold(np.zeros((1, 7, 7)), rows[i : i + 1])[0])


@pytest.mark.parametrize("height", [40, 200])
@pytest.mark.parametrize("trials", [1, 3])
def test_begun_factors_and_factors_of_zeros_are_folded_bit_for_bit_as_alone(engine, height, trials):
    rng = np.random.default_rng(height)
    rows, factor = rng.normal(size=(trials, height, 7)), np.zeros((3, 7, 7))
    factor[1] = np.triu(rng.normal(size=(7, 7)))
    together = engine.fold(factor, rows)
    for i in range(3):
        own = rows[[i]] if trials > 1 else rows
        assert_array_equal(together[i], engine.fold(factor[[i]], own)[0])


def test_trials_can_share_rows(engine, rows):
    shared = engine.fold(np.zeros((2, 7, 7)), rows[:1])
    assert_array_equal(shared[0], shared[1])
    assert_allclose(gram(shared[0]), gram(rows[0]), rtol=1e-12)


def test_columns_of_zeros_in_the_first_rows_are_folded(engine, rows):
    rows[:, :30, :3] = 0.0  # as rows of other parameters
    factor = engine.fold(np.zeros((3, 7, 7)), rows)
    assert_allclose(gram(factor), gram(rows), rtol=1e-12, atol=1e-12)
