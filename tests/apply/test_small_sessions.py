# SPDX-License-Identifier: Apache-2.0
"""Sessions of few poses: a split leaves their frames determined, and poses of a session whose frame
no fitted pose determines are not predicted.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

import loopcal as lc
from loopcal import geometry
from loopcal.apply.validation import validate
from loopcal.io.runs.run_folder import load_run, save_run
from tests.findings.expectations import get_finding, list_codes

SIGMA = 30e-6
POINT = lc.Position(
    targets=("a",), places=np.array([[0.05, 0.02, 0.03]]), unknown=("frame",), frame="trk"
)


@pytest.fixture(scope="module")
def robot():
    return lc.load_robot("hexapod-42")


def measure(robot, sessions: Sequence[str], seed: int) -> lc.Measurements:
    """Return points of faultless sessions, each with a frame somewhere else."""
    truth = robot.with_values(lc.sample_truth(robot, 1, seed)[0])
    sensor = lc.Sensor(POINT, lc.Gaussian(np.full(3, SIGMA)), session=np.asarray(sessions))
    poses = lc.sample_workspace(robot, len(sessions), seed).coordinates
    data = lc.simulate(truth, poses, lc.Instrument((sensor,)), seed)
    (rows,), stream, measured = data.observations, np.random.default_rng(seed), []
    for name in dict.fromkeys(sessions):
        turn, shift = geometry.exp_so3(stream.normal(0, 0.3, 3)), stream.normal(0, 0.5, 3)
        measured.append(rows.measured[rows.session == name] @ turn.T + shift)
    return replace(data, observations=(replace(rows, measured=np.concatenate(measured)),))


TUESDAY = ("61", "62", "63")


@pytest.mark.parametrize("count", [2, 3])
def test_poses_of_a_session_without_a_frame_have_no_error_and_are_no_blunder(robot, count) -> None:
    """One or two fitted points leave the frame open: errors were 28 to 113 mm."""
    data = measure(robot, ["monday"] * 60 + ["tuesday"] * 4, 3)
    held_out = (*TUESDAY[:count], *map(str, range(1, 16)))
    report = lc.calibrate(robot, data, lc.CalibrationOptions(held_out=held_out))
    errors = report.validation
    assert errors is not None
    assert set(errors.poses) == set(map(str, range(1, 16)))
    assert errors.after.statistics("position").max < 8 * SIGMA
    assert errors.blunders == ()
    finding = get_finding(errors.findings, "validation.setup-undetermined")
    assert finding.data == {"poses": TUESDAY[:count], "names": ("tuesday.trk",)}
    assert "validation.setup-moved" not in list_codes(errors.findings)


def test_validation_on_such_poses_alone_leaves_the_verdict_open(robot) -> None:
    data = measure(robot, ["monday"] * 40 + ["tuesday"] * 4, 5)
    report = lc.calibrate(robot, data, lc.CalibrationOptions(held_out=("43", "44")))
    assert report.verdict is lc.Verdict.UNDECIDED
    assert "workflow.nothing-to-validate" in list_codes(report.findings)


def test_run_folder_knows_which_frames_are_open(robot, tmp_path) -> None:
    data = measure(robot, ["monday"] * 40 + ["tuesday"] * 4, 5)
    fitted, other = data.take(np.arange(42)), data.take([42, 43])
    report = lc.calibrate(robot, fitted)
    save_run(report, tmp_path / "run")
    run = load_run(tmp_path / "run")
    with pytest.raises(lc.DataError, match=r"43 and 44\. The fitted poses determine"):
        validate(
            run.identified_robot,
            other,
            nuisance_values=run.nuisance_values,
            uncertainty=run.load_uncertainty(),
        )


def test_common_displacement_of_target_and_frame_leaves_rows_predicted() -> None:
    """A platform that only translates never shows it, so each of both is open, and no row is."""
    robot = lc.load_robot("linear-delta")
    kind = replace(POINT, unknown=("targets", "frame"))
    sensor = lc.Sensor(kind, lc.Gaussian(np.full(3, SIGMA)))
    truth = robot.with_values(lc.sample_truth(robot, 1, 1)[0])
    poses = lc.sample_workspace(robot, 40, 1).coordinates
    data = lc.simulate(truth, poses, lc.Instrument((sensor,)), 1)
    report = lc.calibrate(robot, data, lc.CalibrationOptions(hold_out=0.25))
    assert report.identification.nuisance.is_unobservable.any()
    assert report.validation is not None
    assert len(report.validation.poses) == 10


SESSIONS = {
    "one small session": (["a"] * 60 + ["b"] * 4, 16),
    "sessions of four": ([f"s{i}" for i in range(20) for _ in range(4)], 20),
    "sessions of three, which are held out as a whole": (
        [f"s{i}" for i in range(20) for _ in range(3)],
        15,
    ),
}


@pytest.mark.parametrize("name", SESSIONS)
def test_split_keeps_three_points_of_each_session(robot, name: str) -> None:
    sessions, count = SESSIONS[name]
    data = measure(robot, sessions, 1)
    for seed in range(5):
        fitted, held_out = data.split(hold_out=0.25, seed=seed)
        assert held_out.n_poses == count
        assert min(Counter(fitted.observations[0].session.tolist()).values()) >= 3


def test_split_of_faultless_small_sessions_blames_no_pose(robot) -> None:
    data = measure(robot, [f"s{i}" for i in range(12) for _ in range(4)], 4)
    report = lc.calibrate(robot, data, lc.CalibrationOptions(hold_out=0.25))
    assert report.validation is not None
    assert report.validation.blunders == ()
    assert report.verdict is not lc.Verdict.NOT_CALIBRATED
    assert "setup.unobservable" not in list_codes(report.findings)


def test_repeats_of_one_point_determine_no_frame(robot) -> None:
    """Three visits of one point are one point."""
    again = measure(robot, ["a"] * 20 + ["b"] * 6, 2)
    order = np.r_[np.arange(20), [20, 20, 20, 21, 22, 23, 24]]
    (rows,) = again.observations
    noise = np.random.default_rng(0).normal(0, SIGMA, (27, 3))
    repeated = replace(rows.take(order), rows=np.arange(27), measured=rows.measured[order] + noise)
    data = lc.Measurements(again.robot_name, again.readings[order], (repeated,))
    for seed in range(5):
        fitted = data.split(hold_out=0.4, seed=seed)[0]
        points = fitted.readings[fitted.observations[0].session == "b"]
        assert len(np.unique(points, axis=0)) >= 3
