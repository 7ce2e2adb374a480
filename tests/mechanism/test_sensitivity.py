# SPDX-License-Identifier: Apache-2.0
"""Derivatives of poses and passive joints by parameters and readings, and the three maps of
parameters: onto displacements, onto transmission terms, and shared by several limbs.
"""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from loopcal import geometry
from loopcal.errors import MechanismError
from loopcal.mechanism.assembly import Actuator, Address, LinearMap
from loopcal.mechanism.compilation import build
from loopcal.mechanism.kinematics import compute_readings, forward_trials
from loopcal.mechanism.sensitivity import differentiate_passive_joints, differentiate_pose
from loopcal.mechanism.solutions import forward, make_solution
from loopcal.mechanism.transmission import TERMS, Transmissions, list_constants, nominal_terms
from loopcal.parameters import Parameter
from loopcal.units import Dimension
from tests import zoo
from tests.jacobians import check_jacobian, compile_quickly
from tests.mechanism.derivatives import check_pose_derivatives
from tests.mechanism.families.test_gough import CHAIN
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


def build_ups_hexapod():
    return build(replace(CHAIN, error_model="complete").expand())


@pytest.mark.parametrize("name", ["mixed_hexapod", "three_prs", "planar_rrr"])
def test_passive_joint_derivatives_agree_with_differences(name):
    robot, sol, _ = sample_inverse(name, 1)
    values, q = robot.values[None], sol.q[None]
    state = forward_trials(robot, values, q, start=sol.state)
    result = differentiate_passive_joints(robot, values, q, state)
    assert result.names == sol.passive_names
    dimensions = [*robot.parameters.dimensions, *(a.dimension for a in robot.actuators)]
    unit = np.array([robot.size if d is Dimension.LENGTH else 1.0 for d in dimensions])
    moved, p = np.diag(unit), values.shape[1]

    def joints(x):  # one trial a parameter or reading
        at = forward_trials(
            robot, values + x[0] * moved[:, :p], q + x[0] * moved[:, None, p:], start=state
        )
        by_limb = sorted(
            (limb, g, k)
            for g, group in enumerate(robot.program.groups)
            for k, limb in enumerate(group.limbs)
        )
        return np.concatenate(
            [
                at.joints[g][:, 0, k, : len(robot.program.groups[g].joints)][
                    :, list_passive_joints(robot, limb)
                ]
                for limb, g, k in by_limb
            ],
            axis=1,
        )

    both = np.concatenate([result.parameters, result.readings], axis=-1)[0, 0] * unit
    check_jacobian(
        joints, both.T[..., None], np.zeros(1), scale=0.1,
        atol=1e-6, atol_reason="closure to 1e-13, condition of platform and limb 30 each, step 1e-4",  # noqa: E501
    )  # fmt: skip


def list_passive_joints(robot, limb):
    return [
        j for j, joint in enumerate(robot.assembly.limbs[limb].joints) if joint.actuator is None
    ]


def test_passive_joint_derivatives_do_not_depend_on_row_blocks():
    robot = build_ups_hexapod()
    q = np.random.default_rng(0).uniform(-0.01, 0.01, (1, 700, 6))
    values = robot.values[None]
    state = forward_trials(robot, values, q)
    whole = differentiate_passive_joints(robot, values, q, state)
    single = forward(robot, q[0, 600:601])
    alone = differentiate_passive_joints(robot, values, q[:, 600:601], single.state)
    # numpy's matmul rounds a batch by its size; a turn per meter is about 10
    assert_allclose(whole.parameters[:, 600:601], alone.parameters, rtol=0, atol=1e-11)
    assert make_solution(robot, state, q[0]).passive_names == whole.names


def test_failed_rows_have_nan_derivatives_of_passive_joints():
    robot, q = build_ups_hexapod(), np.zeros((1, 2, 6))
    q[0, 1, 2] = np.nan
    result = differentiate_passive_joints(
        robot, robot.values[None], q, forward_trials(robot, robot.values[None], q)
    )
    assert np.isfinite(result.parameters[0, 0]).all()
    assert np.isnan(result.parameters[0, 1]).all()


@pytest.mark.parametrize("name", ["core-xy", "hexapod-elastic", "par4", "pulley-3", "warm-delta"])
def test_infinite_readings_of_sums_and_loads_have_nan_derivatives_without_a_warning(name):
    robot = zoo.load_cached_robot(name)
    q = np.repeat(compute_readings(robot, robot.values[None], robot.home_state), 2, axis=1)
    q[0, 1] = np.inf
    given = robot, robot.values[None], q, forward_trials(robot, robot.values[None], q)
    pose, passive = differentiate_pose(*given), differentiate_passive_joints(*given)
    for derivatives in (pose.parameters, pose.readings, passive.parameters, passive.readings):
        assert np.isfinite(derivatives[0, 0]).all()
        assert np.isnan(derivatives[0, 1]).all()


def test_ups_legs_have_no_locked_joint():
    # regression: at slide length zero the universal joint had no effect and both axes were locked
    robot = build_ups_hexapod()
    assert robot.findings == ()
    assert_array_equal([g.locked for g in robot.program.groups], [(False, False, False)])


@pytest.mark.parametrize("name", ["hexapod", "delta", "three_prs", "mixed_hexapod"])
def test_displacement_jacobian_agrees_with_differences(name):
    robot = getattr(zoo, name)()
    values = robot.values + np.random.default_rng(1).normal(size=(2, len(robot.parameters))) * 1e-3

    def slots(x):
        e, drives = robot.slots(values + x)
        return np.concatenate([e, drives.tau.reshape(2, -1)], axis=1)

    scale = np.array(
        [
            1.0 if d is not Dimension.LENGTH else 0.2 * robot.size
            for d in robot.parameters.dimensions
        ]
    )
    check_jacobian(
        slots, robot.slots.jacobian(values), np.zeros(len(robot.parameters)), scale=scale
    )


def test_shared_map_jacobian_of_a_delta_agrees_with_differences():
    for shared in zoo.delta().assembly.shared:
        inputs = np.array([[0.12, 0.5, 0.27, 0.3], [0.11, 2.5, 0.25, 0.29]])
        check_jacobian(
            lambda x, g=shared, v=inputs: g.value(v + x),
            shared.jacobian(inputs),
            np.zeros(4),
            scale=0.1,
            automatic=lambda x, g=shared, v=inputs: g.value(v + x),
        )


def test_nominal_values_give_zero_displacements():
    for robot in (zoo.hexapod(), zoo.delta(), zoo.mixed_hexapod()):
        e, drives = robot.slots(robot.values[None])
        assert_array_equal(e, 0.0)
        assert_array_equal(drives.tau, nominal_terms(robot.actuators)[None])


def test_maps_of_stacked_trials_equal_single_trials_bit_for_bit():
    robot = zoo.delta()
    values = robot.values + np.random.default_rng(1).normal(size=(7, len(robot.parameters))) * 1e-3
    e, drives = robot.slots(values)
    for i in range(7):
        own, own_drives = robot.slots(values[i : i + 1])
        assert_array_equal(e[i], own[0])
        assert_array_equal(drives.tau[i], own_drives.tau[0])


FIRST = {"offset": 0.1, "gain": 1.001, "sin1": 2e-5, "cos1": -1e-5, "sin2": 5e-6, "cos2": 3e-6}

ACTUATORS = (
    Actuator("a", Dimension.LENGTH, period=0.005, terms=FIRST),
    Actuator("b", Dimension.LENGTH, terms={"offset": -0.2, "gain": -1.0}),
    Actuator("c", Dimension.ANGLE, period=2 * np.pi, terms={"sin1": 0.02, "cos2": 0.01}),
)  # fmt: skip

READINGS = np.random.default_rng(4).uniform(-0.1, 0.1, (1, 6, 3))


def test_transmission_derivatives_agree_with_differences():
    tau, w = nominal_terms(ACTUATORS)[None], list_constants(ACTUATORS)
    drives = Transmissions(tau, w)
    check_jacobian(
        lambda x: drives.find_joints(READINGS + x[0]),
        drives.differentiate(READINGS)[..., None],
        np.zeros(1),
        scale=0.0005,
        automatic=lambda x: drives.find_joints(READINGS + x[0]),
    )
    for i in range(len(TERMS)):
        unit = np.zeros_like(tau)
        unit[..., i] = 1.0
        column = drives.differentiate_terms(READINGS)[i]
        check_jacobian(
            lambda x, u=unit: Transmissions(tau + x[0] * u, w).find_joints(READINGS),
            column[..., None],
            np.zeros(1),
            scale=1.0,
            atol=1e-12,
            atol_reason="rounding; no approach, no backlash",
        )


def test_transmission_round_trips_to_rounding():
    drives = Transmissions(nominal_terms(ACTUATORS)[None], list_constants(ACTUATORS))
    assert_allclose(
        drives.find_readings(drives.find_joints(READINGS)), READINGS, rtol=0, atol=1e-16 / 0.9 * 10
    )


def test_actuator_without_period_has_no_harmonics():
    drives = Transmissions(nominal_terms(ACTUATORS)[None], list_constants(ACTUATORS))
    columns = drives.differentiate_terms(READINGS)
    for term, column in zip(TERMS, columns, strict=True):
        if term.startswith(("sin", "cos")):
            assert_array_equal(column[..., 1], 0.0)


def test_parameter_values_are_checked_and_read_only():
    robot = zoo.hexapod()
    with pytest.raises(
        MechanismError, match=r"hexapod has 42 parameters, but values of shape \(41,\)"
    ):
        robot.with_values(np.zeros(41))
    broken = np.array(robot.values)
    broken[13] = np.nan
    with pytest.raises(MechanismError, match=r"the value of leg2\.length is not finite"):
        robot.with_values(broken)
    changed = robot.with_values(robot.values + 1e-3)
    assert_array_equal(changed.nominal.values, robot.values)
    with pytest.raises(ValueError, match="read-only"):
        changed.values[0] = 0.0
