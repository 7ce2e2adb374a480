# SPDX-License-Identifier: Apache-2.0
"""What further measurement would help: the ones that must, must; those that cannot, do not."""

import pytest

from loopcal.diagnose import identifiability, suggest_measurements
from loopcal.io import load_robot
from loopcal.io.robot.robot_file import list_shipped_robots
from loopcal.measure import KINDS, Instrument, Pose, Sensor
from tests.estimate.problems import five_dof, hexapod, hexapod_data, tracker


def test_torsion_is_what_the_3_prs_lacks():
    (remedy,) = suggest_measurements(identifiability(load_robot("3-prs"), five_dof(), poses=36))
    assert remedy.measurements[0].words == "psi"
    assert remedy.finding.code == "identifiability.measure-also"
    assert remedy.finding.data["names"] == ("a1y", "a2y", "a3y")
    assert remedy.finding.data["measurements"][0]["words"] == "psi"
    words = {cure.words for cure in remedy.measurements}
    assert "the pose" in words
    # the length of the normal's path, heights and a point in the axis of the turn show nothing of
    # it
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
def test_a_known_frame_is_what_an_unknown_one_lacks(unknown, datum):
    instrument = Instrument((Sensor(Pose(unknown=(unknown,)), tracker().sensors[0].noise),))
    found = suggest_measurements(
        identifiability(hexapod(), hexapod_data(60, instrument=instrument))
    )
    assert len(found) == 6
    for remedy in found:
        words = {cure.words for cure in remedy.measurements}
        assert datum in words
        assert "the pose (frame and tool unknown)" not in words


def test_what_no_pose_depends_on_only_a_sensor_on_the_joint_could_tell(tmp_path):
    path = tmp_path / "robot.yaml"
    path.write_text(
        list_shipped_robots()["3-prs"].read_text("utf-8") + "parameters: fourteen\n", "utf-8"
    )
    found = {
        r.combination.names[0]: r
        for r in suggest_measurements(identifiability(load_robot(path), tracker(), poses=36))
    }
    assert found["thB1z"].finding.code == "identifiability.fix-one"
    assert {cure.words for cure in found["thC1y"].measurements} == {"the joint chain1.joint"}
    assert found["b1z"].finding.code == "identifiability.fix-one"


def test_nothing_is_proposed_where_nothing_is_open():
    assert suggest_measurements(identifiability(hexapod(), hexapod_data(60))) == ()


def test_every_cure_is_of_a_known_kind_and_leaves_less():
    found = identifiability(hexapod(), hexapod_data(60, instrument=five_dof()))
    before = {v.name: v.left for v in found.parameters}
    (remedy,) = suggest_measurements(found)
    for cure in remedy.measurements:
        assert cure.kind in KINDS
        assert cure.left < before[remedy.combination.names[0]]


def test_a_robot_without_a_workspace_is_looked_at_about_home():
    found = identifiability(hexapod(), hexapod_data(60, instrument=five_dof()))
    assert not hexapod().assembly.workspace
    assert "psi" in {cure.words for cure in suggest_measurements(found)[0].measurements}


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


def test_what_is_measured_in_full_already_is_no_remedy(tmp_path):
    """Rounding in what a further instrument sees is no information: this platform never turns, and
    full poses were measured.
    """
    path = tmp_path / "upu.yaml"
    path.write_text(TRANSLATIONAL)
    found = identifiability(load_robot(path), tracker(), poses=60)
    assert found.rank < found.n_parameters
    for remedy in suggest_measurements(found):
        assert not {"psi", "theta", "phi and theta", "the pose"} & {
            cure.words for cure in remedy.measurements
        }, str(remedy)
