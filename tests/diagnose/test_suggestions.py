# SPDX-License-Identifier: Apache-2.0
"""Suggested measurements determine the unidentifiable combinations; others are not suggested."""

import pytest

from loopcal.diagnose.identifiable_parameters import identifiability, suggest_measurements
from loopcal.io.robot.robot_file import list_shipped_robots, load_robot
from loopcal.measure.instrument import Instrument, Sensor
from loopcal.measure.kinds import KINDS
from loopcal.measure.kinds.poses import Pose
from tests.estimate.problems import five_dof, hexapod, hexapod_data, tracker


def test_torsion_is_suggested_for_the_3_prs_without_torsion():
    (suggestion,) = suggest_measurements(identifiability(load_robot("3-prs"), five_dof(), poses=36))
    assert suggestion.measurements[0].words == "psi"
    assert suggestion.finding.code == "identifiability.measure-also"
    assert suggestion.finding.data["names"] == ("a1y", "a2y", "a3y")
    assert suggestion.finding.data["measurements"][0]["words"] == "psi"
    words = {measurement.words for measurement in suggestion.measurements}
    assert "the pose" in words
    # none of these measurements depends on a rotation about the platform's z axis
    assert not words & {
        "z",
        "x",
        "y",
        "theta",
        "phi and theta",
        "the position",
        "the direction",
        "the autocollimation",
    }


@pytest.mark.parametrize(("unknown", "datum"), [("frame", "the pose"), ("tool", "the pose")])
def test_known_frame_is_suggested_for_an_unknown_frame(unknown, datum):
    instrument = Instrument((Sensor(Pose(unknown=(unknown,)), tracker().sensors[0].noise),))
    result = suggest_measurements(
        identifiability(hexapod(), hexapod_data(60, instrument=instrument))
    )
    assert len(result) == 6
    for suggestion in result:
        words = {measurement.words for measurement in suggestion.measurements}
        assert datum in words
        assert "the pose (frame and tool unknown)" not in words


def test_joint_sensor_is_suggested_for_a_parameter_without_effect_on_poses(tmp_path):
    path = tmp_path / "robot.yaml"
    path.write_text(
        list_shipped_robots()["3-prs"].read_text("utf-8") + "parameter_set: fourteen\n", "utf-8"
    )
    result = {
        r.combination.names[0]: r
        for r in suggest_measurements(identifiability(load_robot(path), tracker(), poses=36))
    }
    assert result["thB1z"].finding.code == "identifiability.fix-one"
    assert {measurement.words for measurement in result["thC1y"].measurements} == {
        "the joint chain1.joint"
    }
    assert result["b1z"].finding.code == "identifiability.fix-one"


def test_identifiable_robot_has_no_suggestions():
    assert suggest_measurements(identifiability(hexapod(), hexapod_data(60))) == ()


def test_every_suggestion_has_a_known_kind_and_lowers_the_uncertainty():
    result = identifiability(hexapod(), hexapod_data(60, instrument=five_dof()))
    before = {v.name: v.left for v in result.parameters}
    (suggestion,) = suggest_measurements(result)
    assert suggestion.measurements
    for measurement in suggestion.measurements:
        assert measurement.kind in KINDS
        assert measurement.left < before[suggestion.combination.names[0]]


def test_suggestions_of_a_robot_without_workspace_use_poses_about_home():
    result = identifiability(hexapod(), hexapod_data(60, instrument=five_dof()))
    assert not hexapod().assembly.workspace
    assert "psi" in {
        measurement.words for measurement in suggest_measurements(result)[0].measurements
    }


TRANSLATIONAL = """\
format: 1
family: limbs
name: tsai-3upu
source: of the kind of Tsai 1996, dimensions ours
units: {length: mm, angle: deg}
controlled: [x, y, z]
actuators:
  q: {reads: length, stroke: [-150, 150], offset: 500, unknown: [offset], length: {sd: 0.1}}
limbs:
  - name: leg
    chain:
      - {joint: U, name: lower, at: [300, 0, 0], axes: [y, x], start: [-18, 0]}
      - {joint: P, name: slide, axis: z, actuated: q, start: 500}
      - {joint: U, name: upper, axes: [x, y], start: [0, 18]}
    ending: rigid
    attach: [145, 0, 0]
    copies: {count: 3}
    errors:
      - {of: lower, shift: [x, y], tolerance: {sd: 0.1}}
      - {of: platform, shift: [x, y, z], tolerance: {sd: 0.1}}
home: {z: 475}
workspace: {x: [-60, 60], y: [-60, 60], z: [420, 530]}
"""


def test_quantities_measured_in_full_are_not_suggested(tmp_path):
    """This platform never rotates and full poses were measured: rounding is no information."""
    path = tmp_path / "upu.yaml"
    path.write_text(TRANSLATIONAL)
    result = identifiability(load_robot(path), tracker(), poses=60)
    assert result.rank < result.n_parameters
    for suggestion in suggest_measurements(result):
        assert not {"psi", "theta", "phi and theta", "the pose"} & {
            measurement.words for measurement in suggestion.measurements
        }, str(suggestion)
