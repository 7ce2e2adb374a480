# SPDX-License-Identifier: Apache-2.0
"""Machines whose loops contain bodies with three joints, from simulation to compensation."""

import numpy as np
import pytest

from loopcal import load_robot
from loopcal.apply.compensation import compensate
from loopcal.estimate.identification import identify
from loopcal.estimate.penalties import MAP
from loopcal.estimate.result import Identification
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.poses import Pose
from loopcal.measure.simulation import sample_truth, simulate
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.platform_coordinates import read_coordinates
from loopcal.mechanism.solutions import forward, inverse
from loopcal.mechanism.workspace import sample_workspace

MACHINES = 20
INSTRUMENT = Instrument((Sensor(Pose(), Gaussian(np.repeat([50e-6, 20e-6], 3))),))


def fit_machine(robot: Mechanism, seed: int) -> tuple[Mechanism, Identification]:
    """Return a machine with drawn errors, and the fit of its measurements."""
    machine = robot.with_values(sample_truth(robot, 1, seed)[0])
    count = 5 + len(robot.parameters) // 2
    data = simulate(machine, draw_commands(robot, count, seed), INSTRUMENT, seed)
    return machine, identify(robot, data, MAP())


def draw_commands(robot: Mechanism, count: int, seed: int) -> np.ndarray:
    """Return controlled coordinates of reachable poses."""
    poses = sample_workspace(robot, count, seed=seed + 100).solution.T
    return read_coordinates(poses, robot.controlled)


@pytest.mark.parametrize(
    "name",
    [
        "six-bar",
        "h4",
        pytest.param("jansen-leg", marks=pytest.mark.evidence),
        pytest.param("parallelogram-delta", marks=pytest.mark.evidence),
    ],
)
def test_estimates_of_20_machines_scatter_as_stated(name):
    robot = load_robot(name)
    scores, p_values = [], []
    for seed in range(MACHINES):
        machine, fit = fit_machine(robot, seed)
        deviation = (fit.robot.values - machine.values)[fit.free_parameters.places]
        scores.extend(deviation / fit.standard_deviations)
        p_values.append(fit.residual_test.p_value)
    # each has a prior, so that the scores of all machines are standard normal ones
    assert 0.9 < np.sqrt(np.mean(np.square(scores))) < 1.1
    assert min(p_values) > 1e-4


@pytest.mark.parametrize("name", ["six-bar", "jansen-leg", "parallelogram-delta", "h4"])
def test_compensation_takes_a_machine_of_bodies_to_its_targets(name):
    robot = load_robot(name)
    machine, fit = fit_machine(robot, 1)
    targets = draw_commands(robot, 20, 5)

    def scatter(readings: np.ndarray) -> np.ndarray:
        """Return the standard deviation of the error of each controlled coordinate."""
        reached = read_coordinates(forward(machine, readings).T, robot.controlled)
        return np.std(reached - targets, axis=0)

    before = scatter(inverse(robot, targets).q)
    assert (scatter(compensate(fit.robot, targets).readings) < 0.3 * before).all()
