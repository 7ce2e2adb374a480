# SPDX-License-Identifier: Apache-2.0
"""The descent: independence of trials, penalty on the total deviation, and a status for every
ending.
"""

import numpy as np
import pytest

from loopcal.estimate.fit_findings import report_status
from loopcal.estimate.methods.penalties import MAP, LeastSquares, Ridge
from loopcal.estimate.minimization.descent import FunctionProblem, StepControl, descend
from loopcal.numerics.gauss_newton import DescentStatus
from tests.estimate.problems import fold_rows


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


@pytest.mark.parametrize("method", [LeastSquares(), MAP(), Ridge(0.01)])
def test_descent_of_stacked_trials_equals_single_trials_bit_for_bit(method):
    y = noisy_exponentials(7)
    together = descend(make_problem(Exponentials(y)), np.zeros((7, 3)), method)
    assert (together.status == DescentStatus.CONVERGED).all()
    for i in range(7):
        alone = descend(make_problem(Exponentials(y[i : i + 1])), np.zeros((1, 3)), method)
        assert np.array_equal(together.deviation[i], alone.deviation[0])
        assert together.iterations[i] == alone.iterations[0]
        assert together.cost[i] == alone.cost[0]


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


def test_noise_free_rows_converge_to_rounding_error():
    x = np.linspace(0.0, 3.0, 25)
    y = (1.2 * np.exp(-0.7 * x) + 0.1)[None]
    fit = descend(make_problem(Exponentials(y)), np.zeros((1, 3)), LeastSquares())
    assert fit.status[0] == DescentStatus.CONVERGED
    np.testing.assert_allclose(fit.deviation, [[0.2, -0.3, 0.1]], atol=1e-12)
    assert fit.iterations[0] <= 6
    assert len(fit.cost_history) == fit.iterations[0] + 1


def test_every_descent_status_has_a_finding():
    endings = [status for status in DescentStatus if status is not DescentStatus.RUNNING]
    assert len({report_status(status, 3).code for status in endings}) == len(endings)
