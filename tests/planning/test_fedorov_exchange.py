# SPDX-License-Identifier: Apache-2.0
"""Fedorov exchange finds the known designs, and the best of all subsets of small problems."""

from itertools import combinations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from loopcal.errors import EstimationError
from loopcal.planning.design_space import D, DesignProblem, E, PriorInformation
from loopcal.planning.exchange import choose_design, fedorov_exchange
from tests.findings.expectations import expect_refusal
from tests.planning.design_problems import (
    CASES,
    draw_rows,
    make_grid,
    make_problem,
    polynomial_rows,
)

POINT = 1 / np.sqrt(5)
PARABOLA = polynomial_rows(make_grid(), 2)
ENDS = PriorInformation.none(3).with_rows(
    np.repeat(polynomial_rows(np.array([-1.0, 1.0]), 2), 3, axis=0)
)
"""Earlier measurements: the ends, three times each."""


@pytest.mark.parametrize(
    ("x", "problem", "points"),
    [
        (make_grid(), make_problem(PARABOLA, repeats=True), [-1, -1, 0, 0, 1, 1]),
        (make_grid(), DesignProblem(PARABOLA, D(), ENDS, repeats=True), [0, 0, 0]),
        (
            make_grid(POINT),
            make_problem(polynomial_rows(make_grid(POINT), 3)),
            [-1, -POINT, POINT, 1],
        ),
    ],
    ids=["parabola", "parabola with measured ends", "cubic"],
)
def test_designs_of_polynomials_are_the_known_ones(x, problem, points):
    found = fedorov_exchange(problem, len(points), starts=3)
    assert_allclose(x[found.chosen], points, atol=1e-12)
    if len(points) == 6:  # det of weights 1/3 each, times 6^3
        assert found.value == pytest.approx(np.log(4 / 27 * 6**3), abs=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize(("criterion", "nuisance", "prior"), CASES.values(), ids=CASES)
def test_exchange_finds_the_best_of_all_subsets(criterion, nuisance, prior):
    problem = make_problem(draw_rows(N=9, nuisance=nuisance), criterion, nuisance, prior)
    found = fedorov_exchange(problem, 5, starts=8)

    def value(chosen: tuple[int, ...]) -> float:
        return problem.evaluate(np.array(chosen))

    best = (max if isinstance(criterion, D) else min)(combinations(range(9), 5), key=value)
    assert tuple(found.chosen) == best
    for value_found in (found.value, choose_design(problem, 5).design.value):
        assert value_found == pytest.approx(value(best), rel=1e-10)  # relative: rounding


def test_history_increases_and_ends_at_the_value():
    found = fedorov_exchange(make_problem(polynomial_rows(make_grid(), 3)), 9, starts=4)
    assert (np.diff(found.history) > 0.0).all()
    assert found.value == found.history[-1] == max(found.values)


def test_same_seed_gives_the_same_design_and_the_same_first_starts():
    problem = make_problem(draw_rows(N=40))
    few, again, more = (fedorov_exchange(problem, 6, seed=5, starts=k) for k in (3, 3, 6))
    assert_array_equal(few.chosen, again.chosen)
    assert more.values[:3] == few.values


def test_forbidden_and_repeated_candidates_are_never_chosen():
    rows = draw_rows(N=20)
    rows[::2, 1, 2] = np.nan
    problem = make_problem(rows)
    for found in (fedorov_exchange(problem, 8, starts=5), choose_design(problem, 8).design):
        assert (found.chosen % 2 == 1).all()
        assert len(set(found.chosen.tolist())) == 8


def test_singular_start_finds_the_few_candidates_that_are_needed():
    rows = draw_rows(N=60)
    rows[:57, :, 3] = 0.0  # only the last three show the fourth parameter
    found = fedorov_exchange(make_problem(rows), 3, starts=4)
    assert (found.chosen >= 57).any()
    assert np.isfinite(found.value)


def test_exchange_that_stays_singular_is_refused():
    rows = draw_rows(N=6)
    # three units show two unknowns only, the others the other two, by one row of use each
    rows[:3, :, 2:] = 0.0
    rows[3:, :, :2] = 0.0
    rows[3:, 1] = rows[3:, 0]
    rows[4:, :, 2:] = rows[3, :, 2:]
    rows[5, :, 3] += 1.0
    with expect_refusal("plan.design-singular", chosen=2, available=6):
        fedorov_exchange(make_problem(rows), 2, starts=3)


@pytest.mark.parametrize(
    ("criterion", "starts", "message"), [(E(), 20, "choose D, I or A"), (D(), 0, "give 1 or more")]
)
def test_impossible_exchange_is_refused(criterion, starts, message):
    with pytest.raises(EstimationError, match=message):
        fedorov_exchange(make_problem(draw_rows(), criterion), 5, starts=starts)
