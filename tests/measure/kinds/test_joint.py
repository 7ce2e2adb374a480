# SPDX-License-Identifier: Apache-2.0
"""Joint sensors and locks: passive joints by name, encoders of driven joints, locked joints."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from loopcal.errors import DataError
from loopcal.measure.initial_values import evaluate_measurements, whiten_rows
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.joints import JointSensor, Locked
from loopcal.measure.readings import select_joint_values
from loopcal.measure.simulation import simulate
from loopcal.mechanism.kinematics import forward_trials
from loopcal.mechanism.solutions import inverse
from tests import zoo

COMMANDED = np.random.default_rng(2).uniform([0.65, -np.pi, 0.05], [0.75, np.pi, 0.2], (8, 3))
TINY = 1e-9


def build_sensor(kind, **labels):
    return Sensor(kind, Gaussian(np.full(len(kind.noise_columns), TINY)), **labels)


@pytest.fixture(scope="module")
def robot():
    return zoo.three_prs()


def test_sensor_on_a_passive_joint_measures_its_value_plus_the_offset(robot):
    kind = JointSensor(joints=("limb2.pin", "limb1.pin"), measures="angle", unknown=("offset",))
    data = simulate(
        robot,
        COMMANDED,
        Instrument((build_sensor(kind),)),
        1,
        nuisance_values={"limb1.pin.joint": 0.1},
    )
    solution = inverse(robot, COMMANDED)
    expected = [solution.passive[:, solution.passive_names.index(name)] for name in kind.joints]
    shown = np.stack(expected, axis=1) + np.array([0.0, 0.1])
    assert_allclose(data.observations[0].measured, shown, atol=1e-8)


def test_sensor_on_a_driven_joint_measures_the_reading(robot):
    kind = JointSensor(joints=("q1", "q2", "q3"))
    data = simulate(robot, COMMANDED, Instrument((build_sensor(kind),)), 1)
    assert_allclose(data.observations[0].measured, data.readings, atol=1e-8)


def test_sensor_of_another_dimension_than_its_joint_is_refused(robot):
    kind = JointSensor(joints=("q1", "limb1.pin"))
    with pytest.raises(DataError, match=r"'limb1.pin' as length, .* write `measures: angle`"):
        simulate(robot, COMMANDED, Instrument((build_sensor(kind),)), 1)


def test_lock_measures_the_deviation_from_the_constant_of_its_group(robot):
    kind = Locked(joints=("q1",))
    groups = np.repeat(["a", "b"], 4)
    data = simulate(
        robot,
        COMMANDED,
        Instrument((build_sensor(kind, group=groups),)),
        1,
        nuisance_values={"a.q1.locked": 0.2},
    )
    slip = data.readings[:, 0] - np.repeat([0.2, 0.0], 4)
    assert_allclose(data.observations[0].measured[:, 0], slip, atol=1e-8)


def test_rows_of_joints_have_the_derivatives_of_the_joints(robot):
    kind = JointSensor(joints=("limb1.pin", "limb2.pin"), measures="angle")
    data = simulate(robot, COMMANDED, Instrument((build_sensor(kind),)), 1)
    state = forward_trials(robot, robot.values[None], data.readings[None])
    values = select_joint_values(robot, kind.sensed_joints, data.readings[None], state)
    slopes = {name: np.random.default_rng(5).normal(size=(1, 8, 4)) for name in kind.sensed_joints}
    parts = evaluate_measurements(data, state.T, np.zeros((1, 0)), joints=values)
    rows = whiten_rows(parts, np.ones((1, 8, 6, 4)), slopes)
    assert rows.shape == (1, 16, 5)
    assert_allclose(
        rows[0, :, :4] * TINY,
        np.stack([slopes[n][0] for n in kind.sensed_joints], axis=1).reshape(16, 4),
        rtol=1e-12,
    )
    with pytest.raises(DataError, match=r"needs the values of joint 'limb1\.pin'"):
        evaluate_measurements(data, state.T, np.zeros((1, 0)))


def test_unknown_joint_is_refused_with_the_existing_ones(robot):
    with pytest.raises(DataError, match=r"has no joint 'limb1.pim'.*limb1\.pin"):
        simulate(
            robot, COMMANDED, Instrument((build_sensor(JointSensor(joints=("limb1.pim",))),)), 1
        )
