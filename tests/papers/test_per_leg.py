# SPDX-License-Identifier: Apache-2.0
"""Per-leg identification of the 42-parameter hexapod study, at the ten poses of the study."""

import numpy as np
import pytest

from loopcal.errors import EstimationError
from loopcal.estimate import identify
from loopcal.measure import sample_truth, simulate, simulate_trials
from loopcal.papers.hexapod_42.leg_form import identify_per_leg
from tests import zoo
from tests.estimate.problems import bed_points, hexapod, hexapod_poses, simulate_heights, tracker

MM = 1e-3
# Table 4 of the study: the ten commanded poses (x, y, z [mm], roll, pitch, yaw [rad]).
PAPER_POSES = np.array(
    [
        (10, 0, 200, 0.017453292, 0.034907, 0.05236),
        (10, 10, 200, 0.034906584, -0.03491, 0.017453),
        (0, 10, 200, 0.052359877, 0.034907, -0.01745),
        (-10, 10, 200, -0.05235988, -0.01745, 0.017453),
        (-10, 0, 200, -0.01745329, 0.017453, 0.034907),
        (-10, -10, 200, 0.017453292, -0.05236, 0.017453),
        (0, -10, 200, 0.034906584, 0.05236, -0.03491),
        (10, -10, 200, 0.052359877, 0.017453, 0.05236),
        (0, 0, 210, -0.03490658, 0.034907, -0.05236),
        (0, 0, 210, 0.034906584, -0.03491, 0.034907),
    ]
) * np.array([MM, MM, MM, 1, 1, 1])


def test_noise_free_steps_and_conditions_agree_with_the_study():
    truth = zoo.hexapod().with_values(zoo.hexapod_truth())
    data = simulate(truth, PAPER_POSES, tracker(1e-15, 1e-15), 0)
    found = identify_per_leg(hexapod(), data, steps=3)
    errors = np.abs(found.estimate_history - zoo.hexapod_truth()).max(axis=1) / MM
    assert errors[1] == pytest.approx(1.6e-3, rel=0.1)
    assert errors[2] < 3e-6
    assert errors[3] < 1e-8
    # our own computation, to the three digits that survive the printed rounding of the poses
    np.testing.assert_allclose(found.conditions, [5822, 3501, 4924, 4570, 3385, 4683], rtol=0.01)


def test_per_leg_fit_has_larger_errors_than_the_joint_fit():
    robot = hexapod()
    trials = simulate_trials(
        robot, sample_truth(robot, 12, 0), hexapod_poses(15), tracker(1e-6, 1e-6), 0
    )
    error = {"alone": 0.0, "together": 0.0}
    for i in range(12):
        data, truth = trials.trial(i), trials.truth[i]
        error["alone"] += float(np.sum((identify_per_leg(robot, data).robot.values - truth) ** 2))
        error["together"] += float(np.sum((identify(robot, data).estimate - truth) ** 2))
    assert np.sqrt(error["alone"] / error["together"]) > 1.5


def test_data_that_are_not_full_poses_are_refused():
    robot = zoo.delta()
    with pytest.raises(EstimationError, match="full poses"):
        identify_per_leg(robot, simulate_heights(robot, bed_points(8)))
