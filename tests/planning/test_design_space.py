# SPDX-License-Identifier: Apache-2.0
"""Criteria and observable directions agree with textbook covariances, scores of swaps and additions
and derivatives by weights with recomputed designs.
"""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from loopcal.planning.design_space import (
    Criterion,
    PriorInformation,
    Scoring,
    compute_slopes,
    compute_swap_terms,
    factor_design,
    find_slope_columns,
    score_additions,
    score_swaps,
)
from loopcal.planning.exchange import differentiate_score
from tests.findings.expectations import expect_refusal
from tests.planning.design_problems import (
    CASES,
    Array,
    L,
    compute_covariance,
    draw_rows,
    make_problem,
)

CLOSE = 1e-10  # relative: rounding of inverses of well-conditioned 6 x 6 matrices


@pytest.mark.parametrize("nuisance", [0, 2])
@pytest.mark.parametrize("prior", [False, True])
def test_criteria_equal_those_of_the_covariance_of_machine_parameters(nuisance, prior):
    problem = make_problem(draw_rows(nuisance=nuisance), None, nuisance, prior)
    C = compute_covariance(problem.rows[:5], problem.prior.rows, nuisance)
    expected = {
        Criterion("D"): -np.linalg.slogdet(C)[1],
        Criterion("A"): np.trace(C),
        Criterion("E"): np.linalg.eigvalsh(C)[-1],
        Criterion("I", L, 3): np.trace(L @ C @ L.T) / 3,
    }
    for criterion, value in expected.items():
        found = replace(problem, criterion=criterion).evaluate(np.arange(5))
        assert found == pytest.approx(value, rel=CLOSE)


def test_directions_confounded_with_nuisance_parameters_are_excluded():
    rows = draw_rows(nuisance=2)
    # parameters 1 and 2 together, 1 to 2, do what a frame does
    rows[..., 3] = rows[..., 0] - 2.0 * rows[..., 4]
    problem = make_problem(rows, nuisance=2)
    space = problem.space
    assert len(space) == 3
    assert space.singular_values[3] < 1e-13 * space.singular_values[0]
    assert_allclose(space.machine.T @ np.array([0.0, 1.0, 2.0, 0.0]), 0.0, atol=CLOSE)
    # With parameter 1 fixed instead, 0, 2 and 3 stand for z0, z2 - 2 z1 and z3, which no choice of
    # the frame changes.
    expected = compute_covariance(np.delete(rows[:6], 3, axis=2), np.zeros((0, 5)), 2)
    determined = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, -2.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    assert_allclose(determined @ space.machine @ space.machine.T, determined, atol=1e-12)
    factor = factor_design(rows[:6], problem.prior, space)
    C = space.machine @ np.linalg.inv(factor.T @ factor) @ space.machine.T
    # relative: rounding times a condition of 10^3
    assert_allclose(determined @ C @ determined.T, expected, rtol=1e-8)


def test_earlier_rows_count_the_same_as_rows_of_the_design():
    rows, none = draw_rows(nuisance=1), PriorInformation.none(4, 1)
    space, before = make_problem(rows, nuisance=1).space, none.with_rows(rows[:3])
    assert before.rows.shape == (5, 5)
    found, known = (
        np.abs(factor_design(given, start, space))
        for given, start in ((rows[3:6], before), (rows[:6], none))
    )
    assert_allclose(found, known, rtol=CLOSE, atol=CLOSE)


@pytest.mark.parametrize(
    "criterion",
    [Criterion("D"), Criterion("A"), Criterion("I", np.eye(4)), Criterion("E")],
    ids=lambda c: c.name,
)
def test_design_has_half_the_efficiency_of_its_twofold_repetition(criterion):
    problem = make_problem(draw_rows(), criterion)
    once, twice = (problem.evaluate(np.repeat(np.arange(12), k)) for k in (1, 2))
    assert problem.compare(once, twice) == pytest.approx(0.5, rel=CLOSE)


@pytest.mark.parametrize(
    ("criterion", "worst"), [(Criterion("D"), -np.inf), (Criterion("A"), np.inf)]
)
def test_singular_design_has_the_worst_criterion_value(criterion, worst):
    assert make_problem(draw_rows(), criterion).evaluate(np.array([0])) == worst


@pytest.mark.parametrize(
    ("n", "rows", "code", "data"),
    [
        (2, draw_rows(nuisance=1), "plan.design-too-small", {"needed": 3}),
        (13, draw_rows(), "plan.too-few-candidates", {"available": 12}),
        (5, np.full((3, 2, 4), np.nan), "plan.no-candidate-allowed", {"total": 3}),
        (5, np.zeros((6, 2, 4)), "plan.no-direction-observable", {}),
    ],
)
def test_design_that_cannot_determine_the_parameters_is_refused(n, rows, code, data):
    with expect_refusal(code, **data):
        make_problem(rows, nuisance=rows.shape[2] - 4).require_enough(n)


def test_any_number_of_poses_is_enough_with_a_tolerance_prior():
    assert make_problem(draw_rows(), prior=True).require_enough(1) is None


def test_corners_of_a_picture_are_exchanged_as_few_independent_rows():
    """Twenty rows of rank three become three, and all designs have the scores of the twenty."""
    rows = np.random.default_rng(3).normal(size=(12, 20, 3)) @ draw_rows(r=3, machine=30)
    candidates = make_problem(rows).scale_candidates(11)
    assert candidates.rows.shape == (12, 3, 30)
    scaled = candidates.scoring.scale_rows(rows)
    for chosen in (np.arange(11), np.arange(1, 12)):
        of_all = candidates.scoring.score(candidates.scoring.factor(scaled[chosen]))
        assert_allclose(candidates.scoring.score(candidates.factor(chosen)), of_all, rtol=CLOSE)


every_case = pytest.mark.parametrize(("criterion", "nuisance", "prior"), CASES.values(), ids=CASES)


def build_random_scoring(criterion: Criterion, nuisance: int, prior: bool) -> tuple[Scoring, Array]:
    """Return scoring and scaled rows of a random problem."""
    rows = draw_rows(nuisance=nuisance)
    scoring = make_problem(rows, criterion, nuisance, prior).build_scoring(6)
    return scoring, scoring.scale_rows(rows)


@every_case
def test_gain_of_every_swap_and_addition_equals_that_of_the_new_design(criterion, nuisance, prior):
    scoring, X = build_random_scoring(criterion, nuisance, prior)

    def score(chosen) -> float:
        return scoring.score(scoring.factor(X[chosen]))

    chosen = np.array([0, 3, 4, 7, 9])
    R = scoring.factor(X[chosen])
    terms, slopes = (
        compute_swap_terms(scoring, R, X),
        compute_slopes(X, find_slope_columns(scoring, R)),
    )
    # in logs: rounding of well-conditioned 6 x 6 systems
    for j, out in enumerate(chosen):
        designs = [np.concatenate([np.delete(chosen, j), [k]]) for k in range(len(X))]
        anew = [score(design) - score(chosen) for design in designs]
        gains = score_swaps(terms, out)
        assert_allclose(gains, anew, atol=1e-9)
        assert_allclose(score_swaps(terms, out, np.array([2, 5])), gains[[2, 5]], atol=1e-12)
        assert (gains <= slopes - slopes[out] + 1e-9).all()  # the score is concave
    terms = compute_swap_terms(scoring, scoring.factor(X[:4]), X)
    anew = [score([0, 1, 2, 3, k]) - score([0, 1, 2, 3]) for k in range(len(X))]
    assert_allclose(score_additions(terms), anew, atol=1e-9)


@pytest.mark.parametrize(
    "criterion",
    [Criterion("D"), Criterion("A"), Criterion("I", L, 3)],
    ids=lambda criterion: criterion.name,
)
def test_swap_is_exact_if_the_design_without_the_candidate_is_singular(criterion):
    scoring, X = build_random_scoring(criterion, 0, False)
    R = scoring.factor(X[:2])  # four equations for four unknowns
    gains = score_swaps(compute_swap_terms(scoring, R, X), 0)
    anew = [scoring.score(scoring.factor(X[[k, 1]])) - scoring.score(R) for k in range(2, len(X))]
    # in logs: rounding times the condition of two units, 10
    assert_allclose(gains[2:], anew, atol=1e-8)
    assert gains[1] < -15.0  # the same unit twice leaves two directions open, to rounding


@every_case
def test_derivatives_by_weights_agree_with_finite_differences(criterion, nuisance, prior):
    scoring, X = build_random_scoring(criterion, nuisance, prior)
    w, h = np.random.default_rng(3).uniform(0.3, 0.8, len(X)), 1e-4

    def score(weights: Array) -> float:
        return scoring.score(scoring.factor(np.sqrt(weights)[:, None, None] * X))

    def differentiate(weights: Array) -> tuple[Array, Array]:
        R = scoring.factor(np.sqrt(weights)[:, None, None] * X)
        found = differentiate_score(scoring, X, R)
        assert_allclose(compute_slopes(X, find_slope_columns(scoring, R)), found[0])
        return found

    def slope(weights: Array) -> Array:
        return differentiate(weights)[0]

    def difference(function) -> Array:
        return np.array([(function(w + e) - function(w - e)) / (2 * h) for e in h * np.eye(len(w))])

    found, curve = differentiate(w)
    assert_allclose(found, difference(score), atol=1e-6)  # h^2
    # h^2 times a third derivative of about 100
    assert_allclose(curve, difference(slope), atol=1e-5)
    assert np.linalg.eigvalsh(curve)[-1] < 1e-9  # concave, to rounding
