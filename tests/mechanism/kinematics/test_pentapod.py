# SPDX-License-Identifier: Apache-2.0
"""The pentapod against its closed form, which also tells the working mode of distant poses.

The plane of spindle and strut contains the base joint, because each ring rotates about the spindle.
A hinge is on the side of the spindle where its base joint is; only a base joint that meets the
spindle itself could change the side, so the closed form is the mode of home everywhere.
"""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray

from loopcal import geometry
from loopcal.apply.compensation import Reach, compensate
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import forward, inverse, jacobian
from loopcal.mechanism.states import Status
from loopcal.mechanism.workspace import sample_workspace
from tests.zoo import load_cached_robot

Array = NDArray[np.float64]
AZIMUTH = np.radians([0, 72, 144, 216, 288])
ON_CIRCLE = np.column_stack([0.7 * np.cos(AZIMUTH), 0.7 * np.sin(AZIMUTH), [0, 0.6, 0, 0.6, 0]])
BASE = ON_CIRCLE.round(6)  # as the file gives them, to a micrometer
HEIGHT = np.array([0.3, 0.4, 0.2, 0.1, 0.0])
RADIUS = 0.08


@pytest.fixture(scope="module")
def robot() -> Mechanism:
    return load_cached_robot("pentapod")


def solve_closed_form(coordinates: Array) -> tuple[Array, Array]:
    """Return poses (n, 4, 4) and lengths (n, 5) at x, y, z, phi, theta (n, 5)."""
    p, (phi, theta) = coordinates[:, None, :3], coordinates[:, 3:].T
    normal = np.stack(
        [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=1
    )
    gap = BASE - p
    across = gap - (gap @ normal[..., None]) * normal[:, None]
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    hinge = p + HEIGHT[:, None] * normal[:, None] + RADIUS * across
    held, turn = across[:, 4], np.cross(normal, across[:, 4])
    c, s = np.cos(AZIMUTH[4]), np.sin(AZIMUTH[4])
    rotation = np.stack([c * held - s * turn, s * held + c * turn, normal], axis=-1)
    return geometry.make_pose(rotation, p[:, 0]), np.linalg.norm(hinge - BASE, axis=-1)


def draw_distant(n: int, seed: int) -> Array:
    """Draw coordinates (n, 5) three times as far from home as the workspace, tilts up to 70 deg."""
    low = np.array([-0.36, -0.36, 0.65, -np.pi, 0.0])
    high = np.array([0.36, 0.36, 1.1, np.pi, 1.2])
    return np.random.default_rng(seed).uniform(low, high, (n, 5))


def test_readings_and_pose_are_those_of_the_closed_form(robot: Mechanism) -> None:
    target = sample_workspace(robot, 20, seed=2).coordinates
    solution = inverse(robot, target)
    T, q = solve_closed_form(target)
    assert solution.converged.all()
    assert_allclose(solution.q, q, atol=1e-9)
    assert_allclose(solution.T, T, atol=1e-9)
    back = forward(robot, solution.q)
    assert np.abs(back.T - solution.T).max() < 1e-9


def test_distant_poses_are_in_the_mode_of_home_or_marked(robot: Mechanism) -> None:
    # The first target is one for which Newton's method jumps to another solution and back.
    target = np.concatenate([draw_distant(60, 6)[[23]], draw_distant(8, 3)])
    solution = inverse(robot, target)
    T, q = solve_closed_form(target)
    good = solution.converged
    assert solution.status[0] == Status.OTHER_MODE  # was CONVERGED, 114 mm from the closed form
    assert good.sum() > 4
    assert_allclose(solution.q[good], q[good], atol=1e-9)
    assert_allclose(solution.T[good], T[good], atol=1e-9)
    assert compensate(robot, target[:1]).reach == (Reach.OTHER_MODE,)


def test_sensitivities_are_finite_differences(robot: Mechanism) -> None:
    q = inverse(robot, sample_workspace(robot, 2, seed=5).coordinates).q
    exact, step = jacobian(robot, q), 1e-6
    for j in range(0, len(robot.parameters), 7):
        ends = []
        for sign in (1.0, -1.0):
            values = robot.values.copy()
            values[j] += sign * step
            ends.append(forward(robot.with_values(values), q).T)
        slope = geometry.pose_difference(*ends) / (2 * step)
        assert_allclose(exact.parameters[..., j], slope, atol=1e-7)
