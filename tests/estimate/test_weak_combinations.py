# SPDX-License-Identifier: Apache-2.0
"""Combinations of parameters without a stated spread that the data determine too weakly: along
them the residuals are curved, so that the data alone have no best value.
"""

from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

import loopcal as lc
from loopcal.estimate.free_parameters import FreeParameters, select_free_parameters
from loopcal.estimate.identification import IdentifiedTrials, identify, identify_trials
from loopcal.estimate.penalties import HOLD, MAP, LeastSquares
from loopcal.io.robot.robot_file import find_robot_file
from loopcal.measure.simulation import Trials, reach_poses, simulate_trials
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import inverse
from tests.robot_texts import load_text

NOISE = np.array([5e-5] * 3 + [1e-5] * 3)
POSE = lc.Instrument((lc.Sensor(lc.Pose(), lc.Gaussian(NOISE)),))
MACHINES = 12
ROBOTS = "six-bar", "jansen-leg", "6-rus"


@cache
def load_complete(name: str) -> Mechanism:
    """Return a robot with all errors that its links can have; those of its file have tolerances."""
    text = find_robot_file(name).read_text("utf-8")
    with TemporaryDirectory() as folder:
        complete = "family: limbs\nerror_model: complete"
        return load_text(Path(folder), text.replace("family: limbs", complete))


@cache
def fit_machines(name: str, factor: float) -> tuple[FreeParameters, Trials, IdentifiedTrials]:
    """Return free parameters, machines with errors of `factor` assumed spreads, and fits."""
    robot = load_complete(name)
    free = select_free_parameters(robot)
    z = np.random.default_rng(3).standard_normal((MACHINES, len(free)))
    truth = free.values(z * np.where(free.assumed, factor, 1.0))
    poses = lc.sample_workspace(robot, 30, seed=1).coordinates
    trials = simulate_trials(robot, truth, poses, POSE, seed=1)
    return free, trials, identify_trials(robot, trials)


@pytest.mark.parametrize("factor", [1.0, 5.0])
@pytest.mark.parametrize("name", ROBOTS)
def test_every_fit_converges_to_the_noise_and_predicts_other_poses(name, factor):
    free, trials, fits = fit_machines(name, factor)
    assert free.assumed.any()
    assert fits.converged.all()
    assert fits.iterations.max() < 30
    left = trials.readings.shape[0] * 6 - fits.decomposition.filter_factors(fits.penalty).sum(
        axis=1
    )
    # the mean of 12 chi-squares of more than 100 degrees: 0.04 is its standard deviation
    assert np.mean(fits.cost / left) == pytest.approx(1.0, abs=4 * 0.04)
    commanded = inverse(free.robot, lc.sample_workspace(free.robot, 20, seed=9).coordinates)
    places = [
        reach_poses(free.robot, values, commanded.q, commanded.state)[1].T[..., :3, 3]
        for values in (trials.truth, fits.values)
    ]
    errors = np.linalg.norm(places[0] - places[1], axis=-1)[:, commanded.converged]
    # 30 measured poses: the errors of the machine are a part of the noise of a single pose
    assert np.sqrt(np.mean(errors**2)) < np.linalg.norm(NOISE[3:])


@pytest.mark.parametrize("factor", [1.0, 5.0])
@pytest.mark.parametrize("name", ROBOTS)
def test_uncertainties_cover_the_truth(name, factor):
    free, trials, fits = fit_machines(name, factor)
    sd = fits.standard_deviations()
    z = ((fits.values - trials.truth)[:, free.places] / sd)[np.isfinite(sd)]
    # at five assumed spreads the prior is right; smaller errors are within it
    assert np.sqrt(np.mean(z**2)) < 1.15
    if factor == HOLD:
        assert np.sqrt(np.mean(z**2)) > 0.8


def test_a_fit_names_what_it_held_and_leaves_null_combinations_unknown():
    free, trials, fits = fit_machines("six-bar", 1.0)
    fit = identify(free.robot, trials.trial(0))
    assert isinstance(fit.method, MAP)
    assert fit.method.held
    (held,) = [f for f in fit.findings if f.code == "fit.held"]
    assert held.data["count"] > 0
    assert set(held.data["names"]) <= set(np.array(free.names)[free.assumed])
    assert [str(a) for a in held.data["assumed"]] == [str(a) for a in free.list_assumed(HOLD)]
    sd = np.sqrt(np.diag(fit.covariance))
    assert fit.robot.values == pytest.approx(fits.values[0], rel=1e-12)
    assert sd == pytest.approx(fits.standard_deviations(fit.residual_test.sigma_scale**2)[0])
    # the plane mechanism says nothing of this angle, whatever may be assumed of it
    assert np.isinf(sd[free.names.index("crank.motor.rx")])


def test_stated_tolerances_are_as_wide_with_held_parameters_as_without():
    """The null direction of a stated parameter keeps its spread; one of others is unknown."""
    free, _, fits = fit_machines("jansen-leg", 1.0)
    sd = fits.standard_deviations() / free.tolerance
    assert (sd[:, ~free.assumed] < 1.01).all()
    assert np.isinf(sd[:, free.assumed]).any()


@pytest.mark.parametrize("name", ["hexapod-42", "linear-delta"])
def test_parameters_that_data_determine_are_not_held(name):
    """Without any tolerance the result is that of least squares."""
    robot = lc.load_robot(name)
    entries = tuple(replace(p, tolerance=None) for p in robot.parameters.entries)
    robot = replace(robot, parameters=replace(robot.parameters, entries=entries))
    poses = lc.sample_workspace(robot, 40, seed=2).coordinates
    data = lc.simulate(robot, poses, POSE, seed=1)
    fit, plain = identify(robot, data), identify(robot, data, LeastSquares())
    assert not [f for f in fit.findings if f.code == "fit.held"]
    sd = np.sqrt(np.diag(fit.covariance))
    known = np.isfinite(sd)
    places = fit.free_parameters.places[known]
    assert (fit.robot.values - plain.robot.values)[places] / sd[known] == pytest.approx(0, abs=1e-6)


def test_the_data_inflate_the_assumed_prior_where_errors_exceed_it():
    """Errors of twenty assumed tolerances: the intervals still contain them."""
    free, trials, _ = fit_machines("jansen-leg", 20.0)
    fit = identify(free.robot, trials.trial(1))
    assert fit.converged
    (held,) = [f for f in fit.findings if f.code == "fit.held"]
    assert held.data["assumed"][0].value > 1.2 * free.list_assumed(HOLD)[0].value
