# SPDX-License-Identifier: Apache-2.0
"""Texts of public objects, and refusals of arguments of the wrong type."""

from __future__ import annotations

import numpy as np
import pytest

from loopcal.measure.instrument import Gaussian, Instrument, Sensor, Uniform
from loopcal.measure.kinds import KINDS
from loopcal.measure.kinds.poses import Pose
from loopcal.measure.kinds.position import Position
from loopcal.measure.measurements import Measurements
from loopcal.measure.simulation import simulate, simulate_trials
from tests import zoo

LINES, CHARACTERS = 20, 1600  # of a screen


@pytest.fixture(scope="module")
def robot():
    return zoo.hexapod()


@pytest.fixture(scope="module")
def instrument():
    tracker = Position(targets=("ball",), unknown=("frame", "targets"), frame="tracker")
    pose = Sensor(Pose(), Gaussian(np.full(6, 1e-5)))
    return Instrument((Sensor(tracker, Uniform(np.full(3, 1e-5))), pose))


@pytest.fixture(scope="module")
def poses():
    middle = np.array([0.0, 0.0, 0.2, 0.0, 0.0, 0.0])
    return zoo.make_poses(np.random.default_rng(0).uniform(-0.02, 0.02, (40, 6)) + middle)


def test_text_of_every_public_object_has_fewer_than_20_lines(robot, instrument, poses):
    data = simulate(robot, poses, instrument, seed=1)
    trials = simulate_trials(robot, robot.values[None], poses, instrument, seed=1)
    many = Measurements("many", np.zeros((2, 1)), data.take([0, 1]).observations * 30)
    for value in (
        data,
        trials,
        many,
        many.nuisance_parameters,
        instrument,
        *instrument.sensors,
        *data.observations,
        *(kind for cls in KINDS.values() for kind in cls.examples()),
    ):
        text = repr(value)
        assert type(value).__name__ in text
        assert len(text) < CHARACTERS
        assert text.count("\n") < LINES


def test_text_of_a_kind_states_only_settings_that_differ_from_the_default():
    assert repr(Pose()) == "Pose()"
    assert repr(Position(unknown=("frame",), frame="tracker")) == (
        "Position(unknown=('frame',), frame='tracker')"
    )


def test_text_of_measurements_counts_poses_and_rows(robot, instrument, poses):
    text = repr(simulate(robot, poses, instrument, seed=1))
    assert "40 poses, 6 actuator readings each" in text
    assert "40 rows; 240 residuals" in text
