# SPDX-License-Identifier: Apache-2.0
"""Kind `pose`: residual, forms of orientation, and noise."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from loopcal import geometry
from loopcal.measure.kinds.poses import Pose
from loopcal.measure.observations import Observations


def test_residual_is_a_rotation_vector_and_a_difference_of_positions():
    T = geometry.apply_twist(np.eye(4), np.array([0.2, 0.0, 0.0, 1.0, 2.0, 3.0]))[None, None]
    measured = np.array([[[0.1, 0.0, 0.0, 1.0, 2.0, 2.5]]])
    residual = Pose(T_platform_tool=np.eye(4)).evaluate(T, measured).residual
    assert_allclose(residual[0, 0], [0.1, 0.0, 0.0, 0.0, 0.0, 0.5], atol=1e-15)


def test_all_forms_of_orientation_give_the_same_residual_in_every_frame():
    rng = np.random.default_rng(2)
    T, T_measured = geometry.apply_twist(np.eye(4), rng.uniform(-1, 1, (2, 1, 30, 6)))
    T_base_frame = geometry.apply_twist(np.eye(4), rng.normal(size=6))
    reference = Pose(T_platform_tool=np.eye(4))
    seen = np.concatenate(
        [geometry.log_so3(T_measured[..., :3, :3]), T_measured[..., :3, 3]], axis=-1
    )
    expected = reference.evaluate(T, seen).residual
    turned = np.concatenate(
        [expected[..., :3] @ T_base_frame[:3, :3], expected[..., 3:] @ T_base_frame[:3, :3]],
        axis=-1,
    )
    for name in ("rotation-vector", "quaternion", "tilt-torsion", "euler-xyz", "euler-ZXZ"):
        kind = Pose(name, T_platform_tool=np.eye(4), T_base_frame=T_base_frame)
        measured = kind.measure(T_measured, np.zeros((1, 30, 6)))
        assert_allclose(
            kind.evaluate(T, measured).residual, turned, atol=1e-13
        )  # [m, rad], ulps over the tilt


def test_length_and_sign_of_a_quaternion_do_not_change_the_residual():
    kind = Pose("quaternion", T_platform_tool=np.eye(4))
    T = geometry.apply_twist(np.eye(4), np.full(6, 0.2))[None, None]
    measured = kind.measure(T, np.zeros((1, 1, 6)))
    measured[..., :4] *= -1.0005
    assert_allclose(kind.evaluate(T, measured).residual, 0.0, atol=1e-15)


def test_sigma_of_euler_angles_is_converted_to_that_of_the_rotation_error():
    kind = Pose("euler-xyz", T_platform_tool=np.eye(4))
    measured = np.array([[0.3, 1.0, -0.4, 0.0, 0.0, 0.0]])
    sigma = np.array([1e-5, 2e-5, 3e-5, 1e-6, 2e-6, 3e-6])
    data = Observations.from_sigma(kind, np.array([0]), measured, sigma)
    E = geometry.euler_rates(measured[0, :3], "xyz")
    assert_allclose(data.covariance[0, :3, :3], E @ np.diag(sigma[:3] ** 2) @ E.T, rtol=1e-12)
    assert_allclose(data.covariance[0, 3:, 3:], np.diag(sigma[3:] ** 2), rtol=1e-12)
    assert_allclose(data.covariance[0, :3, 3:], 0.0, atol=0.0)


@pytest.mark.parametrize("form", ["tilt-torsion", "euler-ZXZ"])
@pytest.mark.parametrize("tilt", [0.0, 1e-9, 1e-3])
def test_noise_near_zero_tilt_is_a_rotation_error(form, tilt):
    # before, a tilt of 1e-9 made one rotation a thousand million times as certain as stated, and a
    # tilt of zero was refused
    kind = Pose(form, T_platform_tool=np.eye(4))
    T = geometry.apply_twist(np.eye(4), np.array([0.6 * tilt, -0.8 * tilt, 0.0, 0.0, 0.0, 0.1]))[
        None, None
    ]
    T = np.broadcast_to(T, (1, 200, 4, 4))
    noise = np.random.default_rng(3).normal(size=(1, 200, 6)) * 1e-4
    measured = kind.measure(T, noise)
    assert_allclose(
        kind.evaluate(T, measured).residual, -noise, atol=1e-10
    )  # [rad, m], rounding over the tilt
    rows = Observations.from_sigma(kind, np.arange(200), measured[0], 1e-4)
    assert_allclose(rows.whitener, np.broadcast_to(1e4 * np.eye(6), (200, 6, 6)), rtol=1e-9)
