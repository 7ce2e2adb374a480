# SPDX-License-Identifier: Apache-2.0
"""Machines with several coupled loops, from simulation to compensation."""

import numpy as np
import pytest

from loopcal import load_robot
from loopcal.apply.compensation import compensate
from loopcal.estimate.identification import identify, identify_trials
from loopcal.estimate.penalties import MAP
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.joints import JointSensor
from loopcal.measure.kinds.poses import Pose
from loopcal.measure.simulation import sample_truth, simulate, simulate_trials
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.platform_coordinates import read_coordinates
from loopcal.mechanism.solutions import forward, inverse
from loopcal.mechanism.workspace import sample_workspace

MACHINES = 200
SENSOR = Sensor(Pose(), Gaussian(np.repeat([50e-6, 20e-6], 3)))
FINE = Instrument((Sensor(Pose(), Gaussian(np.repeat([5e-6, 2e-6], 3))),))
LEFT_FINGER = Sensor(JointSensor(joints=("left.rail",)), Gaussian(np.array([20e-6])))
ROBOTS = (
    "six-bar", "jansen-leg", "parallelogram-delta", "h4", "klann-leg", "gripper", "biped-leg",
    "telescopic-delta", "cable-camera", "orthoglide", "par4", "warm-delta",
)  # fmt: skip


def draw_commands(robot: Mechanism, count: int, seed: int) -> np.ndarray:
    """Return controlled coordinates of reachable poses."""
    poses = sample_workspace(robot, count, seed=seed + 100).solution.T
    return read_coordinates(poses, robot.controlled)


@pytest.mark.parametrize("name", [*ROBOTS, "6-rus", "pulley-3"])
def test_estimates_of_machines_scatter_as_stated(name):
    robot = load_robot(name)
    # the pose of the right finger of the gripper does not depend on the left one
    instrument = Instrument((SENSOR, LEFT_FINGER)) if name == "gripper" else Instrument((SENSOR,))
    poses = draw_commands(robot, 5 + len(robot.parameters) // 2, 0)
    truth = sample_truth(robot, MACHINES, 0)
    fits = identify_trials(robot, simulate_trials(robot, truth, poses, instrument, 0), MAP())
    assert fits.converged.all()
    deviations = (fits.values - truth)[:, fits.free_parameters.places]
    # each has a prior, so that the scores of all machines are standard normal ones: of 200 machines
    # with 5 parameters the rms is 1 +- 0.02
    assert 0.9 < np.sqrt(np.mean((deviations / fits.standard_deviations()) ** 2)) < 1.1


@pytest.mark.parametrize("name", ROBOTS)
def test_compensation_takes_a_machine_with_coupled_loops_to_its_targets(name):
    robot = load_robot(name)
    machine = robot.with_values(sample_truth(robot, 1, 1)[0])
    count = 5 + len(robot.parameters) // 2
    fit = identify(robot, simulate(machine, draw_commands(robot, count, 1), FINE, 1), MAP())
    targets = draw_commands(robot, 20, 5)

    def scatter(readings: np.ndarray) -> np.ndarray:
        """Return the standard deviation of the error of each controlled coordinate."""
        reached = read_coordinates(forward(machine, readings).T, robot.controlled)
        return np.std(reached - targets, axis=0)

    before = scatter(inverse(robot, targets).q)
    assert (scatter(compensate(fit.robot, targets).readings) < 0.3 * before).all()
