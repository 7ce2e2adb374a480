# SPDX-License-Identifier: Apache-2.0
"""Arguments that would give a wrong result, or an error of numpy, are refused."""

import numpy as np
import pytest

import loopcal as lc

INSTRUMENT = lc.Instrument((lc.Sensor(lc.Pose(), lc.Gaussian(np.full(6, 1e-5))),))


@pytest.fixture(scope="module")
def robot():
    return lc.load_robot("hexapod-42")


@pytest.fixture(scope="module")
def data(robot):
    return lc.simulate(robot, lc.sample_workspace(robot, 4, 0).coordinates, INSTRUMENT, seed=0)


@pytest.mark.parametrize("truth", [np.zeros((3, 5)), np.zeros((0, 42))])
def test_simulated_trials_need_a_value_of_each_parameter(robot, truth):
    with pytest.raises(lc.DataError, match="truth"):
        lc.simulate_trials(robot, truth, robot.home[None], INSTRUMENT, seed=0)


@pytest.mark.parametrize(
    "poses", [np.array([0.5, 1.2]), "pose", np.array([True, False]), np.zeros((4, 1), dtype=bool)]
)
def test_take_refuses_anything_but_indices_and_a_mask_of_all_poses(data, poses):
    with pytest.raises(lc.DataError, match="give"):
        data.take(poses)


def test_take_accepts_indices_and_a_mask_of_all_poses(data):
    by_index, by_mask = data.take([1, 3]), data.take([False, True, False, True])
    assert by_index.labels == by_mask.labels == ("2", "4")


def test_a_negative_sigma_is_refused(robot):
    kind = lc.Pose().with_tool(robot.tool)
    with pytest.raises(lc.DataError, match="sigma contains -1e-05"):
        lc.Observations.from_sigma(kind, [0], np.zeros((1, 6)), -1e-5)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_stated_value_is_finite(value):
    with pytest.raises(lc.DataError, match=r"tracker\.x"):
        lc.StatedValue("tracker.x", nominal=value)


@pytest.mark.parametrize(
    "function", [lc.sample_workspace, lc.find_assembly_modes, lc.find_working_modes]
)
def test_a_name_in_place_of_a_robot_is_answered_with_how_to_load_one(function):
    with pytest.raises(lc.ArgumentTypeError, match=r"loopcal\.load_robot"):
        function("hexapod-42", np.zeros(6))
