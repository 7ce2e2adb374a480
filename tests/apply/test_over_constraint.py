# SPDX-License-Identifier: Apache-2.0
"""Calibration of over-constrained machines with the least-squares closure: the stated cost."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from loopcal.estimate.identification import identify, identify_trials
from loopcal.estimate.penalties import LeastSquares
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.poses import Pose
from loopcal.measure.measurements import Measurements
from loopcal.measure.simulation import sample_truth, simulate, simulate_trials
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import forward
from tests.over_constrained import EXECHON, FOUR_BAR, close_by_least_squares
from tests.robot_texts import load_text

SIGMA = np.array([20e-6] * 3 + [20e-6] * 3)
"""Of angles [rad] and positions [m]."""


def draw_poses(robot: Mechanism, count: int, seed: int) -> NDArray[np.float64]:
    """Return coordinates (n, c) in the workspace."""
    ranges = np.array(list(robot.assembly.workspace.values()))
    return np.random.default_rng(seed).uniform(ranges[:, 0], ranges[:, 1], (count, len(ranges)))


def measure(robot: Mechanism, poses: int, seed: int) -> tuple[Mechanism, Measurements]:
    """Return a machine with drawn errors, and measured poses."""
    true = robot.with_values(sample_truth(robot, 1, seed)[0])
    asked = draw_poses(robot, poses, seed)
    return true, simulate(true, asked, Instrument((Sensor(Pose(), Gaussian(SIGMA)),)), seed)


def compute_cost(robot: Mechanism, data: Measurements) -> float:
    """Return the sum of squares of measured minus predicted poses over their sigma."""
    T = forward(robot, data.readings).T
    measured = np.array(data.observations[0].measured)
    shift = T[:, :3, 3] - measured[:, 3:]
    turn = Rotation.from_matrix(T[:, :3, :3]) * Rotation.from_rotvec(measured[:, :3]).inv()
    whitened = np.concatenate([turn.as_rotvec(), shift], axis=1) / SIGMA
    return float(np.sum(whitened**2))


@pytest.mark.parametrize("text", [EXECHON, FOUR_BAR], ids=["exechon", "four-bar"])
def test_stated_chi_square_is_the_cost_at_the_stated_estimate(text: str, tmp_path: Path) -> None:
    robot = load_text(tmp_path, close_by_least_squares(text))
    true, data = measure(robot, 25, 3)
    fit = identify(robot, data, LeastSquares())
    assert fit.converged
    cost = compute_cost(fit.robot, data)
    assert fit.chi_square == pytest.approx(cost, rel=1e-8)
    assert cost < compute_cost(true, data)  # no other values fit better
    assert fit.rank == len(fit.names)


@pytest.mark.parametrize("draws", [8, pytest.param(20, marks=pytest.mark.evidence)])
def test_chi_square_of_calibrations_is_that_of_the_noise(tmp_path: Path, draws: int) -> None:
    robot = load_text(tmp_path, close_by_least_squares(EXECHON))
    poses = draw_poses(robot, 15, 1)
    instrument = Instrument((Sensor(Pose(), Gaussian(SIGMA)),))
    trials = simulate_trials(robot, sample_truth(robot, draws, 2), poses, instrument, 3)
    fits = identify_trials(robot, trials, LeastSquares())
    assert fits.converged.all()
    costs = [compute_cost(robot.with_values(v), trials.trial(i)) for i, v in enumerate(fits.values)]
    np.testing.assert_allclose(fits.cost, costs, rtol=1e-7)
    degrees = draws * (15 * 6 - int(robot.parameters.free.sum()))
    low, high = chi2.ppf([0.005, 0.995], degrees)
    assert low < fits.cost.sum() < high
