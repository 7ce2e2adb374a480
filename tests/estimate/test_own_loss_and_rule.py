# SPDX-License-Identifier: Apache-2.0
"""Losses and rules that a user writes: what they return is checked, and they are named. Intervals
of fits with a loss: the variance of an M-estimate, also where sigma is too small.
"""

import warnings

import numpy as np
import pytest

import loopcal as lc
from loopcal.estimate.fit_descent import compute_loss_variance
from loopcal.estimate.identification import identify
from loopcal.estimate.losses import Huber, Tukey
from loopcal.estimate.penalties import LeastSquares
from tests.estimate.test_machine_changes import ROBOTS, measure_delta
from tests.findings.expectations import list_codes


@pytest.fixture(scope="module")
def five_bar():
    robot = lc.load_robot("five-bar")
    truth = robot.with_values(lc.sample_truth(robot, 1, seed=5)[0])
    camera = lc.Instrument((lc.Sensor(lc.Component(("x", "y")), lc.Gaussian(np.full(2, 2e-5))),))
    return robot, lc.simulate(truth, lc.sample_workspace(robot, 20, 1).coordinates, camera, 2)


class Own:
    """A loss whose weights are the result of a function."""

    def __init__(self, function) -> None:
        self.function = function

    def weight(self, distance, degrees):
        return self.function(distance)


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda d: -d, "the loss Own returned the weight -.* must be finite and not negative"),
        (lambda d: d / 0.0 - d / 0.0, "the loss Own returned the weight nan"),
        (lambda d: 1.0, r"the loss Own returned weights of shape \(\) for 20 blocks"),
        (lambda d: d[1:], r"weights of shape \(19,\) for 20 blocks"),
    ],
)
def test_wrong_weights_of_an_own_loss_are_refused(five_bar, function, message) -> None:
    with np.errstate(all="ignore"), pytest.raises(lc.EstimationError, match=message):
        lc.identify(five_bar[0], five_bar[1], loss=Own(function))


def test_an_own_loss_without_repr_is_called_by_its_class(five_bar) -> None:
    fit = lc.identify(five_bar[0], five_bar[1], loss=Own(lambda d: 1.0 / np.maximum(d, 1.0)))
    (finding,) = (finding for finding in fit.findings if finding.code.endswith("-weights"))
    assert finding.data["loss"] == "Own"


@pytest.mark.parametrize("method", [lc.Ridge, lc.TruncatedSVD, lc.MAP])
@pytest.mark.parametrize("value", [[[1.0, 2.0]], [1.0, 2.0], np.nan, -1.0])
def test_a_wrong_result_of_an_own_rule_is_refused(five_bar, method, value) -> None:
    def choose(decomposition):
        return np.array(value)

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(lc.EstimationError, match=r"rule choose returned .* for 1 fits"):
            lc.identify(five_bar[0], five_bar[1], method(choose))


@pytest.mark.parametrize("method", [lc.Ridge, lc.MAP])
def test_one_number_of_an_own_rule_is_enough(five_bar, method) -> None:
    by_rule = lc.identify(five_bar[0], five_bar[1], method(lambda decomposition: 2.0))
    stated = lc.identify(five_bar[0], five_bar[1], method(2.0))
    # rounding: a rule is asked with the decomposition, a stated number needs none for its steps
    np.testing.assert_allclose(by_rule.estimate, stated.estimate, rtol=1e-12, atol=1e-14)


def fit_lines(loss, A: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return estimates (t, p) by reweighting single rows b (t, n), and the weights (t, n)."""
    weight, z = np.ones(b.shape), np.zeros((len(b), A.shape[1]))
    for _ in range(20):
        M = np.einsum("np,tn,nq->tpq", A, weight, A, optimize=True)
        z = np.linalg.solve(M, np.einsum("np,tn->tp", A, weight * b)[..., None])[..., 0]
        distance = np.abs(z @ A.T - b)
        weight = loss.weight(distance.ravel(), np.ones(b.size)).reshape(b.shape)
    return z, weight


@pytest.mark.parametrize("loss", [Huber(), Tukey()])
@pytest.mark.parametrize(("ratio", "tails"), [(1.0, "normal"), (1.3, "normal"), (1.0, "t3")])
def test_variance_is_that_of_the_true_errors(loss, ratio, tails) -> None:
    """200 independent fits of 60 rows: stated variance over the variance of the estimates."""
    rng, t, n = np.random.default_rng(5), 200, 60
    A = rng.normal(size=(n, 4))
    noise = rng.standard_normal((t, n)) if tails == "normal" else rng.standard_t(3, (t, n))
    z, weight = fit_lines(loss, A, ratio * noise)
    stated = []
    for trial in range(t):
        distance = np.abs(A @ z[trial] - ratio * noise[trial])
        variance, left = compute_loss_variance(loss, distance, np.ones(n), 4)
        assert left == n - 4
        covariance = np.linalg.inv(A.T @ (weight[trial][:, None] * A))
        stated.append(variance * np.diag(covariance))
    assert np.mean(stated) / np.mean(z**2) == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize("loss", [Huber(), Tukey()])
def test_intervals_allow_for_a_sigma_that_is_too_small(loss) -> None:
    delta = ROBOTS["linear-delta"]
    wrong, right = (identify(delta, measure_delta(delta, 3, ratio), LeastSquares(), loss=loss)
                    for ratio in (2.5, 1.0))  # fmt: skip
    assert "noise.loss-contradicted" in list_codes(wrong.findings)
    assert "noise.loss-contradicted" not in list_codes(right.findings)
    times = np.median(wrong.standard_deviations / right.standard_deviations)
    assert times == pytest.approx(2.5, rel=0.4)  # 20 poses, of which Tukey's loss drops some
    np.testing.assert_allclose(
        wrong.standard_deviations**2, (wrong.posterior.root**2).sum(axis=1), rtol=1e-9
    )
