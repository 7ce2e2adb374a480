# SPDX-License-Identifier: Apache-2.0
"""Leave-one-out scores of many methods from one linearization equal those of refits of the linear
problem.
"""

from dataclasses import replace

import numpy as np
import pytest

from loopcal.diagnose.cross_validation import score_leave_one_out
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.estimate.identification import identify
from loopcal.estimate.penalties import MAP, LeastSquares, Ridge, TruncatedSVD
from loopcal.estimate.problem import problem_of
from tests.estimate.problems import hexapod, hexapod_data, tracker

DATA = hexapod_data(14, instrument=tracker(20e-6, 100e-6))


@pytest.mark.parametrize("poses", [1, 8], ids="{}-poses-a-block".format)
@pytest.mark.parametrize("method", [LeastSquares(), MAP(), Ridge(30.0)])
def test_leave_one_out_scores_equal_those_of_linear_refits(method, poses):
    """Also where one of two blocks has half of the leverage of 42 parameters: every eigenvalue of
    1 - H is about a half then, and their product is below 1e-12.
    """
    n = 14 if poses == 1 else 2 * poses
    data = hexapod_data(n, instrument=tracker(20e-6, 100e-6))
    data = replace(data, block=np.arange(n) // poses)
    (score,), _, blocks = score_leave_one_out(hexapod(), data, (method,))
    assert blocks == n // poses
    problem = problem_of(select_free_parameters(hexapod()), data)
    at = problem.linearize(np.zeros((1, 42)), problem.start())
    parts = [part for block in problem.leverage_rows(at) for part in block]
    A, m = np.concatenate([part.rows.reshape(-1, 43) for part in parts]), 6 * poses
    lam = {LeastSquares(): 0.0, MAP(): 1.0, Ridge(30.0): 30.0}[method]
    total = 0.0
    for j in range(blocks):
        own, held = A[m * j : m * j + m], np.delete(A, np.s_[m * j : m * j + m], axis=0)
        held = np.concatenate([held, np.sqrt(lam) * np.eye(42, 43)])
        z = np.linalg.lstsq(held[:, :-1], -held[:, -1], rcond=None)[0]
        total += ((own[:, :-1] @ z + own[:, -1]) ** 2).sum()
    assert score == pytest.approx(total / (6 * n), rel=1e-8)


def test_a_block_that_alone_determines_a_parameter_cannot_be_left_out():
    """Seven poses have as many residuals as parameters, so each has the leverage 1."""
    data = hexapod_data(7, instrument=tracker(20e-6, 100e-6))
    (score, ridge), error, _ = score_leave_one_out(hexapod(), data, (LeastSquares(), Ridge(30.0)))
    assert np.isinf(score)
    assert np.isnan(error[0])
    assert np.isfinite([ridge, error[1]]).all()


def test_best_regularization_lies_between_nominal_and_least_squares():
    fit = identify(hexapod(), DATA)
    ridges = (Ridge(float(lam)) for lam in np.logspace(-8.0, 4.0, 40))
    methods = (*ridges, *(TruncatedSVD(k) for k in range(43)), LeastSquares())
    score, error, _ = score_leave_one_out(fit.robot, DATA, methods)
    assert score.shape == error.shape == (40 + 43 + 1,)
    assert score[0] == pytest.approx(score[-1], rel=1e-4)  # the smallest lam still shrinks
    assert score[-2] == pytest.approx(score[-1], rel=1e-9)
    assert score.min() < min(score[0], score[39], score[40], score[-1])
