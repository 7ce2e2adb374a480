# SPDX-License-Identifier: Apache-2.0
"""How many units: monotone curves, the smallest size for a target, and what no size can reach."""

import numpy as np
import pytest

from loopcal.errors import EstimationError
from loopcal.planning.criteria import A, Criterion, D
from loopcal.planning.curve import design_curve, enough, smallest
from loopcal.planning.design import Start
from tests.planning.polynomials import polynomial, random_rows

PARABOLA = polynomial(np.linspace(-1, 1, 21), 2)


@pytest.mark.parametrize("criterion", [D(), A()], ids=["D", "A"])
def test_more_units_are_never_worse_and_none_beats_its_bound(criterion: Criterion) -> None:
    found = design_curve(
        random_rows(N=30), (12, 4, 6, 5, 9, 9), criterion, Start.nothing(4), shakes=2
    )
    sign = 1.0 if isinstance(criterion, D) else -1.0
    np.testing.assert_array_equal(found.numbers, [4, 5, 6, 9, 12])
    assert (np.diff(sign * found.values) > 0.0).all()
    assert (sign * found.values <= sign * found.bounds + 1e-12).all()


def test_a_known_number_of_points_for_a_known_sum_of_variances() -> None:
    # With weights 1/4, 1/2, 1/4 of n points the sum of the variances is 8 / n: 0.4 takes 20 points
    # and no fewer.
    found = enough(PARABOLA, 0.4 + 1e-9, A(), Start.nothing(3), most=200, repeats=True, shakes=2)
    assert found.n == 20
    assert 19 <= found.at_least <= 20  # the bound is computed to three parts in a thousand
    assert found.certified.design.value == pytest.approx(0.4, rel=1e-9)


def test_the_determinant_asked_for_is_reached_by_thesmallest_number() -> None:
    target = np.log(4 / 27 * 30**3) - 1e-9  # thirty points, ten at each end and in the middle
    found = enough(PARABOLA, target, D(), Start.nothing(3), most=200, repeats=True, shakes=2)
    assert found.n == 30


def test_what_is_known_before_saves_units() -> None:
    rows = random_rows(N=60)
    alone = enough(rows, 0.1, A(), Start.nothing(4), shakes=2)
    helped = enough(rows, 0.1, A(), Start.nothing(4).plus(rows[:10]), shakes=2)
    assert alone.at_least <= alone.n
    assert helped.n < alone.n


def test_targets_out_of_reach_are_refused_with_the_best_that_is_possible() -> None:
    with pytest.raises(
        EstimationError,
        match=r"no 12 of the 12 allowed candidates bring criterion A to 0\.001: the best",
    ):
        enough(random_rows(), 0.001, A(), Start.nothing(4))
    with pytest.raises(EstimationError, match="no 5 of the 12 allowed"):
        enough(random_rows(), 0.2, A(), Start.nothing(4), most=5)


@pytest.mark.parametrize("growth", [0.1, 1.0, 5.0])
def test_thesmallest_size_is_found_however_values_grow(growth: float) -> None:
    asked: list[int] = []

    def value(n: int) -> float:
        asked.append(n)
        return float(n**-growth)

    for right in (3, 4, 57, 1000):
        asked.clear()
        assert smallest(value, 3, 1000, 5, A(), right**-growth * (1 + 1e-12), 4) == right
        assert len(asked) <= 25  # twice the halvings of a thousand, and a few
    assert smallest(value, 3, 1000, 5, A(), 1001**-growth, 4) == 1001
