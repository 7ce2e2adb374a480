# SPDX-License-Identifier: Apache-2.0
"""Calibrate the trials of a block by the methods of published studies, without uncertainties."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopcal.errors import DataError, EstimationError
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.estimate.published_methods.per_leg import identify_per_leg
from loopcal.estimate.published_methods.plane_line_products import (
    Layout,
    PaperRows,
    Weights,
    identify_from_rows,
)
from loopcal.estimate.published_methods.raw_steps import (
    EPSILON,
    LIMIT,
    StepRule,
    make_raw_problem,
    penalize_none,
    penalize_ridge,
    penalize_truncated,
    take_steps,
)
from loopcal.measure import Measurements, Trials
from loopcal.mechanism import Mechanism
from loopcal.numerics.gauss_newton import DescentStatus
from loopcal.studies.simulation.methods import make_method
from loopcal.studies.specification.levels import MethodLevel
from loopcal.typing import BoolArray, FloatArray, IntArray

MOST_LEG_STEPS = 100
"""Steps of a fit leg by leg at most, where epsilon ends them."""


@dataclass(frozen=True, eq=False)
class PublishedFits:
    """Fits of t trials.

    Attributes
    ----------
    values : (t, p of the robot) [SI], NaN where there are none. iterations : (t,).
    is_converged, is_diverged, is_refused : (t,); none of them: out of steps.
    rank : (t,), where the method has one.
    """

    values: FloatArray
    iterations: IntArray
    is_converged: BoolArray
    is_diverged: BoolArray
    is_refused: BoolArray
    rank: IntArray | None = None


def fit_published(
    method: MethodLevel, robot: Mechanism, trials: Trials, layout: Layout | None
) -> PublishedFits:
    """Calibrate all trials; a trial that fails does not stop the others.

    Raises
    ------
    DataError : products of points that are not held on planes and lines.
    """
    if method.is_of_products:
        if layout is None:
            raise DataError(
                "products of points need 'choice: plane-line' of the poses; add it, or remove "
                f"'rows: {method.rows}'"
            )
        return _fit_products(method, robot, trials, layout)
    if method.method == "per-leg":
        return _fit_per_leg(method, robot, trials)
    raw = make_raw_problem(robot, trials)
    steps = take_steps(raw, choose_penalty(method, raw.problem.parameters), choose_rule(method))
    is_counted = method.epsilon is None and method.steps is not None
    is_converged = ~steps.is_diverged if is_counted else steps.is_converged
    nowhere = np.zeros(len(trials), dtype=bool)
    return PublishedFits(steps.values, steps.count, is_converged, steps.is_diverged, nowhere)


def _fit_products(
    method: MethodLevel, robot: Mechanism, trials: Trials, layout: Layout
) -> PublishedFits:
    """Calibrate all trials from products of points, with the library's descent."""
    free, sd = select_free_parameters(robot), np.zeros(len(robot.parameters))
    sd[free.places] = free.tolerance
    sigma = float(trials.instrument.sensors[0].noise.sigma[0])
    weights: Weights = "full" if method.rows == "products" else "printed"
    assert trials.recorded is not None
    rows = PaperRows(layout, trials.recorded, sd, sigma, weights)
    fit = identify_from_rows(rows, make_method(method))
    nowhere = np.zeros(len(trials), dtype=bool)
    return PublishedFits(
        rows.values(fit.deviation),
        fit.iterations,
        fit.status == DescentStatus.CONVERGED,
        nowhere,
        nowhere,
        fit.decomposition.rank,
    )


def choose_penalty(method: MethodLevel, parameters: int) -> FloatArray:
    """Return the penalty (1, p) of each direction."""
    if method.method == "ridge":
        return penalize_ridge(np.array([method.lam]), parameters)
    if method.method == "truncated-svd":
        return penalize_truncated(np.array([method.keep]), parameters)
    return penalize_none(parameters)


def choose_rule(method: MethodLevel) -> StepRule:
    """Return when the steps of raw fits end."""
    if method.steps is None:
        return StepRule(EPSILON if method.epsilon is None else method.epsilon, LIMIT)
    return StepRule(method.epsilon or 0.0, method.steps)


def refuse_per_leg(method: MethodLevel, robot: Mechanism, data: Measurements) -> None:
    """Raise the reason for which the fit of a trial leg by leg is refused; nothing without one.

    Raises
    ------
    EstimationError, DataError : see `identify_per_leg`.
    """
    rule = choose_rule(method)
    identify_per_leg(robot, data, rule.limit if method.steps else MOST_LEG_STEPS, rule.epsilon)


def _fit_per_leg(method: MethodLevel, robot: Mechanism, trials: Trials) -> PublishedFits:
    """Calibrate the trials one by one, leg by leg."""
    rule, t = choose_rule(method), len(trials)
    values = np.full((t, len(robot.parameters)), np.nan)
    iterations, converged = np.zeros(t, dtype=np.int64), np.zeros(t, dtype=bool)
    refused = np.zeros(t, dtype=bool)
    for i in range(t):
        steps = rule.limit if method.steps else MOST_LEG_STEPS
        try:
            fit = identify_per_leg(robot, trials.trial(i), steps, rule.epsilon)
        except (EstimationError, DataError):
            refused[i] = True
            continue
        values[i], converged[i] = fit.robot.values, fit.is_converged
        iterations[i] = len(fit.estimate_history) - 1
    return PublishedFits(values, iterations, converged, np.zeros(t, dtype=bool), refused)
