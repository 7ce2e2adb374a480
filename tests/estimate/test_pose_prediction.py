# SPDX-License-Identifier: Apache-2.0
"""Prediction of poses from readings of different sigmas: each reading counts by its sigma."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from loopcal.apply.validation import validate
from loopcal.errors import DataError
from loopcal.estimate.pose_estimate import predict_from_readings
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.instrument import Instrument, Sensor
from loopcal.measure.kinds.position import Position
from loopcal.measure.simulation import simulate
from loopcal.mechanism.solutions import forward, inverse
from loopcal.mechanism.workspace import sample_workspace
from tests.estimate.problems import MM, UM, noise


@pytest.fixture(scope="module")
def cable():
    """Return a four-line robot, true positions, and their measurements with noisy readings."""
    robot = load_robot("cable-4")
    positions = sample_workspace(robot, 8, 1).coordinates
    return (
        robot,
        positions,
        simulate(robot, positions, Instrument((Sensor(Position(), noise(UM, UM, UM)),)), 1),
    )


def change_reading(data, sigma, off, pose=2, line=0):
    """Change a reading by `off` [rad] and state another sigma [rad] for it."""
    readings, stated = data.readings.copy(), data.reading_sigma.copy()
    readings[pose, line] += off
    stated[pose, line] = sigma
    return replace(data, readings=readings, reading_sigma=stated)


@pytest.mark.parametrize(("sigma", "off"), [(1e3, 50.0), (np.inf, 50.0), (np.inf, np.nan)])
def test_line_with_a_large_sigma_does_not_affect_the_predicted_pose(cable, sigma, off):
    robot, positions, data = cable
    usual = validate(robot, data, before=robot)
    result = validate(robot, change_reading(data, sigma, off), before=robot)
    assert result.poses == usual.poses
    assert result.unreachable == ()
    assert result.findings == usual.findings
    error = result.after.position
    assert_allclose(
        np.delete(error, 2), np.delete(usual.after.position, 2), atol=1e-6
    )  # [m]: two ways to solve the same
    assert error[2] < 10 * MM  # three lines; 50 rad of the fourth are meters
    at, is_predicted = predict_from_readings(robot, change_reading(data, sigma, off))
    assert is_predicted.all()
    assert_allclose(at.T[2, :3, 3], positions[2], atol=10 * MM)
    assert_allclose(
        inverse(robot, at.T[2:3]).q[0, 1:], data.readings[2, 1:], atol=1e-4
    )  # [rad]: three lines agree


def test_pose_with_too_few_readings_is_estimated_with_its_rows_and_reported(cable):
    """Four lines hold the platform in three freedoms; two readings and a position leave two."""
    robot, _, data = cable
    two = change_reading(change_reading(data, np.inf, np.nan), np.inf, np.nan, line=2)
    result = validate(robot, two, before=robot)
    assert result.poses == ("1", "2", "3", "4", "5", "6", "7", "8")
    assert result.unreachable == ()
    (estimated,) = [f for f in result.findings if f.code == "validation.poses-estimated"]
    assert tuple(estimated.data["names"]) == ("pose 3",)


def test_equal_sigmas_predict_the_forward_kinematics(cable):
    robot, _, data = cable
    result, _ = predict_from_readings(robot, data)
    assert_allclose(result.T, forward(robot, data.readings).T, atol=0)
    other, _ = predict_from_readings(
        robot,
        replace(data, reading_sigma=data.reading_sigma * np.array([1.0, 1.0, 1.0, 1.0 + 1e-6])),
    )
    assert_allclose(other.T, result.T, atol=1e-6)  # [m]: closure's curvature times noise


@pytest.mark.parametrize("name", ["cable-4", "linear-delta"])
def test_validation_without_any_readings_is_refused(name):
    robot = load_robot(name)
    data = simulate(
        robot,
        sample_workspace(robot, 3, 1).coordinates,
        Instrument((Sensor(Position(), noise(UM, UM, UM)),)),
        1,
    )
    none = replace(
        data,
        readings=np.full(data.readings.shape, np.nan),
        reading_sigma=np.full(data.readings.shape, np.inf),
    )
    with pytest.raises(DataError, match="None of the 3 poses"):
        validate(robot, none)
