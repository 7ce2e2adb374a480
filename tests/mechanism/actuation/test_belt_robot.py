# SPDX-License-Identifier: Apache-2.0
"""The planar belt robot against its closed form: belt k of reading q_k from its anchor a_k has the
length q_k + c_k = |x - a_k|.
"""

from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import least_squares

import loopcal as lc
from loopcal.mechanism.actuation import differentiate_at_pose
from loopcal.mechanism.sensitivity import differentiate_pose

SIZE = 4.3  # [m] of the machine


@pytest.fixture(scope="module")
def machine():
    """A machine that differs from its file, positions (50, 2) and their readings in closed form."""
    nominal = lc.load_robot("belt-4")
    robot = nominal.with_values(lc.sample_truth(nominal, 1, seed=4)[0])
    x = np.random.default_rng(1).uniform([-1.1, -0.7], [1.1, 0.7], (50, 2))
    return robot, x, compute_readings(robot.values, x)


def compute_readings(values, x, module=np):
    """Return the readings (.., 4) [m] at positions (.., 2), by parameter values (12,)."""
    anchors = values.reshape(4, 3)
    return module.linalg.norm(x[..., None, :] - anchors[:, :2], axis=-1) - anchors[:, 2]


def intersect_circles(values, q):
    """Return the positions (n, 2) where the first and second belt meet, above their anchors."""
    anchors = values.reshape(4, 3)
    a, b = anchors[0, :2], anchors[1, :2]
    r, s = (q[:, :2] + anchors[:2, 2]).T
    span = np.linalg.norm(b - a)
    along = (r**2 - s**2 + span**2) / (2 * span)
    across = np.sqrt(r**2 - along**2)
    unit = (b - a) / span
    return a + along[:, None] * unit + across[:, None] * np.array([-unit[1], unit[0]])


def test_inverse_kinematics_are_distances_from_the_anchors(machine):
    robot, x, readings = machine
    solution = lc.inverse(robot, x)
    assert solution.converged.all()
    assert_allclose(solution.q, readings, atol=1e-9 * SIZE, rtol=0)


def test_forward_kinematics_are_intersections_of_circles(machine):
    robot, x, readings = machine
    solution = lc.forward(robot, readings)
    assert solution.converged.all()
    T = solution.T
    assert_allclose(intersect_circles(robot.values, readings), x, atol=1e-9)
    assert_allclose(T[:, :2, 3], x, atol=1e-9 * SIZE, rtol=0)
    assert_allclose(T[:, :3, :3], np.broadcast_to(np.eye(3), (50, 3, 3)), atol=1e-12)


def test_contradicting_readings_lead_to_their_least_squares_position(machine):
    robot, x, readings = machine
    shown = readings + 1e-3 * np.random.default_rng(2).standard_normal(readings.shape)
    found = lc.forward(robot, shown).T[:, :2, 3]
    for start, q, position in zip(x, shown, found, strict=True):

        def gap(p, q=q):
            return compute_readings(robot.values, p) - q

        best = least_squares(gap, start, xtol=1e-15, ftol=1e-15, gtol=1e-15)
        assert_allclose(position, best.x, atol=1e-8 * SIZE)  # [m] of scipy's minimum


@pytest.mark.slow
def test_sensitivities_agree_with_automatic_derivatives(machine):
    import jax

    jax.config.update("jax_enable_x64", True)
    compute = partial(compute_readings, module=jax.numpy)
    robot, x, readings = machine
    state = lc.forward(robot, readings).state
    found = differentiate_at_pose(robot, robot.values[None], readings[None], state)
    by_values = jax.jacobian(compute)(robot.values, x)
    by_position = jax.vmap(jax.jacobian(compute, argnums=1), (None, 0))(robot.values, x)
    assert_allclose(found.readings[0][0], by_values, atol=1e-11)
    assert_allclose(found.readings[1][0], by_position, atol=1e-11)
    # the pose at given readings, by least squares of equal weights: x' = -(J'J)^-1 J' dq/dp
    D = differentiate_pose(robot, robot.values[None], readings[None], state).parameters[0]
    expected = -np.linalg.pinv(np.asarray(by_position)) @ np.asarray(by_values)
    assert_allclose(D[:, 3:5], expected, atol=1e-10)
