# SPDX-License-Identifier: Apache-2.0
"""Machines whose loops contain bodies with three joints, from simulation to compensation."""

import numpy as np
import pytest

from loopcal import load_robot
from loopcal.apply.compensation import compensate
from loopcal.estimate.identification import identify
from loopcal.estimate.penalties import MAP
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.poses import Pose
from loopcal.measure.simulation import sample_truth, simulate
from loopcal.mechanism.platform_coordinates import read_coordinates
from loopcal.mechanism.solutions import forward
from loopcal.mechanism.workspace import sample_workspace

MACHINES = 20
INSTRUMENT = Instrument((Sensor(Pose(), Gaussian(np.repeat([50e-6, 20e-6], 3))),))


@pytest.mark.parametrize("name", ["six-bar", "jansen-leg", "parallelogram-delta", "h4"])
def test_estimates_of_20_machines_scatter_as_stated_and_compensation_reaches_targets(name):
    robot = load_robot(name)
    count = 5 + len(robot.parameters) // 2
    scores, p_values = [], []
    for seed in range(MACHINES):
        truth = sample_truth(robot, 1, seed)[0]
        poses = sample_workspace(robot, count, seed=seed + 100).solution.T
        commands = read_coordinates(poses, robot.controlled)
        data = simulate(robot.with_values(truth), commands, INSTRUMENT, seed)
        fit = identify(robot, data, MAP())
        places, sd = fit.free_parameters.places, fit.standard_deviations
        scores.extend((fit.robot.values - truth)[places] / sd)
        p_values.append(fit.residual_test.p_value)
    # each has a prior, so that the scores of all machines are standard normal ones
    assert 0.9 < np.sqrt(np.mean(np.square(scores))) < 1.1
    assert min(p_values) > 1e-4
    machine = robot.with_values(truth)
    readings = {"before": data.readings, "after": compensate(fit.robot, commands).readings}
    errors = {
        name: np.std(read_coordinates(forward(machine, q).T, robot.controlled) - commands, axis=0)
        for name, q in readings.items()
    }
    assert (errors["after"] < 0.3 * errors["before"]).all()
