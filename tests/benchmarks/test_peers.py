# SPDX-License-Identifier: Apache-2.0
"""The programs by hand, beside which loopcal is timed, find the same estimates."""

import numpy as np
import pytest

from benchmarks.peers.__main__ import SAME_ROWS, make_cases
from loopcal.estimate.descent import StepControl
from loopcal.estimate.identification import identify
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import LeastSquares


def test_a_stricter_end_of_the_iteration_is_not_further_from_the_solution():
    """Rounding of poses changes the sum of squares by 1e-11 of itself, more than the last step."""
    case = make_cases()["hexapod"]
    exact, _ = case.by_hand["same cost"](case.start, case.unit, case.rows)
    for relative in (1e-6, 1e-8, 1e-10, 1e-12):
        options = FitOptions(control=StepControl(relative=relative))
        fit = identify(case.robot, case.data, LeastSquares(), options=options)
        assert (np.abs(fit.estimate - exact) <= case.rounding * fit.standard_deviations).all()


@pytest.mark.parametrize("key", ["hexapod", "delta"])
def test_programs_by_hand_find_the_estimate_of_loopcal(key):
    case = make_cases()[key]
    exact = FitOptions(control=StepControl(relative=1e-10))
    fit = identify(case.robot, case.data, LeastSquares(), options=exact)
    for name, run in case.by_hand.items():
        estimate, covariance = run(case.start, case.unit, case.rows)
        limit = case.rounding if name == "same cost" else SAME_ROWS
        assert (np.abs(estimate - fit.estimate) <= limit * fit.standard_deviations).all(), name
        own = fit.covariance / fit.residual_test.sigma_scale**2
        # lengths of legs are whitened at the nominal geometry, whose errors are a few percent
        assert covariance == pytest.approx(own, rel=0.05, abs=1e-3 * np.abs(own).max())
