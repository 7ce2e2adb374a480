# SPDX-License-Identifier: Apache-2.0
"""The inverse kinematics of an unreachable pose returns the nearest reachable one."""

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal

from loopcal import geometry
from loopcal.mechanism import Status, inverse, read_coordinates
from tests import zoo
from tests.mechanism.kinematics.test_kinematics import sample_inverse


def squared_distance(robot, T, target):
    """|log(R R*')|^2 size^2 + |t - t*|^2 (n,) [m^2]."""
    gap = geometry.pose_difference(T, target) * np.array([robot.size] * 3 + [1.0] * 3)
    return (gap**2).sum(axis=1)


def make_unreachable_poses(n=20):
    """Draw poses up to 2 cm and 0.05 rad from the workspace of a 3-PRS, in all six directions."""
    rng = np.random.default_rng(5)
    values = rng.uniform([0.66, -np.pi, 0.1], [0.74, np.pi, 0.5], (n, 3))
    T = inverse(zoo.three_prs(), values).T
    return geometry.apply_twist(T, rng.uniform(-1, 1, (n, 6)) * np.array([0.05] * 3 + [0.02] * 3))


def test_nearest_pose_of_a_3_prs_minimizes_the_distance():
    robot, target = zoo.three_prs(), make_unreachable_poses()
    sol = inverse(robot, target)
    assert_array_equal(sol.status, Status.CONVERGED)
    result = read_coordinates(sol.T, robot.controlled)
    best, h = squared_distance(robot, sol.T, target), 1e-5
    for i in range(3):
        ahead, behind = (
            squared_distance(robot, inverse(robot, result + s * h * np.eye(3)[i]).T, target)
            for s in (1, -1)
        )
        # slope against curvature: how far along this coordinate the minimum still is
        assert (np.abs(ahead - behind) / (ahead + behind - 2 * best) * h / 2 < 1e-6).all()
        assert (np.minimum(ahead, behind) >= best).all()


def test_reachable_pose_is_its_own_nearest_pose():
    robot, sol, _ = sample_inverse("three_prs", 20)
    back = inverse(robot, sol.T)
    assert_allclose(geometry.pose_difference(back.T, sol.T), 0.0, atol=1e-11)
    assert_allclose(back.q, sol.q, atol=1e-11)


def test_delta_ignores_the_orientation_of_a_target_pose():
    robot = zoo.delta()
    T = zoo.make_poses(np.array([[0.02, -0.03, 0.08, 0.3, 0.2, 0.1]]))
    sol = inverse(robot, T)
    assert_array_equal(sol.status, Status.CONVERGED)
    assert_allclose(sol.T[0, :3, 3], T[0, :3, 3], atol=1e-14)
    assert_allclose(sol.T[0, :3, :3], np.eye(3))


def test_hexapod_reaches_the_target_pose_exactly():
    _, sol, _ = sample_inverse("hexapod", 20)
    assert_allclose(
        geometry.pose_difference(inverse(zoo.hexapod(), sol.T).T, sol.T), 0.0, atol=1e-15
    )
