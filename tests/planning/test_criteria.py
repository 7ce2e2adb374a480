# SPDX-License-Identifier: Apache-2.0
"""Criteria and observable directions agree with textbook covariances; refusals give the reason."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from loopcal.planning.design_space import Criterion, PriorInformation, factor_design
from tests.findings.expectations import expect_refusal
from tests.planning.design_problems import L, compute_covariance, draw_rows, make_problem

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
