# SPDX-License-Identifier: Apache-2.0
"""More actuators than freedoms: the pose is the weighted least-squares solution of the readings."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import least_squares

from loopcal.io.robot.robot_file import load_robot
from loopcal.mechanism.assembly import Actuator, Link
from loopcal.mechanism.compilation import build
from loopcal.mechanism.kinematics import forward_trials
from loopcal.mechanism.sensitivity import differentiate_pose
from loopcal.mechanism.solutions import forward, inverse
from loopcal.mechanism.states import Status
from loopcal.units import Dimension
from tests import zoo
from tests.jacobians import check_jacobian


def load_cable_robot(sigmas=None):
    """Build the shipped four-line robot with these sigmas of its encoders."""
    assembly = load_robot("cable-4").assembly
    if sigmas is None:
        return build(assembly)
    return build(
        replace(
            assembly,
            actuators=tuple(
                replace(a, sigma=s) for a, s in zip(assembly.actuators, sigmas, strict=True)
            ),
        )
    )


def compute_line_lengths(robot, q):
    """Return the length of each line at readings q (a,), from the numbers of the assembly."""
    terms = [a.terms for a in robot.actuators]
    driven = np.array(
        [
            t.get("offset", 0.0) + t.get("gain", 1.0) * r + t.get("curve", 0.0) * r**2
            for t, r in zip(terms, q, strict=True)
        ]
    )
    return driven + np.array([limb.length for limb in robot.assembly.limbs])


def list_attachment_points(robot):
    """Return anchors and attachment points (k, 3) from the numbers of the assembly."""
    anchors = np.array([limb.links[-1].transform[:3, 3] for limb in robot.assembly.limbs])
    return anchors, np.array([limb.attachment.transform[:3, 3] for limb in robot.assembly.limbs])


def solve_position_by_scipy(robot, q, sigmas):
    """Minimize the weighted sum of squared length errors by scipy; return the position."""
    anchors, attached = list_attachment_points(robot)
    lengths = compute_line_lengths(robot, q)

    def misfit(x):
        return (np.linalg.norm(x + attached - anchors, axis=1) - lengths) / sigmas

    return least_squares(misfit, robot.home[:3, 3], xtol=1e-15, ftol=1e-15, gtol=1e-15).x


@pytest.mark.parametrize("sigmas", [(1.0, 1.0, 1.0, 1.0), (1.0, 5.0, 0.2, 2.0)])
def test_contradicting_readings_give_the_least_squares_pose(sigmas):
    robot = load_cable_robot(tuple(1e-3 * s for s in sigmas))
    rng = np.random.default_rng(2)
    asked = np.array([robot.home[:3, 3]]) + rng.uniform(-0.1, 0.1, (5, 3))
    q = inverse(robot, asked).q
    q = q + rng.normal(size=q.shape) * 1e-3 * np.abs(q).max()
    sol = forward(robot, q)
    assert (sol.status == Status.CONVERGED).all()
    gains = np.array([abs(a.terms.get("gain", 1.0)) for a in robot.actuators])
    for i, row in enumerate(q):
        # scipy stops at about the square root of rounding in x, the gap being millimetres
        assert_allclose(
            sol.T[i, :3, 3],
            solve_position_by_scipy(robot, row, np.array(sigmas) * gains),
            atol=1e-7 * robot.size,
        )
    assert (sol.residual > 1e-6).all()


def test_consistent_readings_leave_no_residual():
    robot = load_cable_robot((1e-3, 5e-3, 2e-4, 2e-3))
    asked = np.array([robot.home[:3, 3]]) + np.random.default_rng(3).uniform(-0.1, 0.1, (20, 3))
    sol = forward(robot, inverse(robot, asked).q)
    assert_allclose(sol.T[:, :3, 3], asked, atol=1e-12)
    assert sol.residual.max() <= 1e-12


def test_pose_derivatives_by_redundant_readings_agree_with_differences():
    robot = load_cable_robot((1e-3, 5e-3, 2e-4, 2e-3))
    q = inverse(robot, np.array([robot.home[:3, 3]]) + 0.05).q
    values = robot.values[None]

    def position(readings):
        return forward(robot, readings[None]).T[0, :3, 3]

    def slopes(readings):
        state = forward_trials(robot, values, readings[None, None])
        return differentiate_pose(robot, values, readings[None, None], state).readings[0, 0, 3:]

    check_jacobian(
        position,
        slopes(q[0]),
        q[0],
        scale=1e-2,
        atol=1e-9,
        atol_reason="poses solved to 1e-13, steps of 1e-2",
    )


def build_hexapod_with_seven_legs():
    """Build the small hexapod with a seventh driven leg from the middle of the base."""
    assembly = zoo.hexapod().assembly
    foot, corner = zoo.place((0.0, 0.0, 0.0)), zoo.place((0.02, 0.03, 0.0))
    length = float(np.linalg.norm((assembly.home @ corner)[:3, 3]))
    links = {"links": (Link("base", foot),), "attachment": Link("platform", corner)}
    leg = replace(assembly.limbs[0], name="leg7", actuator="q7", length=length, **links)
    actuators = (*assembly.actuators, Actuator("q7", Dimension.LENGTH))
    return build(
        replace(assembly, limbs=(*assembly.limbs, leg), actuators=actuators, parameters=(), maps=())
    )


def test_local_minimum_far_from_home_is_left_or_marked():
    robot = build_hexapod_with_seven_legs()
    reach = np.array([0.12, 0.12, 0.12, 1.2, 1.2, 1.2])
    asked = (
        np.array([0, 0, 0.2, 0, 0, 0]) + np.random.default_rng(0).uniform(-1, 1, (600, 6)) * reach
    )
    result = inverse(robot, asked)
    result = result.take(result.closed)
    again = forward(robot, result.q)
    # the readings are consistent, so a residual belongs to a local minimum beside the true pose
    assert again.residual[again.converged].max() < 1e-2 * robot.size
    right = np.abs(again.T - result.T).max(axis=(1, 2)) < 1e-9
    assert 0.85 < right.mean() < 1
    assert again.converged[right].all()
    for row in np.flatnonzero(~right).tolist():
        assert again.explain(row).code != "kinematics.closed"


def test_contradicting_readings_are_reported_as_a_compromise():
    robot = load_cable_robot((1e-3, 1e-3, 1e-3, 1e-3))
    q = inverse(robot, robot.home[None, :3, 3]).q
    fits, apart = forward(robot, q), forward(robot, q * [1.002, 1, 1, 1])
    assert fits.explain(0).code == "kinematics.closed"
    assert apart.converged.all()
    assert apart.explain(0).code == "kinematics.compromise"
    wild = forward(robot, q + np.array([40.0, 0, 0, 40.0]))
    assert wild.status[0] == Status.UNREACHABLE
    assert wild.explain(0).code == "kinematics.unreachable"
