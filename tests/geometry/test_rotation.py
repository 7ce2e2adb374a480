# SPDX-License-Identifier: Apache-2.0
"""Exponential, logarithm, their Jacobians and quaternions: near zero, near pi and between."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from loopcal import geometry
from tests.jacobians import check_jacobian

ROUNDING = 4e-15  # [1] or [rad], a few ulps over one product of rotations
coordinate = st.floats(-1.0, 1.0)
direction = (
    st.tuples(coordinate, coordinate, coordinate)
    .map(np.array)
    .filter(lambda v: np.linalg.norm(v) > 1e-3)
)
unit = direction.map(lambda v: v / np.linalg.norm(v))
angle = st.one_of(
    st.floats(0.0, np.pi - 1e-6),
    st.floats(-200.0, -1.0).map(lambda exponent: 10.0**exponent),
    st.floats(-12.0, -1.0).map(lambda exponent: np.pi - 10.0**exponent),
)
vector = st.builds(lambda n, t: t * n, unit, angle)


@given(vector)
def test_exponential_is_a_rotation_and_agrees_with_scipy(w):
    R = geometry.exp_so3(w)
    assert_allclose(R @ R.T, np.eye(3), atol=ROUNDING)
    assert_allclose(R, Rotation.from_rotvec(w).as_matrix(), atol=ROUNDING)


@given(vector)
def test_logarithm_inverts_the_exponential_from_zero_to_pi(w):
    back = geometry.log_so3(geometry.exp_so3(w))
    # Turning a matrix to a vector cannot be better than its entries: a few ulps of 1, at every
    # angle.
    assert_allclose(back, w, atol=4 * ROUNDING)


@given(unit, st.floats(-15.0, -3.0))
def test_small_angles_keep_their_relative_accuracy(n, exponent):
    w = 10.0**exponent * n
    assert_allclose(
        geometry.log_so3(geometry.exp_so3(w)), w, rtol=0.0, atol=2e-16 + 4e-16 * 10.0**exponent
    )


@given(unit)
def test_logarithm_at_pi_is_one_of_the_two_rotation_vectors(n):
    back = geometry.log_so3(2.0 * np.outer(n, n) - np.eye(3))
    assert_allclose(np.linalg.norm(back), np.pi, atol=ROUNDING)
    assert_allclose(
        np.outer(back, back) / np.pi**2, np.outer(n, n), atol=1e-14
    )  # [1], the square root of the diagonal


def test_zero_rotation_gives_the_exact_identity():
    assert np.array_equal(geometry.exp_so3(np.zeros(3)), np.eye(3))
    assert np.array_equal(geometry.log_so3(np.eye(3)), np.zeros(3))
    assert np.array_equal(geometry.left_jacobian_so3(np.zeros(3)), np.eye(3))
    assert np.array_equal(geometry.left_jacobian_inverse_so3(np.zeros(3)), np.eye(3))


@given(vector)
def test_left_jacobian_times_its_inverse_is_the_identity(w):
    product = geometry.left_jacobian_so3(w) @ geometry.left_jacobian_inverse_so3(w)
    assert_allclose(
        product, np.eye(3), atol=2e-14
    )  # [1], at pi the inverse has entries of size 1.6


@pytest.mark.slow
@pytest.mark.parametrize("size", [1e-9, 3.1])
def test_left_jacobian_is_the_derivative_of_the_exponential(size):
    w = size * np.array([0.6, -0.48, 0.64])
    base = np.array(geometry.exp_so3(w)).T

    def turned(x):
        return geometry.log_so3(geometry.exp_so3(w + x) @ base)

    check_jacobian(turned, geometry.left_jacobian_so3(w), np.zeros(3), scale=0.3, automatic=turned)


@pytest.mark.slow
@pytest.mark.parametrize("size", [1e-9, 3.0])
def test_inverse_left_jacobian_is_the_derivative_of_the_logarithm(size):
    w = size * np.array([0.6, -0.48, 0.64])
    R = geometry.exp_so3(w)

    def logarithm(x):
        return geometry.log_so3(geometry.exp_so3(x) @ R)

    check_jacobian(
        logarithm,
        geometry.left_jacobian_inverse_so3(w),
        np.zeros(3),
        scale=0.05,
        automatic=logarithm,
    )


@given(vector, st.sampled_from([-3.0, 1.0, 0.1]))
def test_quaternions_of_any_length_and_sign_round_trip(w, length):
    R = geometry.exp_so3(w)
    q = geometry.matrix_to_quaternion(R)
    assert q[0] >= 0.0
    assert_allclose(np.linalg.norm(q), 1.0, atol=ROUNDING)
    assert_allclose(geometry.quaternion_to_matrix(length * q), R, atol=ROUNDING)
    scipy_q = np.roll(Rotation.from_matrix(R).as_quat(), 1)
    assert_allclose(np.abs(q @ scipy_q), 1.0, atol=ROUNDING)


def test_single_rotation_equals_the_same_rotation_in_a_batch():
    w = np.random.default_rng(3).normal(size=(2, 5, 3))
    batch = geometry.exp_so3(w)
    assert batch.shape == (2, 5, 3, 3)
    assert_allclose(
        geometry.exp_so3(w[1, 4]), batch[1, 4], atol=1e-16
    )  # [1], one ulp: vectorised sine may differ
    assert_allclose(
        geometry.log_so3(batch)[1, 4], geometry.log_so3(batch[1, 4]), atol=1e-15
    )  # [rad], likewise
