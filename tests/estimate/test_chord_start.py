# SPDX-License-Identifier: Apache-2.0
"""Fits that begin with chords end where the usual ones do, within 1e-3 standard deviations."""

from dataclasses import replace

import numpy as np
import pytest

from loopcal.errors import EstimationError
from loopcal.estimate import identification as module
from loopcal.estimate import problem as problem_module
from loopcal.estimate.identification import ACCEPTED_STEP, IdentifiedTrials, identify_trials
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import GCV, MAP, LeastSquares, Ridge
from loopcal.estimate.tolerance_components import InflatedTolerances
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.poses import Pose
from loopcal.measure.kinds.position import Position
from loopcal.measure.simulation import Trials, sample_truth, simulate_trials
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.workspace import sample_workspace

HEXAPOD, DELTA = load_robot("hexapod-42"), load_robot("rotary-delta")


def simulate(robot: Mechanism, count: int, poses: int, factor: float = 1.0, kind=None) -> Trials:
    """Return measurements of machines whose errors are `factor` times those of the spreads."""
    kind = Pose() if kind is None else kind
    truth = robot.values + factor * (sample_truth(robot, count, 2) - robot.values)
    noise = Gaussian(np.full(len(kind.noise_columns), 1e-5))
    coordinates = sample_workspace(robot, poses, 1).coordinates
    instrument = Instrument((Sensor(kind, noise),))
    return simulate_trials(robot, truth, coordinates, instrument, 3)


def fit_both(robot: Mechanism, trials: Trials, method) -> tuple[IdentifiedTrials, IdentifiedTrials]:
    """Return the usual fits, and those that begin with chords."""
    usual, chords = (identify_trials(robot, trials, method, chord_start=c) for c in (False, True))
    return usual, chords


def measure_distance(usual: IdentifiedTrials, other: IdentifiedTrials) -> np.ndarray:
    """Return the largest difference of each trial in standard deviations; both must converge."""
    places = usual.free_parameters.places
    assert np.array_equal(usual.status, other.status)
    good = usual.converged
    difference = np.abs(usual.values - other.values)[good][:, places]
    return (difference / usual.standard_deviations()[good]).max(axis=1)


@pytest.mark.slow
@pytest.mark.parametrize("factor", [pytest.param(1.0, marks=pytest.mark.evidence), 10.0])
@pytest.mark.parametrize("method", [LeastSquares(), MAP(), MAP(InflatedTolerances())], ids=repr)
@pytest.mark.parametrize(
    ("robot", "poses"),
    [pytest.param(HEXAPOD, 20, marks=pytest.mark.evidence), (HEXAPOD, 8), (DELTA, 12)],
)
def test_estimates_are_those_of_the_usual_descent(robot, poses, method, factor):
    usual, chords = fit_both(robot, simulate(robot, 6, poses, factor), method)
    assert usual.converged.all()
    assert measure_distance(usual, chords).max() < ACCEPTED_STEP
    assert (chords.iterations <= usual.iterations + 1).all()


def test_trials_of_small_errors_need_one_linearization_less():
    usual, chords = fit_both(HEXAPOD, simulate(HEXAPOD, 12, 30), LeastSquares())
    assert (chords.iterations < usual.iterations).sum() >= 10


def test_trials_that_diverge_end_as_without_chords():
    trials = simulate(HEXAPOD, 6, 20)
    measured = trials.measured[0].copy()
    measured[2] += 5.0 * np.random.default_rng(1).standard_normal(measured[2].shape)  # [m], [rad]
    measured[4, :, -3:] *= 40.0
    trials = replace(trials, measured=(measured,))
    usual, chords = fit_both(HEXAPOD, trials, LeastSquares())
    failed = ~usual.converged
    assert failed[[2, 4]].any()
    assert usual.converged[[0, 1, 3, 5]].all()
    assert measure_distance(usual, chords).max() < ACCEPTED_STEP
    assert np.array_equal(usual.values[failed], chords.values[failed])


def test_the_test_of_the_next_step_refuses_trials(monkeypatch):
    trials = simulate(HEXAPOD, 12, 8, 30.0)
    usual, chords = fit_both(HEXAPOD, trials, LeastSquares())
    assert measure_distance(usual, chords).max() < ACCEPTED_STEP
    monkeypatch.setattr(module, "ACCEPTED_STEP", 1e6)  # accepts every first step
    _, accepted = fit_both(HEXAPOD, trials, LeastSquares())
    assert measure_distance(usual, accepted).max() > ACCEPTED_STEP
    assert (accepted.iterations < chords.iterations).all()


def test_numbers_depend_neither_on_threads_nor_on_the_other_trials(monkeypatch):
    trials, options = simulate(HEXAPOD, 9, 20), FitOptions(method=MAP())
    one = identify_trials(HEXAPOD, trials, options=options, chord_start=True)
    monkeypatch.setattr(problem_module, "TRIAL_BLOCK", 40)  # two trials in each part
    for threads in (1, 3):
        other = identify_trials(HEXAPOD, trials, options=options, chord_start=True, threads=threads)
        assert np.array_equal(one.values, other.values)
        assert np.array_equal(one.iterations, other.iterations)


@pytest.mark.parametrize("method", [Ridge(GCV()), LeastSquares()], ids=repr)
def test_fits_without_a_shared_factor_are_the_usual_ones(method):
    poses = 30
    trials = simulate(DELTA, 3, poses)
    if isinstance(method, LeastSquares):
        kind = Position(places=np.array([[0.03, -0.02, 0.05]]), unknown=("frame",))
        trials = simulate(DELTA, 3, poses, kind=kind)
        method = MAP()
    usual, chords = fit_both(DELTA, trials, method)
    assert np.array_equal(usual.values, chords.values)
    assert np.array_equal(usual.iterations, chords.iterations)


def test_fits_of_fewer_rows_than_parameters_are_the_usual_ones():
    trials = simulate(HEXAPOD, 2, 12, kind=Position())  # 36 rows for 42 parameters
    usual, chords = fit_both(HEXAPOD, trials, LeastSquares())
    assert np.array_equal(usual.values, chords.values)


def test_no_trials_are_refused():
    trials = simulate(HEXAPOD, 1, 12)
    with pytest.raises(EstimationError, match="set of trials is empty"):
        identify_trials(HEXAPOD, replace(trials, truth=trials.truth[:0]))
