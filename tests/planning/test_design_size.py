# SPDX-License-Identifier: Apache-2.0
"""Size of designs: monotone values, the smallest size for a target, unreachable targets."""

import numpy as np
import pytest

from loopcal.planning.design_space import A, Criterion, D, PriorInformation
from loopcal.planning.exchange import compute_design_curve, find_smallest_design, search_size
from tests.findings.expectations import expect_refusal
from tests.planning.design_problems import draw_rows, polynomial_rows

PARABOLA = polynomial_rows(np.linspace(-1, 1, 21), 2)


@pytest.mark.parametrize("criterion", [D(), A()], ids=["D", "A"])
def test_larger_designs_are_better_and_stay_within_their_bounds(criterion: Criterion) -> None:
    found = compute_design_curve(
        draw_rows(N=30), (12, 4, 6, 5, 9, 9), criterion, PriorInformation.none(4), perturbations=2
    )
    sign = 1.0 if isinstance(criterion, D) else -1.0
    np.testing.assert_array_equal(found.sizes, [4, 5, 6, 9, 12])
    assert (np.diff(sign * found.values) > 0.0).all()
    assert (sign * found.values <= sign * found.bounds + 1e-12).all()


def test_smallest_design_for_criterion_a_has_the_known_size() -> None:
    # With weights 1/4, 1/2, 1/4 of n points the sum of the variances is 8 / n: 0.4 takes 20 points
    # and no fewer.
    found = find_smallest_design(
        PARABOLA, 0.4 + 1e-9, A(), PriorInformation.none(3), most=200, repeats=True, perturbations=2
    )
    assert found.n == 20
    assert 19 <= found.at_least <= 20  # the bound is computed to three parts in a thousand
    assert found.certified.design.value == pytest.approx(0.4, rel=1e-9)


def test_smallest_design_for_criterion_d_has_the_known_size() -> None:
    target = np.log(4 / 27 * 30**3) - 1e-9  # thirty points, ten at each end and in the middle
    found = find_smallest_design(
        PARABOLA, target, D(), PriorInformation.none(3), most=200, repeats=True, perturbations=2
    )
    assert found.n == 30


def test_earlier_measurements_reduce_the_design_size() -> None:
    rows = draw_rows(N=60)
    alone = find_smallest_design(rows, 0.1, A(), PriorInformation.none(4), perturbations=2)
    helped = find_smallest_design(
        rows, 0.1, A(), PriorInformation.none(4).with_rows(rows[:10]), perturbations=2
    )
    assert alone.at_least <= alone.n
    assert helped.n < alone.n


def test_unreachable_target_is_refused_with_the_largest_possible_size() -> None:
    with expect_refusal("plan.target-impossible", size=12, available=12, target=0.001):
        find_smallest_design(draw_rows(), 0.001, A(), PriorInformation.none(4))
    with expect_refusal("plan.target-impossible", size=5, available=12):
        find_smallest_design(draw_rows(), 0.2, A(), PriorInformation.none(4), most=5)


@pytest.mark.parametrize("growth", [0.1, 1.0, 5.0])
def test_search_finds_the_smallest_size_in_few_evaluations(growth: float) -> None:
    asked: list[int] = []

    def value(n: int) -> float:
        asked.append(n)
        return float(n**-growth)

    for right in (3, 4, 57, 1000):
        asked.clear()
        assert search_size(value, 3, 1000, 5, A(), right**-growth * (1 + 1e-12), 4) == right
        assert len(asked) <= 25  # twice the halvings of a thousand, and a few
    assert search_size(value, 3, 1000, 5, A(), 1001**-growth, 4) == 1001
