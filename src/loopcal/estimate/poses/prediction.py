# SPDX-License-Identifier: Apache-2.0
"""Poses that a geometry predicts from readings, as far as each reading is believed.

With as many actuators as freedoms a pose needs all its readings, and their sigmas do not move it.
Redundant readings contradict each other: the pose is where they fit best in units of their own
sigma, and a reading that was not taken may not be needed at all. See
docs/theory/uncertain-readings.md.
"""

from __future__ import annotations

import numpy as np

from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.problem_construction import make_problem
from loopcal.measure import Measurements, NuisanceParameters, fill_in_reading_sigma
from loopcal.mechanism import Mechanism, Solution, forward, make_solution
from loopcal.parameters import ParameterTable
from loopcal.typing import BoolArray

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
    sigma = data.reading_sigma
    if robot.program.sigma is None or sigma is None:
        known = np.ones(data.n_poses, dtype=bool)
        if sigma is not None:
            known = np.asarray(np.isfinite(sigma).all(axis=1))
        return forward(robot, data.readings), known
    ratio = sigma / np.array(robot.program.sigma)
    if np.isfinite(ratio).all() and np.ptp(ratio, axis=1).max() <= SAME_RATIO * ratio.min():
        return forward(robot, data.readings), np.ones(data.n_poses, dtype=bool)
    return _fit_readings(robot, fill_in_reading_sigma(robot, data))


def _fit_readings(robot: Mechanism, data: Measurements) -> tuple[Solution, BoolArray]:
    """Return poses where redundant readings fit best by their sigmas, and which are determined."""
    nothing = np.zeros(0)
    fixed = FreeParameters(robot, nothing.astype(np.int64), nothing, nothing, nothing.astype(bool))
    no_nuisance = NuisanceParameters(ParameterTable(()), ())
    problem = make_problem(
        fixed, data.readings[None], data.reading_sigma, (), 1, no_nuisance, lambda _: data
    )
    z = np.zeros((1, 0))
    estimates = problem.solve(z, problem.start(z)).estimates
    assert estimates is not None
    solution = make_solution(robot, estimates.states.state, estimates.states.q[0])
    return solution, ~estimates.is_undetermined[0]
