# SPDX-License-Identifier: Apache-2.0
"""Redundant machines whose start closes no pose: the answer names the poses and their gaps."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import loopcal as lc
from loopcal.diagnose.gauge_freedoms import find_gauge_freedoms
from loopcal.diagnose.identifiable_parameters import identifiability
from loopcal.errors import EstimationError, LoopcalError
from loopcal.estimate.descent import StepControl
from loopcal.estimate.identification import identify
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import LeastSquares
from loopcal.estimate.pose_estimate import find_unclosed_poses
from loopcal.estimate.result import Identification
from loopcal.measure.initial_values import guess_nuisance_values
from loopcal.mechanism.kinematics import forward_trials

FILE = Path(lc.__file__).parent / "robots" / "cable-4.yaml"

WRONG = {
    "anchors half a meter off": ("tip: [0, -1500, -120]", "tip: [0, -2000, -120]"),
    "spools ten times as wide": ("radius: 5.88 ", "radius: 58.8 "),
    "a line too short": ("length: 2300", "length: 10"),
}


@pytest.fixture(scope="module")
def data():
    robot = lc.load_robot("cable-4")
    instrument = lc.Instrument((lc.Sensor(lc.Component(("z",)), lc.Gaussian(np.array([1e-3]))),))
    return lc.simulate(robot, lc.sample_workspace(robot, 6, 1).coordinates, instrument, 1)


@pytest.fixture
def wrong(tmp_path, request):
    """A cable robot with another mistake in its file."""
    old, new = WRONG[request.param]
    text = FILE.read_text("utf-8")
    assert old in text
    (tmp_path / "wrong.yaml").write_text(text.replace(old, new))
    return lc.load_robot(tmp_path / "wrong.yaml")


@pytest.mark.parametrize("wrong", WRONG, indirect=True)
def test_identifiability_names_the_unclosed_poses_and_their_gaps(wrong, data):
    with pytest.raises(EstimationError) as error:
        identifiability(wrong, data)
    assert error.value.code == "fit.poses-open"
    found = error.value.args[0].data
    assert found["count"] == found["total"] == 6
    assert set(found["poses"]) == set(data.labels)
    gaps = [gap.value for gap in found["gaps"]]
    assert gaps == sorted(gaps, reverse=True)
    solution = lc.forward(wrong, data.readings)
    np.testing.assert_allclose(gaps[0], 1e3 * solution.residual.max())
    assert f"pose {found['poses'][0]} by " in str(error.value)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("wrong", "readings_alone", "poses"),
    [
        ("anchors half a meter off", False, 6),
        ("anchors half a meter off", True, 1),
        ("a line too short", False, 1),
        pytest.param("a line too short", True, 6, marks=pytest.mark.evidence),
    ],
    indirect=["wrong"],
)
def test_every_entry_point_answers_in_words(wrong, data, readings_alone, poses):
    """A refusal with a code, or a fit that says which poses were open: never an error of numpy."""
    few = data.take(np.arange(poses))
    if readings_alone:
        few = lc.Measurements(data.robot_name, few.readings, (), reading_sigma=few.reading_sigma)
    unclosed = find_unclosed_poses(wrong, few)
    assert unclosed.are_most
    for answer in (
        lambda: identify(wrong, few),
        lambda: identify(wrong, few, LeastSquares()),
        lambda: lc.calibrate(wrong, few, lc.CalibrationOptions(check_conventions=False)),
    ):
        try:
            result = answer()
        except LoopcalError:
            continue
        fit = result.identification if isinstance(result, lc.CalibrationReport) else result
        assert isinstance(fit, Identification)
        assert fit.converged
        (note,) = [f for f in fit.findings if f.code == "fit.poses-open-at-start"]
        assert note.data["poses"] == unclosed.poses


@pytest.mark.slow
@pytest.mark.parametrize("wrong", ["spools ten times as wide"], indirect=True)
def test_a_fit_that_does_not_converge_from_unclosed_poses_is_refused(wrong, data):
    with pytest.raises(EstimationError) as error:
        identify(
            wrong, data.take(np.arange(2)), options=FitOptions(control=StepControl(iterations=5))
        )
    assert error.value.code == "fit.poses-open"


@pytest.mark.parametrize("wrong", ["anchors half a meter off"], indirect=True)
def test_motions_of_frames_need_a_pose(wrong, data):
    posterior = identify(wrong, data).posterior
    unreachable = replace(posterior, robot=wrong.with_values(np.full_like(wrong.values, 5.0)))
    assert (
        find_gauge_freedoms(
            unreachable.robot, unreachable.places, unreachable.unit, unreachable.undetermined
        ).count
        == 0
    )


def test_good_readings_are_not_open(data):
    robot = lc.load_robot("cable-4")
    assert find_unclosed_poses(robot, data).poses == ()
    codes = [finding.code for finding in identify(robot, data).findings]
    assert "fit.poses-open-at-start" not in codes


@pytest.mark.parametrize("robot", ["cable-4", "hexapod-42"])
def test_no_readings_lead_to_no_poses(robot):
    robot = lc.load_robot(robot)
    state = forward_trials(robot, robot.values[None], np.zeros((1, 0, len(robot.actuators))))
    assert state.T.shape == (1, 0, 4, 4)


def test_measurements_without_rows_keep_the_number_of_sets(data):
    alone = lc.Measurements(data.robot_name, data.readings, (), reading_sigma=data.reading_sigma)
    T = np.broadcast_to(np.eye(4), (3, data.n_poses, 4, 4))
    values = guess_nuisance_values(alone, [], T, alone.nuisance_parameters)
    assert values.shape == (3, 0)
