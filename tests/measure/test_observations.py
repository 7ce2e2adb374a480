# SPDX-License-Identifier: Apache-2.0
"""Rows of one kind: whitening, missing components, weights and refusals."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from loopcal import geometry
from loopcal.measure.kinds.poses import Component, Pose
from loopcal.measure.observations import Observations

POINT = Component(("x", "y", "z"), T_platform_tool=np.eye(4))
POSE = Pose(T_platform_tool=np.eye(4))


def draw_covariances(r, m, seed=0):
    A = np.random.default_rng(seed).normal(size=(r, m, m))
    scale = 10.0 ** np.linspace(-6, -3, m)  # mixed units: micrometres beside millimetres
    return (A @ np.swapaxes(A, 1, 2) + 0.1 * np.eye(m)) * np.outer(scale, scale)


def test_whitener_is_the_inverse_lower_cholesky_factor():
    C = draw_covariances(20, 6)
    data = Observations(POSE, np.arange(20), np.zeros((20, 6)), C)
    W = data.whitener
    expected = np.tril(np.linalg.inv(np.linalg.cholesky(C)))
    size = np.abs(expected).max(axis=2, keepdims=True)
    assert_allclose(
        W / size, expected / size, atol=1e-10
    )  # [1], ulps times a condition of up to 1e5
    assert_allclose(W @ C @ np.swapaxes(W, 1, 2), np.broadcast_to(np.eye(6), C.shape), atol=1e-10)


@given(st.lists(st.booleans(), min_size=3, max_size=3), st.integers(0, 1000))
def test_missing_components_are_removed_from_the_covariance(is_present, seed):
    present = np.flatnonzero(is_present)
    C = draw_covariances(1, 3, seed)
    measured = np.where(is_present, np.random.default_rng(seed).normal(size=3), np.nan)[None]
    data = Observations(POINT, np.array([0]), measured, C)
    T = geometry.apply_twist(np.eye(4), np.random.default_rng(seed).normal(size=6))[None, None]
    result = data.evaluate(T)
    white, slopes = (
        data.whitener[0] @ result.residual[0, 0],
        data.whitener[0] @ result.jacobian[0, 0],
    )
    assert_allclose(np.delete(white, present), 0.0, atol=0.0)
    assert_allclose(np.delete(slopes, present, axis=0), 0.0, atol=0.0)
    W = np.linalg.inv(np.linalg.cholesky(C[0][np.ix_(present, present)]))
    assert_allclose(white[present], W @ (T[0, 0, present, 3] - measured[0, present]), rtol=1e-9)
    assert data.n_residuals == len(present)


def test_covariance_entries_of_missing_components_are_ignored():
    C = draw_covariances(1, 3)
    measured = np.array([[1.0, np.nan, 2.0]])
    broken = C.copy()
    broken[:, 1, :] = broken[:, :, 1] = np.nan
    first, second = (Observations(POINT, np.array([0]), measured, c) for c in (C, broken))
    assert np.array_equal(first.whitener, second.whitener)


def test_weight_multiplies_the_square_and_zero_removes_a_row():
    C = draw_covariances(3, 3)
    one = Observations(POINT, np.arange(3), np.zeros((3, 3)), C)
    weighed = one.with_weights([1.0, 0.25, 0.0])
    assert_allclose(
        weighed.whitener, one.whitener * np.array([1.0, 0.5, 0.0])[:, None, None], rtol=1e-15
    )
    assert (one.n_residuals, weighed.n_residuals) == (9, 6)


def test_sigma_is_one_number_one_per_column_or_one_per_row_and_column():
    rows, measured = np.arange(2), np.zeros((2, 3))
    for sigma in (2.0, [2.0, 2.0, 2.0], np.full((2, 3), 2.0)):
        data = Observations.from_sigma(POINT, rows, measured, sigma)
        assert_allclose(data.covariance, np.broadcast_to(4.0 * np.eye(3), (2, 3, 3)), rtol=1e-15)


def test_arrays_are_read_only_copies():
    measured = np.zeros((2, 3))
    data = Observations.from_sigma(POINT, np.arange(2), measured, 1.0)
    measured[0, 0] = 7.0
    assert data.measured[0, 0] == 0.0
    for name in ("rows", "measured", "covariance", "weight", "present", "whitener"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(data, name)[0] = 1


@pytest.mark.slow
def test_100000_rows_are_whitened():
    data = Observations.from_sigma(POSE, np.arange(100_000), np.zeros((100_000, 6)), 1e-3)
    assert_allclose(data.whitener[99_999], 1e3 * np.eye(6), rtol=1e-12)


def test_rows_of_equal_noise_share_one_matrix_also_when_some_are_taken() -> None:
    measured = np.random.default_rng(1).normal(0.0, 0.01, (500, 6))
    rows = Observations.from_sigma(POSE, np.arange(500), measured, [5e-6] * 3 + [1e-6] * 3)
    apart = replace(rows, covariance=np.array(rows.covariance), weight=np.r_[np.ones(499), 2.0])
    for each in (rows, rows.take(measured[:, 0] > 0.0), rows.take(np.arange(3))):
        assert each.covariance.strides[0] == each.whitener.strides[0] == 0
        assert_allclose(each.whitener[:2], apart.whitener[:2], rtol=1e-15)  # rounding of a product
    assert apart.whitener.strides[0] > 0  # one row has another weight
