# SPDX-License-Identifier: Apache-2.0
"""A frame has the coordinates that the motion of the machine determines; others are fixed."""

from dataclasses import replace

import numpy as np
import pytest

import loopcal as lc
from loopcal import Component, Gaussian, Instrument, Pose, Position, Sensor
from loopcal.apply.calibration_report import Verdict
from loopcal.estimate.determinable_setup import fix_undetermined_setup, report_equal_setup
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.measurements import Measurements
from loopcal.measure.simulation import sample_truth
from loopcal.mechanism.model import Mechanism

CAMERA = Component(("x", "y"), unknown=("frame",), frame="camera")
TRACKER = Position(unknown=("frame",), frame="camera")
AXIS = """
format: 1
family: stages
name: axis
units: {length: mm, angle: deg}
controlled: [x]
stages:
  - name: a
    mount: {y: 100}
    joint: {kind: P, axis: x, stroke: [-100, 100], errors: [rz, gain, offset]}
tolerances: {lengths: {sd: 0.1}, angles: {sd: 0.02}}
workspace: {x: [-100, 100]}
"""


@pytest.fixture
def robots(tmp_path):
    path = tmp_path / "axis.yaml"
    path.write_text(AXIS)
    return lambda name: load_robot(path if name == "axis" else name)


def measure(robot: Mechanism, kind, place: tuple[float, ...], count: int = 60) -> Measurements:
    """Return measurements of a machine with drawn errors; `place` of the frame [rad, m]."""
    truth = robot.with_values(sample_truth(robot, 1, 3)[0])
    names = [f"camera.{axis}" for axis in ("rx", "ry", "rz", "x", "y", "z")]
    sensor = Sensor(kind, Gaussian(np.full(len(kind.noise_columns), 2e-5)))
    poses = lc.sample_workspace(robot, count, 1).coordinates
    setup = dict(zip(names, place, strict=True))
    instrument = Instrument((sensor,))
    return lc.simulate(truth, poses, instrument, 1, controller=robot, nuisance_values=setup)


def list_fixed(robot: Mechanism, data: Measurements) -> str:
    """Return the coordinates of the camera that are fixed, such as `rx ry`."""
    table = fix_undetermined_setup(robot, data).nuisance_parameters.table
    return " ".join(p.name.removeprefix("camera.") for p in table.entries if not p.free)


@pytest.mark.parametrize(
    ("name", "kind", "fixed"),
    [
        ("five-bar", CAMERA, "rx ry z"),
        ("five-bar", TRACKER, ""),
        ("3-rrr", CAMERA, "rx ry z"),
        ("cable-4", CAMERA, "z"),
        ("belt-4", CAMERA, "rx ry z"),
        ("agile-eye", TRACKER, "rx ry rz"),
        ("agile-eye", Pose(unknown=("frame",), frame="camera"), ""),
        ("axis", Component(("x",), unknown=("frame",), frame="camera"), "rx ry rz y z"),
        ("axis", TRACKER, "rx"),
        ("hexapod-42", CAMERA, "z"),
        ("hexapod-42", Component(("z",), unknown=("frame",), frame="camera"), "rz x y"),
    ],
)
def test_coordinates_without_effect_are_fixed(name, kind, fixed, robots):
    robot = robots(name)
    assert list_fixed(robot, measure(robot, kind, (0.02, -0.01, 0.03, 2.0, -1.2, 0.5))) == fixed


def test_camera_over_a_planar_machine_is_not_tilted_by_errors_of_the_machine():
    """With six free numbers, the tilt took up errors of the machine: the frame moved by meters, and
    errors before calibration were understated.
    """
    robot = load_robot("five-bar")
    data = measure(robot, CAMERA, (0.0, 0.0, 0.03, 2.0, -1.2, 0.0))
    report = lc.calibrate(robot, data, lc.CalibrationOptions(hold_out=0.25))
    (fixed,) = [f for f in report.findings if f.code == "setup.fixed"]
    assert fixed.data["names"] == ("camera.rx", "camera.ry", "camera.z")
    assert not [f for f in report.findings if f.code == "setup.unobservable"]
    setup = report.identification.nuisance
    values = dict(zip(setup.names, setup.estimate, strict=True))
    assert (values["camera.rx"], values["camera.ry"], values["camera.z"]) == (0.0, 0.0, 0.0)
    assert values["camera.x"] == pytest.approx(2.0, abs=5e-3)  # 4 sd
    assert report.verdict is Verdict.CALIBRATED


def test_coordinates_that_more_poses_would_determine_stay_free():
    """Two measured points leave a rotation about their line to other poses of the workspace."""
    robot = load_robot("linear-delta")
    data = measure(robot, TRACKER, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0), count=2)
    assert list_fixed(robot, data) == ""


@pytest.mark.parametrize("place", [(3.0, 0.02, 0.0), (0.6, 0.0, 0.0)])
def test_nothing_is_fixed_where_the_frame_is_far_from_its_stated_place(place):
    """A camera that looks from below, or at an angle, sees another motion than stated."""
    robot = load_robot("five-bar")
    data = measure(robot, CAMERA, (*place, 0.3, -0.2, 0.0))
    assert list_fixed(robot, data) == ""


def test_stated_values_and_priors_stay_as_stated():
    robot = load_robot("five-bar")
    stated = tuple(lc.StatedValue(f"camera.{axis}", sd=0.01) for axis in ("rx", "ry"))
    data = measure(robot, CAMERA, (0.0, 0.0, 0.03, 2.0, -1.2, 0.0))
    data = replace(data, stated_values=stated)
    assert list_fixed(robot, data) == "z"


def test_written_files_do_not_state_what_was_fixed(tmp_path):
    robot = load_robot("five-bar")
    data = fix_undetermined_setup(robot, measure(robot, CAMERA, (0.0, 0.0, 0.03, 2.0, -1.2, 0.0)))
    lc.save_measurements(data, tmp_path / "data.csv", robot)
    assert "unknowns:" not in (tmp_path / "data.csv").read_text()
    read = lc.load_measurements(tmp_path / "data.csv", robot)
    assert [v.name for v in read.stated_values] == ["camera.rx", "camera.ry", "camera.z"]


def test_a_second_place_that_fits_alike_is_stated_with_the_first():
    """Projected onto its plane, a camera tilted to one side and to the other one sees the same."""
    robot = load_robot("five-bar")
    data = measure(robot, CAMERA, (0.6, 0.0, 0.0, 0.3, -0.2, 0.0))
    report = lc.calibrate(robot, data, lc.CalibrationOptions(hold_out=0.25))
    (found,) = [f for f in report.findings if f.code == "setup.two-solutions"]
    tilt = next(row for row in found.data["places"] if row["name"] == "camera.rx")
    assert abs(tilt["value"].value) == pytest.approx(np.degrees(0.6), abs=0.3)  # 4 sd
    assert tilt["other"].value == pytest.approx(-tilt["value"].value, abs=0.3)


@pytest.mark.parametrize(("name", "kind"), [("five-bar", CAMERA), ("hexapod-42", TRACKER)])
def test_no_second_place_is_stated_where_only_one_fits(name, kind):
    robot = load_robot(name)
    data = measure(robot, kind, (0.02, -0.01, 0.03, 2.0, -1.2, 0.5))
    assert report_equal_setup(lc.identify(robot, data), data) == []


def test_trials_have_the_same_fixed_coordinates_as_single_fits():
    robot = load_robot("five-bar")
    sensor = Sensor(CAMERA, Gaussian(np.full(2, 2e-5)))
    poses = lc.sample_workspace(robot, 30, 1).coordinates
    truth = sample_truth(robot, 2, 3)
    trials = lc.simulate_trials(robot, truth, poses, Instrument((sensor,)), 1, robot)
    together = lc.identify_trials(robot, trials)
    for i in range(2):
        single = lc.identify(robot, trials.trial(i))
        np.testing.assert_allclose(together.values[i], single.robot.values, rtol=0, atol=1e-9)
