# SPDX-License-Identifier: Apache-2.0
"""Steps by back substitution equal those of the decomposition, which is made where it is asked."""

import numpy as np
import pytest

from loopcal.engine import fold
from loopcal.estimate.descent import SpectralModel, TriangularModel, descend, make_linear_model
from loopcal.estimate.linearization import Linearization, Start
from loopcal.estimate.penalties import MAP, LeastSquares, Method, Ridge, TruncatedSVD, fix_penalty
from loopcal.numerics.decomposition import RANK_TOLERANCE, empty_factor
from tests.estimate.function_problem import FunctionProblem

P, M, T = 13, 40, 4
CORRELATION = np.eye(P) + 0.4 * np.eye(P, k=1) + 0.4 * np.eye(P, k=-1)
APART = CORRELATION.copy()
APART[:2, 2:] = APART[2:, :2] = 0.0
FREE = (True, True, *[False] * (P - 2))

METHODS = [
    LeastSquares(),
    Ridge(0.0),
    Ridge(0.3),
    Ridge(tuple(float(i % 4) for i in range(P))),
    Ridge((0.0,) * P),
    MAP(),
    MAP(inflation=3.0),
    MAP(free=FREE),
    MAP(correlation=CORRELATION),
    MAP(free=FREE, correlation=APART),
]


def linearize(seed: int = 0, rank: int = P) -> Linearization:
    """Return random rows at random deviations, columns of different size."""
    rng = np.random.default_rng(seed)
    rows = rng.standard_normal((T, M, P + 1)) * np.geomspace(1.0, 1e-3, P + 1)
    rows[:, :, rank:P] = 0.0
    z = rng.standard_normal((T, P))
    factor = fold(empty_factor(T, P), rows)
    start = Start(z, np.zeros((T, 0)), np.zeros((T, 0, P)), np.zeros((T, 0)))
    return Linearization(z, factor, (factor[:, :, -1] ** 2).sum(axis=1), np.full(T, M), start)


def make_both(method: Method, rows: Linearization) -> tuple[TriangularModel, SpectralModel]:
    """Return both linear models of rows."""
    fixed = fix_penalty(method, P)
    triangular = make_linear_model(rows, method, RANK_TOLERANCE, fixed)
    spectral = make_linear_model(rows, method, RANK_TOLERANCE, None)
    assert isinstance(triangular, TriangularModel)
    assert isinstance(spectral, SpectralModel)
    return triangular, spectral


@pytest.mark.parametrize("method", METHODS, ids=repr)
def test_full_steps_equal_those_of_the_decomposition(method):
    rows = linearize()
    triangular, spectral = make_both(method, rows)
    assert triangular.is_regular.all()
    steps = [m.propose(rows.deviation, np.zeros(T)) for m in (triangular, spectral)]
    for name in vars(steps[0]):
        values = [getattr(step, name) for step in steps]
        # [1] rounding times the condition number, 1e3
        np.testing.assert_allclose(*values, rtol=1e-11, atol=1e-11, err_msg=name)
    assert "decomposition" not in vars(triangular)
    other = np.random.default_rng(1).standard_normal((T, P))
    np.testing.assert_allclose(triangular.penalize(other), spectral.penalize(other), rtol=1e-11)


@pytest.mark.parametrize("method", METHODS, ids=repr)
def test_damped_steps_and_what_is_asked_later_are_those_of_the_decomposition(method):
    rows, damping = linearize(), np.array([0.0, 1.0, 1e-4, 0.0])
    triangular, spectral = make_both(method, rows)
    ours, other = (m.propose(rows.deviation, damping) for m in (triangular, spectral))
    is_damped = damping > 0.0
    assert np.array_equal(ours.deviation[is_damped], other.deviation[is_damped])
    assert np.array_equal(triangular.penalty, spectral.penalty)
    assert np.array_equal(
        triangular.decomposition.singular_values, spectral.decomposition.singular_values
    )


@pytest.mark.parametrize("method", [LeastSquares(), MAP(free=(False,) * (P - 1) + (True,))])
def test_directions_without_data_are_left_to_the_decomposition(method):
    rows = linearize(rank=P - 2)
    triangular, spectral = make_both(method, rows)
    assert not triangular.is_regular.any()
    ours, other = (m.propose(rows.deviation, np.zeros(T)) for m in (triangular, spectral))
    assert np.array_equal(ours.target, other.target)
    mixed = Linearization.join([rows.take(np.arange(2)), linearize(1)])
    together, _ = make_both(method, mixed)
    assert together.is_regular.tolist() == [False, False, *[True] * T]
    steps = together.propose(mixed.deviation, np.zeros(T + 2))
    assert np.array_equal(steps.target[:2], ours.target[:2])


@pytest.mark.parametrize("method", [TruncatedSVD(3), Ridge(lambda d: np.ones(len(d.rows)))])
def test_methods_that_look_at_the_singular_values_have_no_fixed_penalty(method):
    assert fix_penalty(method, P) is None


class OwnPenalty(LeastSquares):
    """A method of a user that inherits from another one."""

    def penalty(self, decomposition):
        return np.full_like(decomposition.singular_values, 2.0)


def test_a_penalty_of_a_user_is_that_of_his_class():
    assert fix_penalty(OwnPenalty(), P) is None
    rows = linearize()

    def evaluate(deviation, trials):
        factor = rows.factor[trials].copy()
        change = deviation - rows.deviation[trials]
        factor[:, :P, P] += (factor[:, :P, :P] @ change[:, :, None])[:, :, 0]
        return factor, (factor[:, :, P] ** 2).sum(axis=1)

    problem = FunctionProblem(P, evaluate, np.full(T, M))
    own, ridge = (descend(problem, np.zeros((T, P)), m) for m in (OwnPenalty(), Ridge(2.0)))
    np.testing.assert_allclose(own.deviation, ridge.deviation, rtol=1e-9, atol=1e-12)
    plain = descend(problem, np.zeros((T, P)), LeastSquares())
    assert np.abs(plain.deviation - own.deviation).max() > 1e-3


def test_a_trial_keeps_its_step_in_any_batch():
    rows = linearize()
    for method in METHODS:
        together, _ = make_both(method, rows)
        for i in range(T):
            alone, _ = make_both(method, rows.take(np.array([i])))
            assert np.array_equal(alone.step[0], together.step[i])


def test_a_tolerance_that_cuts_directions_is_that_of_the_decomposition():
    rows, fixed = linearize(), fix_penalty(LeastSquares(), P)
    wide = 0.05  # more than the smallest of the singular values, which are 1 to 1e-3
    model = make_linear_model(rows, LeastSquares(), wide, fixed)
    assert isinstance(model, TriangularModel)
    assert not model.is_regular.any()
    assert (model.decomposition.rank < P).all()
    spectral = make_linear_model(rows, LeastSquares(), wide, None)
    steps = [m.propose(rows.deviation, np.zeros(T)) for m in (model, spectral)]
    assert np.array_equal(steps[0].target, steps[1].target)
