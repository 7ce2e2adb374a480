# SPDX-License-Identifier: Apache-2.0
"""Residuals against order, time, temperature, session and readings: levels, power, exactness."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import f as f_distribution
from scipy.stats import kstest

from loopcal.diagnose.error_causes import explain_residuals
from loopcal.diagnose.residual_patterns import collect_residual_rows, estimate_sizes, list_effects
from loopcal.diagnose.residual_patterns import test_correlation as compute_correlation
from loopcal.diagnose.residual_patterns import test_effect as compute_tail
from loopcal.estimate.fit_linearization import linearize_fit
from loopcal.estimate.identification import identify
from loopcal.estimate.penalties import LeastSquares, Ridge
from loopcal.numerics.statistics import compute_any_probability, compute_single_level
from tests.diagnose.correlated_data import ROBOTS, draw_errors, make_rows, measure


def collect(robot, kind, errors, seed, method=None, **context):
    """Return the residual rows of a fit, and its data."""
    _, data = measure(robot, kind, errors, seed, **context)
    fit = identify(ROBOTS[robot], data, method)
    rows = collect_residual_rows(linearize_fit(fit, data))
    assert rows is not None
    return rows, data


CLEAN = [
    ("linear-delta", "component", 20, None),
    pytest.param("linear-delta", "component", 10, LeastSquares(), marks=pytest.mark.evidence),
    ("3-prs", "pose", 12, Ridge(3.0)),
    pytest.param("hexapod-42", "tracker", 12, None, marks=pytest.mark.evidence),
]


@pytest.mark.slow
@pytest.mark.parametrize("fits", [15, pytest.param(40, marks=pytest.mark.evidence)])
@pytest.mark.parametrize(("robot", "kind", "n", "method"), CLEAN)
def test_independent_errors_give_uniform_probabilities(robot, kind, n, method, fits):
    p_values = []
    m = {"component": 3, "pose": 6, "tracker": 9}[kind]
    for seed in range(fits):
        context = {"time": 60.0 * np.arange(n), "temperature": 20.0 + np.sin(np.arange(n) / 5.0)}
        errors = draw_errors(n, m, seed) * 3.0  # a wrong sigma changes nothing
        rows, data = collect(robot, kind, errors, seed, method, context=context)
        effects = [e for e in list_effects(rows, data, ROBOTS[robot]) if e.columns.shape[1]]
        p_values.append(
            [compute_tail(rows, e) for e in effects[:2]] + [compute_correlation(rows)[1]]
        )
    for column in np.array(p_values).T:
        assert kstest(column, "uniform").pvalue > 1e-3


def test_correlation_has_its_stated_probabilities_where_the_fit_takes_up_half_of_the_rows():
    rng = np.random.default_rng(3)
    series = np.repeat(np.arange(3), 10)
    smooth = np.cos(np.outer(np.arange(10), np.arange(5)) * np.pi / 10)
    basis = np.linalg.qr(np.kron(np.eye(3), smooth))[0]  # takes up what changes slowly
    drawn = rng.standard_normal((2000, 30))
    p_values = np.array([compute_correlation(make_rows(basis, e, series))[1] for e in drawn])
    assert kstest(p_values, "uniform").pvalue > 1e-3
    assert 0.03 < (p_values < 0.05).mean() < 0.07
    assert 0.002 < (p_values < 0.01).mean() < 0.02


def test_effects_are_compared_with_the_f_distribution_of_two_nested_fits():
    rows, data = collect("linear-delta", "component", draw_errors(15, 3, 1), 1)
    effects = list_effects(rows, data, ROBOTS["linear-delta"])
    for effect in (e for e in effects if e.columns.shape[1]):
        # the same by dense least squares without and with the columns of the effect
        X = np.column_stack(
            [rows.basis.toarray(), effect.columns / np.linalg.norm(effect.columns, axis=0)]
        )
        left = rows.residual - X @ np.linalg.lstsq(X, rows.residual, rcond=1e-10)[0]
        q = np.linalg.matrix_rank(X, tol=1e-8) - rows.basis.shape[1]
        degrees = len(left) - q - rows.basis.shape[1]
        full, rest = float((rows.residual**2).sum()), float((left**2).sum())
        expected = f_distribution.sf((full - rest) / q / (rest / degrees), q, degrees)
        assert compute_tail(rows, effect) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(
    "source", ["order", "time", "temperature", "session", "reading", "correlation"]
)
def test_each_dependence_is_found_and_named(source):
    n, seed = 24, 2
    errors, context, session = draw_errors(n, 3, seed), {}, None
    truth_of = np.array([1.0, -2.0, 0.5])
    ramp = np.linspace(-2.0, 2.0, n)[:, None]
    if source == "order":
        errors = errors + ramp * truth_of
    if source == "time":
        order = np.random.default_rng(0).permutation(n)  # the file is not in the order of time
        context = {"time": 60.0 * order}
        errors = errors + ramp[order] * truth_of
    if source == "temperature":
        temperature = np.random.default_rng(1).uniform(19.0, 21.0, n)
        context = {"temperature": temperature}
        errors = errors + (temperature[:, None] - 20.0) * 3.0 * truth_of
    if source == "session":
        session = np.array([f"s{i % 3}" for i in range(n)])
        errors = errors + np.random.default_rng(2).normal(0.0, 3.0, (3, 3))[np.arange(n) % 3]
    if source == "reading":
        _, data = measure("linear-delta", "component", errors, seed)
        q = data.readings[:, 1]
        errors[:, :2] += 400.0 * ((q - q.mean()) ** 2 / np.ptp(q) ** 2)[:, None]
    if source == "correlation":
        errors = draw_errors(n, 3, seed, 0.9)
    _, data = measure("linear-delta", "component", errors, seed, session=session, context=context)
    fit = identify(ROBOTS["linear-delta"], data)
    explained = explain_residuals(linearize_fit(fit, data))
    if source == "correlation":
        assert explained.causes[0].source == "walk"
        return
    first = explained.causes[0]
    assert first.source == source
    if source == "reading":
        assert first.name == "q2"
    if source in ("order", "time"):
        assert first.effect is not None
        assert explained.rows is not None
        sizes = estimate_sizes(explained.rows, first, first.effect)
        # from the first to the last row: 4 times these sizes [sigma]
        found = dict(zip("xyz", sizes.sizes / 5e-6, strict=True))
        errors_of = dict(zip("xyz", sizes.errors / 5e-6, strict=True))
        for name, true in zip("xyz", 4.0 * truth_of, strict=True):
            assert abs(found[name] - true) < 4.0 * errors_of[name]
            assert errors_of[name] < 3.0


def test_a_frame_of_each_session_explains_what_sessions_share():
    session = np.array([f"s{i // 8}" for i in range(24)])
    shift = np.tile(np.random.default_rng(4).normal(0.0, 20.0, (3, 3)), (1, 3))
    errors = draw_errors(24, 9, 4) + np.repeat(shift, 8, axis=0)
    _, data = measure("hexapod-42", "tracker", errors, 4, session=session)
    fit = identify(ROBOTS["hexapod-42"], data)
    assert not explain_residuals(linearize_fit(fit, data)).causes


def test_rows_that_are_absent_are_left_out():
    truth, data = measure("linear-delta", "component", draw_errors(20, 3, 6), 6)
    del truth
    (rows,) = data.observations
    measured = np.array(rows.measured)
    measured[3, 1] = measured[7] = np.nan
    holes = replace(data, observations=(replace(rows, measured=measured),))
    fit = identify(ROBOTS["linear-delta"], holes)
    collected = collect_residual_rows(linearize_fit(fit, holes))
    assert collected is not None
    assert len(collected.residual) == 60 - 4
    assert np.isfinite(compute_correlation(collected)[1])


def test_the_probability_of_a_pattern_counts_all_tests_of_the_fit() -> None:
    """One p-value of 0.01 among ten is nothing special: 1 - 0.99^10."""
    assert compute_any_probability(0.01, 10) == pytest.approx(1.0 - 0.99**10)
    assert compute_any_probability(1e-12, 7) == pytest.approx(7e-12)
    assert np.isnan(compute_any_probability(np.nan, 3))
    for tests in (1, 2, 100, 10_000):
        single = compute_single_level(0.05, tests)
        assert compute_any_probability(single, tests) == pytest.approx(0.05, rel=1e-12)
