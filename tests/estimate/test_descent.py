# SPDX-License-Identifier: Apache-2.0
"""The descent: independence of trials, penalty on the total deviation, and a status for every
ending. Fits that did not converge or left their spreads state no noise, no intervals and no
prior.
"""

from dataclasses import replace
from functools import lru_cache
from typing import Any, cast

import numpy as np
import pytest
from scipy.optimize import least_squares

from loopcal.diagnose.fit_examination import StartVerdict, check_start_values
from loopcal.estimate.descent import StepControl, descend
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.estimate.identification import identify
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import MAP, LeastSquares, Ridge
from loopcal.estimate.prior import prior_from
from loopcal.estimate.problem import Problem, problem_of_trials
from loopcal.estimate.result import History
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.distance import Distance
from loopcal.measure.simulation import sample_truth, simulate_trials
from loopcal.mechanism import kinematics as batch_kinematics
from loopcal.mechanism.workspace import sample_workspace
from loopcal.numerics.gauss_newton import DescentStatus
from tests.estimate.function_problem import FunctionProblem
from tests.estimate.problems import fold_rows, hexapod, hexapod_data
from tests.findings.expectations import expect_refusal, get_finding, list_codes


def report_status(status, iterations):
    return History(status, iterations, np.zeros(1), np.zeros((1, 0))).finding


class Exponentials:
    """y = (1 + z0) exp(-(1 + z1) x) + z2 for several trials of noisy y."""

    parameters = 3

    def __init__(self, y: np.ndarray) -> None:
        self.y, self.x = y, np.linspace(0.0, 3.0, y.shape[1])
        self.equations = np.full(len(y), y.shape[1])

    def evaluate(self, deviation, trials):
        a, b, c = (deviation[:, i, None] for i in range(3))
        decay = np.exp(-(1.0 + b) * self.x)
        residual = (1.0 + a) * decay + c - self.y[trials]
        columns = [decay, -(1.0 + a) * self.x * decay, np.ones_like(decay)]
        return fold_rows(np.stack([*columns, residual], axis=2)), (residual**2).sum(axis=1)


class Circle:
    """One equation, two unknowns: |(1 + z0, z1)| = 2, so one direction is never determined."""

    parameters, equations = 2, np.array([1])

    def evaluate(self, deviation, trials):
        x, y = 1.0 + deviation[:, 0], deviation[:, 1]
        length = np.hypot(x, y)
        row = np.stack([x / length, y / length, length - 2.0], axis=1)[:, None, :]
        return fold_rows(row), (length - 2.0) ** 2


class Unreachable:
    """Finite at the start only."""

    parameters, equations = 1, np.array([3])

    def evaluate(self, deviation, trials):
        cost = np.where(deviation[:, 0] == 0.0, 1.0, np.inf)
        return np.tile(np.array([[1.0, 1.0], [0.0, 0.0]]), (len(deviation), 1, 1)), cost


def make_problem(functions):
    """Return the problem of an object of this module."""
    return FunctionProblem(functions.parameters, functions.evaluate, functions.equations)


def noisy_exponentials(t: int) -> np.ndarray:
    rng = np.random.default_rng(4)
    x = np.linspace(0.0, 3.0, 25)
    truth = rng.uniform(-0.5, 0.5, (t, 3, 1))
    clean = (1.0 + truth[:, 0]) * np.exp(-(1.0 + truth[:, 1]) * x) + truth[:, 2]
    return clean + 0.01 * rng.standard_normal(clean.shape)


def test_ridge_minimizes_squares_plus_penalty_on_the_total_deviation():
    y = noisy_exponentials(1)
    fit = descend(make_problem(Exponentials(y)), np.zeros((1, 3)), Ridge(0.3))
    factor, _ = Exponentials(y).evaluate(fit.deviation, np.array([0]))
    gradient = factor[0, :3, :3].T @ factor[0, :3, 3] + 0.3 * fit.deviation[0]
    np.testing.assert_allclose(gradient, 0.0, atol=1e-8)


def test_minimum_does_not_depend_on_the_start():
    y = noisy_exponentials(1)
    a = descend(make_problem(Exponentials(y)), np.zeros((1, 3)), MAP())
    b = descend(make_problem(Exponentials(y)), np.array([[2.0, 1.5, -1.0]]), MAP())
    np.testing.assert_allclose(a.deviation, b.deviation, atol=1e-7)


def test_least_squares_takes_the_smallest_deviation_in_the_null_space():
    fit = descend(make_problem(Circle()), np.array([[0.4, 0.9]]), LeastSquares())
    assert fit.status[0] == DescentStatus.CONVERGED
    assert fit.decomposition.rank[0] == 1
    np.testing.assert_allclose(fit.deviation, [[1.0, 0.0]], atol=1e-6)


def test_exhausted_iterations_are_reported():
    fit = descend(
        make_problem(Exponentials(noisy_exponentials(1))),
        np.zeros((1, 3)),
        LeastSquares(),
        StepControl(iterations=1),
    )
    assert fit.status[0] == DescentStatus.OUT_OF_ITERATIONS
    finding = report_status(DescentStatus(fit.status[0]), int(fit.iterations[0]))
    assert finding.code == "fit.out-of-iterations"


def test_trial_with_a_bad_start_is_marked_and_does_not_change_others():
    y = noisy_exponentials(3)
    y[1, 4] = np.nan
    fit = descend(make_problem(Exponentials(y)), np.zeros((3, 3)), LeastSquares())
    assert fit.status.tolist() == [
        DescentStatus.CONVERGED,
        DescentStatus.BAD_START,
        DescentStatus.CONVERGED,
    ]
    alone = descend(make_problem(Exponentials(y[2:])), np.zeros((1, 3)), LeastSquares())
    assert np.array_equal(fit.deviation[2], alone.deviation[0])


def test_descent_without_a_finite_step_is_reported():
    fit = descend(make_problem(Unreachable()), np.zeros((1, 1)), LeastSquares())
    assert fit.status[0] == DescentStatus.NO_DESCENT


class Valley:
    """Two residuals of a bent valley, 10 (y - x^2) and 1 - x, at several starts of x."""

    parameters = 2

    def __init__(self, starts: np.ndarray, steepness: float = 1e3) -> None:
        self.starts, self.steepness = starts, steepness
        self.equations, self.count = np.full(len(starts), 2), np.zeros(len(starts), dtype=int)

    def evaluate(self, deviation, trials):
        self.count[trials] += 1
        x, y = (self.starts[trials] + deviation).T
        k, zero = self.steepness, np.zeros_like(x)
        residual = np.stack([k * (y - x**2), 1.0 - x], axis=1)
        slopes = [np.stack([-2.0 * k * x, zero - 1.0], axis=1), np.stack([zero + k, zero], axis=1)]
        return fold_rows(np.stack([*slopes, residual], axis=2)), (residual**2).sum(axis=1)


STARTS = np.array([[0.3, 0.1], [3.0, -7.0], [1.0, 1.0], [-30.0, 900.0]])


def test_chain_of_full_steps_crosses_a_bent_valley():
    """Damping alone follows its bottom in 109 evaluations, and in more than 1000."""
    valley = Valley(STARTS)
    fit = descend(make_problem(valley), np.zeros((4, 2)), LeastSquares())
    assert (fit.status == DescentStatus.CONVERGED).all()
    np.testing.assert_allclose(STARTS + fit.deviation, 1.0, atol=1e-9)
    assert valley.count.max() <= 6


@pytest.mark.parametrize(
    ("functions", "method"),
    [(Exponentials, LeastSquares()), (Exponentials, MAP()), (Exponentials, Ridge(0.01)),
     (Valley, Ridge(1e-6))],
    ids=repr,
)  # fmt: skip
def test_stacked_trials_equal_single_trials_bit_for_bit(functions, method):
    """In the valley there are chains of full steps, of different lengths."""
    y = noisy_exponentials(7)
    if functions is Valley:
        y = np.random.default_rng(3).uniform(-40.0, 40.0, (30, 2))
    p = functions.parameters
    together = descend(make_problem(functions(y)), np.zeros((len(y), p)), method)
    if functions is Valley:
        assert len(set(together.iterations.tolist())) > 1
    else:
        assert (together.status == DescentStatus.CONVERGED).all()
    for i in range(len(y)):
        alone = descend(make_problem(functions(y[i : i + 1])), np.zeros((1, p)), method)
        assert np.array_equal(together.deviation[i], alone.deviation[0])
        for name in ("iterations", "status", "cost"):
            assert getattr(together, name)[i] == getattr(alone, name)[0]


class RunsAway:
    """exp(-z) has no minimum: every full step is as long as the last one, or blocked at z = 6."""

    parameters, equations = 1, np.array([2])

    def evaluate(self, deviation, trials):
        z = deviation[:, 0]
        residual = np.stack([1.0 + 1e-3 * np.exp(-z), 0.0 * z], axis=1)
        rows = np.stack([-1e-3 * np.exp(-z), residual[:, 0]], axis=1)[:, None]
        cost = np.where(z < 6.0, (residual**2).sum(axis=1), np.inf)
        return fold_rows(rows), cost


def test_fit_without_progress_ends_early():
    fit = descend(make_problem(RunsAway()), np.zeros((1, 1)), LeastSquares())
    assert fit.status[0] == DescentStatus.NO_PROGRESS
    assert len(fit.cost_history) <= 25
    finding = report_status(DescentStatus(fit.status[0]), int(fit.iterations[0]))
    assert finding.code == "fit.no-progress"


def test_slow_progress_goes_on():
    """exp(-z) without noise: every step gains a share of the sum of squares, for long."""
    count = [0]

    def evaluate(deviation, trials):
        count[0] += 1
        residual = np.exp(-0.01 * deviation[:, 0]) - np.exp(-9.0)
        rows = np.stack([-0.01 * np.exp(-0.01 * deviation[:, 0]), residual], axis=1)[:, None]
        return fold_rows(rows), residual**2

    problem = FunctionProblem(1, evaluate, np.array([1]))
    fit = descend(problem, np.zeros((1, 1)), LeastSquares())
    assert fit.status[0] == DescentStatus.CONVERGED
    assert fit.deviation[0, 0] == pytest.approx(900.0)


class CountedProblem:
    """A problem that counts the evaluations of every trial."""

    def __init__(self, problem: Problem, count: np.ndarray, numbers: np.ndarray) -> None:
        self.problem, self.count, self.numbers = problem, count, numbers
        self.parameters, self.start = problem.parameters, problem.start

    def linearize(self, deviation, start):
        self.count[self.numbers] += 1
        return self.problem.linearize(deviation, start)

    def take(self, trials):
        return CountedProblem(self.problem.take(trials), self.count, self.numbers[trials])


def test_one_wire_with_an_unknown_anchor_converges_by_least_squares():
    """A 3-PRS with 9 of 33 directions undetermined and others hardly: scipy needs more evaluations
    and finds the same minimum. Ends whose further steps would change the residuals by 1e-9 of
    themselves take one evaluation more than the 15 of ends at 1e-6. Rounding alone changes the
    median: 13 to 17 of three draws of machines."""
    robot, t = load_robot("3-prs"), 10
    count = np.zeros(t, dtype=int)
    place, anchor = np.array([[0.05, 0.02, 0.0]]), np.array([1.0, -0.6, 0.2])
    wire = Distance(anchor=anchor, places=place, unknown=("anchor",))
    instrument = Instrument((Sensor(wire, Gaussian(np.array([1e-5]))),))
    poses = sample_workspace(robot, 80, 5).coordinates
    trials = simulate_trials(robot, sample_truth(robot, t, 1), poses, instrument, seed=7)
    problem = problem_of_trials(select_free_parameters(robot), trials)
    counted, p = CountedProblem(problem, count, np.arange(t)), problem.parameters
    fit = descend(counted, np.zeros((t, p)), LeastSquares())
    assert (fit.status == DescentStatus.CONVERGED).mean() >= 0.95
    assert np.median(count) <= 18
    one = problem.take(np.array([5]))

    @lru_cache(1)
    def evaluate(z):
        return one.linearize(np.array([z]), fit.start.take(np.array([5]))).factor[0]

    found = least_squares(
        lambda z: evaluate(tuple(z))[:, -1],
        np.zeros(p),
        cast(Any, lambda z: evaluate(tuple(z))[:, :-1]),
        method="trf",
        ftol=1e-6,
    )
    assert fit.cost[5] <= 2.0 * found.cost
    assert count[5] <= found.nfev


def test_noise_free_rows_converge_to_rounding_error():
    x = np.linspace(0.0, 3.0, 25)
    y = (1.2 * np.exp(-0.7 * x) + 0.1)[None]
    fit = descend(make_problem(Exponentials(y)), np.zeros((1, 3)), LeastSquares())
    assert fit.status[0] == DescentStatus.CONVERGED
    np.testing.assert_allclose(fit.deviation, [[0.2, -0.3, 0.1]], atol=1e-12)
    assert fit.iterations[0] <= 6
    assert len(fit.cost_history) == fit.iterations[0] + 1


def test_every_descent_status_has_a_finding():
    refused = (DescentStatus.RUNNING, DescentStatus.BAD_START)  # `identify` refuses a bad start
    endings = [status for status in DescentStatus if status not in refused]
    assert len({report_status(status, 3).code for status in endings}) == len(endings)


def test_each_step_of_a_fit_is_reported_with_its_sum_of_squares():
    reports: list[str] = []
    y = noisy_exponentials(1)
    fit = descend(
        make_problem(Exponentials(y)),
        np.zeros((1, 3)),
        LeastSquares(),
        progress=lambda done, total, what: reports.append(f"{done} of {total}: {what}"),
    )
    costs = fit.cost_history[1 : len(reports), 0]
    steps = [f"0 of 1: fitting, step {i + 1}: sum of squares {c:.4g}" for i, c in enumerate(costs)]
    assert reports == ["0 of 1: fitting", *steps]
    assert len(steps) > 2


ONE_STEP = StepControl(iterations=1)


@pytest.mark.parametrize("method", [LeastSquares(), MAP(), None])
@pytest.mark.parametrize("noise", ["given", "estimated"])
def test_fit_without_convergence_has_no_noise_test_and_no_intervals(method, noise):
    data = hexapod_data(12)
    rows = data.observations[0]
    # with sigmas a hundred times too large even the first step leaves less than noise explains
    loose = replace(data, observations=(replace(rows, covariance=rows.covariance * 1e4),))
    for some in (data, loose):
        fit = identify(hexapod(), some, method, options=FitOptions(noise=noise, control=ONE_STEP))
        assert not fit.converged
        assert np.isnan(fit.interval()).all()
        assert np.isnan(fit.residual_test.p_value)
        assert not fit.residual_test.failed
        codes = list_codes(fit.findings)
        assert {"fit.out-of-iterations", "noise.not-tested"} <= codes
        assert not {code for code in codes if code.startswith("noise.")} - {"noise.not-tested"}
        assert bool(codes & {"fit.no-prior", "fit.beyond-tolerance"}) == (method == LeastSquares())
        assert check_start_values(fit).verdict is StartVerdict.OPEN
        assert check_start_values(fit).finding.code == "residuals.start-not-comparable"


def test_fit_without_convergence_cannot_be_a_prior():
    with expect_refusal("prior.no-uncertainty"):
        prior_from(
            identify(hexapod(), hexapod_data(12), options=FitOptions(control=ONE_STEP)).posterior
        )


def test_estimate_far_outside_its_tolerance_is_reported():
    robot, data = hexapod(), hexapod_data(12)
    place = robot.parameters.names.index("leg1.length")
    entries = list(robot.parameters.entries)
    entries[place] = replace(
        entries[place], nominal=entries[place].nominal + 40 * (entries[place].tolerance or 0.0)
    )
    wrong = replace(robot, parameters=replace(robot.parameters, entries=tuple(entries)))
    fit = identify(wrong, data, LeastSquares())
    assert fit.converged
    far = get_finding(fit.findings, "fit.beyond-tolerance")
    assert far.data["names"][0] == "leg1.length"
    assert far.data["factor"] > 10.0
    findings = (
        identify(robot, data, LeastSquares()).findings + identify(wrong, data, MAP()).findings
    )
    assert "fit.beyond-tolerance" not in list_codes(findings)


def test_hopeless_fit_follows_no_paths_to_poses_that_its_steps_do_not_reach(monkeypatch):
    """Such a step is shortened. Paths from its own readings took most of the time of these fits."""
    followed = []
    follow = batch_kinematics.follow_path

    def count(loops, joints, begin, state, wrong):
        followed.append(int(wrong.sum()))
        return follow(loops, joints, begin, state, wrong)

    data = hexapod_data(12)
    rows = data.observations[0]
    measured = rows.measured.copy()
    measured[4, 3:] += 1000.0  # [m]
    wrong = replace(data, observations=(replace(rows, measured=measured),))
    monkeypatch.setattr(batch_kinematics, "follow_path", count)
    fit = identify(hexapod(), wrong, LeastSquares())
    assert not fit.converged
    assert followed == []
