# SPDX-License-Identifier: Apache-2.0
"""Relaxed designs have the weights known in closed form, and their bound holds for all designs."""

from itertools import combinations

import numpy as np
import pytest

from loopcal.planning.design_space import (
    A,
    Criterion,
    D,
    I,
    PriorInformation,
    evaluate_criterion,
    factor_design,
)
from loopcal.planning.relaxation import relax_design
from tests.findings.expectations import expect_refusal
from tests.planning.design_problems import Array, draw_rows, make_grid, make_prior, polynomial_rows

GAP = 1e-7
MOMENTS = np.linalg.cholesky(
    np.array([[1, 0, 1 / 3], [0, 1 / 3, 0], [1 / 3, 0, 1 / 5]])
).T  # of [-1, 1], for 1, x, x^2
L = np.random.default_rng(1).normal(size=(9, 4))


@pytest.mark.parametrize(
    ("criterion", "nuisance", "shares", "value"),
    [
        (D(), 0, (1 / 3, 1 / 3, 1 / 3), np.log(4 / 27)),
        (A(), 0, (1 / 4, 1 / 2, 1 / 4), 8.0),
        (I(MOMENTS), 0, (1 / 4, 1 / 2, 1 / 4), 32 / 15),
        (
            D(),
            2,
            (1 / 4, 1 / 2, 1 / 4),
            np.log(1 / 4),
        ),  # 1 and x are not of interest: the Chebyshev points
    ],
    ids=["D", "A", "I", "D of the highest coefficient"],
)
def test_weights_and_values_for_a_parabola_are_the_known_ones(
    criterion: Criterion, nuisance: int, shares: tuple[float, ...], value: float
) -> None:
    x, n = make_grid(), 12
    start = PriorInformation.none(3 - nuisance, nuisance)
    found = relax_design(polynomial_rows(x, 2), n, criterion, start, GAP, repeats=True)
    q = 3 - nuisance
    known = value + q * np.log(n) if isinstance(criterion, D) else value / n
    assert found.converged
    assert found.value == pytest.approx(known, rel=1e-6)  # relative: the gap asked for
    assert found.efficiency(known) == pytest.approx(1.0, abs=2 * GAP)
    masses = [
        found.weights[abs(x - at) < 0.15].sum() / n for at in (-1.0, 0.0, 1.0)
    ]  # the optimum is flat about 0
    np.testing.assert_allclose(masses, shares, atol=2e-3)


def test_points_for_a_cubic_are_the_known_ones() -> None:
    x = make_grid(extra=1 / np.sqrt(5))
    found = relax_design(polynomial_rows(x, 3), 4, D(), PriorInformation.none(4), GAP, repeats=True)
    for at in (-1.0, -1 / np.sqrt(5), 1 / np.sqrt(5), 1.0):
        assert found.weights[abs(x - at) < 0.05].sum() == pytest.approx(1.0, abs=2e-3)


def test_optimal_design_satisfies_the_equivalence_theorem() -> None:
    found = relax_design(
        polynomial_rows(make_grid(), 2), 12, D(), PriorInformation.none(3), GAP, repeats=True
    )
    assert (12 * found.slopes).max() == pytest.approx(
        3.0, rel=1e-5
    )  # variance of the prediction at most p: Kiefer, Wolfowitz
    np.testing.assert_allclose(12 * found.slopes[found.weights > 0.1], 3.0, rtol=1e-3)


def find_best_value(
    rows: Array, n: int, criterion: Criterion, start: PriorInformation, found
) -> float:
    """Return the best criterion value of all subsets."""
    values = [
        evaluate_criterion(
            criterion, factor_design(rows[list(chosen)], start, found.space), found.space.machine
        )
        for chosen in combinations(range(len(rows)), n)
    ]
    return max(values) if isinstance(criterion, D) else min(values)


@pytest.mark.parametrize("criterion", [D(), A(), I(L, 3)], ids=lambda criterion: criterion.name)
@pytest.mark.parametrize("nuisance", [0, 2])
@pytest.mark.parametrize("prior", [False, True])
def test_bound_holds_for_every_subset_and_is_tighter_without_repeats(
    criterion: Criterion, nuisance: int, prior: bool
) -> None:
    rows = draw_rows(nuisance=nuisance)
    start = make_prior(prior, nuisance)
    capped = relax_design(rows, 5, criterion, start, 1e-6)
    free = relax_design(rows, 5, criterion, start, 1e-6, repeats=True)
    best = find_best_value(rows, 5, criterion, start, capped)
    assert capped.converged
    assert free.converged
    assert capped.weights.max() <= 1.0
    assert capped.weights.sum() == pytest.approx(5.0, abs=1e-9)
    assert 0.5 < capped.efficiency(best) <= 1.0 + 1e-9
    assert free.efficiency(best) < capped.efficiency(best)


def test_bound_holds_for_an_early_stop() -> None:
    rows = draw_rows()
    rough = relax_design(rows, 5, D(), PriorInformation.none(4), gap=0.9)
    assert rough.bound >= find_best_value(rows, 5, D(), PriorInformation.none(4), rough)
    assert rough.value <= rough.bound


def test_relaxed_design_of_all_candidates_has_unit_weights() -> None:
    rows = draw_rows()
    found = relax_design(rows, 12, A(), PriorInformation.none(4))
    assert found.value == found.bound
    np.testing.assert_array_equal(found.weights, 1.0)


def test_forbidden_candidates_have_zero_weight() -> None:
    rows = draw_rows(N=30)
    rows[:10, 0, 0] = np.nan
    found = relax_design(rows, 6, D(), PriorInformation.none(4))
    assert found.weights[:10].max() == 0.0
    assert found.converged


def test_unobservable_prediction_is_refused() -> None:
    rows = draw_rows()
    rows[:, :, 3] = 0.0
    with expect_refusal("plan.prediction-unobservable"):
        relax_design(rows, 5, I(np.array([[0.0, 0.0, 0.0, 1.0]])), PriorInformation.none(4))
