# SPDX-License-Identifier: Apache-2.0
"""A problem has no state: its results depend on its arguments alone, bit for bit."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.estimate.linearization import Linearization, Start
from loopcal.estimate.problem import Problem, problem_of, problem_of_trials
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.distance import Separation
from loopcal.measure.kinds.poses import Pose
from loopcal.measure.kinds.position import Position
from loopcal.measure.kinds.surfaces import Plane
from loopcal.measure.simulation import sample_truth, simulate, simulate_trials
from tests import zoo
from tests.estimate.problems import UM, hexapod, hexapod_poses

TARGETS = np.array([[0.1, 0.0, 0.02], [-0.06, 0.1, 0.03], [-0.05, -0.1, 0.01]])
TRACKER = Position(targets=("a", "b", "c"), places=TARGETS, unknown=("frame", "targets"))
FRAME = {"frame.rx": 0.3, "frame.ry": -0.2, "frame.rz": 1.0, "frame.x": 0.4, "a.x": 0.11}
PROBE = Plane(
    unknown=("surface", "targets"), targets=("probe",), places=np.array([[0.0, 0.0, 0.06]])
)
POSES = 24


def make_sensor(kind, **seen) -> Sensor:
    """Return a sensor with one micrometer, or microradian, of noise."""
    return Sensor(kind, Gaussian(np.full(len(kind.noise_columns), UM)), **seen)


def make_problem(*sensors: Sensor, sigma: float | None = None, **given) -> Problem:
    """Return the problem of a hexapod with errors."""
    truth = hexapod().with_values(zoo.hexapod_truth())
    instrument = Instrument(sensors)
    data = simulate(truth, hexapod_poses(POSES), instrument, 1, reading_sigma=sigma, **given)
    return problem_of(select_free_parameters(hexapod()), data)


def make_trial_problem(sigma: float | None) -> Problem:
    """Return the problem of three hexapods measured in an unknown frame."""
    instrument = Instrument((make_sensor(TRACKER),))
    truth = sample_truth(hexapod(), 3, 2)
    data = simulate_trials(
        hexapod(),
        truth,
        hexapod_poses(POSES),
        instrument,
        1,
        nuisance_values=FRAME,
        reading_sigma=sigma,
    )
    return problem_of_trials(select_free_parameters(hexapod()), data)


def make_session_problem(sigma: float | None = None) -> Problem:
    """Return a problem with frames of three sessions, and planes of four groups with one probe."""
    day = np.repeat(["monday", "tuesday", "friday"], POSES // 3)
    plate = np.array([f"plate{i % 4}" for i in range(POSES)])
    return make_problem(
        make_sensor(Pose(unknown=("frame",)), session=day),
        make_sensor(PROBE, group=plate),
        sigma=sigma,
    )


LINKS = np.array([[i, (i + 7) % POSES] for i in range(6)])

PROBLEMS: dict[str, Callable[[], Problem]] = {
    "exact readings": lambda: make_problem(make_sensor(Pose())),
    "frame and targets unknown": lambda: make_problem(make_sensor(TRACKER), nuisance_values=FRAME),
    "sessions and groups": make_session_problem,
    "uncertain readings": lambda: make_problem(make_sensor(Pose()), sigma=2 * UM),
    "uncertain readings, linked poses": lambda: make_problem(
        make_sensor(Pose()), make_sensor(Separation(), rows=LINKS), sigma=2 * UM
    ),
    "uncertain readings, sessions and groups": lambda: make_session_problem(2 * UM),
    "trials": lambda: make_trial_problem(None),
    "trials, uncertain readings": lambda: make_trial_problem(2 * UM),
}


@dataclass(frozen=True)
class Call:
    """One linearization, with its solution, residuals and leverage rows."""

    problem: Problem
    z: np.ndarray
    start: Start

    def __call__(self) -> list[np.ndarray]:
        at = self.problem.linearize(self.z, self.start)
        solution = self.problem.solve(self.z, at.next_start)
        residuals = self.problem.residuals(self.z, solution)
        result = [*list_arrays(at), *(r.whitened for r in residuals)]
        one = np.arange(1)
        blocks = self.problem.take(one).leverage_rows(at.take(one))
        return [*result, *(part.rows for block in blocks for part in block)]


def list_arrays(at: Linearization) -> list[np.ndarray]:
    """Return the arrays of a linearization."""
    result = [at.factor, at.cost, at.equations, at.next_start.nuisance]
    if at.nuisance is not None:
        done = at.nuisance.elimination
        result += [at.nuisance.best, done.slope, done.rank, *done.roots]
    if at.poses is not None:
        result += [at.poses.states.q, at.poses.states.state.T, at.poses.rank]
    return result


def list_calls(problem: Problem) -> list[Call]:
    """Return linearizations at three points, from the first and from a warm start."""
    t, p = len(problem), problem.parameters
    nominal = np.zeros((t, p))
    first = problem.start(nominal)
    warm = problem.linearize(nominal, first).next_start
    steps = np.random.default_rng(5).normal(0.0, 0.3, (2, t, p))
    points = (nominal, *steps)
    return [Call(problem, z, start) for z in points for start in (first, warm)]


def assert_same(found: list[np.ndarray], expected: list[np.ndarray]) -> None:
    """Assert that all arrays are equal bit for bit."""
    assert len(found) == len(expected)
    for a, b in zip(found, expected, strict=True):
        assert_array_equal(a, b)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["sessions and groups", "uncertain readings, linked poses", "trials"]
)
def test_equal_arguments_give_equal_bits_in_any_order_and_in_threads(name):
    calls = list_calls(PROBLEMS[name]())
    expected = [call() for call in calls]
    for i in np.random.default_rng(1).permutation(2 * len(calls)) % len(calls):
        assert_same(calls[i](), expected[i])
    with ThreadPoolExecutor(4) as pool:
        for result, wanted in zip(pool.map(lambda call: call(), calls), expected, strict=True):
            assert_same(result, wanted)


@pytest.mark.parametrize("name", ["trials", "trials, uncertain readings"])
def test_linearized_trial_equals_the_same_trial_alone(name):
    problem = PROBLEMS[name]()
    z = np.random.default_rng(3).normal(0.0, 0.3, (3, 42))
    start = problem.start(z)
    together = problem.linearize(z, start)
    for i in range(3):
        one = np.array([i])
        alone = problem.take(one).linearize(z[one], start.take(one))
        assert_allclose(alone.cost, together.cost[one], rtol=1e-12)  # rounding of sums
        assert_array_equal(alone.equations, together.equations[one])


@pytest.mark.parametrize("name", PROBLEMS)
def test_start_changes_the_linearization_by_rounding_only(name):
    problem = PROBLEMS[name]()
    z = np.full((len(problem), 42), 0.05)
    first = problem.linearize(z, problem.start(z))
    again = problem.linearize(z, first.next_start)
    gram, expected = (at.factor.swapaxes(1, 2) @ at.factor for at in (again, first))
    # nuisance parameters and poses are solved for to 1e-7 of the residuals
    assert_allclose(gram, expected, rtol=0, atol=1e-5 * np.abs(expected).max())
    assert_allclose(again.cost, first.cost, rtol=1e-9)


def test_leverage_rows_do_not_depend_on_earlier_linearizations():
    """Rows by the machine had a norm of 46.7 instead of 8.3 before the first linearization.

    They were read with the frame's nominal values and without its elimination, because both were
    kept from the last call.
    """

    def machine_rows(problem: Problem, at: Linearization) -> np.ndarray:
        parts = [part.rows for block in problem.leverage_rows(at) for part in block]
        return np.concatenate([rows.reshape(-1, rows.shape[-1]) for rows in parts])

    make = PROBLEMS["frame and targets unknown"]
    z = np.zeros((1, 42))
    fresh, used = make(), make()
    for step in np.random.default_rng(2).normal(0.0, 0.3, (3, 1, 42)):
        used.linearize(step, used.start(step))
    rows = machine_rows(fresh, fresh.linearize(z, fresh.start(z)))
    assert_array_equal(machine_rows(used, used.linearize(z, used.start(z))), rows)
    # the rows of the machine, frame and targets eliminated, have the Gram matrix of the factor
    at = fresh.linearize(z, fresh.start(z))
    machine, factor = rows[:, -43:-1], at.factor[0, :-1, :-1]
    expected = factor.T @ factor
    assert_allclose(machine.T @ machine, expected, rtol=0, atol=1e-9 * np.abs(expected).max())
