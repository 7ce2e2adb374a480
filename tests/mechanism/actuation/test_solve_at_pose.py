# SPDX-License-Identifier: Apache-2.0
"""Redundant actuators at a given pose: derivatives of readings and passive joints agree with
differences.
"""

import numpy as np
from numpy.testing import assert_allclose

from loopcal import geometry
from loopcal.mechanism.actuation import differentiate_at_pose, solve_at_pose
from loopcal.mechanism.sensitivity import differentiate_passive_joints
from loopcal.mechanism.solutions import forward, inverse
from loopcal.mechanism.states import Status
from tests import zoo
from tests.jacobians import check_jacobian


def solve_example_pose(robot, seed=0):
    """Return values (1, p), a pose (1, 1, 4, 4), and the state and readings at this pose."""
    rng = np.random.default_rng(seed)
    values = robot.values[None] + 1e-3 * rng.standard_normal((1, len(robot.values)))
    T = zoo.place((0.01, -0.02, 0.0), (0, 0, 0.1))[None, None]
    state, q = solve_at_pose(robot, values, T, robot.home_state)
    assert (state.status == Status.CONVERGED).all()
    return values, T, state, q


def test_every_limb_closes_at_the_given_pose():
    robot = zoo.planar_arms(("ball",) * 4, first=80.0)
    values, T, state, q = solve_example_pose(robot)
    assert_allclose(state.T, T, atol=1e-14)  # [m], [rad]
    assert state.residual.max() < 1e-12 * robot.size
    solution = forward(robot.with_values(values[0]), q[0])
    assert_allclose(solution.T, T[0], atol=1e-11)  # [m]: consistent readings give the same pose


def test_reading_and_passive_joint_derivatives_at_a_pose_agree_with_differences():
    robot = zoo.planar_arms(("ball",) * 4, first=80.0)
    values, T, state, q = solve_example_pose(robot)
    result = differentiate_at_pose(robot, values, q, state)
    p, freedoms = values.shape[1], robot.program.freedoms
    moved = np.zeros((3, 6))
    moved[range(3), list(freedoms)] = 1.0

    def joints(x):  # one trial a parameter or freedom
        at = np.concatenate(
            [
                np.tile(T, (p, 1, 1, 1)),
                geometry.apply_twist(np.tile(T, (3, 1, 1, 1)), x[0] * moved[:, None]),
            ]
        )
        every = np.concatenate([values + x[0] * np.eye(p), np.tile(values, (3, 1))])
        new, readings = solve_at_pose(robot, every, at, state)
        elbows = np.concatenate([new.joints[0][:, 0, k, 1:2] for k in range(4)], axis=1)
        return np.concatenate([readings[:, 0], elbows], axis=1)

    both = [np.concatenate(parts, axis=-1)[0, 0] for parts in (result.readings, result.passive)]
    expected = np.concatenate(both).T[..., None]
    check_jacobian(
        joints,
        expected,
        np.zeros(1),
        scale=0.1,
        atol=1e-6,
        atol_reason="closure to 1e-13, step 1e-4",
    )


def test_derivatives_by_pose_and_by_readings_agree():
    robot = zoo.planar_arms(("ball",) * 4, first=80.0)
    values, _, state, q = solve_example_pose(robot)
    result = differentiate_at_pose(robot, values, q, state)
    by_reading = differentiate_passive_joints(robot, values, q, state)
    # passive by readings, readings by pose
    turned = by_reading.readings[0, 0] @ result.readings[1][0, 0]
    assert_allclose(turned, result.passive[1][0, 0], atol=1e-9)  # [rad/m]
    assert inverse(robot, np.zeros((1, 3))).converged.all()
