# SPDX-License-Identifier: Apache-2.0
"""A small calibration of each sort, made once."""

from dataclasses import dataclass

import numpy as np
import pytest

import loopcal as lc


@dataclass(frozen=True)
class Example:
    """A robot with simulated measurements, split, and the fit of the first part."""

    robot: lc.Mechanism
    fitted: lc.Measurements
    held_out: lc.Measurements
    fit: lc.Identification


def make_example(name: str, kind, sigma: float, n: int = 24, **options) -> Example:
    robot = lc.load_robot(name)
    noise = lc.Gaussian(np.full(len(kind.noise_columns), sigma))
    instrument = lc.Instrument((lc.Sensor(kind, noise),))
    truth = robot.with_values(lc.sample_truth(robot, 1, 1)[0])
    poses = lc.sample_workspace(robot, n, seed=1).coordinates
    data = lc.simulate(truth, poses, instrument, 1, controller=robot, **options)
    fitted, held_out = data.split(hold_out=0.25, seed=1)
    return Example(robot, fitted, held_out, lc.identify(robot, fitted))


@pytest.fixture(scope="session")
def five_bar() -> Example:
    return make_example("five-bar", lc.Position(), 2e-5)


@pytest.fixture(scope="session")
def linear_delta() -> Example:
    return make_example("linear-delta", lc.Position(unknown=("frame",), frame="tracker"), 2e-5)


@pytest.fixture(scope="session")
def hexapod() -> Example:
    """A hexapod with uncertain readings, of which the positions leave some parameters open."""
    sigma = np.full(6, 1e-6)
    return make_example("hexapod-42", lc.Position(), 1e-5, 30, reading_sigma=sigma)


@pytest.fixture(scope="session")
def plan() -> lc.Plan:
    noise = lc.Gaussian(np.full(3, 1e-5))
    instrument = lc.Instrument((lc.Sensor(lc.Position(), noise),))
    return lc.plan(lc.load_robot("linear-delta"), instrument, n_poses=8)
