# SPDX-License-Identifier: Apache-2.0
"""Find interpretations that explain data as well as the stated one, which explains them: the data
cannot show which is true.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from loopcal.diagnose.conventions.interpretations import Interpretation
from loopcal.diagnose.conventions.judgement import judge_data
from loopcal.diagnose.conventions.misfit import compute_quick_misfit, is_redundant
from loopcal.diagnose.conventions.reading_interpretations import list_reading_interpretations
from loopcal.diagnose.conventions.refinement import refine_misfit
from loopcal.diagnose.conventions.selection import ALLOWED, FEWEST_POSES
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.measure import Measurements
from loopcal.measure.kinds.rows import Column
from loopcal.typing import IntArray
from loopcal.units import Dimension

HEIGHT, SIGNIFICANT = (Column("z", Dimension.LENGTH),), 10.0
"""Columns of a height, and standard deviations of the noise from which its sign matters."""

MEASURED = 12
"""Number of measured residuals from which the order of a redundant robot's actuators is certain:
those of four positions, by which no machine of another order agrees with its redundant readings.
"""

ORDERS = ("swapped-readings", "reversed-readings", "permuted-readings")
"""Slips in the order of the actuators."""


def find_equal_orders(free: FreeParameters, data: Measurements) -> tuple[Interpretation, ...]:
    """Find other orders of the actuators that explain data of a redundant robot as well as the
    stated one, which explains them.

    Only data whose measured rows are few leave that open: poses are then known from the readings.
    """
    measured = sum(o.n_residuals for o in data.observations)
    if not is_redundant(free) or measured >= MEASURED:
        return ()
    few = data.take(select_measured(data))
    equal = []
    for interpretation in list_reading_interpretations(few, free.robot.actuators):
        if interpretation.slip in ORDERS:
            comparison = judge_data(free, interpretation.apply(few))
            if comparison is not None and refine_misfit(comparison)[0] <= ALLOWED:
                equal.append(interpretation)
    return tuple(equal)


def compute_opposite_misfit(free: FreeParameters, data: Measurements) -> float:
    """Return the misfit of data that consist of heights alone with the opposite sign of these; NaN
    for other data, and for heights within the noise.
    """
    if not data.observations or any(o.kind.columns != HEIGHT for o in data.observations):
        return float("nan")
    sizes = [np.nan_to_num(o.whitener[:, 0, 0] * o.measured[:, 0]) for o in data.observations]
    if not np.abs(np.concatenate(sizes)).max(initial=0.0) > SIGNIFICANT:
        return float("nan")
    opposite = tuple(replace(o, measured=-o.measured) for o in data.observations)
    return compute_quick_misfit(free, replace(data, observations=opposite))


def select_measured(data: Measurements) -> IntArray:
    """Return the measured poses, and others spread over the data up to `FEWEST_POSES`."""
    measured = np.unique(np.concatenate([o.rows.ravel() for o in data.observations] or [[]]))
    others = np.setdiff1d(np.arange(data.n_poses), measured)
    missing = max(FEWEST_POSES - len(measured), 0) if len(others) else 0
    spread = np.linspace(0, len(others) - 1, missing)
    return np.union1d(measured, others[np.unique(spread.astype(np.intp))]).astype(np.intp)
