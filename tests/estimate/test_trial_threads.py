# SPDX-License-Identifier: Apache-2.0
"""Trials are fitted in parts, by any number of threads, with the same numbers to the last bit."""

import gc
import tracemalloc

import numpy as np
import pytest

from loopcal.errors import DataError, EstimationError
from loopcal.estimate import problem as problem_module
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.estimate.identification import divide_trials, identify_trials
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import MAP, LeastSquares
from loopcal.estimate.pose_rows import BLOCK
from loopcal.estimate.problem import problem_of_trials
from loopcal.estimate.tolerance_components import InflatedTolerances
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.poses import Pose
from loopcal.measure.kinds.position import Position
from loopcal.measure.simulation import Trials, sample_truth, simulate_trials
from loopcal.mechanism.workspace import sample_workspace

DELTA = load_robot("rotary-delta")
POSES = BLOCK // 4
"""Poses of a trial, so that a part has four trials."""


@pytest.fixture(autouse=True)
def small_parts(monkeypatch):
    """Divide rows that the engine folds into parts as small as those of others."""
    monkeypatch.setattr(problem_module, "TRIAL_BLOCK", BLOCK)


def simulate(trials: int, kind=None, poses: int = POSES) -> Trials:
    """Return measurements of simulated deltas."""
    kind = Pose() if kind is None else kind
    instrument = Instrument((Sensor(kind, Gaussian(np.full(len(kind.noise_columns), 1e-5))),))
    coordinates = sample_workspace(DELTA, poses, 1).coordinates
    return simulate_trials(DELTA, sample_truth(DELTA, trials, 2), coordinates, instrument, 3)


@pytest.mark.parametrize("method", [LeastSquares(), MAP(), MAP(InflatedTolerances())], ids=repr)
def test_results_depend_neither_on_threads_nor_on_the_number_of_trials(method):
    trials = simulate(10)
    one, three = (identify_trials(DELTA, trials, method, threads=n) for n in (1, 3))
    for name in ("values", "status", "iterations", "cost", "penalty"):
        assert np.array_equal(getattr(one, name), getattr(three, name)), name
    assert np.array_equal(one.standard_deviations(), three.standard_deviations())
    fewer = identify_trials(DELTA, simulate(6), method)
    assert np.array_equal(fewer.values, one.values[:6])


def test_all_parts_begin_with_the_same_unknown_frame():
    kind = Position(places=np.array([[0.03, -0.02, 0.05]]), unknown=("frame",))
    instrument = Instrument((Sensor(kind, Gaussian(np.full(3, 1e-5))),))
    coordinates = sample_workspace(DELTA, POSES, 1).coordinates
    station = {"frame.x": -2.5, "frame.y": -1.8, "frame.z": 0.1}
    truth = sample_truth(DELTA, 9, 2)
    trials = simulate_trials(DELTA, truth, coordinates, instrument, 3, nuisance_values=station)
    one, two = (identify_trials(DELTA, trials, MAP(), threads=n) for n in (1, 2))
    assert one.converged.all()
    assert np.array_equal(one.values, two.values)


def test_a_trial_that_fails_in_a_thread_stops_no_other():
    trials = simulate(9)
    start = np.repeat(DELTA.values[None], 9, axis=0)
    start[5] += 1.0  # [m], [rad]
    options = FitOptions(method=MAP(), start=start)
    result = identify_trials(DELTA, trials, options=options, threads=2)
    assert np.flatnonzero(~result.converged).tolist() == [5]


@pytest.mark.parametrize(
    ("trials", "threads", "sizes"),
    [
        (3, 2, [3]),  # too few for two parts
        (4, 2, [4]),
        (9, 1, [3, 3, 3]),
        (9, 2, [3, 2, 2, 2]),  # four parts, so that both threads have two
        (9, 64, [3, 3, 3]),
        (41, 4, [4] * 5 + [3] * 7),
    ],
)
def test_parts_are_equal_and_equally_many_for_each_thread(trials, threads, sizes):
    problem = problem_of_trials(select_free_parameters(DELTA), simulate(trials))
    assert problem.part_size == 4
    assert [len(part) for part in divide_trials(problem, threads)] == sizes


@pytest.mark.parametrize("threads", [0, -1])
def test_no_thread_is_refused(threads):
    with pytest.raises(EstimationError, match=f"threads is {threads}. Give 1 or more"):
        identify_trials(DELTA, simulate(1, poses=10), threads=threads)
    with pytest.raises(DataError, match="threads"):
        identify_trials(DELTA, simulate(1, poses=10), threads=1.5)  # pyright: ignore


def measure_memory(trials: Trials) -> tuple[float, float]:
    """Return the memory [bytes] during fits and after them, beyond what was there before."""
    gc.collect()
    tracemalloc.start()
    result = identify_trials(DELTA, trials, LeastSquares())
    kept, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert result.converged.all()
    return peak, kept


@pytest.mark.slow
def test_memory_of_many_trials_is_that_of_their_results():
    few, many = simulate(8), simulate(40)
    measure_memory(few)  # what is made once
    (least, kept_few), (most, kept_many) = measure_memory(few), measure_memory(many)
    # what the trials of one part are computed with is several times the rest: it does not grow,
    # but one of ten parts needs more steps, and so a little more memory, than both of two
    assert most - least < 1.2 * (kept_many - kept_few) + 0.15 * least
    assert least > 4.0 * kept_few
