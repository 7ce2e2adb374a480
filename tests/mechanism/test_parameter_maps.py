# SPDX-License-Identifier: Apache-2.0
"""The three maps of parameters: onto displacements, onto transmission terms, and shared by several
limbs.
"""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from loopcal.errors import MechanismError
from loopcal.mechanism.assembly import Actuator
from loopcal.mechanism.transmission import (
    TERMS,
    harmonic_frequencies,
    joint_slopes,
    joints_from_readings,
    nominal_terms,
    readings_from_joints,
    term_derivatives,
)
from loopcal.units import Dimension
from tests import zoo
from tests.jacobians import check_jacobian


@pytest.mark.parametrize("name", ["hexapod", "delta", "three_prs", "mixed_hexapod"])
def test_displacement_jacobian_agrees_with_differences(name):
    robot = getattr(zoo, name)()
    values = robot.values + np.random.default_rng(1).normal(size=(2, len(robot.parameters))) * 1e-3

    def slots(x):
        e, tau = robot.slots(values + x)
        return np.concatenate([e, tau.reshape(2, -1)], axis=1)

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
        e, tau = robot.slots(robot.values[None])
        assert_array_equal(e, 0.0)
        assert_array_equal(tau, nominal_terms(robot.actuators)[None])


def test_maps_of_stacked_trials_equal_single_trials_bit_for_bit():
    robot = zoo.delta()
    values = robot.values + np.random.default_rng(1).normal(size=(7, len(robot.parameters))) * 1e-3
    together = robot.slots(values)
    for i in range(7):
        for a, b in zip(together, robot.slots(values[i : i + 1]), strict=True):
            assert_array_equal(a[i], b[0])


FIRST = {"offset": 0.1, "gain": 1.001, "sin1": 2e-5, "cos1": -1e-5, "sin2": 5e-6, "cos2": 3e-6}
ACTUATORS = (
    Actuator("a", Dimension.LENGTH, period=0.005, terms=FIRST),
    Actuator("b", Dimension.LENGTH, terms={"offset": -0.2, "gain": -1.0}),
    Actuator("c", Dimension.ANGLE, period=2 * np.pi, terms={"sin1": 0.02, "cos2": 0.01}),
)  # fmt: skip
READINGS = np.random.default_rng(4).uniform(-0.1, 0.1, (1, 6, 3))


def test_transmission_derivatives_agree_with_differences():
    tau, w = nominal_terms(ACTUATORS)[None], harmonic_frequencies(ACTUATORS)
    check_jacobian(
        lambda x: joints_from_readings(READINGS + x[0], tau, w), joint_slopes(READINGS, tau, w)[..., None], np.zeros(1), scale=0.0005,  # noqa: E501
        automatic=lambda x: joints_from_readings(READINGS + x[0], tau, w),
    )  # fmt: skip
    for i in range(len(TERMS)):
        unit = np.zeros_like(tau)
        unit[..., i] = 1.0
        column = term_derivatives(READINGS, tau, w)[i]
        check_jacobian(
            lambda x, u=unit: joints_from_readings(READINGS, tau + x[0] * u, w),
            column[..., None],
            np.zeros(1),
            scale=1.0,
            atol=1e-12,
            atol_reason="rounding; no approach, no backlash",
        )


def test_transmission_round_trips_to_rounding():
    tau, w = nominal_terms(ACTUATORS)[None], harmonic_frequencies(ACTUATORS)
    assert_allclose(
        readings_from_joints(joints_from_readings(READINGS, tau, w), tau, w),
        READINGS,
        rtol=0,
        atol=1e-16 / 0.9 * 10,
    )


def test_actuator_without_period_has_no_harmonics():
    columns = term_derivatives(
        READINGS, nominal_terms(ACTUATORS)[None], harmonic_frequencies(ACTUATORS)
    )
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
