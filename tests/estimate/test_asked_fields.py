# SPDX-License-Identifier: Apache-2.0
"""A fit computes what it is asked for, once, whatever was asked before."""

import copy
import dataclasses

import numpy as np
import pytest

import loopcal as lc
from loopcal.estimate import fit_analysis, free_parameters

UM = 1e-6
FIELDS = tuple(field.name for field in dataclasses.fields(lc.Identification))


def measure(n: int = 12, kind: lc.Kind | None = None, times: float = 1.0, **changes):
    """Return a hexapod and simulated measurements of one whose errors are so many times those that
    its spreads let expect.
    """
    robot = lc.load_robot("hexapod-42")
    rng = np.random.default_rng(3)
    ranges = np.array([robot.assembly.workspace[name] for name in robot.controlled])
    poses = rng.uniform(ranges[:, 0], ranges[:, 1], (n, 6))
    drawn = lc.sample_truth(robot, 1, 3)[0]
    truth = robot.with_values(robot.values + times * (drawn - robot.values))
    noise = lc.Gaussian(np.array([5 * UM] * 3 + [UM] * 3))
    data = lc.simulate(truth, poses, lc.Instrument((lc.Sensor(kind or lc.Pose(), noise),)), 3)
    return robot, dataclasses.replace(data, **changes)


def fit_least_squares():
    robot, data = measure()
    return lc.identify(robot, data, lc.LeastSquares())


def fit_with_inflated_tolerances():
    robot, data = measure(times=10.0)
    return lc.identify(robot, data)


def fit_unknown_frame():
    robot, data = measure(kind=lc.Pose(unknown=("frame",), frame="tracker"))
    return lc.identify(robot, data)


def fit_uncertain_readings():
    robot, data = measure(reading_sigma=2 * UM)
    return lc.identify(robot, data)


def fit_with_loss():
    robot, data = measure()
    return lc.identify(robot, data, loss=lc.Huber())


FITS = (
    fit_least_squares,
    fit_with_inflated_tolerances,
    fit_unknown_frame,
    fit_uncertain_readings,
    fit_with_loss,
)


@pytest.mark.parametrize("fit", FITS)
def test_no_result_depends_on_the_order_of_asking(fit):
    first = fit()
    expected, arrays = repr(first.to_dict()), first.arrays()
    for order in (FIELDS, FIELDS[::-1], tuple(np.random.default_rng(0).permutation(FIELDS))):
        other = fit()
        for name in order:
            getattr(other, name)
        assert repr(other.to_dict()) == expected
        found = other.arrays()
        assert found.keys() == arrays.keys()
        for name, array in arrays.items():
            np.testing.assert_array_equal(found[name], array, err_msg=name)


@pytest.mark.parametrize("make", FITS[:2])
def test_a_field_is_computed_when_asked_for_and_once(monkeypatch, make):
    asked = []

    def count(module, name):
        computed = getattr(module, name)
        monkeypatch.setattr(
            module, name, lambda *a, **k: (asked.append(name), computed(*a, **k))[1]
        )

    for name in ("label_residuals", "describe_frames", "report_noise"):
        count(fit_analysis, name)
    count(free_parameters, "describe_null_space")
    fit = make()
    assert fit.converged
    assert np.isfinite(fit.estimate).all()
    assert np.isfinite(fit.covariance).all()
    assert np.isfinite(fit.interval()).all() or asked  # its degrees are those of the posterior
    assert "label_residuals" not in asked
    assert "report_noise" not in asked
    for _ in range(2):
        assert fit.residuals[0].kind == "pose"
        assert fit.findings
        assert fit.unidentifiable == ()
    assert sorted(asked) == sorted(set(asked))
    assert {"label_residuals", "describe_null_space", "report_noise"} <= set(asked)


def test_a_fit_stays_frozen():
    fit = fit_least_squares()
    with pytest.raises(dataclasses.FrozenInstanceError):
        setattr(fit, "findings", ())  # noqa: B010


def test_a_changed_copy_keeps_all_that_was_not_changed():
    fit, other = fit_least_squares(), fit_least_squares()
    changed = dataclasses.replace(fit, findings=())
    assert changed.findings == ()
    np.testing.assert_array_equal(changed.posterior.directions, other.posterior.directions)


def test_a_copy_holds_what_was_not_asked_for():
    copied = copy.deepcopy(fit_least_squares())  # by the state that a pickle has, too
    assert repr(copied.to_dict()) == repr(fit_least_squares().to_dict())


def test_tolerances_of_the_inflated_fit_are_contradicted():
    assert "prior.inflation" in {
        finding.code for finding in fit_with_inflated_tolerances().findings
    }
