# SPDX-License-Identifier: Apache-2.0
"""Comparison of the start values with the fit, in units of the noise."""

import numpy as np
import pytest

from loopcal.diagnose.fit_examination import StartVerdict, check_start_values
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.estimate.identification import identify
from loopcal.estimate.losses import Huber, Tukey
from loopcal.estimate.options import FitOptions
from loopcal.estimate.prior import Prior
from loopcal.estimate.problem import problem_of
from tests import zoo
from tests.estimate.problems import hexapod, hexapod_data


def test_start_at_the_truth_is_within_noise_of_the_fit() -> None:
    truth = hexapod().with_values(zoo.hexapod_truth())
    result = check_start_values(identify(truth, hexapod_data()))
    assert result.verdict is StartVerdict.WITHIN_NOISE
    assert result.p_value > 1e-3
    # 180 equations, 42 parameters: the truth leaves 1 sigma, the fit sqrt(138 / 180) of it
    assert result.before == pytest.approx(1.0, abs=0.2)
    assert result.after == pytest.approx(np.sqrt(138 / 180), abs=0.2)


@pytest.mark.parametrize("noise", ["given", "estimated"])
def test_nominal_start_is_not_calibrated(noise) -> None:
    result = check_start_values(
        identify(hexapod(), hexapod_data(), options=FitOptions(noise=noise))
    )
    assert result.verdict is StartVerdict.NOT_CALIBRATED
    assert result.p_value < 1e-6
    assert result.before > 10 * result.after


def test_start_at_the_fit_is_the_best() -> None:
    first = identify(hexapod(), hexapod_data())
    assert check_start_values(identify(first.robot, hexapod_data())).verdict is StartVerdict.BEST


@pytest.mark.parametrize("loss", [Huber(), Tukey()])
def test_nominal_start_is_not_calibrated_with_a_robust_loss(loss) -> None:
    """Reweighting restarts from the last estimate; the verdict must use the given start."""
    fit = identify(hexapod(), hexapod_data(), loss=loss)
    assert check_start_values(fit).verdict is StartVerdict.NOT_CALIBRATED
    assert len(fit.history.cost) == fit.history.iterations + 1
    np.testing.assert_array_equal(
        fit.history.estimate[0], hexapod().values[hexapod().parameters.free]
    )
    best = identify(fit.robot, hexapod_data(), loss=loss)
    assert check_start_values(best).verdict is StartVerdict.BEST


@pytest.mark.parametrize("loss", [Huber(), Tukey()])
def test_history_of_a_robust_fit_continues_that_of_the_plain_fit(loss) -> None:
    """The first descent is unweighted, so its history equals that of a fit without a loss."""
    plain, fit = identify(hexapod(), hexapod_data()), identify(hexapod(), hexapod_data(), loss=loss)
    assert fit.history.iterations > plain.history.iterations
    assert len(fit.history.cost) == len(fit.history.estimate) == fit.history.iterations + 1
    np.testing.assert_array_equal(
        fit.history.estimate[: plain.history.iterations + 1], plain.history.estimate
    )
    np.testing.assert_array_equal(fit.history.estimate[-1], fit.estimate)


def test_start_cost_of_a_robust_fit_has_its_weights_and_the_prior() -> None:
    robot, data = hexapod(), hexapod_data()
    free = select_free_parameters(robot)
    spread = 0.1 * free.tolerance
    prior = Prior(free.names, zoo.hexapod_truth(), free.tolerance, np.diag(1.0 / spread))
    fit = identify(robot, data, loss=Huber(), options=FitOptions(prior=prior))
    assert fit.pose_weights.min() < 0.99
    start = free.deviation(robot.values[None])
    problem = problem_of(free, data).weighted(fit.pose_weights)
    cost = problem.linearize(start, problem.start(start)).cost[0]
    held = (((robot.values[free.places] - prior.mean) / spread) ** 2).sum()
    assert held > 100.0
    assert fit.history.cost[0] == pytest.approx(
        cost + held,
        rel=1e-11,  # poses are closed to 1e-13 of the size from other starts, 1e-8 sigma
    )
