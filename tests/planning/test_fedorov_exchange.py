# SPDX-License-Identifier: Apache-2.0
"""Fedorov exchange finds the known designs, and the best of all subsets of small problems."""

from itertools import combinations

import numpy as np
import pytest

from loopcal.errors import EstimationError
from loopcal.planning.design_space import (
    A,
    Criterion,
    D,
    E,
    I,
    PriorInformation,
    evaluate_criterion,
    factor_design,
)
from loopcal.planning.exchange import choose_design, fedorov_exchange
from tests.findings.expectations import expect_refusal
from tests.planning.design_problems import draw_rows, make_grid, make_prior, polynomial_rows

L = np.random.default_rng(1).normal(size=(9, 4))


def test_six_points_for_a_parabola_are_the_ends_and_the_middle_twice() -> None:
    x = make_grid()
    found = fedorov_exchange(
        polynomial_rows(x, 2), 6, D(), PriorInformation.none(3), starts=3, repeats=True
    )
    np.testing.assert_allclose(x[found.chosen], [-1, -1, 0, 0, 1, 1], atol=1e-12)
    assert found.value == pytest.approx(
        np.log(4 / 27 * 6**3), abs=1e-10
    )  # det of weights 1/3 each, times 6^3


def test_four_points_for_a_cubic_are_the_known_ones() -> None:
    x = make_grid(extra=1 / np.sqrt(5))
    found = fedorov_exchange(polynomial_rows(x, 3), 4, D(), PriorInformation.none(4), starts=3)
    np.testing.assert_allclose(
        x[found.chosen], [-1, -1 / np.sqrt(5), 1 / np.sqrt(5), 1], atol=1e-12
    )


@pytest.mark.slow
@pytest.mark.parametrize("criterion", [D(), A(), I(L, 3)], ids=lambda criterion: criterion.name)
@pytest.mark.parametrize("nuisance", [0, 2])
@pytest.mark.parametrize("prior", [False, True])
def test_exchange_finds_the_best_of_all_subsets(
    criterion: Criterion, nuisance: int, prior: bool
) -> None:
    rows = draw_rows(N=9, nuisance=nuisance)
    start = make_prior(prior, nuisance)
    found = fedorov_exchange(rows, 5, criterion, start, starts=8)

    def value(chosen: tuple[int, ...]) -> float:
        factor = factor_design(rows[list(chosen)], start, found.space)
        return evaluate_criterion(criterion, factor, found.space.machine)

    best = (max if isinstance(criterion, D) else min)(combinations(range(9), 5), key=value)
    assert tuple(found.chosen) == best
    assert found.value == pytest.approx(value(best), rel=1e-10)  # relative: rounding
    assert choose_design(rows, 5, criterion, start).design.value == pytest.approx(
        value(best), rel=1e-10
    )


def test_history_increases_and_ends_at_the_value() -> None:
    found = fedorov_exchange(
        polynomial_rows(make_grid(), 3), 9, D(), PriorInformation.none(4), starts=4
    )
    assert (np.diff(found.history) > 0.0).all()
    assert found.value == found.history[-1] == max(found.values)


def test_same_seed_gives_the_same_design_and_the_same_first_starts() -> None:
    rows = draw_rows(N=40)
    few, again, more = (
        fedorov_exchange(rows, 6, D(), PriorInformation.none(4), seed=5, starts=k)
        for k in (3, 3, 6)
    )
    np.testing.assert_array_equal(few.chosen, again.chosen)
    assert more.values[:3] == few.values


def test_forbidden_and_repeated_candidates_are_never_chosen() -> None:
    rows = draw_rows(N=20)
    rows[::2, 1, 2] = np.nan
    for found in (
        fedorov_exchange(rows, 8, D(), PriorInformation.none(4), starts=5),
        choose_design(rows, 8, D(), PriorInformation.none(4)).design,
    ):
        assert (found.chosen % 2 == 1).all()
        assert len(set(found.chosen.tolist())) == 8


def test_singular_start_finds_the_few_candidates_that_are_needed() -> None:
    rows = draw_rows(N=60)
    rows[:57, :, 3] = 0.0  # only the last three show the fourth parameter
    found = fedorov_exchange(rows, 3, D(), PriorInformation.none(4), starts=4)
    assert (found.chosen >= 57).any()
    assert np.isfinite(found.value)


def test_design_complements_earlier_measurements() -> None:
    x = make_grid()
    rows = polynomial_rows(x, 2)
    ends = PriorInformation.none(3).with_rows(
        np.repeat(polynomial_rows(np.array([-1.0, 1.0]), 2), 3, axis=0)
    )
    found = fedorov_exchange(rows, 3, D(), ends, starts=3, repeats=True)
    np.testing.assert_allclose(x[found.chosen], 0.0, atol=1e-12)


def test_exchange_that_stays_singular_is_refused() -> None:
    rows = draw_rows(N=6)
    rows[:3, :, 2:] = (
        0.0  # three units show two unknowns only, the others the other two, by one row of use each
    )
    rows[3:, :, :2] = 0.0
    rows[3:, 1] = rows[3:, 0]
    rows[4:, :, 2:] = rows[3, :, 2:]
    rows[5, :, 3] += 1.0
    with expect_refusal("plan.design-singular", chosen=2, available=6):
        fedorov_exchange(rows, 2, D(), PriorInformation.none(4), starts=3)


def test_criterion_e_is_refused_for_an_exchange() -> None:
    with pytest.raises(EstimationError, match="choose D, I or A"):
        fedorov_exchange(draw_rows(), 5, E(), PriorInformation.none(4))


def test_exchange_without_a_start_is_refused() -> None:
    with pytest.raises(EstimationError, match="give 1 or more"):
        fedorov_exchange(draw_rows(), 5, D(), PriorInformation.none(4), starts=0)
