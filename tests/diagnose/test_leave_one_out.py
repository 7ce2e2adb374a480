# SPDX-License-Identifier: Apache-2.0
"""Leave-one-out scores of many methods from one linearization equal those of refits of the linear
problem.
"""

import numpy as np
import pytest

from loopcal.diagnose.cross_validation import score_leave_one_out
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.estimate.identification import identify
from loopcal.estimate.penalties import MAP, LeastSquares, Ridge, TruncatedSVD
from loopcal.estimate.problem import problem_of
from tests.estimate.problems import hexapod, hexapod_data, tracker

DATA = hexapod_data(14, instrument=tracker(20e-6, 100e-6))


@pytest.mark.parametrize("method", [LeastSquares(), MAP(), Ridge(30.0)])
def test_leave_one_out_scores_equal_those_of_linear_refits(method):
    result = score_leave_one_out(hexapod(), DATA, (method,))
    problem = problem_of(select_free_parameters(hexapod()), DATA)
    at = problem.linearize(np.zeros((1, 42)), problem.start())
    parts = [part for block in problem.leverage_rows(at) for part in block]
    A = np.concatenate([part.rows.reshape(-1, 43) for part in parts])
    lam = {LeastSquares(): 0.0, MAP(): 1.0, Ridge(30.0): 30.0}[method]
    total = 0.0
    for j in range(14):
        held, own = np.delete(A, np.s_[6 * j : 6 * j + 6], axis=0), A[6 * j : 6 * j + 6]
        held = np.concatenate([held, np.sqrt(lam) * np.eye(42, 43)])
        z = np.linalg.lstsq(held[:, :-1], -held[:, -1], rcond=None)[0]
        total += ((own[:, :-1] @ z + own[:, -1]) ** 2).sum()
    assert result.score[0] == pytest.approx(total / 84, rel=1e-8)


def test_regularization_path_runs_from_nominal_to_least_squares():
    fit = identify(hexapod(), DATA)
    ridges = (Ridge(float(lam)) for lam in np.logspace(-8.0, 4.0, 40))
    methods = (*ridges, *(TruncatedSVD(k) for k in range(43)))
    result = score_leave_one_out(fit.robot, DATA, methods)
    assert len(result.score) == 40 + 43
    assert result.dof[40] == 0.0
    assert result.dof[-1] == pytest.approx(42.0)
    np.testing.assert_allclose(result.estimate[40], fit.nominal, rtol=0, atol=1e-15)
    whole = identify(hexapod(), DATA, LeastSquares())
    assert (
        np.abs((result.estimate[-1] - whole.estimate) / whole.standard_deviations).max() < 0.1
    )  # one linearization at another point
    inside = result.score.min()
    assert inside < min(result.score[0], result.score[39], result.score[40], result.score[-1])
    assert isinstance(result.best, Ridge | TruncatedSVD)
