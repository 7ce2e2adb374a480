# SPDX-License-Identifier: Apache-2.0
"""Criteria and observable directions agree with textbook covariances; refusals give the reason."""

import numpy as np
import pytest

from loopcal.planning.design_space import (
    A,
    D,
    E,
    I,
    PriorInformation,
    compute_efficiency,
    evaluate_criterion,
    factor_design,
    find_observable_space,
    require_enough,
)
from tests.findings.expectations import expect_refusal
from tests.planning.design_problems import compute_covariance, draw_rows, make_prior

CLOSE = 1e-10  # relative: rounding of inverses of well-conditioned 6 x 6 matrices


@pytest.mark.parametrize("nuisance", [0, 2])
@pytest.mark.parametrize("prior", [False, True])
def test_criteria_equal_those_of_the_covariance_of_machine_parameters(
    nuisance: int, prior: bool
) -> None:
    rows = draw_rows(nuisance=nuisance)
    start = make_prior(prior, nuisance)
    L = np.random.default_rng(1).normal(size=(9, 4))
    space = find_observable_space(rows, start)
    factor = factor_design(rows[:5], start, space)
    C = compute_covariance(rows[:5], start.rows, nuisance)
    expected = {
        D(): -np.linalg.slogdet(C)[1],
        A(): np.trace(C),
        E(): np.linalg.eigvalsh(C)[-1],
        I(L, 3): np.trace(L @ C @ L.T) / 3,
    }
    for criterion, value in expected.items():
        assert evaluate_criterion(criterion, factor, space.machine) == pytest.approx(
            value, rel=CLOSE
        )


def test_directions_confounded_with_nuisance_parameters_are_excluded() -> None:
    rows = draw_rows(nuisance=2)
    rows[..., 3] = (
        rows[..., 0] - 2.0 * rows[..., 4]
    )  # parameters 1 and 2 together, 1 to 2, do what a frame does
    start = PriorInformation.none(4, 2)
    space = find_observable_space(rows, start)
    assert len(space) == 3
    assert space.singular_values[3] < 1e-13 * space.singular_values[0]
    np.testing.assert_allclose(space.machine.T @ np.array([0.0, 1.0, 2.0, 0.0]), 0.0, atol=CLOSE)
    # With parameter 1 fixed instead, 0, 2 and 3 stand for z0, z2 - 2 z1 and z3, which no choice of
    # the frame changes.
    expected = compute_covariance(np.delete(rows[:6], 3, axis=2), np.zeros((0, 5)), 2)
    determined = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, -2.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    np.testing.assert_allclose(determined @ space.machine @ space.machine.T, determined, atol=1e-12)
    factor = factor_design(rows[:6], start, space)
    C = space.machine @ np.linalg.inv(factor.T @ factor) @ space.machine.T
    np.testing.assert_allclose(
        determined @ C @ determined.T, expected, rtol=1e-8
    )  # relative: rounding times a condition of 10^3


def test_earlier_rows_count_the_same_as_rows_of_the_design() -> None:
    rows = draw_rows(nuisance=1)
    none = PriorInformation.none(4, 1)
    space = find_observable_space(rows, none)
    before = none.with_rows(rows[:3])
    assert before.rows.shape == (5, 5)
    np.testing.assert_allclose(
        np.abs(factor_design(rows[3:6], before, space)),
        np.abs(factor_design(rows[:6], none, space)),
        rtol=CLOSE,
        atol=CLOSE,
    )


def test_design_has_half_the_efficiency_of_its_twofold_repetition() -> None:
    rows = draw_rows()
    start = PriorInformation.none(4)
    space = find_observable_space(rows, start)
    once, twice = (factor_design(np.repeat(rows, k, axis=0), start, space) for k in (1, 2))
    for criterion in (D(), A(), I(np.eye(4)), E()):
        values = [evaluate_criterion(criterion, factor, space.machine) for factor in (once, twice)]
        assert compute_efficiency(criterion, values[0], values[1], len(space)) == pytest.approx(
            0.5, rel=CLOSE
        )


def test_singular_design_has_the_worst_criterion_value() -> None:
    rows = draw_rows()
    start = PriorInformation.none(4)
    space = find_observable_space(rows, start)
    factor = factor_design(rows[:1], start, space)
    assert evaluate_criterion(D(), factor, space.machine) == -np.inf
    assert evaluate_criterion(A(), factor, space.machine) == np.inf


@pytest.mark.parametrize(
    ("n", "rows", "code", "data"),
    [
        (2, draw_rows(nuisance=1), "plan.design-too-small", {"needed": 3}),
        (13, draw_rows(), "plan.too-few-candidates", {"available": 12}),
        (5, np.full((3, 2, 4), np.nan), "plan.no-candidate-allowed", {"total": 3}),
        (5, np.zeros((6, 2, 4)), "plan.no-direction-observable", {}),
    ],
)
def test_design_that_cannot_determine_the_parameters_is_refused(
    n: int, rows: np.ndarray, code: str, data: dict
) -> None:
    start = PriorInformation.none(4, rows.shape[2] - 4)
    with expect_refusal(code, **data):
        require_enough(n, rows, start, find_observable_space(rows, start), repeats=False)


def test_any_number_of_poses_is_enough_with_a_tolerance_prior() -> None:
    rows = draw_rows()
    start = PriorInformation.from_tolerances(4)
    assert require_enough(1, rows, start, find_observable_space(rows, start)) is None
