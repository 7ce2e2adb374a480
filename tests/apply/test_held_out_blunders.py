# SPDX-License-Identifier: Apache-2.0
"""Held-out poses that do not fit: they are named with what explains them, and never dropped."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from loopcal.apply.calibration import calibrate
from loopcal.apply.calibration_options import CalibrationOptions
from loopcal.apply.calibration_report import Verdict
from loopcal.apply.validation import validate
from loopcal.diagnose.blunders import check_held_out_rows
from loopcal.estimate.fit_linearization import collect_uncertainty
from loopcal.estimate.identification import identify
from loopcal.findings import Quantity, report_finding
from loopcal.io.robot.robot_file import load_robot
from loopcal.io.runs.run_folder import load_run, save_run
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.poses import Pose
from loopcal.measure.kinds.position import Position
from loopcal.measure.measurements import Measurements
from loopcal.measure.simulation import sample_truth, simulate
from loopcal.mechanism.workspace import sample_workspace
from tests.estimate.problems import UM
from tests.findings.expectations import get_finding, list_codes

MM = 1e-3
PLACES = np.array([[0.1, 0.0, 0.0], [0.0, 0.12, 0.0], [-0.1, -0.1, 0.05]])
KIND = Position(targets=("a", "b", "c"), places=PLACES, unknown=("targets", "frame"), frame="trk")
TRACKER = Instrument((Sensor(KIND, Gaussian(np.full(9, 5 * UM))),))
WRONG = 3
"""Row of the held-out data that is changed."""


def simulate_hexapod(seed: int, instrument: Instrument, poses: int = 40) -> Measurements:
    """Return measurements of a hexapod with random errors of its geometry."""
    robot = load_robot("hexapod-42")
    truth = robot.with_values(sample_truth(robot, 1, seed)[0])
    return simulate(truth, sample_workspace(robot, poses, seed).coordinates, instrument, seed)


@pytest.fixture(scope="module")
def robot():
    return load_robot("hexapod-42")


@pytest.fixture(scope="module")
def data():
    return simulate_hexapod(5, TRACKER)


@pytest.fixture(scope="module")
def split(data):
    return data.split(hold_out=0.25, seed=1)


@pytest.fixture(scope="module")
def fit(robot, split):
    return identify(robot, split[0])


WRONG_VALUES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "targets swapped": lambda row: np.r_[row[3:6], row[:3], row[6:]],
    "targets in turn": lambda row: np.r_[row[3:], row[:3]],
    "m as mm": lambda row: 1e-3 * row,
    "coordinate moved": lambda row: row + 5 * MM * (np.arange(9) == 4),
    "target moved": lambda row: row + 5 * MM * (np.arange(9) // 3 == 1),
    "disturbed": lambda row: row + np.random.default_rng(0).normal(size=9) * 10 * MM,
}
"""What is wrong -> function of the right values (9,) of a row."""
SWAPPED = WRONG_VALUES["targets swapped"]


def change(
    data: Measurements, wrong: Callable[[np.ndarray], np.ndarray], row: int | list[int]
) -> Measurements:
    """Return measurements in which a row, or several, is a function of the right values."""
    rows = data.observations[0]
    measured = np.array(rows.measured)
    measured[row] = wrong(measured[row])
    return replace(data, observations=(replace(rows, measured=measured),))


@pytest.mark.parametrize(
    ("wrong", "explanation", "key", "value"),
    [
        ("targets swapped", "targets", "pairs", [("a", "b"), ("b", "a")]),
        ("targets in turn", "targets", "pairs", [("a", "c"), ("b", "a"), ("c", "b")]),
        ("m as mm", "unit", "factor", 1e3),
        ("coordinate moved", "column", "column", "b.y"),
        ("target moved", "target", "left_out", "b"),
        ("disturbed", "none", "left_out", ""),
    ],
)
def test_wrong_held_out_row_is_named_with_its_explanation(
    fit, split, wrong, explanation, key, value
):
    result = validate(fit, change(split[1], WRONG_VALUES[wrong], WRONG))
    (blunder,) = result.blunders
    assert blunder.poses == (split[1].labels[WRONG],)
    found = get_finding(result.findings, "validation.blunder")
    assert found.data["explanation"] == explanation
    stated = found.data[key]
    if key == "pairs":
        stated = [(pair["target"], pair["holds"]) for pair in stated]
    assert stated == value
    assert "validation.blunders-dominate" in list_codes(result.findings)
    # all statistics contain the row; those without it are stated beside them
    right = validate(fit, split[1])
    assert result.after.statistics("position").count == right.after.statistics("position").count
    assert result.without_blunders is not None
    without = result.without_blunders.after.statistics("position")
    assert without.count == right.after.statistics("position").count - 3
    kept = right.after.position[np.asarray(right.after["position"].rows) != WRONG]
    assert without.rms == pytest.approx(np.sqrt(np.mean(kept**2)), rel=1e-9)


def test_where_no_other_pose_is_left_no_error_without_them_is_stated():
    values = {"poses": ("1", "2"), "quantity": "length", "error": Quantity(0.2, "mm")}
    finding = report_finding("validation.blunders-dominate", without=None, **values)
    assert "without them the data contain no length error. Correct" in str(finding)


def test_interchanged_poses_are_both_named(fit, split):
    result = validate(fit, change(split[1], lambda rows: rows[::-1], [WRONG, WRONG + 2]))
    first, second = split[1].labels[WRONG], split[1].labels[WRONG + 2]
    findings = [f for f in result.findings if f.code == "validation.blunder"]
    assert {(f.data["poses"], f.data["other"]) for f in findings} == {
        ((first,), second),
        ((second,), first),
    }


def test_error_of_a_millimeter_is_found_by_the_calibrated_robot_in_a_run_folder(
    robot, data, split, tmp_path
):
    options = CalibrationOptions(held_out=split[1].labels)
    report = calibrate(robot, data, options)
    run = load_run(save_run(report, tmp_path / "run"))
    wrong = change(split[1], WRONG_VALUES["target moved"], WRONG)
    result = validate(
        run.robot,
        wrong,
        before=run.initial_robot,
        nuisance_values=run.nuisance_values,
        nuisance_values_before=run.initial_nuisance_values,
        uncertainty=run.load_uncertainty(),
    )
    of_fit = validate(report.identification, wrong)
    assert [b.poses for b in result.blunders] == [b.poses for b in of_fit.blunders]
    assert result.blunders[0].times == pytest.approx(of_fit.blunders[0].times, rel=1e-6)
    # without any knowledge of the uncertainty, noise and the other poses decide
    alone = validate(run.robot, wrong, nuisance_values=run.nuisance_values)
    assert alone.blunders[0].poses == (split[1].labels[WRONG],)


@pytest.mark.parametrize("instrument", ["tracker", "pose"])
@pytest.mark.parametrize("machines", [4, pytest.param(8, marks=pytest.mark.evidence)])
def test_predicted_distances_of_right_rows_have_the_chi_square_distribution(
    robot, instrument, machines
):
    """Mean of d^2 per degree of freedom is 1, which needs the uncertainty of machine, frame and
    targets together: with 12 fitted poses it is as large as the noise.
    """
    pose = Instrument((Sensor(Pose(unknown=("frame",)), Gaussian(np.full(6, 5 * UM))),))
    distance, degrees, noise_alone = 0.0, 0, 0.0
    for seed in range(machines):
        chosen = TRACKER if instrument == "tracker" else pose
        fitted, held_out = simulate_hexapod(seed, chosen, 18).split(hold_out=0.33, seed=seed)
        result = identify(robot, fitted)
        check = _check(result, held_out)
        alone = check.blocks.fit_without(np.ones(len(check.blocks.poses), dtype=bool))
        distance += alone.influence.distance.sum()
        degrees += int(alone.influence.degrees.sum())
        noise_alone += sum(float((group.rows[..., -1] ** 2).sum()) for group in check.blocks.groups)
    assert distance / degrees == pytest.approx(1.0, abs=5 * np.sqrt(2.0 / degrees))
    assert noise_alone / degrees > 1.2


def _check(fit, held_out):
    values = dict(fit.nuisance.values)
    kept = tuple(fit.nuisance.names)
    check = check_held_out_rows(
        fit.robot, held_out, values, frozenset(kept), collect_uncertainty(fit)
    )
    assert check is not None
    return check


@pytest.mark.parametrize("machines", [3, pytest.param(10, marks=pytest.mark.evidence)])
def test_right_rows_raise_no_alarm(robot, machines):
    for seed in range(machines):
        fitted, held_out = simulate_hexapod(seed, TRACKER, 20).split(hold_out=0.3, seed=seed)
        assert validate(identify(robot, fitted), held_out).blunders == ()


def test_new_session_is_checked_with_a_frame_of_its_own(fit, split):
    """Frames that the fit does not know are estimated with all held-out rows but the wrong one."""
    rows = split[1].observations[0]
    tuesday = replace(rows, session=np.array(["tuesday"] * len(rows)))
    held_out = replace(split[1], observations=(tuesday,))
    assert validate(fit, held_out).blunders == ()
    (blunder,) = validate(fit, change(held_out, SWAPPED, WRONG)).blunders
    assert (blunder.poses, blunder.explanation.what) == ((split[1].labels[WRONG],), "targets")


def test_single_held_out_pose_is_compared_with_the_fit_alone(fit, split):
    one = split[1].take([WRONG])
    assert validate(fit, one).blunders == ()
    (blunder,) = validate(fit, change(one, SWAPPED, 0)).blunders
    assert blunder.explanation.what == "targets"


def test_dominating_blunder_leaves_the_verdict_undecided_and_is_the_next_step(robot, data, split):
    row = data.labels.index(split[1].labels[WRONG])
    options = CalibrationOptions(held_out=split[1].labels)
    report = calibrate(robot, change(data, SWAPPED, row), options)
    assert report.verdict is Verdict.UNDECIDED
    assert report.top_findings[0].code == "validation.blunder"
    assert report.next_step.code == "workflow.next-check-held-out"
    assert report.next_step.data["poses"] == (f"pose {split[1].labels[WRONG]}",)
    assert "gates.errors-grew" not in list_codes(report.findings)


def test_lost_decimal_point_of_a_fitted_row_is_the_next_step_although_the_fit_fails(
    robot, data, split
):
    label = split[0].labels[3]
    wild = change(data, lambda values: values * 1e4, data.labels.index(label))
    report = calibrate(robot, wild, CalibrationOptions(held_out=split[1].labels))
    assert report.verdict is Verdict.NOT_CALIBRATED
    assert report.next_step.code == "workflow.next-check-outliers"
    assert report.next_step.data["poses"] == (f"pose {label}",)


def test_small_blunder_is_a_reservation_and_exceeded_limits_fail_with_it(robot, data, split):
    row = data.labels.index(split[1].labels[WRONG])
    wrong = change(data, lambda values: values + 50 * UM * (np.arange(9) == 0), row)
    options = CalibrationOptions(held_out=split[1].labels)
    assert calibrate(robot, wrong, options).verdict is Verdict.RESERVATIONS
    strict = calibrate(robot, wrong, replace(options, limit_position=30 * UM))
    assert (strict.verdict, strict.exit_code) == (Verdict.RESERVATIONS, 2)
    limit = get_finding(strict.findings, "conformity.fails")
    assert (limit.data["pose"], limit.data["target"]) == (split[1].labels[WRONG], "a")
    assert strict.next_step.code == "workflow.next-check-held-out"
