# SPDX-License-Identifier: Apache-2.0
"""Losses and rules that a user writes: what they return is checked, and they are named."""

import warnings

import numpy as np
import pytest

import loopcal as lc


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
