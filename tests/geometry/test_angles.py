# SPDX-License-Identifier: Apache-2.0
"""All 24 Euler conventions, and tilt and torsion, with their rates."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from loopcal import geometry
from loopcal.errors import DataError
from tests.jacobians import check_jacobian

ROUNDING = 5e-15  # [1], a few ulps over three products of rotations
turn = st.floats(-np.pi, np.pi)
quarter = st.integers(-2, 2).map(lambda k: k * np.pi / 2)
any_angles = st.lists(st.one_of(turn, quarter), min_size=3, max_size=3).map(np.array)


@pytest.mark.slow
@pytest.mark.parametrize("order", geometry.EULER_ORDERS)
@given(angles=any_angles)
@settings(max_examples=12)  # of each of 24 orders
def test_every_euler_order_agrees_with_scipy_and_round_trips_with_parallel_axes(order, angles):
    R = geometry.euler_to_matrix(angles, order)
    assert_allclose(R, Rotation.from_euler(order, angles).as_matrix(), atol=ROUNDING)
    assert_allclose(
        geometry.euler_to_matrix(geometry.matrix_to_euler(R, order), order), R, atol=ROUNDING
    )


@pytest.mark.parametrize("order", geometry.EULER_ORDERS)
@given(first=turn, third=turn, middle=st.floats(0.05, 0.95))
@settings(max_examples=8)  # of each of 24 orders
def test_regular_euler_angles_round_trip(order, first, third, middle):
    repeated = order[0] == order[2]
    second = np.pi * middle if repeated else np.pi * (middle - 0.5)
    angles = np.array([first, second, third])
    back = geometry.matrix_to_euler(geometry.euler_to_matrix(angles, order), order)
    assert_allclose(
        geometry.wrap_angle(back - angles), np.zeros(3), atol=1e-13
    )  # [rad], ulps over sin(0.05 pi)


@pytest.mark.slow
@pytest.mark.parametrize("order", geometry.EULER_ORDERS)
def test_euler_rates_are_the_derivative_and_have_the_stated_inverse(order):
    angles = np.array([0.4, 0.7, -2.1])
    base = geometry.euler_to_matrix(angles, order).T

    def turned(x):
        return geometry.log_so3(geometry.euler_to_matrix(angles + x, order) @ base)

    # compiling takes longer than all else: every fifth order, differences for all
    automatic = turned if order in geometry.EULER_ORDERS[::5] else None
    check_jacobian(
        turned, geometry.euler_rates(angles, order), np.zeros(3), scale=0.3, automatic=automatic
    )
    product = geometry.euler_rates_inverse(angles, order) @ geometry.euler_rates(angles, order)
    assert_allclose(product, np.eye(3), atol=ROUNDING)


def test_roll_pitch_yaw_are_rotations_about_fixed_x_y_z():
    a, b, g = 0.3, -0.2, 0.9
    ca, sa, cb, sb, cg, sg = np.cos(a), np.sin(a), np.cos(b), np.sin(b), np.cos(g), np.sin(g)
    R = np.array([[cg, -sg, 0], [sg, cg, 0], [0, 0, 1]]) @ [[cb, 0, sb], [0, 1, 0], [-sb, 0, cb]]
    R = R @ [[1, 0, 0], [0, ca, -sa], [0, sa, ca]]
    assert_allclose(geometry.euler_to_matrix(np.array([a, b, g]), "xyz"), R, atol=ROUNDING)
    rates = np.array([[cg * cb, -sg, 0], [sg * cb, cg, 0], [-sb, 0, 1]])
    assert_allclose(geometry.euler_rates(np.array([a, b, g]), "xyz"), rates, atol=ROUNDING)


def test_unknown_euler_order_is_refused_with_the_allowed_ones():
    with pytest.raises(DataError, match="'xxz' is not one of the 24: use xyz"):
        geometry.euler_to_matrix(np.zeros(3), "xxz")
    with pytest.raises(DataError, match="'Xyz'"):
        geometry.matrix_to_euler(np.eye(3), "Xyz")


@given(phi=turn, theta=st.floats(1e-3, np.pi - 1e-3), psi=turn)
def test_tilt_and_torsion_round_trip(phi, theta, psi):
    angles = np.array([phi, theta, psi])
    back = geometry.matrix_to_tilt_torsion(geometry.tilt_torsion_to_matrix(angles))
    assert_allclose(
        geometry.wrap_angle(back - angles), np.zeros(3), atol=5e-12
    )  # [rad], ulps / sin


@given(phi=turn, theta=st.floats(-200.0, -3.0).map(lambda e: 10.0**e), psi=st.floats(-3.1, 3.1))
def test_tilt_and_torsion_stay_exact_at_vanishing_tilt(phi, theta, psi):
    R = geometry.tilt_torsion_to_matrix(np.array([phi, theta, psi]))
    back = geometry.matrix_to_tilt_torsion(R)
    assert_allclose(back[1:], [theta, psi], atol=ROUNDING)
    assert_allclose(geometry.tilt_torsion_to_matrix(back), R, atol=ROUNDING)


def test_zero_tilt_has_zero_azimuth_and_torsion_equal_to_the_rotation():
    assert_allclose(
        geometry.matrix_to_tilt_torsion(geometry.rotation_about_axis(0.3, 2)),
        (0.0, 0.0, 0.3),
        atol=1e-16,
    )


def test_tilt_torsion_matrix_has_the_printed_entries():
    phi, theta, psi = 0.7, 0.4, -1.1
    cp, sp, ct, s_t = np.cos(phi), np.sin(phi), np.cos(theta), np.sin(theta)
    c, s = np.cos(psi - phi), np.sin(psi - phi)
    expected = [
        [cp * ct * c - sp * s, -cp * ct * s - sp * c, cp * s_t],
        [sp * ct * c + cp * s, -sp * ct * s + cp * c, sp * s_t],
        [-s_t * c, s_t * s, ct],
    ]
    R = geometry.tilt_torsion_to_matrix(np.array([phi, theta, psi]))
    assert_allclose(R, expected, atol=ROUNDING)


@pytest.mark.slow
@pytest.mark.parametrize("theta", [0.02, 0.6, 2.8])
def test_tilt_torsion_rates_are_the_derivative_and_have_the_stated_inverse(theta):
    angles = np.array([2.4, theta, -0.8])
    base = geometry.tilt_torsion_to_matrix(angles).T

    def turned(x):
        return geometry.log_so3(geometry.tilt_torsion_to_matrix(angles + x) @ base)

    rates = geometry.tilt_torsion_rates(angles)
    check_jacobian(turned, rates, np.zeros(3), scale=0.3, automatic=turned)
    product = geometry.tilt_torsion_rates_inverse(angles) @ rates
    assert_allclose(product, np.eye(3), atol=ROUNDING / np.sin(theta))


@given(st.floats(-50.0, 50.0))
def test_wrapped_angle_is_the_same_angle_between_minus_pi_and_pi(x):
    wrapped = geometry.wrap_angle(x)
    assert -np.pi < wrapped <= np.pi
    assert_allclose(
        [np.cos(wrapped), np.sin(wrapped)], [np.cos(x), np.sin(x)], atol=1e-13
    )  # [1], ulps of 50 rad


def test_minus_pi_wraps_to_plus_pi():
    assert geometry.wrap_angle(np.array([np.pi, -np.pi])).tolist() == [np.pi, np.pi]
