# SPDX-License-Identifier: Apache-2.0
"""Relaxed designs have the weights known in closed form, and their bound holds for all designs."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from loopcal.planning.design_space import Criterion, DesignProblem
from loopcal.planning.exchange import relax_design
from tests.findings.expectations import expect_refusal
from tests.planning.design_problems import (
    CASES,
    draw_rows,
    make_grid,
    make_problem,
    polynomial_rows,
)

GAP = 1e-7
MOMENTS = np.linalg.cholesky(
    np.array([[1, 0, 1 / 3], [0, 1 / 3, 0], [1 / 3, 0, 1 / 5]])
).T  # of [-1, 1], for 1, x, x^2


@pytest.mark.parametrize(
    ("criterion", "nuisance", "shares", "value"),
    [
        (Criterion("D"), 0, (1 / 3, 1 / 3, 1 / 3), np.log(4 / 27)),
        (Criterion("A"), 0, (1 / 4, 1 / 2, 1 / 4), 8.0),
        (Criterion("I", MOMENTS), 0, (1 / 4, 1 / 2, 1 / 4), 32 / 15),
        # 1 and x are not of interest: the Chebyshev points
        (Criterion("D"), 2, (1 / 4, 1 / 2, 1 / 4), np.log(1 / 4)),
    ],
    ids=["D", "A", "I", "D of the highest coefficient"],
)
def test_weights_and_values_for_a_parabola_are_the_known_ones(criterion, nuisance, shares, value):
    x, n, q = make_grid(), 12, 3 - nuisance
    problem = make_problem(polynomial_rows(x, 2), criterion, nuisance, repeats=True)
    found = relax_design(problem, n, GAP)
    known = value + q * np.log(n) if criterion.is_d else value / n
    assert found.converged
    assert found.value == pytest.approx(known, rel=1e-6)  # relative: the gap asked for
    assert found.efficiency(known) == pytest.approx(1.0, abs=2 * GAP)
    # the optimum is flat about 0
    masses = [found.weights[abs(x - at) < 0.15].sum() / n for at in (-1.0, 0.0, 1.0)]
    assert_allclose(masses, shares, atol=2e-3)
    if criterion.is_d and not nuisance:
        # variance of the prediction at most p, the equivalence theorem of Kiefer and Wolfowitz
        assert (n * found.slopes).max() == pytest.approx(3.0, rel=1e-5)
        assert_allclose(n * found.slopes[found.weights > 0.1], 3.0, rtol=1e-3)


def test_points_for_a_cubic_are_the_known_ones():
    x = make_grid(extra=1 / np.sqrt(5))
    found = relax_design(make_problem(polynomial_rows(x, 3), repeats=True), 4, GAP)
    for at in (-1.0, -1 / np.sqrt(5), 1 / np.sqrt(5), 1.0):
        assert found.weights[abs(x - at) < 0.05].sum() == pytest.approx(1.0, abs=2e-3)


def find_best_value(problem: DesignProblem, n: int) -> float:
    """Return the best criterion value of all subsets."""
    subsets = combinations(range(len(problem.rows)), n)
    values = [problem.evaluate(np.array(chosen)) for chosen in subsets]
    return max(values) if problem.criterion.is_d else min(values)


@pytest.mark.parametrize(("criterion", "nuisance", "prior"), CASES.values(), ids=CASES)
def test_bound_holds_for_every_subset_and_is_tighter_without_repeats(criterion, nuisance, prior):
    problem = make_problem(draw_rows(nuisance=nuisance), criterion, nuisance, prior)
    capped = relax_design(problem, 5, 1e-6)
    free = relax_design(replace(problem, repeats=True), 5, 1e-6)
    best = find_best_value(problem, 5)
    assert capped.converged
    assert free.converged
    assert capped.weights.max() <= 1.0
    assert capped.weights.sum() == pytest.approx(5.0, abs=1e-9)
    assert 0.5 < capped.efficiency(best) <= 1.0 + 1e-9
    assert free.efficiency(best) < capped.efficiency(best)


def test_bound_holds_for_an_early_stop():
    problem = make_problem(draw_rows())
    rough = relax_design(problem, 5, gap=0.9)
    assert rough.bound >= find_best_value(problem, 5)
    assert rough.value <= rough.bound


def test_relaxed_design_of_all_candidates_has_unit_weights():
    found = relax_design(make_problem(draw_rows(), Criterion("A")), 12)
    assert found.value == found.bound
    assert_array_equal(found.weights, 1.0)


def test_forbidden_candidates_have_zero_weight():
    rows = draw_rows(N=30)
    rows[:10, 0, 0] = np.nan
    found = relax_design(make_problem(rows), 6)
    assert found.weights[:10].max() == 0.0
    assert found.converged


def test_unobservable_prediction_is_refused():
    rows = draw_rows()
    rows[:, :, 3] = 0.0
    with expect_refusal("plan.prediction-unobservable"):
        relax_design(make_problem(rows, Criterion("I", np.array([[0.0, 0.0, 0.0, 1.0]]))), 5)
