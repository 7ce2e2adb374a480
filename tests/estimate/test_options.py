# SPDX-License-Identifier: Apache-2.0
"""Invalid options, arguments and rows are refused with the allowed values."""

from dataclasses import replace

import numpy as np
import pytest

import loopcal as lc
from loopcal.errors import DataError, EstimationError
from loopcal.estimate.descent import StepControl
from loopcal.estimate.identification import identify, identify_trials
from loopcal.estimate.losses import Huber
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import MAP, LeastSquares, TruncatedSVD
from loopcal.estimate.recalibration import recalibrate
from loopcal.measure.simulation import sample_truth, simulate_trials
from tests.estimate.problems import hexapod, hexapod_data, hexapod_poses, tracker
from tests.findings.expectations import expect_refusal, get_finding


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("relative", 0.0),
        ("relative", np.nan),
        ("absolute", -1.0),
        ("absolute", np.inf),
        ("iterations", -1),
        ("damping", -1.0),
    ],
)
def test_invalid_step_control_is_refused(name, value) -> None:
    with pytest.raises(EstimationError, match=name):
        StepControl(**{name: value})


def test_truncation_rank_that_is_not_an_integer_is_refused() -> None:
    with pytest.raises(EstimationError, match="integer"):
        TruncatedSVD(2.5)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("method", ["ls", LeastSquares])
def test_method_that_is_not_an_instance_is_refused(method) -> None:
    with pytest.raises(EstimationError, match=r"LeastSquares\(\)"):
        identify(hexapod(), hexapod_data(), method)


@pytest.mark.parametrize("tolerance", [0.0, 1.0, np.nan])
def test_rank_tolerance_outside_zero_and_one_is_refused(tolerance) -> None:
    with pytest.raises(EstimationError, match="above 0 and below 1"):
        identify(hexapod(), hexapod_data(), options=FitOptions(rank_tolerance=tolerance))


@pytest.mark.filterwarnings("error")
def test_huge_measured_value_is_refused_with_its_pose() -> None:
    data = hexapod_data()
    (pose,) = data.observations
    values = pose.measured.copy()
    values[3, 5] = 1e300
    with expect_refusal("fit.residuals-not-finite", poses=(data.labels[3],)):
        identify(hexapod(), replace(data, observations=(replace(pose, measured=values),)))


def test_directions_determined_by_tolerances_alone_are_counted() -> None:
    fit = identify(hexapod(), hexapod_data(5))
    few = get_finding(fit.findings, "fit.few-equations")
    assert few.data == {"equations": 30, "parameters": 42, "directions": 12}


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"noise": "guessed"}, "'given', 'estimated'"),
        ({"begin": "anywhere"}, "'kinematics', 'closure'"),
        ({"loss": Huber}, r"Huber\(\) or Tukey\(\)"),
        ({"rank_tolerance": 2.0}, "above 0 and below 1"),
    ],
)
def test_options_are_checked_on_construction(given, words) -> None:
    with pytest.raises(EstimationError, match=words):
        FitOptions(**given)


def test_repr_of_options_shows_changed_values_and_options_copy_arrays() -> None:
    start = np.zeros(3)
    options = FitOptions(LeastSquares(), noise="estimated", excluded_poses=["6"], start=start)
    start[0] = 1.0
    assert repr(options) == (
        "FitOptions(method=LeastSquares(), noise='estimated', start=array([0., 0., 0.]), "
        "excluded_poses=('6',))"
    )
    assert np.array_equal(np.asarray(options.start), np.zeros(3))
    assert repr(FitOptions()) == "FitOptions()"


def test_method_and_loss_override_the_options() -> None:
    data, options = hexapod_data(), FitOptions(method=MAP(), loss=Huber(), noise="estimated")
    fit = identify(hexapod(), data, LeastSquares(), options=options)
    assert fit.method == LeastSquares()
    assert fit.options.loss == Huber()
    assert fit.options.noise == "estimated"
    assert options.method == MAP()
    with pytest.raises(DataError, match="Give FitOptions"):
        lc.identify(hexapod(), data, options={"noise": "given"})  # pyright: ignore[reportArgumentType]


def test_wrong_argument_type_is_refused_with_the_expected_type() -> None:
    with pytest.raises(DataError, match=r"robot: got the text 'hexapod-42'\. .*load_robot"):
        lc.identify("hexapod-42", hexapod_data())  # pyright: ignore[reportArgumentType]
    with pytest.raises(DataError, match=r"data: got the text 'a.csv'\. .*load_measurements"):
        lc.identify(hexapod(), "a.csv")  # pyright: ignore[reportArgumentType]
    with pytest.raises(DataError, match=r"trials: got a Measurements\. Give Trials"):
        lc.identify_trials(hexapod(), hexapod_data())  # pyright: ignore[reportArgumentType]
    with pytest.raises(DataError, match=r"prior: got the text 'run'\. .*prior_from"):
        FitOptions(prior="run")  # pyright: ignore[reportArgumentType]
    with pytest.raises(DataError, match=r"sequence of labels, such as \['12'\]"):
        FitOptions(excluded_poses="12")


def test_unsupported_options_of_trials_and_recalibration_are_refused() -> None:
    robot = hexapod()
    trials = simulate_trials(robot, sample_truth(robot, 2, 1), hexapod_poses(15), tracker(), 2)
    with pytest.raises(EstimationError, match="does not support the option loss"):
        identify_trials(robot, trials, options=FitOptions(loss=Huber()))
    fit = identify(robot, hexapod_data(), LeastSquares())
    with pytest.raises(EstimationError, match="uses LeastSquares"):
        recalibrate(robot, hexapod_data(), fit.posterior, options=FitOptions(method=MAP()))
    with pytest.raises(EstimationError, match="takes no loss"):
        recalibrate(robot, hexapod_data(), fit.posterior, options=FitOptions(loss=Huber()))


def test_results_have_short_representations() -> None:
    fit = identify(hexapod(), hexapod_data(), LeastSquares())
    for shown in (fit, fit.posterior, fit.history, fit.residuals[0], fit.free_parameters):
        assert len(repr(shown)) < 600
    assert "fit.converged" not in repr(fit)
    assert "noise.consistent" in repr(fit)
    (row,) = (line for line in str(fit).splitlines() if line.startswith("leg1.length"))
    assert row.endswith(" mm")
