# SPDX-License-Identifier: Apache-2.0
"""Cross-validation over observation blocks, and the choice of the simplest sufficient set of
parameters.
"""

from dataclasses import replace

import numpy as np
import pytest

from loopcal.apply.calibration import calibrate
from loopcal.apply.calibration_options import CalibrationOptions
from loopcal.diagnose.cross_validation import (
    Candidate,
    choose_model,
    cross_validate,
    draw_folds,
    nest_parameter_sets,
)
from loopcal.errors import DataError, EstimationError
from loopcal.estimate.descent import StepControl
from loopcal.estimate.identification import identify
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import LeastSquares
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.simulation import simulate
from tests import zoo
from tests.estimate.problems import UM, URAD, hexapod, hexapod_data, hexapod_poses, tracker


def simulate_length_errors(seed: int = 0):
    """Simulate a hexapod with errors of leg lengths only."""
    robot, truth = zoo.hexapod(), zoo.hexapod().values.copy()
    places = [i for i, name in enumerate(robot.parameters.names) if name.endswith("length")]
    truth[places] = zoo.hexapod_truth()[places]
    return simulate(robot.with_values(truth), hexapod_poses(30, seed), tracker(), seed)


def test_folds_hold_out_every_pose_once_and_keep_blocks_together():
    data = replace(hexapod_data(30), block=np.arange(30) // 3)
    parts = draw_folds(data, 5, 1)
    assert sorted(np.concatenate(parts)) == list(range(30))
    assert {len(part) for part in parts} == {6}
    for part in parts:
        assert len(np.unique(data.block[part])) == 2
    assert all(np.array_equal(a, b) for a, b in zip(parts, draw_folds(data, 5, 1), strict=True))
    with pytest.raises(DataError, match="11 folds of 10 blocks"):
        draw_folds(data, 11, 1)


def test_held_out_poses_are_predicted_to_the_noise_and_worse_than_fitted_ones():
    data = hexapod_data(40)
    result = cross_validate(hexapod(), data, LeastSquares())
    assert sorted(result.poses, key=int) == list(data.labels)
    fit = identify(hexapod(), data, LeastSquares())
    fitted = fit.chi_square / 240
    assert fitted < 1.0 < result.score < 2.0  # 42 parameters from 192 equations add about a quarter
    assert result.improvement() > 10.0
    assert result.converged
    assert (result.before_fold > 100.0).all()


def test_machine_with_length_errors_alone_needs_lengths_alone():
    result = choose_model(hexapod(), simulate_length_errors(), method=LeastSquares())
    assert [c.name for c in result.candidates] == ["nothing", "lengths", "ideal"]
    assert result.chosen.name == "lengths"
    assert len(result.chosen.parameters) == 6
    assert result.finding.code == "model.simpler-suffices"
    assert result.finding.data["parameters"] == 6
    assert int(result.robot.parameters.free.sum()) == 6
    assert "nothing" in str(result)


def measure_perfect_machine():
    """Measure a machine without errors by a poor instrument."""
    return simulate(zoo.hexapod(), hexapod_poses(30), tracker(100 * UM, 500 * URAD), 1)


@pytest.mark.parametrize(
    ("data", "method", "chosen", "code"),
    [
        (lambda: hexapod_data(30), None, "ideal", "model.all-needed"),
        (measure_perfect_machine, LeastSquares(), "nothing", "model.nothing-gained"),
    ],
)
def test_all_parameters_or_none_are_chosen_where_the_machine_needs_them(data, method, chosen, code):
    result = choose_model(hexapod(), data(), method=method)
    assert (result.chosen.name, result.finding.code) == (chosen, code)


def shift_pose(data, place: int, by: object):
    """Return the data with one wrong row."""
    (rows,) = data.observations
    measured = rows.measured.copy()
    measured[place] += by
    return replace(data, observations=(replace(rows, measured=measured),))


def test_nested_parameter_sets_of_the_3_prs():
    robot = load_robot("3-prs")
    assert list(nest_parameter_sets(robot)) == ["offsets", "lengths", "ideal", "complete"]
    sets = nest_parameter_sets(robot)
    assert sets["offsets"] == ("q1", "q2", "q3")
    assert set(sets["lengths"]) == {"q1", "q2", "q3", "l1", "l2", "l3"}
    assert len(sets["complete"]) == 33


def test_parameter_sets_that_are_not_nested_are_refused():
    with pytest.raises(EstimationError, match="'a' is not within 'b'"):
        choose_model(
            hexapod(), hexapod_data(30), {"a": ["leg1.length"], "b": ["leg2.length", "leg3.length"]}
        )


def test_excluded_poses_are_neither_fitted_nor_predicted():
    data = hexapod_data(30)
    wrong = shift_pose(data, 4, 0.1)  # [rad], [m]
    options = FitOptions(method=LeastSquares(), excluded_poses=("5",))
    result = cross_validate(hexapod(), wrong, options=options)
    assert "5" not in result.poses
    same = cross_validate(hexapod(), data, options=options)
    np.testing.assert_allclose(result.fold, same.fold, rtol=1e-9)


def test_nuisance_parameters_of_all_rows_are_refused_in_folds():
    data = hexapod_data(30)
    options = FitOptions(nuisance=data.nuisance_parameters)
    with pytest.raises(EstimationError, match="does not support the option nuisance"):
        cross_validate(hexapod(), data, options=options)


def test_first_fit_that_does_not_converge_ends_a_comparison():
    options = FitOptions(method=LeastSquares(), control=StepControl(iterations=1))
    folds = []
    with pytest.raises(EstimationError, match="leaves out fold 1 of 5 did not converge") as refusal:
        cross_validate(
            hexapod(),
            hexapod_data(30),
            options=options,
            must_converge=True,
            progress=lambda done, *_: folds.append(done),
        )
    assert refusal.value.code == "model.fold-not-converged"
    assert folds == [0]
    choice = choose_model(hexapod(), hexapod_data(30), options=options)
    assert choice.finding.data["not_compared"] == ("lengths", "ideal")
    assert "skipped the sets lengths and ideal. With one fold" in str(choice.finding)


def test_parameters_are_not_chosen_by_rows_that_are_far_off():
    data = hexapod_data(30)
    wrong = shift_pose(data, 4, [0.0] * 3 + [1000.0] * 3)
    with pytest.raises(DataError, match=r"Pose 5 is far off the others and alone would decide"):
        calibrate(hexapod(), wrong, CalibrationOptions(choose_model=True))


def test_a_standard_error_is_not_called_plus_minus_which_is_an_interval_of_95_percent() -> None:
    titles = {field.name: field.title for field in Candidate.FIELDS}
    assert titles["standard_error"] == "standard error"
