# SPDX-License-Identifier: Apache-2.0
"""Kind `component`: subsets, wrapped angles, the normal near zero tilt and covariances."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from loopcal import geometry
from loopcal.measure.kinds.poses import SMALL_TILT, Component, Pose
from loopcal.measure.observations import Observations
from tests.jacobians import check_jacobian

FIVE = Component(("x", "y", "z", "phi", "theta"), "tilt-torsion", T_platform_tool=np.eye(4))


def make_poses(phi, theta, psi):
    return geometry.make_pose(
        geometry.tilt_torsion_to_matrix(np.stack(np.broadcast_arrays(phi, theta, psi), axis=-1)),
        np.zeros(3),
    )[None]


def map_covariance(kind, T, measured, covariance):
    """Return the covariance of the residuals (r, m, m) from that of full poses (r, 6, 6)."""
    rows = kind.evaluate(T, measured).jacobian[0]
    return rows @ covariance @ np.swapaxes(rows, -1, -2)


def test_probed_height_is_z_of_the_tool_point():
    T_platform_tool = geometry.make_pose(np.eye(3), np.array([0.0, 0.1, -0.2]))
    height = Component(T_platform_tool=T_platform_tool)
    T = geometry.make_pose(geometry.rotation_about_axis(0.5, 0), np.array([1.0, 2.0, 3.0]))[
        None, None
    ]
    residual, jacobian, nuisance, _ = height.evaluate(T, np.array([[[3.0]]]))
    assert nuisance is None
    assert_allclose(residual, 0.1 * np.sin(0.5) - 0.2 * np.cos(0.5), atol=1e-15)
    assert_allclose(jacobian[0, 0, 0, 3:], [0.0, 0.0, 1.0], atol=0.0)


def test_angle_differences_are_wrapped_at_180_deg():
    kind = Component(("a", "c"), "euler-xyz", T_platform_tool=np.eye(4))
    T = geometry.make_pose(
        geometry.euler_to_matrix(np.array([np.pi - 1e-3, 0.2, -np.pi + 2e-3]), "xyz"), np.zeros(3)
    )[None, None]
    residual = kind.evaluate(T, np.array([[[-np.pi + 1e-3, np.pi - 2e-3]]])).residual
    assert_allclose(residual[0, 0], [-2e-3, 4e-3], atol=1e-15)


def test_azimuth_differences_are_wrapped():
    T = make_poses(np.array([np.pi - 1e-3]), np.array([0.3]), np.array([0.0]))
    measured = np.array([[[0.0, 0.0, 0.0, -np.pi + 1e-3, 0.3]]])
    assert_allclose(FIVE.evaluate(T, measured).residual[0, 0, 3:], [-2e-3, 0.0], atol=1e-14)


@pytest.mark.parametrize(
    "theta", [0.0, 1e-9, pytest.param(0.9 * SMALL_TILT, marks=pytest.mark.slow)]
)
def test_normal_replaces_phi_and_theta_near_zero_tilt(theta):
    T = make_poses(np.array([2.0]), np.array([theta]), np.array([0.4]))
    noise = np.array([[[0.0, 0.0, 0.0, 2e-4, -1e-4]]])
    measured = FIVE.measure(T, noise)
    assert_allclose(FIVE.evaluate(T, measured).residual, -noise, atol=1e-15)

    def residual(x):
        return FIVE.evaluate(geometry.apply_twist(T, x), measured).residual

    result = FIVE.evaluate(T, measured)
    # jax cannot pass the angles of zero tilt themselves, which the normal replaces: 0 times their
    # infinite slope.
    automatic = residual if theta > 1e-6 else None
    check_jacobian(residual, result.jacobian, np.zeros(6), scale=0.02, automatic=automatic)


def test_information_is_continuous_at_the_tilt_limit_of_the_normal():
    covariance = np.diag([1e-10, 1e-10, 1e-10, 1e-12, 1e-12, 1e-12])[None]
    measured = np.array(
        [
            [0.0, 0.0, 0.0, 0.7, SMALL_TILT * (1 - 1e-9)],
            [0.0, 0.0, 0.0, 0.7, SMALL_TILT * (1 + 1e-9)],
        ]
    )
    T = make_poses(measured[:, 3], measured[:, 4], np.zeros(2))
    data = Observations(FIVE, np.arange(2), measured, map_covariance(FIVE, T, measured, covariance))
    white = data.whitener @ data.evaluate(T).jacobian[0]
    information = np.swapaxes(white, -1, -2) @ white
    # [1/m^2, 1/rad^2] relative 1e-7: the same two directions of the normal, in angles and in
    # components
    assert_allclose(information[0], information[1], atol=1e-7 * information.max())


def test_mapped_covariance_of_angles_agrees_with_drawn_rotations():
    rng = np.random.default_rng(3)
    kind = Component(("z", "a", "b", "c"), "euler-xyz", T_platform_tool=np.eye(4))
    A = rng.normal(size=(6, 6))
    C = 1e-8 * (A @ A.T + np.eye(6))
    T = geometry.apply_twist(np.eye(4), np.array([0.4, 0.8, -0.3, 0.0, 0.0, 0.0]))[None, None]
    exact = kind.measure(T, np.zeros((1, 1, 4)))
    drawn = geometry.apply_twist(T, rng.multivariate_normal(np.zeros(6), C, size=(1, 20000)))
    scatter = np.cov((kind.measure(drawn, np.zeros((1, 1, 4))) - exact)[0].T)
    mapped = map_covariance(kind, T, exact, C[None])[0]
    # relative 5 %: four sigma of a variance from 20000 draws is 4 sqrt(2 / 20000) = 4 %
    assert_allclose(
        scatter, mapped, atol=0.05 * np.sqrt(np.outer(np.diag(mapped), np.diag(mapped))).max()
    )


def test_six_components_have_the_information_of_a_full_pose():
    C = np.diag([1e-10, 2e-10, 3e-10, 1e-12, 2e-12, 3e-12])
    T = geometry.apply_twist(np.eye(4), np.array([0.4, 0.6, -0.3, 0.1, 0.2, 0.3]))[None, None]
    kinds = (
        Pose(T_platform_tool=np.eye(4)),
        Component(("a", "b", "c", "x", "y", "z"), "euler-ZYX", T_platform_tool=np.eye(4)),
        Component(
            ("x", "y", "z", "phi", "theta", "psi"), "tilt-torsion", T_platform_tool=np.eye(4)
        ),
    )
    found = []
    for kind in kinds:
        measured = kind.measure(T, np.zeros((1, 1, 6)))[0]
        covariance = (
            C[None] if isinstance(kind, Pose) else map_covariance(kind, T, measured, C[None])
        )
        data = Observations(kind, np.array([0]), measured, covariance)
        white = data.whitener @ data.evaluate(T).jacobian[0]
        found.append(np.swapaxes(white, -1, -2) @ white)
    assert_allclose(found[1], found[0], rtol=1e-9, atol=1e-9 * found[0].max())
    assert_allclose(found[2], found[0], rtol=1e-9, atol=1e-9 * found[0].max())
