# SPDX-License-Identifier: Apache-2.0
"""Find other orders of the actuators that explain data of a redundant robot as well as the stated
one, which explains them: the data cannot show which is true.
"""

from __future__ import annotations

import numpy as np

from loopcal.diagnose.conventions.interpretations.interpretation import Interpretation
from loopcal.diagnose.conventions.interpretations.reading_interpretations import (
    list_reading_interpretations,
)
from loopcal.diagnose.conventions.judgement import judge_data
from loopcal.diagnose.conventions.misfit import ALLOWED, is_redundant
from loopcal.diagnose.conventions.refinement import refine_misfit
from loopcal.diagnose.conventions.selection import FEWEST_POSES
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.measure import Measurements
from loopcal.typing import IntArray

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


def select_measured(data: Measurements) -> IntArray:
    """Return the measured poses, and others spread over the data up to `FEWEST_POSES`."""
    measured = np.unique(np.concatenate([o.rows.ravel() for o in data.observations] or [[]]))
    others = np.setdiff1d(np.arange(data.n_poses), measured)
    missing = max(FEWEST_POSES - len(measured), 0) if len(others) else 0
    spread = np.linspace(0, len(others) - 1, missing)
    return np.union1d(measured, others[np.unique(spread.astype(np.intp))]).astype(np.intp)
