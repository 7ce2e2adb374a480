# SPDX-License-Identifier: Apache-2.0
"""The descent: independence of trials, the total deviation, and endings that are never silent."""

import numpy as np
import pytest

from loopcal.estimate.fit_findings import report_status
from loopcal.estimate.methods.penalties import MAP, LeastSquares, Ridge
from loopcal.estimate.minimization.descent import FunctionProblem, StepControl, descend
from loopcal.numerics.gauss_newton import DescentStatus
from tests.estimate.problems import folded


class Exponentials:
    """y = (1 + z0) exp(-(1 + z1) x) + z2 for several trials of noisy y."""

    def __init__(self, y: np.ndarray) -> None:
        self.y, self.x = y, np.linspace(0.0, 3.0, y.shape[1])
        self.parameters, self.equations = 3, np.full(len(y), y.shape[1])

    def evaluate(self, deviation, trials):
        a, b, c = (deviation[:, i, None] for i in range(3))
        decay = np.exp(-(1.0 + b) * self.x)
        residual = (1.0 + a) * decay + c - self.y[trials]
        columns = [decay, -(1.0 + a) * self.x * decay, np.ones_like(decay)]
        return folded(np.stack([*columns, residual], axis=2)), (residual**2).sum(axis=1)


class Circle:
    """One equation, two unknowns: |(1 + z0, z1)| = 2, so one direction is never determined."""

    parameters, equations = 2, np.array([1])

    def evaluate(self, deviation, trials):
        x, y = 1.0 + deviation[:, 0], deviation[:, 1]
        length = np.hypot(x, y)
        row = np.stack([x / length, y / length, length - 2.0], axis=1)[:, None, :]
        return folded(row), (length - 2.0) ** 2


class Unreachable:
    """Finite at the start only."""

    parameters, equations = 1, np.array([3])

    def evaluate(self, deviation, trials):
        cost = np.where(deviation[:, 0] == 0.0, 1.0, np.inf)
        return np.tile(np.array([[1.0, 1.0], [0.0, 0.0]]), (len(deviation), 1, 1)), cost


def problem_of(functions):
    """The problem that functions of this module define."""
    return FunctionProblem(functions.parameters, functions.evaluate, functions.equations)


def noisy(t: int) -> np.ndarray:
    rng = np.random.default_rng(4)
    x = np.linspace(0.0, 3.0, 25)
    truth = rng.uniform(-0.5, 0.5, (t, 3, 1))
    clean = (1.0 + truth[:, 0]) * np.exp(-(1.0 + truth[:, 1]) * x) + truth[:, 2]
    return clean + 0.01 * rng.standard_normal(clean.shape)


@pytest.mark.parametrize("method", [LeastSquares(), MAP(), Ridge(0.01)])
def test_trials_stacked_equal_trials_alone_bit_for_bit(method):
    y = noisy(7)
    together = descend(problem_of(Exponentials(y)), np.zeros((7, 3)), method)
    assert (together.status == DescentStatus.CONVERGED).all()
    for i in range(7):
        alone = descend(problem_of(Exponentials(y[i : i + 1])), np.zeros((1, 3)), method)
        assert np.array_equal(together.deviation[i], alone.deviation[0])
        assert together.iterations[i] == alone.iterations[0]
        assert together.cost[i] == alone.cost[0]


def test_ridge_minimises_the_sum_of_squares_plus_the_penalty_on_the_total_deviation():
    y = noisy(1)
    fit = descend(problem_of(Exponentials(y)), np.zeros((1, 3)), Ridge(0.3))
    factor, _ = Exponentials(y).evaluate(fit.deviation, np.array([0]))
    gradient = factor[0, :3, :3].T @ factor[0, :3, 3] + 0.3 * fit.deviation[0]
    np.testing.assert_allclose(gradient, 0.0, atol=1e-8)


def test_the_answer_does_not_depend_on_the_start():
    y = noisy(1)
    a = descend(problem_of(Exponentials(y)), np.zeros((1, 3)), MAP())
    b = descend(problem_of(Exponentials(y)), np.array([[2.0, 1.5, -1.0]]), MAP())
    np.testing.assert_allclose(a.deviation, b.deviation, atol=1e-7)


def test_least_squares_takes_the_smallest_total_deviation_where_nothing_is_known():
    fit = descend(problem_of(Circle()), np.array([[0.4, 0.9]]), LeastSquares())
    assert fit.status[0] == DescentStatus.CONVERGED
    assert fit.decomposition.rank[0] == 1
    np.testing.assert_allclose(fit.deviation, [[1.0, 0.0]], atol=1e-6)


def test_too_few_iterations_are_said():
    fit = descend(
        problem_of(Exponentials(noisy(1))),
        np.zeros((1, 3)),
        LeastSquares(),
        StepControl(iterations=1),
    )
    assert fit.status[0] == DescentStatus.OUT_OF_ITERATIONS
    finding = report_status(DescentStatus(fit.status[0]), int(fit.iterations[0]))
    assert finding.code == "fit.out-of-iterations"


def test_a_trial_that_fails_at_its_start_is_marked_and_the_others_go_on():
    y = noisy(3)
    y[1, 4] = np.nan
    fit = descend(problem_of(Exponentials(y)), np.zeros((3, 3)), LeastSquares())
    assert fit.status.tolist() == [
        DescentStatus.CONVERGED,
        DescentStatus.BAD_START,
        DescentStatus.CONVERGED,
    ]
    alone = descend(problem_of(Exponentials(y[2:])), np.zeros((1, 3)), LeastSquares())
    assert np.array_equal(fit.deviation[2], alone.deviation[0])


def test_a_wall_on_every_side_is_said():
    fit = descend(problem_of(Unreachable()), np.zeros((1, 1)), LeastSquares())
    assert fit.status[0] == DescentStatus.NO_DESCENT


def test_noise_free_rows_converge_to_rounding():
    x = np.linspace(0.0, 3.0, 25)
    y = (1.2 * np.exp(-0.7 * x) + 0.1)[None]
    fit = descend(problem_of(Exponentials(y)), np.zeros((1, 3)), LeastSquares())
    assert fit.status[0] == DescentStatus.CONVERGED
    np.testing.assert_allclose(fit.deviation, [[0.2, -0.3, 0.1]], atol=1e-12)
    assert fit.iterations[0] <= 6
    assert len(fit.cost_history) == fit.iterations[0] + 1


def test_every_ending_has_a_finding():
    endings = [status for status in DescentStatus if status is not DescentStatus.RUNNING]
    assert len({report_status(status, 3).code for status in endings}) == len(endings)
