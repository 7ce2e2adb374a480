# SPDX-License-Identifier: Apache-2.0
"""Checks of a calibrated machine: rate of false alarms, changes that are named, and what else
explains an alarm.
"""

from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

import loopcal as lc
from loopcal.cli.entry_point import main
from loopcal.measure.simulation import sample_truth
from loopcal.mechanism.workspace import sample_workspace
from tests.findings.expectations import expect_refusal

CORNERS = np.array([[0.03, 0.0, 0.01], [-0.02, 0.03, 0.0], [-0.02, -0.03, 0.02]])
KIND = lc.Position(targets=("a", "b", "c"), places=CORNERS, unknown=("frame", "targets"))
INSTRUMENT = lc.Instrument((lc.Sensor(KIND, lc.Gaussian(np.full(9, 1e-5))),))


def measure(robot: lc.Mechanism, truth: np.ndarray, poses: int, seed: int, moved: float = 0.0):
    """Return positions of targets, of which the first is `moved` [m], in any frame."""
    rng = np.random.default_rng(seed)
    setup = {f"frame.{axis}": 0.2 * rng.standard_normal() for axis in ("rx", "ry", "rz", *"xyz")}
    setup |= {"a.x": CORNERS[0, 0] + moved}
    place = sample_workspace(robot, poses, seed=seed).coordinates
    return lc.simulate(robot.with_values(truth), place, INSTRUMENT, seed, nuisance_values=setup)


@cache
def calibrate(machine: int) -> tuple[lc.Run, np.ndarray]:
    """Return the run of a calibrated delta, and its true values."""
    robot = lc.load_robot("linear-delta")
    truth = sample_truth(robot, 1, machine)[0]
    report = lc.calibrate(robot, measure(robot, truth, 20, 100 + machine))
    with TemporaryDirectory() as folder:
        lc.save_run(report, Path(folder) / "run")
        return lc.load_run(Path(folder) / "run"), truth


def test_checks_of_unchanged_machines_give_no_alarm() -> None:
    """Their probabilities are uniform: the mean of ten is within 3.3 standard deviations of 0.5.
    `evidence/check_up.py` counts the false alarms.
    """
    p_values = []
    for machine in range(1, 11):
        run, truth = calibrate(machine)
        checks = {str(k): measure(run.robot, truth, 5, 1000 + 10 * machine + k) for k in range(2)}
        result = lc.check_up(run, checks)
        assert not any(check.alarm for check in result.checks)
        p_values.append(result.checks[0].p_value)
    assert 0.2 < np.mean(p_values) < 0.9  # several tests together: 0.6 if they are independent


@pytest.mark.parametrize("name", ["arm1.length", "tower2.angle"])
def test_change_is_found_and_named(name) -> None:
    run, truth = calibrate(1)
    place, changed = run.robot.parameters.names.index(name), truth.copy()
    changed[place] += 1.5 * run.robot.parameters.tolerance[place]
    before = {str(k): measure(run.robot, truth, 5, 50 + k) for k in range(3)}
    result = lc.check_up(run, before | {"new": measure(run.robot, changed, 5, 60)})
    assert [check.alarm for check in result.checks] == [False, False, False, True]
    assert result.failures
    assert result.checks[-1].together == 1
    assert name in (*result.cause, *result.findings[0].data["alternatives"])
    assert "position error, rms" in str(result.page()[-1])
    assert result.plot().axes
    assert list(result.to_frame().iloc[:, 0]) == ["0", "1", "2", "new"]


def test_slow_change_is_found_by_several_checks_together() -> None:
    """A change that single checks do not show."""
    run, truth = calibrate(2)
    place, changed = run.robot.parameters.names.index("arm2.length"), truth.copy()
    alone, together = [], []
    changed[place] += 0.2 * run.robot.parameters.tolerance[place]
    for k in range(2):
        checks = {str(i): measure(run.robot, changed, 5, 500 + 10 * k + i) for i in range(8)}
        result = lc.check_up(run, checks)
        together.append(result.checks[-1].p_value)
        alone += [lc.check_up(run, {name: data}).checks[0].p_value for name, data in checks.items()]
    assert np.median(together) < 0.1 * np.median(alone)


def test_wrong_row_and_moved_target_are_named() -> None:
    run, truth = calibrate(3)
    data = measure(run.robot, truth, 5, 70)
    (rows,) = data.observations
    wrong = np.array(rows.measured)
    wrong[2, 3] += 2e-3
    result = lc.check_up(run, {"new": replace(data, observations=(replace(rows, measured=wrong),))})
    assert result.findings[0].code == "checks.wrong-pose"
    assert result.findings[0].data["pose"] == data.labels[2]
    assert not result.cause
    moved = measure(run.robot, truth, 5, 71, moved=1e-3)
    result = lc.check_up(run, {"new": moved})
    assert result.findings[0].code == "checks.setup-moved"
    assert result.findings[0].data["names"] == ("a",)
    assert not result.cause
    assert not lc.check_up(run, {"new": moved}, refit=("a",)).moved


def test_impossible_checks_are_refused() -> None:
    run, truth = calibrate(1)
    data = {"new": measure(run.robot, truth, 5, 80)}
    for checks, rate, number in (({}, 0.05, 52), (data, 1.0, 52), (data, 0.05, 0)):
        with expect_refusal("checks.options", lc.DataError):
            lc.check_up(run, checks, false_alarms=rate, a_year=number)
    with expect_refusal("checks.nothing-determined", lc.DataError):
        lc.check_up(run, {"one": measure(run.robot, truth, 1, 81)}, refit=("a", "b", "c"))
    with expect_refusal("checks.no-uncertainty", lc.EstimationError):
        lc.check_up(replace(run, result={}), data)
    with expect_refusal("validation.rows-reused", lc.DataError):
        lc.check_up(run, {"old": measure(run.robot, truth, 20, 101)})


def test_rows_that_count_twice_and_unknown_names_are_refused() -> None:
    run, truth = calibrate(1)
    data = measure(run.robot, truth, 5, 82)
    part = data.take(np.arange(5) < 2)
    with expect_refusal("checks.rows-repeated", lc.DataError, check="copy", count=2, total=2):
        lc.check_up(run, {"one": data, "copy": part})
    with pytest.raises(lc.DataError, match="has the name 'd'"):
        lc.check_up(run, {"one": data}, refit=("d",))


def test_checks_may_measure_different_quantities() -> None:
    run, truth = calibrate(1)
    robot = run.robot.with_values(truth)
    place = sample_workspace(robot, 6, seed=83).coordinates
    instrument = lc.Instrument((lc.Sensor(lc.Separation(), lc.Gaussian(np.array([1e-5]))),))
    lengths = lc.simulate(robot, place, instrument, 83)
    result = lc.check_up(run, {"lengths": lengths, "places": measure(run.robot, truth, 5, 84)})
    assert [len(check.errors) for check in result.checks] == [1, 1]
    assert result.page()
    assert result.plot().axes


def test_poses_without_values_do_not_count() -> None:
    run, truth = calibrate(1)
    data = measure(run.robot, truth, 6, 86)
    (rows,) = data.observations
    part = replace(data, observations=(rows.take(rows.rows < 4),))
    (check,), (same,) = (
        lc.check_up(run, {"one": d}).checks for d in (part, data.take(np.arange(4)))
    )
    assert (check.poses, check.p_value) == (4, pytest.approx(same.p_value, rel=1e-9))  # rounding


def test_a_failed_calibration_does_not_hold() -> None:
    run, truth = calibrate(1)
    data = {"one": measure(run.robot, truth, 5, 85)}
    failed = replace(run, result={**run.result, "verdict": "not_calibrated"})
    assert "still holds" in str(lc.check_up(run, data))
    assert "calibration of this run failed" in str(lc.check_up(failed, data))


def test_planned_checks_run_from_the_command_line(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)

    def call(line: str, code: int = 0) -> str:
        assert main(line.split()) == code
        return " ".join("".join(capsys.readouterr()).split())

    draw = "simulate linear-delta --draw-errors --kind position"
    call(f"{draw} --draw 20 --truth true.yaml -o data.csv --seed 4")
    call("calibrate linear-delta data.csv -o run --hold-out 0.25")
    plan = "plan run/robot.yaml --check-up --kind position"
    page = call(f"{plan} -o check")
    assert "5 poses of linear-delta for a check-up" in page
    assert "validation" not in page
    assert "loopcal check-up RUN check/measurements.csv" in page
    call("simulate true.yaml --fill check/measurements.csv -o week-1.csv --seed 6")
    assert "still holds" in call("check-up run week-1.csv -o history.svg")
    assert Path("history.svg").stat().st_size > 1000
    fill = "--fill check/measurements.csv --draw-errors --seed 5"
    call(f"simulate linear-delta {fill} -o other.csv")
    assert "has changed" in call("check-up run week-1.csv other.csv", code=2)
    text = Path("other.csv").read_text("utf-8")
    Path("other.csv").write_text(text.replace("robot: linear-delta", "robot: its-twin"), "utf-8")
    assert "but the run is of 'linear-delta'" in call("check-up run other.csv", code=1)
    assert "Leave out --curve" in call(f"{plan} -o again --curve", code=1)
