# SPDX-License-Identifier: Apache-2.0
"""The inverse kinematics of an unreachable pose returns the nearest reachable one."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from loopcal import geometry
from loopcal.io.robot.robot_file import list_shipped_robots, load_robot
from loopcal.mechanism.platform_coordinates import POSITION, read_coordinates
from loopcal.mechanism.solutions import controls_all, inverse
from loopcal.mechanism.states import Status
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


def list_robots_with_few_freedoms():
    """Shipped robots whose controlled coordinates do not state each freedom of the platform."""
    return [name for name in list_shipped_robots() if not controls_all(load_robot(name))]


def make_far_poses(robot, far, n):
    """Draw poses `far` sizes and `far` rad away from home, in random directions."""
    rng = np.random.default_rng(1)
    direction = rng.normal(size=(n, 2, 3))
    direction /= np.linalg.norm(direction, axis=2, keepdims=True)
    twist = np.concatenate([direction[:, 0], robot.size * direction[:, 1]], axis=1) * far
    return geometry.apply_twist(np.broadcast_to(robot.home_state.T[0, 0], (n, 4, 4)), twist)


SLOWEST = "solar-tracker"  # as long as all the others but the excavator, which is a chain as well


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.evidence) if name == SLOWEST else name
        for name in list_robots_with_few_freedoms()
    ],
)
def test_projection_is_converged_only_where_the_distance_is_stationary(name):
    """The gradient by central differences of inverse solutions vanishes where a row is converged,
    for targets up to two sizes and 2 rad away from home.
    """
    robot, n = load_robot(name), 4
    target = np.concatenate([make_far_poses(robot, far, n // 2) for far in (0.05, 2.0)])
    sol = inverse(robot, target)
    done = sol.converged
    assert done[: n // 2].sum() >= 0.9 * (n // 2)  # the near ones are not merely given up
    assert not np.isin(sol.status, Status.NOT_FINITE).any()
    end, target = sol.take(done), target[done]
    at = read_coordinates(end.T, robot.controlled)
    distance, h = squared_distance(robot, end.T, target), 1e-5  # [rad] or a share of the size
    for i, coordinate in enumerate(robot.controlled):
        step = np.zeros(len(at[0]))
        step[i] = h * (robot.size if coordinate in POSITION else 1.0)
        ahead, behind = (inverse(robot, at + sign * step, end) for sign in (1, -1))
        both = ahead.converged & behind.converged
        slope = (
            squared_distance(robot, ahead.T, target) - squared_distance(robot, behind.T, target)
        ) / (2 * h)
        # the share 1e-6 of the distance that the search allows, at a lever of at most 3 sizes,
        # the error of differences, and what rounding of the distances leaves
        limit = 1e-5 * robot.size * np.sqrt(distance) + 1e-8 * (robot.size**2 + distance)
        assert (np.abs(slope) <= limit)[both].all()


def test_projection_that_ends_at_the_limit_of_the_reach_says_so():
    sol = inverse(load_robot("ru-pus-prs"), make_far_poses(load_robot("ru-pus-prs"), 2.0, 20))
    codes = {
        sol.explain(int(row)).code for row in np.flatnonzero(sol.status == Status.NOT_CONVERGED)
    }
    assert "kinematics.not-nearest" in codes
