# SPDX-License-Identifier: Apache-2.0
"""Poses that a geometry predicts from readings, as far as each reading is believed.

With as many actuators as freedoms a pose needs all its readings, and their sigmas do not move it.
Redundant readings contradict each other: the pose is where they fit best in units of their own
sigma, and a reading that was not taken may not be needed at all. See
docs/theory/uncertain-readings.md.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.problem_construction import problem_of
from loopcal.measure import Measurements, NuisanceParameters, fill_in_reading_sigma
from loopcal.mechanism import Mechanism, Solution, forward, make_solution
from loopcal.parameters import ParameterTable
from loopcal.typing import BoolArray, FloatArray, IntArray

SAME_RATIO = 1e-9
"""Relative difference of sigma ratios below which a pose's readings are weighted as the robot
states."""


def predict_from_readings(robot: Mechanism, data: Measurements) -> tuple[Solution, BoolArray]:
    """Return the poses of all readings.

    Returns
    -------
    solution : of n poses.
    is_determined : (n,) poses that the readings determine which were taken and are believed.

    Raises
    ------
    DataError
        A redundant reading is stated to be exact.
    """
    if robot.program.sigma is not None:
        data = fill_in_reading_sigma(robot, data)
    sigma = data.reading_sigma
    if robot.program.sigma is None or sigma is None:
        known = np.ones(data.n_poses, dtype=bool)
        if sigma is not None:
            known = np.asarray(np.isfinite(sigma).all(axis=1))
        return forward(robot, data.readings), known
    ratio = sigma / np.array(robot.program.sigma)
    if np.isfinite(ratio).all() and np.ptp(ratio, axis=1).max() <= SAME_RATIO * ratio.min():
        solution = forward(robot, data.readings)
        if solution.converged.all():
            return solution, np.ones(data.n_poses, dtype=bool)
    # also readings that contradict each other by more than forward kinematics accept
    located = fit_poses(robot, data)
    return located.solution, located.is_determined


class PoseFit(NamedTuple):
    """Poses of a robot where readings and rows fit best.

    Attributes
    ----------
    solution : of n poses. is_determined : (n,) poses that the data determine.
    absorbed : (n,) number of residuals of rows that each pose takes up, which are its unknowns less
        its recorded uncertain readings; poses that rows link are counted at the first of them.
    left : (n,) number of residuals of its linked poses that are left.
    reading_residuals : (n, actuators) true minus recorded readings in units of their sigma, zero
        where exact or not taken.
    """

    solution: Solution
    is_determined: BoolArray
    absorbed: IntArray
    left: IntArray
    reading_residuals: FloatArray


def fit_poses(
    robot: Mechanism, data: Measurements, nuisance: NuisanceParameters | None = None
) -> PoseFit:
    """Return the poses where uncertain readings and all rows fit best at this geometry.

    Parameters
    ----------
    data : with at least one uncertain reading. nuisance : with fixed values; those without are
        fitted as well. None leaves the rows out: readings alone locate the poses.

    Raises
    ------
    DataError
        A redundant reading is stated to be exact.
    """
    data, nothing = fill_in_reading_sigma(robot, data), np.zeros(0)
    if nuisance is None:
        data = replace(data, observations=())
        nuisance = NuisanceParameters(ParameterTable(()), ())
    free = FreeParameters(robot, nothing.astype(np.int64), nothing, nothing, nothing.astype(bool))
    problem, z = problem_of(free, data, nuisance), np.zeros((1, 0))
    fitted = problem.solve(z, problem.start(z))
    estimates = fitted.estimates
    assert estimates is not None
    assert problem.member is not None
    states, member = estimates.states, problem.member
    assert data.reading_sigma is not None
    uncertain = (np.isfinite(data.reading_sigma) & (data.reading_sigma > 0.0)).sum(axis=1)
    first = np.unique(member, return_index=True)[1]
    absorbed = np.zeros(data.n_poses, dtype=np.int64)
    absorbed[first] = np.maximum(estimates.rank[0] - np.bincount(member, uncertain), 0)
    return PoseFit(
        make_solution(robot, states.state, states.q[0]),
        ~estimates.is_undetermined[0],
        absorbed,
        (problem.component_count[0] - estimates.rank[0])[member],
        problem.residuals(z, fitted)[-1].whitened[0],
    )
