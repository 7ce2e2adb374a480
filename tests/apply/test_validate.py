# SPDX-License-Identifier: Apache-2.0
"""Validation: error indices, predicted and commanded errors, moved setups, and quality gates."""

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from loopcal.apply.validation import ErrorChange, NoiseKnowledge, validate
from loopcal.diagnose.conventions.convention_check import find_moved_setups
from loopcal.diagnose.row_errors import METRICS, Metric, compute_noise_floor, compute_row_errors
from loopcal.errors import DataError
from loopcal.estimate.identification import identify
from loopcal.io.core.text_file import to_json
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds import KINDS
from loopcal.measure.kinds.poses import Pose
from loopcal.measure.kinds.position import Position
from loopcal.measure.observations import Observations
from loopcal.measure.simulation import sample_truth, simulate
from loopcal.mechanism.workspace import sample_workspace
from loopcal.report.validation_view import view_error_statistics
from tests import zoo
from tests.estimate.problems import (
    UM,
    bed_points,
    hexapod,
    hexapod_data,
    simulate_heights,
    tracker,
    with_tolerance,
)

MM = 1e-3


def make_tracker_in_unknown_frame() -> Instrument:
    """Return an instrument of full poses in an unknown frame."""
    return Instrument(
        (Sensor(Pose(unknown=("frame",)), Gaussian(np.array([5e-6] * 3 + [1e-6] * 3))),)
    )


@pytest.fixture(scope="module")
def split_data():
    return hexapod_data(40).split(hold_out=0.25, seed=1)


@pytest.fixture(scope="module")
def validation(split_data):
    return validate(identify(hexapod(), split_data[0]), split_data[1])


def make_pose_rows(measured: np.ndarray) -> Observations:
    """Return rows of full poses (r, 6) whose residuals are given separately."""
    kind = Pose().with_tool(np.eye(4))
    return Observations.from_sigma(kind, np.arange(len(measured)), measured, UM)


def test_error_indices_equal_their_formulas():
    residual = np.array([[2e-3, 0.0, 0.0, 3.0 * MM, 0.0, -4.0 * MM]])
    errors = compute_row_errors([make_pose_rows(np.zeros((1, 6)))], [residual])
    assert errors.position[0] == pytest.approx(5 * MM)
    assert errors.orientation[0] == pytest.approx(2e-3)
    assert errors["position"].balance[0] == pytest.approx(7 * MM)
    assert errors["orientation"].balance[0] == pytest.approx(2e-3)


def test_unmeasured_quantities_have_no_error_index():
    measured = np.full((2, 6), np.nan)
    measured[0, 5] = 0.0
    errors = compute_row_errors([make_pose_rows(measured)], [np.full((2, 6), MM)])
    assert errors.position == pytest.approx([MM])
    assert errors["position"].measured == ("z",)
    assert np.isnan(errors["position"].balance).all()
    assert errors.statistics("position").count == 1
    assert errors.statistics("orientation").count == 0
    assert list(errors.quantities) == ["position"]


def test_position_errors_are_those_of_each_target():
    """One row with three targets has three position errors; the noise floor uses the same rows."""
    places = np.array([[0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, 0.1]])
    kind = Position(targets=("a", "b", "c"), places=places)
    rows = Observations.from_sigma(kind, np.arange(2), np.zeros((2, 9)), 2 * UM)
    residual = np.zeros((2, 9))
    residual[0] = 3 * MM, 0.0, 4 * MM, 0.0, MM, 0.0, 0.0, 0.0, 2 * MM
    errors = compute_row_errors([rows], [residual])
    assert errors.position == pytest.approx([5 * MM, 0.0, MM, 0.0, 2 * MM, 0.0], abs=1e-18)
    assert errors["position"].targets == ("a", "a", "b", "b", "c", "c")
    assert errors["position"].rows.tolist() == [0, 1] * 3
    floor = compute_noise_floor([rows])
    assert floor.rms["position"] == pytest.approx(2 * UM * np.sqrt(3.0))
    noise = np.random.default_rng(0).normal(size=(20000, 6, 3)) * 2 * UM
    largest = np.linalg.norm(noise, axis=2).max(axis=1)
    assert floor.metrics["max"]["position"] == pytest.approx(np.median(largest), rel=0.01)


def test_one_entry_adds_a_metric_to_results_json_and_tables(validation, monkeypatch):
    def compute_percentile(sizes):
        return float(np.quantile(sizes, 0.95))

    monkeypatch.setitem(METRICS, "p95", Metric("95 %", compute_percentile))
    expected = pytest.approx(np.quantile(validation.after.position, 0.95))
    assert validation.after.statistics("position").p95 == expected
    assert json.loads(to_json(validation))["after"]["position"]["p95"] == expected
    table: Any = view_error_statistics(validation)[0]
    titles = [column.title for column in table.columns]
    assert titles[-3:-1] == ["sd", "95 %"]


@pytest.mark.parametrize("kind_class", KINDS.values(), ids=list(KINDS))
def test_every_residual_of_a_kind_belongs_to_one_error(kind_class):
    for kind in kind_class.examples():
        groups = kind.error_groups
        columns = [i for group in groups for i in group.columns]
        assert sorted(columns) == list(range(len(kind.noise_columns)))
        assert all(len(group.columns) <= 3 for group in groups)
        length = kind.name in ("distance", "separation")
        assert all((group.quantity == "length") == length for group in groups)


def test_errors_of_held_out_poses_are_at_the_noise_after_calibration(validation):
    assert len(validation.poses) == 10
    assert validation.before.statistics("position").rms > 0.02 * MM
    # [m] sqrt(3) um of noise and as much of the fit
    assert validation.after.statistics("position").rms < 4e-6
    assert validation.changes()["position"].times > 10.0


def test_commanded_errors_of_a_hexapod_equal_predicted_errors(validation):
    assert validation.not_compensable.position.max() < 1e-12
    np.testing.assert_allclose(
        validation.commanded_after.position, validation.after.position, rtol=1e-9
    )
    np.testing.assert_allclose(
        validation.commanded_before.position, validation.before.position, rtol=1e-12
    )


TWO_JOINTS = """format: 1
family: stages
name: arm
units: {length: mm, angle: deg}
controlled: [x, y]
stages:
  - name: shoulder
    joint: {kind: R, start: 20, errors: [offset]}
  - name: elbow
    mount: {x: 300}
    joint: {kind: R, start: 60, tip: [250, 0, 0], errors: [x, offset]}
tolerances: {lengths: {sd: 0.5}, angles: {sd: 0.1}}
workspace: {x: [150, 350], y: [200, 400]}
"""


def test_positions_that_are_commanded_can_be_corrected_whatever_the_platform_turns(tmp_path):
    path = tmp_path / "arm.yaml"
    path.write_text(TWO_JOINTS)
    robot = load_robot(path)
    truth = robot.with_values(sample_truth(robot, 1, 3)[0])
    noise = Gaussian(np.full(3, 1e-6))
    poses = sample_workspace(robot, 12, seed=1).coordinates
    data = simulate(truth, poses, Instrument((Sensor(Position(), noise),)), 2)
    perfect = validate(truth, data)
    assert perfect.before.statistics("position").rms > 0.2 * MM
    # [m] the size of the arm is 0.5 m; orientation and position were traded off here
    assert perfect.not_compensable.position.max() < 1e-9


def test_errors_without_an_actuator_are_not_compensable():
    robot = with_tolerance(zoo.three_prs(), 0.1 * MM)
    rng = np.random.default_rng(0)
    truth = robot.with_values(robot.values + rng.uniform(-0.05, 0.05, len(robot.values)) * MM)
    poses = np.column_stack(
        [rng.uniform(0.65, 0.75, 30), rng.uniform(-3, 3, 30), rng.uniform(0.1, 0.3, 30)]
    )
    data = simulate(truth, poses, tracker(), 0)
    # perfect knowledge predicts the measured poses, and still cannot command x, y and torsion
    perfect = validate(truth, data, before=robot)
    assert perfect.after.statistics("position").rms < 2.5e-6  # [m] noise
    left = perfect.not_compensable.statistics("position").rms
    assert left > 5e-6
    assert perfect.commanded_after.statistics("position").rms == pytest.approx(left, rel=0.3)
    assert (
        perfect.commanded_after.statistics("position").rms
        < perfect.commanded_before.statistics("position").rms
    )


def test_exceeded_limit_fails_with_quantity_and_limit(split_data):
    fit = identify(hexapod(), split_data[0])
    assert validate(fit, split_data[1], limit_position=0.01 * MM, limit_angle=1e-4).passed
    failed = validate(hexapod(), split_data[1], limit_position=1e-7, limit_angle=1e-2)
    assert not failed.passed
    (failure,) = failed.failures
    assert failure.code == "conformity.fails"
    assert failure.data["quantity"] == "position"
    assert failure.data["limit"].value == pytest.approx(0.1)
    assert failure.data["limit"].unit == "um"


def test_limit_on_an_unmeasured_quantity_fails():
    robot = zoo.delta()
    result = validate(robot, simulate_heights(robot, bed_points(8)), limit_angle=1e-3)
    (failure,) = result.failures
    assert failure.code == "gates.limit-not-measured"
    assert failure.data == {"quantity": "orientation"}


def test_rows_of_weight_zero_are_left_out_and_no_rows_are_refused(split_data):
    weight = np.ones(split_data[1].n_poses)
    weight[0] = 0.0
    fewer = validate(hexapod(), split_data[1].with_weights(weight))
    assert len(fewer.poses) == split_data[1].n_poses - 1
    with pytest.raises(DataError) as error:
        validate(hexapod(), split_data[1].with_weights(0.0 * weight))
    assert error.value.code == "residuals.no-rows-to-predict"


def test_text_names_every_error_and_json_every_pose(validation):
    assert "noise floor" in str(validation)
    assert list(validation.errors()) == [
        "predicted before",
        "predicted after",
        "commanded before",
        "commanded after",
        "not compensable",
    ]
    document = json.loads(to_json(validation.to_dict()))
    assert document["passed"] is True
    assert len(document["after"]["position"]["rows"]) == len(document["poses"])


def test_diverged_geometry_and_unreachable_readings_have_different_errors():
    robot, data = hexapod(), hexapod_data(4)
    legs = np.array([name.endswith("length") for name in robot.parameters.names])
    diverged = robot.with_values(np.where(legs, 0.2, 1.0) * robot.values)
    with pytest.raises(DataError) as error:
        validate(diverged, data, before=robot)
    assert error.value.code == "residuals.calibrated-out-of-reach"
    assert error.value.args[0].data["before"] == 4
    with pytest.raises(DataError) as error:
        validate(robot, data, before=diverged)
    assert error.value.code == "residuals.before-out-of-reach"
    assert error.value.args[0].data["after"] == 4
    far = replace(data, readings=data.readings + np.array([10.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    with pytest.raises(DataError) as error:
        validate(robot, far)
    assert error.value.code == "residuals.poses-out-of-reach"


def make_error_size(*moved, base=1.0, by=50.0, left=30):
    """Return a function whose error stays large while one of `moved` is kept."""
    return lambda refit: (by if set(moved) - set(refit) else base, left)


def test_moved_setups_are_named():
    result = find_moved_setups(("trk", "tool", "probe"), make_error_size("trk", "probe"))
    assert result is not None
    assert result[0] == ("trk", "probe")
    assert result[1] == pytest.approx(50.0)
    # a shift of the frame is a shift of the target: refitting either is enough, so that neither
    # alone brings it back
    either = find_moved_setups(("trk", "tool"), lambda refit: (1.0 if refit else 50.0, 30))
    assert either is not None
    assert either[0] == ("trk", "tool")


def test_moved_setups_need_large_differing_errors_and_enough_rows():
    assert find_moved_setups((), make_error_size()) is None
    assert find_moved_setups(("trk",), make_error_size("trk", by=2.5, base=0.5)) is None
    assert find_moved_setups(("trk",), make_error_size("trk", by=50.0, base=20.0)) is None
    assert find_moved_setups(("trk",), make_error_size("trk", left=7)) is None


def test_setup_parameters_fitted_for_the_earlier_geometry_are_reported():
    instrument = make_tracker_in_unknown_frame()
    fit = identify(hexapod(), hexapod_data(20, 0, instrument))
    more = hexapod_data(8, 1, instrument)
    known = dict(fit.nuisance.values)
    before = "validation.setup-fitted-before"
    assert before in {f.code for f in validate(fit.robot, more, nuisance_values=known).findings}
    alike = validate(
        fit.robot, more, nuisance_values=known, nuisance_values_before=fit.nuisance.starts
    )
    assert before not in {f.code for f in alike.findings}
    own = validate(fit, more)
    np.testing.assert_allclose(alike.before.position, own.before.position, rtol=1e-9)


@pytest.mark.parametrize("degrees", [np.inf, np.nan, 8.0])
def test_noise_bounds_errors_also_where_sigma_is_exact(degrees: float) -> None:
    """NaN is an infinite number that was read from JSON."""
    noise = NoiseKnowledge(1.0, degrees)
    assert ErrorChange(1.0, 5.0, 1.0, 30, noise).has_grown
    assert ErrorChange(1.0, 1.2, 1.0, 30, noise).is_noise
