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
    (score,), _, blocks = score_leave_one_out(hexapod(), DATA, (method,))
    assert blocks == 14
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
    assert score == pytest.approx(total / 84, rel=1e-8)


def test_best_regularization_lies_between_nominal_and_least_squares():
    fit = identify(hexapod(), DATA)
    ridges = (Ridge(float(lam)) for lam in np.logspace(-8.0, 4.0, 40))
    methods = (*ridges, *(TruncatedSVD(k) for k in range(43)), LeastSquares())
    score, error, _ = score_leave_one_out(fit.robot, DATA, methods)
    assert score.shape == error.shape == (40 + 43 + 1,)
    assert score[0] == pytest.approx(score[-1], rel=1e-4)  # the smallest lam still shrinks
    assert score[-2] == pytest.approx(score[-1], rel=1e-9)
    assert score.min() < min(score[0], score[39], score[40], score[-1])
