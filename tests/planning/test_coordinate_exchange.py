# SPDX-License-Identifier: Apache-2.0
"""Coordinate exchange: known designs, forbidden levels and poses of a hexapod."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from loopcal.errors import EstimationError
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.estimate.information import observe_poses
from loopcal.io.robot.robot_file import load_robot
from loopcal.mechanism.solutions import inverse
from loopcal.mechanism.workspace import sample_workspace
from loopcal.planning.design_space import (
    Criterion,
    PriorInformation,
    evaluate_criterion,
    factor_design,
    find_observable_space,
)
from loopcal.planning.exchange import coordinate_exchange
from tests.findings.expectations import expect_refusal
from tests.planning.design_problems import Array, Places, polynomial_rows

NONE = PriorInformation.none(3)
LEVELS = [np.linspace(-1.0, 1.0, 5)]
SIGMA = np.array([5e-5] * 3 + [1e-5] * 3)  # [rad, m]


def parabola(_: Places, x: Array) -> Array:
    """Return rows of 1, x, x^2."""
    return polynomial_rows(x[:, 0], 2)


@pytest.mark.parametrize(
    ("criterion", "best"),
    [
        (Criterion("D"), [-1, -1, -1, -1, 0, 0, 0, 0, 1, 1, 1, 1]),
        (Criterion("A"), [-1] * 3 + [0] * 6 + [1] * 3),
    ],
)
@pytest.mark.parametrize("seed", range(4))
def test_every_start_converges_to_the_known_design_of_a_parabola(criterion, best, seed):
    begin = np.random.default_rng(seed).uniform(-1, 1, (12, 1))
    found = coordinate_exchange(parabola, begin, LEVELS, criterion, NONE)
    assert_allclose(np.sort(found.design[:, 0]), best, atol=1e-12)
    assert_array_equal(found.rows, parabola(np.arange(12), found.design))


def test_points_that_start_at_one_place_are_separated():
    found = coordinate_exchange(parabola, np.zeros((6, 1)), LEVELS, Criterion("D"), NONE)
    assert found.history[0] == -np.inf
    assert_allclose(np.sort(found.design[:, 0]), [-1, -1, 0, 0, 1, 1], atol=1e-12)


def test_forbidden_levels_are_never_chosen():
    def forbid_left_end(which: Places, x: Array) -> Array:
        rows = parabola(which, x)
        rows[(x[:, 0] < -0.9) & (which % 2 == 0)] = np.nan
        return rows

    found = coordinate_exchange(
        forbid_left_end, np.full((6, 1), 0.25), LEVELS, Criterion("D"), NONE
    )
    assert (found.design[::2, 0] > -0.9).all()
    assert (found.design[1::2, 0] < -0.9).any()


def test_rows_of_all_levels_of_a_coordinate_are_evaluated_in_one_call():
    asked = []

    def count_rows(which: Places, x: Array) -> Array:
        asked.append(len(which))
        return parabola(which, x)

    found = coordinate_exchange(
        count_rows, np.linspace(-1, 1, 7)[:, None], LEVELS, Criterion("D"), NONE
    )
    sweeps = len(found.history) - 1
    assert asked[0] == 7
    assert asked[2:] == [7 * 5] * sweeps


def test_coordinate_without_levels_is_not_changed():
    begin = np.random.default_rng(0).uniform(-1, 1, (6, 2))
    found = coordinate_exchange(parabola, begin, [*LEVELS, np.zeros(0)], Criterion("D"), NONE)
    assert_array_equal(found.design[:, 1], begin[:, 1])


def test_forbidden_first_design_and_too_few_points_are_refused():
    with pytest.raises(EstimationError, match="group 1 of the first design is not allowed"):
        coordinate_exchange(
            parabola, np.array([[0.0], [np.nan], [1.0]]), LEVELS, Criterion("D"), NONE
        )
    with expect_refusal("plan.design-too-small", needed=3):
        coordinate_exchange(parabola, np.zeros((2, 1)), LEVELS, Criterion("D"), NONE)


def test_design_that_stays_singular_is_refused():
    def fix_all_but_the_first(which: Places, x: Array) -> Array:
        rows = parabola(which, x)
        rows[(which > 0) & (x[:, 0] != 0.0)] = np.nan
        return rows

    with expect_refusal("plan.design-singular", unknowns=3):
        coordinate_exchange(fix_all_but_the_first, np.zeros((4, 1)), LEVELS, Criterion("D"), NONE)


def test_exchange_of_hexapod_poses_halves_the_parameter_uncertainty():
    free = select_free_parameters(load_robot("hexapod-42"))
    drawn = sample_workspace(free.robot, 200, 0).coordinates
    middle, half = drawn.mean(axis=0), 0.5 * np.ptp(drawn, axis=0)

    def linearize(_: Places, x: Array) -> Array:
        at = inverse(free.robot, x)
        rows = (
            observe_poses(free, np.where(at.converged[:, None], at.q, 0.0)).twists[0]
            / SIGMA[:, None]
        )
        return np.where(at.converged[:, None, None], rows, np.nan)

    levels = [
        m + h * np.array([-1.0, -0.5, 0.0, 0.5, 1.0]) for m, h in zip(middle, half, strict=True)
    ]
    found = coordinate_exchange(
        linearize, drawn[:20], levels, Criterion("D"), PriorInformation.none(len(free))
    )
    none = PriorInformation.none(len(free))
    space = find_observable_space(found.rows, none)
    before, after = (
        evaluate_criterion(Criterion("A"), factor_design(rows, none, space), space.machine)
        for rows in (linearize(np.arange(20), drawn[:20]), found.rows)
    )
    assert (np.diff(found.history) >= 0.0).all()
    # rms standard deviation of the parameters; 2.8 to 3.0 with 100 poses
    assert np.sqrt(before / after) > 2.0
    assert inverse(free.robot, found.design).converged.all()
