# SPDX-License-Identifier: Apache-2.0
"""Frames, targets, surfaces and offsets that fit measurements best at a given geometry.

They are the setup of the errors "before calibration": on the rows of the fit, with the geometry
from which it starts, so that before and after differ by the geometry only.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from loopcal.errors import DataError
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.minimization.descent import Descent
from loopcal.estimate.options import FitOptions
from loopcal.estimate.poses.prediction import predict_from_readings
from loopcal.estimate.problem import Problem
from loopcal.estimate.problem_construction import problem_of
from loopcal.measure import Measurements, NuisanceParameters
from loopcal.mechanism import Mechanism
from loopcal.parameters import ParameterTable
from loopcal.typing import FloatArray


def fit_setup_before(
    problem: Problem,
    robot: Mechanism,
    options: FitOptions,
    data: Measurements,
    weights: FloatArray,
    fit: Descent,
) -> FloatArray | None:
    """Return the nuisance parameters (U,) that fit the robot from which a fit starts.

    Parameters
    ----------
    weights : (n,) of the poses in the fit.

    Returns
    -------
    None without nuisance parameters, or where the fit began with these values: at this robot, with
    these weights, and with all poses.
    """
    is_first = (
        options.start is None and options.loss is None and np.isfinite(fit.cost_history[0, 0])
    )
    if problem.nuisance is None or is_first:
        return None
    return fit_setup_alone(robot, data.with_weights(weights), problem.nuisance.local)


def fit_setup_alone(
    robot: Mechanism, data: Measurements, nuisance: NuisanceParameters
) -> FloatArray:
    """Return nuisance parameters (U,) [SI] that fit measurements best at the robot's geometry.

    Poses that the geometry does not reach do not count. NaN where the others do not determine the
    parameters, and no value is stated.
    """
    table = nuisance.table
    unknown = np.where(table.free & np.isnan(table.tolerance), np.nan, nuisance.values())
    solution, known = predict_from_readings(robot, data)
    reached = solution.converged & known
    if not reached.any():
        return unknown
    reached_data = data.take(reached)
    reached_setup = reached_data.nuisance_parameters
    entries = {entry.name: entry for entry in table.entries}
    stated = ParameterTable(tuple(entries[name] for name in reached_setup.table.names))
    nothing = np.zeros(0)
    fixed = FreeParameters(robot, nothing.astype(np.int64), nothing, nothing, nothing.astype(bool))
    setup, z = replace(reached_setup, table=stated), nothing[None]
    problem = problem_of(fixed, reached_data, setup)
    try:
        fitted = problem.solve(z, problem.start(z)).nuisance
    except DataError:  # too few rows for a closed form
        return unknown
    values = {} if fitted is None else dict(zip(reached_setup.table.names, fitted[0], strict=True))
    return np.array([values.get(name, unknown[i]) for i, name in enumerate(table.names)])
