# SPDX-License-Identifier: Apache-2.0
"""Invalid standard deviations of readings are refused with the actuator and the unit."""

from dataclasses import replace

import numpy as np
import pytest

from loopcal.errors import DataError
from loopcal.estimate.identification import identify
from loopcal.estimate.penalties import LeastSquares
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.position import Position
from loopcal.measure.measurements import Measurements
from loopcal.measure.simulation import simulate
from loopcal.mechanism.workspace import sample_workspace


def simulate_positions(name, n=20, sigma=None):
    """Return a robot and simulated positions of it."""
    robot = load_robot(name)
    seen = Instrument((Sensor(Position(), Gaussian(np.full(3, 1e-5))),))
    return robot, simulate(
        robot, sample_workspace(robot, n, 1).coordinates, seen, 0, reading_sigma=sigma
    )


@pytest.mark.parametrize("given", ["5 um", 1j, np.array([1j]), [[1.0], "a"]])
def test_sigma_that_is_not_a_number_is_refused(given):
    with pytest.raises(DataError, match="Give numbers, in meters and radians"):
        Measurements("r", [[0.0, 0.0]], (), reading_sigma=given)  # type: ignore[arg-type]
    with pytest.raises(DataError, match="Give numbers, in meters and radians"):
        simulate_positions("linear-delta", 1, given)


def test_missing_reading_needs_an_infinite_sigma():
    with pytest.raises(
        DataError,
        match=r"row 1, column 2 is nan. Give a finite number, or "
        r"reading_sigma",
    ):
        Measurements("r", [[0.0, np.nan]], ())  # type: ignore[arg-type]
    with pytest.raises(
        DataError,
        match=r"pose '1': the sigma 2e-05 \[m or rad\] of reading 2 belongs to a missing "
        r"reading",
    ):
        Measurements("r", [[0.0, np.nan]], (), reading_sigma=0.1 + 0.2 - 0.29998)  # type: ignore


@pytest.mark.parametrize(
    ("name", "sigma", "message"),
    [
        (
            "linear-delta",
            1e12,
            r"the sigma 1e\+15 mm of the reading of slide1 in row 1 is larger than .* Give inf",
        ),
        ("linear-delta", 1e200, "Give inf"),
        ("rotary-delta", 2e6, "in row 1 is larger than any possible error of a reading"),
        (
            "linear-delta",
            -1e-5,
            r"the sigma -0\.01 mm of the reading of slide1 in row 1 is not a standard deviation",
        ),
        ("linear-delta", np.nan, "is not a standard deviation"),
    ],
)
def test_invalid_sigma_of_a_reading_is_refused_with_the_actuator(name, sigma, message):
    robot = load_robot(name)
    message = message.replace("slide1", robot.actuators[0].name)
    with pytest.raises(DataError, match=message):
        simulate_positions(name, 3, sigma)
    if sigma > 0.0:
        robot, data = simulate_positions(name)
        with pytest.raises(DataError, match=message):
            identify(
                robot,
                replace(data, reading_sigma=np.full(data.readings.shape, sigma)),
                LeastSquares(),
            )


def test_exact_reading_of_a_redundant_actuator_is_refused():
    robot, data = simulate_positions("cable-4")
    exact = replace(data, reading_sigma=np.array([0.0, 1e-3, 1e-3, 1e-3]))
    with pytest.raises(
        DataError,
        match=r"Readings of redundant actuators cannot be exact. Give each a "
        r"sigma above 0",
    ) as error:
        identify(robot, exact, LeastSquares())
    assert "contradict" not in str(error.value)


def test_sigmas_of_very_different_size_are_reported():
    robot, data = simulate_positions("cable-4")
    usual = identify(robot, data, LeastSquares())
    assert not any("standard deviations differ" in note for note in map(str, usual.findings))
    extreme = identify(robot, replace(data, reading_sigma=1e-15), LeastSquares())
    note = next(str(f) for f in extreme.findings if "standard deviations differ" in str(f))
    assert f"readings {robot.actuators[0].name}" in note
