# SPDX-License-Identifier: Apache-2.0
"""Scores of swaps and additions, and derivatives by weights, agree with recomputed designs."""

import numpy as np
import pytest

from loopcal.planning.design_space import (
    A,
    Criterion,
    D,
    I,
    PriorInformation,
    Scoring,
    build_scoring,
    compute_swap_terms,
    find_observable_space,
    score_additions,
    score_swaps,
)
from loopcal.planning.relaxation import differentiate_score
from tests.planning.design_problems import Array, draw_rows

CRITERIA = (D(), A(), I(np.random.default_rng(1).normal(size=(9, 4)), 3))
CASES = [
    (criterion, nuisance, prior)
    for criterion in CRITERIA
    for nuisance in (0, 2)
    for prior in (False, True)
]
NAMES = [
    f"{criterion.name}-nuisance{nuisance}-{'prior' if prior else 'none'}"
    for criterion, nuisance, prior in CASES
]


def build_random_scoring(criterion: Criterion, nuisance: int, prior: bool) -> tuple[Scoring, Array]:
    """Return scoring and scaled rows of a random problem."""
    rows = draw_rows(nuisance=nuisance)
    start = (
        PriorInformation.from_tolerances(4, nuisance)
        if prior
        else PriorInformation.none(4, nuisance)
    )
    scoring = build_scoring(rows, 0.5, criterion, start, find_observable_space(rows, start))
    return scoring, scoring.scale_rows(rows)


@pytest.mark.parametrize(("criterion", "nuisance", "prior"), CASES, ids=NAMES)
def test_gain_of_every_swap_equals_that_of_the_new_design(
    criterion: Criterion, nuisance: int, prior: bool
) -> None:
    scoring, X = build_random_scoring(criterion, nuisance, prior)
    chosen = np.array([0, 3, 4, 7, 9])
    R = scoring.factor(X[chosen])
    terms = compute_swap_terms(scoring, R, X)
    for j, out in enumerate(chosen):
        gains = score_swaps(terms, out)
        designs = [np.concatenate([np.delete(chosen, j), [k]]) for k in range(len(X))]
        anew = [scoring.score(scoring.factor(X[design])) - scoring.score(R) for design in designs]
        np.testing.assert_allclose(
            gains, anew, atol=1e-9
        )  # in logs: rounding of well-conditioned 6 x 6 systems


@pytest.mark.parametrize(("criterion", "nuisance", "prior"), CASES, ids=NAMES)
def test_gain_of_every_addition_equals_that_of_the_new_design(
    criterion: Criterion, nuisance: int, prior: bool
) -> None:
    scoring, X = build_random_scoring(criterion, nuisance, prior)
    R = scoring.factor(X[:4])
    anew = [
        scoring.score(scoring.factor(np.concatenate([X[:4], X[k : k + 1]]))) - scoring.score(R)
        for k in range(len(X))
    ]
    np.testing.assert_allclose(
        score_additions(compute_swap_terms(scoring, R, X)), anew, atol=1e-9
    )  # in logs, as above


@pytest.mark.parametrize("criterion", CRITERIA, ids=lambda criterion: criterion.name)
def test_swap_is_exact_if_the_design_without_the_candidate_is_singular(
    criterion: Criterion,
) -> None:
    scoring, X = build_random_scoring(criterion, 0, False)
    R = scoring.factor(X[:2])  # four equations for four unknowns
    terms = compute_swap_terms(scoring, R, X)
    gains = score_swaps(terms, 0)
    anew = [scoring.score(scoring.factor(X[[k, 1]])) - scoring.score(R) for k in range(2, len(X))]
    np.testing.assert_allclose(
        gains[2:], anew, atol=1e-8
    )  # in logs: rounding times the condition of two units, 10
    assert gains[1] < -15.0  # the same unit twice leaves two directions open, to rounding


@pytest.mark.parametrize(("criterion", "nuisance", "prior"), CASES, ids=NAMES)
def test_derivatives_by_weights_agree_with_finite_differences(
    criterion: Criterion, nuisance: int, prior: bool
) -> None:
    scoring, X = build_random_scoring(criterion, nuisance, prior)
    w = np.random.default_rng(3).uniform(0.3, 0.8, len(X))

    def score(weights: Array) -> float:
        return scoring.score(scoring.factor(np.sqrt(weights)[:, None, None] * X))

    slope, curve = differentiate_score(scoring, X, w)
    h = 1e-4
    steps = h * np.eye(len(w))
    np.testing.assert_allclose(
        slope, [(score(w + e) - score(w - e)) / (2 * h) for e in steps], atol=1e-6
    )  # h^2
    differences = [
        (differentiate_score(scoring, X, w + e)[0] - differentiate_score(scoring, X, w - e)[0])
        / (2 * h)
        for e in steps
    ]
    np.testing.assert_allclose(
        curve, np.array(differences), atol=1e-5
    )  # h^2 times a third derivative of about 100
    assert np.linalg.eigvalsh(curve)[-1] < 1e-9  # concave, to rounding
