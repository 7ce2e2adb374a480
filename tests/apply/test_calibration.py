# SPDX-License-Identifier: Apache-2.0
# pyright: reportArgumentType=false
# Wrong types are passed on purpose.
"""`calibrate`: verdict, findings, held-out poses, JSON document and refused options."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

import loopcal as lc
from loopcal.apply import calibration
from loopcal.apply.calibration import calibrate
from loopcal.apply.calibration_options import CalibrationOptions, split_data
from loopcal.apply.calibration_report import Verdict, choose_next_step, decide_verdict
from loopcal.apply.conformity import STATED
from loopcal.cli.entry_point import main
from loopcal.errors import DataError, EstimationError
from loopcal.estimate import fit_linearization
from loopcal.estimate.penalties import MAP
from loopcal.estimate.pose_rows import BLOCK, EXACT_BLOCK
from loopcal.findings import Quantity, Severity, report_finding
from loopcal.io.core.text_file import to_json
from loopcal.io.runs.run_folder import load_run, save_run
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.poses import Pose
from loopcal.measure.kinds.position import Position
from loopcal.measure.simulation import sample_truth, simulate
from loopcal.report.calibration_view import view_calibration
from loopcal.results.tables import render_text
from tests.estimate.problems import hexapod, hexapod_data

EXAMPLE = Path(__file__).parents[2] / "examples" / "hexapod-42" / "measurements.csv"
APPLY = "values.apply"
"""Recommendation of most calibrations."""


@pytest.fixture(scope="module")
def robot():
    return lc.load_robot("hexapod-42")


@pytest.fixture(scope="module")
def data(robot):
    return lc.load_measurements(EXAMPLE, robot)


@pytest.fixture(scope="module")
def report(robot, data):
    return calibrate(robot, data, CalibrationOptions(hold_out=0.25))


@pytest.fixture(scope="module")
def unvalidated(robot, data):
    """The report without held-out poses, and the steps of its progress."""
    steps = []
    report = calibrate(
        robot, data, progress=lambda done, total, what: steps.append((done, total, what))
    )
    return report, steps


def test_budget_is_computed_when_it_is_asked_for_and_the_fit_is_linearized_once(
    robot, data, monkeypatch
):
    budget = Mock(side_effect=calibration.compute_error_budget)
    linearized = Mock(side_effect=fit_linearization.problem_of)
    monkeypatch.setattr(calibration, "compute_error_budget", budget)
    monkeypatch.setattr(fit_linearization, "problem_of", linearized)
    found = calibrate(robot, data, CalibrationOptions(hold_out=0.25))
    assert budget.call_count == 0
    assert found.budget is found.budget
    assert budget.call_count == 1
    assert linearized.call_count == 1


def test_good_calibration_reaches_the_noise_floor_and_has_a_next_step(report):
    assert report.verdict is Verdict.CALIBRATED
    assert (report.exit_code, report.failures) == (0, ())
    assert report.next_step.code == "workflow.next-use-result"
    validation = report.validation
    assert validation is not None
    for quantity in ("position", "orientation"):
        floor = validation.noise_floor.rms[quantity]
        assert 0.7 * floor < validation.after.statistics(quantity).rms < 2.0 * floor
    assert report.robot is report.identification.robot
    assert report.fitted_errors is None


def test_text_and_repr_are_the_summary_of_the_command_on_one_screen(report):
    for text in (str(report), repr(report)):
        assert text == render_text(view_calibration(report), 1000)
        assert len(text.splitlines()) < 40  # of 42 parameters only those that moved most
        assert text.startswith("Calibrated: hexapod-42, 42 parameters from 30 poses.")


def test_json_document_contains_the_verdict_and_every_finding(report):
    document = json.loads(to_json(report.to_dict()))
    assert document["verdict"] == "calibrated"
    assert len(document["findings"]) == len(report.findings)
    assert all(set(f) == {"code", "severity", "data", "text"} for f in document["findings"])
    assert len(document["split"]["held_out"]) == 10
    assert document["passed"] is True
    assert json.loads(json.dumps(report.to_dict(), allow_nan=False)) == report.to_dict()


def test_parts_of_a_report_and_its_run_folder_print_on_a_screen(report, tmp_path):
    run = load_run(save_run(report, tmp_path / "run"))
    assert repr(run).endswith("run': hexapod-42, calibrated>")
    assert repr(report.validation) == str(report.validation)
    for value in (run, report.validation, report.examination, report.robot.parameters):
        assert len(repr(value)) < 800
        assert len(repr(value).splitlines()) < 20


def test_python_and_command_line_hold_out_the_same_poses(data, tmp_path, monkeypatch, capsys):
    """`--hold-out 0.25`, `hold_out=0.25` and `data.split(hold_out=0.25)` are the same sets."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(EXAMPLE, tmp_path / "data.csv")
    words = "calibrate hexapod-42 data.csv -o run --hold-out 0.25 --seed 3 --json"
    assert main(words.split()) == 0
    document = json.loads(capsys.readouterr().out)
    fitted, held_out = data.split(hold_out=0.25, seed=3)
    split = split_data(data, hold_out=0.25, seed=3)
    assert split.held_out is not None
    assert split.fitted.labels == fitted.labels
    assert split.held_out.labels == held_out.labels
    assert document["split"] == {"hold_out": 0.25, "seed": 3, "held_out": list(held_out.labels)}


def test_poses_can_be_held_out_by_name(data):
    split = split_data(data, held_out=("2", "7"))
    assert split.held_out is not None
    assert split.held_out.labels == ("2", "7")
    assert split.fitted.n_poses == data.n_poses - 2
    with pytest.raises(DataError, match="held_out names the pose '99'"):
        split_data(data, held_out=("99",))
    with pytest.raises(DataError, match="validation takes all poses of the data"):
        split_data(data, held_out=data.labels)


def test_without_held_out_poses_the_verdict_is_undecided(robot, data, unvalidated):
    report, _ = unvalidated
    assert report.verdict is Verdict.UNDECIDED
    assert report.exit_code == 0
    assert report.top_findings[0].code == "workflow.no-held-out-poses"
    assert report.next_step.code == "workflow.next-hold-out"
    few = calibrate(robot, data, CalibrationOptions(hold_out=0.1))
    assert (few.verdict, few.next_step.code) == (Verdict.UNDECIDED, "workflow.next-hold-out-more")
    assert report.validation is None
    assert report.fitted_errors is not None
    text = str(report)
    assert "Errors at 40 fitted (optimistic) poses, in the stated frame\n" in text
    assert "Validation" not in text


def test_too_few_held_out_poses_give_an_undecided_verdict(robot, data):
    report = calibrate(robot, data, CalibrationOptions(held_out=("1", "2", "3")))
    assert report.verdict is Verdict.UNDECIDED
    few = next(f for f in report.findings if f.code == "workflow.few-held-out-poses")
    assert few.data == {"count": 3, "needed": 5}


def test_missed_limit_is_a_statement_beside_the_verdict(robot, data):
    # few fitted poses, so that the errors exceed the noise: below it, a limit stays open
    report = calibrate(robot, data, CalibrationOptions(hold_out=0.8, limit_position=1e-7))
    assert report.verdict is Verdict.RESERVATIONS
    assert report.exit_code == 2
    assert [f.code for f in report.failures] == ["conformity.fails"]
    assert report.headline.endswith("The limit of position fails.")
    assert report.recommendation.code == "values.apply"
    assert report.next_step.code == "workflow.next-improve-accuracy"


def test_outlier_gives_the_verdict_not_calibrated_and_is_the_next_step(robot, data):
    rows = data.observations[0]
    measured = np.array(rows.measured)
    measured[4, 3] += 1e-3  # [m], 1000 sigma
    wrong = replace(data, observations=(replace(rows, measured=measured),))
    report = calibrate(robot, wrong, CalibrationOptions(held_out=data.labels[10:20]))
    assert report.verdict is Verdict.NOT_CALIBRATED
    assert report.next_step.code == "workflow.next-check-outliers"
    assert report.next_step.data["poses"] == (f"pose {data.labels[4]}",)


def test_gauge_freedom_of_frames_is_one_finding_of_severity_info(robot):
    sensor = Sensor(Pose(unknown=("frame",)), Gaussian(np.array([5e-6] * 3 + [1e-6] * 3)))
    truth = robot.with_values(sample_truth(robot, 1, 5)[0])
    poses = lc.sample_workspace(robot, 40, 3).coordinates
    data = simulate(truth, poses, Instrument((sensor,)), 1)
    report = calibrate(robot, data, CalibrationOptions(hold_out=0.25))
    (freedom,) = [f for f in report.findings if f.code == "workflow.frame-freedoms"]
    assert freedom.severity is Severity.INFO
    assert freedom.data == {"count": 6, "frames": ("base",), "still": 0, "bodies": ()}
    assert not any(f.code == "workflow.undetermined-combinations" for f in report.findings)
    assert report.verdict is Verdict.CALIBRATED


def test_unidentifiable_combinations_give_a_warning(robot, data):
    rows = data.observations[0]
    measured = np.array(rows.measured)
    measured[:, :] = np.nan
    measured[:, 5] = rows.measured[:, 5]  # heights alone
    heights = replace(data, observations=(replace(rows, measured=measured),))
    fit = replace(CalibrationOptions().fit, method=MAP())
    report = calibrate(robot, heights, CalibrationOptions(fit=fit, hold_out=0.25))
    (undetermined,) = [f for f in report.findings if f.code == "workflow.undetermined-combinations"]
    assert undetermined.severity is Severity.WARNING
    (frames,) = [f for f in report.findings if f.code == "workflow.frame-freedoms"]
    assert undetermined.data["count"] + frames.data["count"] == 42 - 30
    assert report.verdict in (Verdict.RESERVATIONS, Verdict.NOT_CALIBRATED)


def test_progress_is_reported_from_zero_to_the_total(unvalidated):
    _, steps = unvalidated
    assert steps[0][0] == 0
    assert steps[-1][0] == steps[-1][1]
    assert all(what for *_, what in steps)
    assert any("fitting, step 1: sum of squares " in what for *_, what in steps)


REFUSED = {
    "load_robot": lambda: lc.calibrate("hexapod.yaml", "data.csv"),
    "load_measurements": lambda: lc.calibrate(hexapod(), "data.csv"),
    "CalibrationOptions": lambda: lc.calibrate(hexapod(), hexapod_data(4), 0.25),
    "workflow.free-limb-needs-prior": lambda: CalibrationOptions(free_limb="leg3"),
    "hold_out is 1, which is not a share": lambda: CalibrationOptions(hold_out=1.0),
    "Give one of the two": lambda: CalibrationOptions(hold_out=0.25, held_out=("1",)),
    r"held_out is the text '1'. Give .*\['1'\]": lambda: CalibrationOptions(held_out="1"),
    "limit_position is nan. Give a number of metres": (
        lambda: CalibrationOptions(hold_out=0.25, limit_position=float("nan"))
    ),
    "workflow.limit-needs-held-out-poses": (
        lambda: calibrate(hexapod(), hexapod_data(20), CalibrationOptions(limit_position=1e-3))
    ),
    "all held-out poses are empty or excluded": (
        lambda: calibrate(
            hexapod(),
            hexapod_data(20),
            CalibrationOptions(lc.FitOptions(excluded_poses=("1",)), held_out=("1",)),
        )
    ),
}


@pytest.mark.parametrize("expected", REFUSED)
def test_wrong_or_contradictory_arguments_are_refused(expected):
    with pytest.raises(DataError) as refused:
        REFUSED[expected]()
    assert expected == refused.value.code or re.search(expected, str(refused.value))


SMALL = Quantity(0.003, "mm")
UNDETERMINED = report_finding(
    "workflow.undetermined-combinations",
    count=1,
    names=("leg1.length",),
    sizes=(Quantity(0.1, "mm"),),
    where="the workspace",
)
NOISE = report_finding(
    "noise.residuals-too-large",
    Severity.FAILURE,
    ratio=3.9,
    degrees=81.0,
    p_value=1e-9,
    uncertainty=0.25,
)
SESSIONS = report_finding(
    "residuals.sessions-differ",
    unit="session",
    component="x",
    size=SMALL,
    error=SMALL,
    ratio=1.8,
    p_value=0.01,
)
MISSING = report_finding("gates.limit-not-measured", quantity="orientation")
EXCEEDED = report_finding(
    "gates.limit-exceeded", quantity="position", pose="32", target="", error=SMALL, limit=SMALL
)
OPEN = report_finding(
    "conformity.undecided", quantity="position", count=12, probability=0.5, most_probable=0.7,
    is_volume=False, level=0.95, pose="7", target="", error=SMALL, **dict.fromkeys(STATED, SMALL),
)  # fmt: skip
GROWN = report_finding("gates.errors-grew", quantity="position", times=1.4)


def test_most_severe_finding_decides_the_verdict():
    undecided = report_finding("workflow.no-held-out-poses")
    info = report_finding("workflow.frame-freedoms", count=6, frames=("base",), still=0, bodies=())
    findings = (info, UNDETERMINED, undecided, NOISE)
    verdicts = [decide_verdict(findings[:count]).name for count in (4, 3, 2, 1)]
    assert verdicts == ["NOT_CALIBRATED", "UNDECIDED", "RESERVATIONS", "CALIBRATED"]
    for limit, verdict in ((MISSING, Verdict.RESERVATIONS), (OPEN, Verdict.RESERVATIONS)):
        assert decide_verdict((info, limit)) is verdict
        assert decide_verdict((limit, undecided)) is Verdict.UNDECIDED


@pytest.mark.parametrize(
    ("recommendation", "code"),
    [
        ("apply", "use-result"),
        ("apply-held-out", "use-result"),
        ("keep-within-noise", "keep-values"),
        ("keep-not-confirmed", "keep-values"),
        ("keep-undecided", "state-noise"),
    ],
)
def test_next_step_of_a_good_calibration_agrees_with_the_recommendation(
    recommendation, code
) -> None:
    step = choose_next_step(Verdict.CALIBRATED, (), (), f"values.{recommendation}")
    assert step.code == f"workflow.next-{code}"
    assert str(step).startswith("Use the calibrated geometry") == ("apply" in recommendation)


@pytest.mark.parametrize(
    ("findings", "repeatability", "expected"),
    [
        ((UNDETERMINED,), {}, "resolve-warnings"),
        ((NOISE,), {}, "check-noise"),
        ((NOISE, SESSIONS), {}, "check-residuals"),
        ((MISSING,), {}, "Measure orientation as well, or omit its limit."),
        ((EXCEEDED,), {}, "improve-accuracy"),
        ((OPEN,), {}, "less-noise"),
        ((OPEN, UNDETERMINED), {}, "resolve-warnings"),
        # an action of each warning: that of the catalog, or the last sentence of its text
        ((OPEN, UNDETERMINED), {}, "Measure what determines"),
        ((OPEN, UNDETERMINED), {}, "Use an instrument with less noise"),
        ((EXCEEDED, MISSING), {}, "largest source of the expected position error"),
        # what no calibration reduces
        ((EXCEEDED,), {"position": 0.83, "orientation": 0.0}, "improve-machine"),
        ((EXCEEDED,), {"position": 0.83}, "83 % of the variance of the expected position error"),
        ((EXCEEDED,), {"position": 0.4, "orientation": 0.9}, "improve-accuracy"),
        ((EXCEEDED, GROWN), {"position": 0.83}, "measure-more"),
    ],
)
def test_next_step_is_what_would_help(findings, repeatability, expected):
    step = choose_next_step(decide_verdict(findings), findings, (), APPLY, repeatability)
    assert step.code == f"workflow.next-{expected}" or expected in str(step)


def test_measurements_made_in_python_are_checked_for_wrong_conventions(
    robot, data, unvalidated
) -> None:
    rows = data.observations[0]
    inches = rows.measured.copy()
    inches[:, 3:] /= 25.4
    wrong = replace(data, observations=(replace(rows, measured=inches, source=""),))
    with pytest.raises(DataError) as error:
        calibrate(robot, wrong)
    assert error.value.code == "conventions.other-interpretation"
    report, _ = unvalidated
    assert report.conventions.finding is None
    assert report.conventions.misfit < 3.0
    unchecked = calibrate(robot, data, CalibrationOptions(check_conventions=False))
    assert np.isnan(unchecked.conventions.misfit)


def test_unreachable_poses_are_reported_without_held_out_poses(robot, data) -> None:
    readings = data.readings.copy()
    readings[3] += np.array([0.9, -0.4, 0.9, -0.4, 0.9, -0.4])  # [m]
    fit = lc.FitOptions(excluded_poses=[data.labels[3]])
    report = calibrate(robot, replace(data, readings=readings), CalibrationOptions(fit))
    (finding,) = [f for f in report.findings if f.code == "validation.unreachable-poses"]
    assert finding.data["names"] == (f"pose {data.labels[3]}",)
    assert report.verdict is Verdict.UNDECIDED


def test_readings_without_a_finite_sigma_leave_no_equation(robot, data) -> None:
    unread = replace(data, reading_sigma=np.full(data.readings.shape, np.inf))
    with pytest.raises(lc.EstimationError, match="Because the readings are uncertain") as error:
        calibrate(robot, unread)
    assert error.value.code == "fit.no-equation-left"


def test_held_out_poses_that_determine_nothing_but_their_own_frames_leave_the_verdict_open(
    robot, data
) -> None:
    rows = data.observations[0]
    kind = replace(rows.kind, unknown=("frame",))
    halves = np.where(np.arange(len(rows)) < 32, "first", [f"day{i}" for i in range(len(rows))])
    moved = replace(data, observations=(replace(rows, kind=kind, session=halves),))
    options = CalibrationOptions(held_out=data.labels[32:], check_conventions=False)
    report = calibrate(robot, moved, options)
    assert report.verdict is Verdict.UNDECIDED
    (finding,) = [f for f in report.findings if f.code == "workflow.held-out-setup"]
    assert finding.data == {"values": 48, "setup": 48}
    assert report.next_step.code == "workflow.next-hold-out-more"


def test_suggestions_use_the_rank_tolerance_of_the_fit(robot, data) -> None:
    fit = replace(CalibrationOptions().fit, rank_tolerance=0.05)
    report = calibrate(robot, data, CalibrationOptions(fit=fit))
    assert report.identification.unidentifiable
    assert report.suggestions


def test_unknown_frame_of_errors_is_refused_before_the_fit(robot, data):
    with pytest.raises(EstimationError, match=r"frame is 'laser'.*'fitted', 'base', 'relative'"):
        calibrate(robot, data, CalibrationOptions(frame="laser"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("n", "kind"),
    [
        (BLOCK + 1, Position(unknown=("frame",))),
        (EXACT_BLOCK + 1, Position()),
        pytest.param(BLOCK + 1, Position(), marks=pytest.mark.evidence),
        pytest.param(EXACT_BLOCK + 1, Position(unknown=("frame",)), marks=pytest.mark.evidence),
    ],
    ids=repr,
)
def test_poses_of_several_blocks_are_calibrated_with_all_findings(kind, n):
    """Poses that one problem solved serve others with further parameters, in the same blocks."""
    robot = lc.load_robot("linear-delta")
    truth = robot.with_values(sample_truth(robot, 1, 0)[0])
    poses = np.resize(lc.sample_workspace(robot, 400, seed=1).coordinates, (n, 3))
    noise = Gaussian(np.full(3, 1e-5))  # [m]
    report = calibrate(robot, simulate(truth, poses, Instrument((Sensor(kind, noise),)), 0))
    assert report.identification.converged
    assert report.identification.residual_test.p_value > 1e-3
    assert report.failures == ()
