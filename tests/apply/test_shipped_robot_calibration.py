# SPDX-License-Identifier: Apache-2.0
"""Calibrations of every shipped robot: chi-square of many draws of its errors, and z-values.

A new file in src/loopcal/robots is included automatically.
"""

import numpy as np
import pytest
from scipy.stats import chi2

from loopcal.estimate.identification import identify_trials
from loopcal.estimate.penalties import LeastSquares
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.poses import Pose
from loopcal.measure.simulation import sample_truth, simulate_trials
from loopcal.mechanism.workspace import sample_workspace
from tests.zoo import ROBOTS as SHIPPED
from tests.zoo import load_cached_robot

DRAWS, POSES = 200, 40  # of 200 draws of five correlated parameters the rms of z has 4 %
# their chi-square has other degrees of freedom: redundant readings; parameters without effect
OTHER_FREEDOMS = ("belt-4", "cable-4", "linear-delta-6")
ROBOTS = [robot for robot in SHIPPED if robot.values[0] not in OTHER_FREEDOMS]


@pytest.mark.parametrize("name", ROBOTS)
def test_residuals_and_estimates_of_simulated_calibrations_are_as_stated(name: str) -> None:
    robot = load_cached_robot(name)
    poses = sample_workspace(robot, POSES, seed=1).coordinates
    noise = Gaussian(np.repeat([5e-5, 1e-5], 3))  # [rad, m]
    instrument = Instrument((Sensor(Pose("rotation-vector"), noise),))
    truth = sample_truth(robot, DRAWS, 2)
    trials = simulate_trials(robot, truth, poses, instrument, 3)
    fits = identify_trials(robot, trials, LeastSquares())
    assert fits.converged.all()
    sd, places = fits.standard_deviations(), fits.free_parameters.places
    z = ((fits.values - truth)[:, places] / sd)[np.isfinite(sd)]
    assert 0.9 < np.sqrt(np.mean(z**2)) < 1.1
    freedoms = DRAWS * (6 * POSES - int(robot.parameters.free.sum()))
    low, high = chi2.ppf([0.005, 0.995], freedoms)
    assert low < fits.cost.sum() < high
