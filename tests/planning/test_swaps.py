# SPDX-License-Identifier: Apache-2.0
"""Scores of swaps and additions, and derivatives by weights, agree with recomputed designs."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from loopcal.planning.design_space import (
    Criterion,
    Scoring,
    compute_swap_terms,
    score_additions,
    score_swaps,
)
from loopcal.planning.exchange import differentiate_score
from tests.planning.design_problems import CASES, Array, L, draw_rows, make_problem

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
    terms = compute_swap_terms(scoring, scoring.factor(X[chosen]), X)
    # in logs: rounding of well-conditioned 6 x 6 systems
    for j, out in enumerate(chosen):
        designs = [np.concatenate([np.delete(chosen, j), [k]]) for k in range(len(X))]
        anew = [score(design) - score(chosen) for design in designs]
        assert_allclose(score_swaps(terms, out), anew, atol=1e-9)
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

    def slope(weights: Array) -> Array:
        return differentiate_score(scoring, X, weights)[0]

    def difference(function) -> Array:
        return np.array([(function(w + e) - function(w - e)) / (2 * h) for e in h * np.eye(len(w))])

    found, curve = differentiate_score(scoring, X, w)
    assert_allclose(found, difference(score), atol=1e-6)  # h^2
    # h^2 times a third derivative of about 100
    assert_allclose(curve, difference(slope), atol=1e-5)
    assert np.linalg.eigvalsh(curve)[-1] < 1e-9  # concave, to rounding
