# SPDX-License-Identifier: Apache-2.0
"""The relaxation finds the continuous designs that are known in closed form, and its bound holds
for every design.
"""

from itertools import combinations

import numpy as np
import pytest

from loopcal.planning.design import (
    A,
    Criterion,
    D,
    I,
    PriorInformation,
    evaluate_criterion,
    factor_design,
    relax_design,
)
from tests.findings.reported import refused
from tests.planning.polynomials import Array, grid, polynomial, random_rows

GAP = 1e-7
MOMENTS = np.linalg.cholesky(
    np.array([[1, 0, 1 / 3], [0, 1 / 3, 0], [1 / 3, 0, 1 / 5]])
).T  # of [-1, 1], for 1, x, x^2
L = np.random.default_rng(1).normal(size=(9, 4))


@pytest.mark.parametrize(
    ("criterion", "own", "shares", "value"),
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
def test_parabola_known_weights_and_values(
    criterion: Criterion, own: int, shares: tuple[float, ...], value: float
) -> None:
    x, n = grid(), 12
    start = PriorInformation.none(3 - own, own)
    found = relax_design(polynomial(x, 2), n, criterion, start, GAP, repeats=True)
    q = 3 - own
    known = value + q * np.log(n) if isinstance(criterion, D) else value / n
    assert found.converged
    assert found.value == pytest.approx(known, rel=1e-6)  # relative: the gap asked for
    assert found.efficiency(known) == pytest.approx(1.0, abs=2 * GAP)
    masses = [
        found.weights[abs(x - at) < 0.15].sum() / n for at in (-1.0, 0.0, 1.0)
    ]  # the optimum is flat about 0
    np.testing.assert_allclose(masses, shares, atol=2e-3)


def test_cubic_known_points() -> None:
    x = grid(extra=1 / np.sqrt(5))
    found = relax_design(polynomial(x, 3), 4, D(), PriorInformation.none(4), GAP, repeats=True)
    for at in (-1.0, -1 / np.sqrt(5), 1 / np.sqrt(5), 1.0):
        assert found.weights[abs(x - at) < 0.05].sum() == pytest.approx(1.0, abs=2e-3)


def test_at_the_optimum_no_slope_exceeds_the_mean_and_the_design_lies_where_it_is_reached() -> None:
    found = relax_design(
        polynomial(grid(), 2), 12, D(), PriorInformation.none(3), GAP, repeats=True
    )
    assert (12 * found.slopes).max() == pytest.approx(
        3.0, rel=1e-5
    )  # variance of the prediction at most p: Kiefer, Wolfowitz
    np.testing.assert_allclose(12 * found.slopes[found.weights > 0.1], 3.0, rtol=1e-3)


def best_of_all(rows: Array, n: int, criterion: Criterion, start: PriorInformation, found) -> float:
    """Best value of all subsets."""
    values = [
        evaluate_criterion(
            criterion, factor_design(rows[list(chosen)], start, found.space), found.space.machine
        )
        for chosen in combinations(range(len(rows)), n)
    ]
    return max(values) if isinstance(criterion, D) else min(values)


@pytest.mark.parametrize("criterion", [D(), A(), I(L, 3)], ids=lambda criterion: criterion.name)
@pytest.mark.parametrize("own", [0, 2])
@pytest.mark.parametrize("prior", [False, True])
def test_the_bound_is_better_than_every_subset_and_the_cap_makes_it_tighter(
    criterion: Criterion, own: int, prior: bool
) -> None:
    rows = random_rows(own=own)
    start = PriorInformation.from_tolerances(4, own) if prior else PriorInformation.none(4, own)
    capped = relax_design(rows, 5, criterion, start, 1e-6)
    free = relax_design(rows, 5, criterion, start, 1e-6, repeats=True)
    best = best_of_all(rows, 5, criterion, start, capped)
    assert capped.converged
    assert free.converged
    assert capped.weights.max() <= 1.0
    assert capped.weights.sum() == pytest.approx(5.0, abs=1e-9)
    assert 0.5 < capped.efficiency(best) <= 1.0 + 1e-9
    assert free.efficiency(best) < capped.efficiency(best)


def test_the_bound_holds_long_before_the_optimum() -> None:
    rows = random_rows()
    rough = relax_design(rows, 5, D(), PriorInformation.none(4), gap=0.9)
    assert rough.bound >= best_of_all(rows, 5, D(), PriorInformation.none(4), rough)
    assert rough.value <= rough.bound


def test_all_candidates_are_the_best_design_of_all_candidates() -> None:
    rows = random_rows()
    found = relax_design(rows, 12, A(), PriorInformation.none(4))
    assert found.value == found.bound
    np.testing.assert_array_equal(found.weights, 1.0)


def test_units_that_are_not_allowed_have_no_weight() -> None:
    rows = random_rows(N=30)
    rows[:10, 0, 0] = np.nan
    found = relax_design(rows, 6, D(), PriorInformation.none(4))
    assert found.weights[:10].max() == 0.0
    assert found.converged


def test_weights_of_a_prediction_that_nothing_determines_are_refused() -> None:
    rows = random_rows()
    rows[:, :, 3] = 0.0
    with refused("plan.prediction-unobservable"):
        relax_design(rows, 5, I(np.array([[0.0, 0.0, 0.0, 1.0]])), PriorInformation.none(4))
