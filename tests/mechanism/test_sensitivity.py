# SPDX-License-Identifier: Apache-2.0
"""Derivatives of poses by parameters and readings: values and batches."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from loopcal import geometry
from loopcal.mechanism.assembly import Address, LinearMap
from loopcal.mechanism.compilation import build
from loopcal.mechanism.kinematics import forward_trials
from loopcal.mechanism.sensitivity import differentiate_pose
from loopcal.parameters import Parameter
from loopcal.units import Dimension
from tests import zoo
from tests.jacobians import check_jacobian, compile_quickly
from tests.mechanism.derivatives import check_pose_derivatives
from tests.mechanism.kinematics.test_kinematics import sample_inverse


def hexapod_closure(jnp, values, q, T, twist):
    """Return the closure of a hexapod (6,): |t + R p - b| - length - reading."""
    legs = values.reshape(6, 7)
    w = twist[:3]
    K = jnp.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])
    R = (jnp.eye(3) + K) @ T[:3, :3]  # the first order is all that a derivative at zero needs
    gap = legs[:, 3:6] @ R.T + T[:3, 3] + twist[3:] - legs[:, :3]
    return jnp.sqrt((gap**2).sum(axis=1)) - legs[:, 6] - q


def delta_closure(jnp, values, q, T, twist):
    """Return the closure of a linear delta (3,): distance of nozzle and carriage less the arm."""
    radius, towers = values[0], values[1:].reshape(3, 3)
    angle, arm, stop = towers.T
    carriage = jnp.stack(
        [radius * jnp.cos(angle), radius * jnp.sin(angle), stop + jnp.sqrt(arm**2 - radius**2) - q],
        axis=1,
    )
    return jnp.sqrt(((T[:3, 3] + twist[3:] - carriage) ** 2).sum(axis=1)) - arm


def perturb_values(robot, size=2e-4, seed=1, t=1):
    return robot.values + np.random.default_rng(seed).normal(size=(t, len(robot.parameters))) * size


@pytest.mark.slow
@pytest.mark.parametrize(("name", "legs"), [("hexapod", hexapod_closure), ("delta", delta_closure)])
def test_pose_derivatives_of_families_agree_with_differences_and_jax(name, legs, jax):
    robot, sol, _ = sample_inverse(name, 4)
    values, q = perturb_values(robot), sol.q[None]
    state = forward_trials(robot, values, q)
    result = differentiate_pose(robot, values, q, state)
    free = list(robot.program.freedoms)

    both = np.concatenate([result.parameters[0], result.readings[0]], axis=-1)
    scale = np.concatenate(
        [
            [1.0 if d is Dimension.ANGLE else robot.size for d in robot.parameters.dimensions],
            np.full(q.shape[2], robot.size),
        ]
    )
    moved = np.diag(scale)

    def solved(x):  # one trial a parameter or reading
        v, r = values + x[0] * moved[:, : values.size], q + x[0] * moved[:, None, values.size :]
        return geometry.pose_difference(forward_trials(robot, v, r, start=state).T, state.T)

    check_jacobian(
        solved, (both * scale).transpose(2, 0, 1)[..., None], np.zeros(1), scale=0.1,
        atol=1e-8, atol_reason="closure to 1e-13, condition 30, step 1e-4",
    )  # fmt: skip
    x = np.concatenate([values[0], np.zeros(q.shape[2])])
    jnp, n = jax.numpy, values.size
    by_pose = compile_quickly(jax.jacfwd(lambda y, r, T: legs(jnp, values[0], r, T, y)))
    by_values = compile_quickly(
        jax.jacfwd(lambda v, r, T: legs(jnp, v[:n], r + v[n:], T, np.zeros(6)))
    )
    for row in range(4):
        at = q[0, row], state.T[0, row]
        F = by_pose(np.zeros(6), *at)[:, free]
        G = by_values(x, *at)
        assert_allclose(both[row][free], -np.linalg.solve(F, G), atol=1e-11)


@pytest.mark.parametrize("name", ["mixed_hexapod", "three_prs", "five_bar", "planar_rrr"])
def test_pose_derivatives_of_any_mechanism_agree_with_differences(name):
    robot, sol, _ = sample_inverse(name, 1)
    check_pose_derivatives(robot, sol.q[None])


def test_pose_derivatives_by_transmission_terms_agree_with_differences():
    robot = add_harmonics(zoo.hexapod())
    _, sol, _ = sample_inverse("hexapod", 3)
    values, q = perturb_values(robot, 1e-4), sol.q[None]
    state = forward_trials(robot, values, q)
    result = differentiate_pose(robot, values, q, state)
    both = np.concatenate([result.parameters[0][..., 42:], result.readings[0]], axis=-1)

    def solved(x):
        v = np.concatenate([values[0, :42], x[:-6]])[None]
        return geometry.pose_difference(
            forward_trials(robot, v, q + x[-6:], start=state).T[0], state.T[0]
        )

    x = np.concatenate([values[0, 42:], np.zeros(6)])
    check_jacobian(
        solved,
        both,
        x,
        scale=0.002,
        atol=1e-10,
        atol_reason="closure to 1e-13, condition 30, step 1e-4",
    )


def add_harmonics(robot):
    """Add every transmission term of the first two actuators as a parameter, on a 5 mm screw."""
    terms = ("offset", "gain", "sin1", "cos1", "sin2", "cos2")
    assembly, extra, maps = robot.assembly, [], []
    for name in ("q1", "q2"):
        for term in terms:
            dimension = Dimension.RATIO if term == "gain" else Dimension.LENGTH
            extra.append(Parameter(f"{name}.{term}", dimension, float(term == "gain")))
            maps.append(LinearMap(f"{name}.{term}", Address(name, "transmission", term)))
    actuators = tuple(
        replace(a, period=0.005) if a.name in ("q1", "q2") else a for a in assembly.actuators
    )
    return build(
        replace(
            assembly,
            parameters=(*assembly.parameters, *extra),
            maps=(*assembly.maps, *maps),
            actuators=actuators,
        )
    )


def test_pose_derivatives_of_stacked_trials_equal_single_trials_to_rounding():
    robot, sol, _ = sample_inverse("three_prs", 6)
    values, q = perturb_values(robot, 1e-4, t=7), sol.q[None]
    state = forward_trials(robot, values, q)
    together = differentiate_pose(robot, values, q, state)
    for i in range(7):
        one = forward_trials(robot, values[i : i + 1], q)
        alone = differentiate_pose(robot, values[i : i + 1], q, one)
        # the product with de/dp is one matmul a trial, whose order of summation BLAS chooses
        assert_allclose(together.parameters[i], alone.parameters[0], rtol=1e-12, atol=1e-13)
        assert_array_equal(together.readings[i], alone.readings[0])


def test_failed_rows_have_nan_derivatives_and_do_not_change_other_rows():
    robot, q = zoo.hexapod(), np.zeros((1, 3, 6))
    q[0, 1, 2] = np.nan
    values = robot.values[None]
    result = differentiate_pose(robot, values, q, forward_trials(robot, values, q))
    assert np.isnan(result.parameters[0, 1]).all()
    assert np.isfinite(result.parameters[0, [0, 2]]).all()
