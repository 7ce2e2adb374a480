# SPDX-License-Identifier: Apache-2.0
"""What further measurement would help: the ones that must, must; those that cannot, do not."""

import pytest

from loopcal.calibrate import identifiability
from loopcal.calibrate.remedies import remedies
from loopcal.io import load_robot
from loopcal.io.robot_file import shipped_robots
from loopcal.measure import KINDS, Instrument, Pose, Sensor
from tests.calibrate.problems import five_dof, hexapod, hexapod_data, tracker


def test_torsion_is_what_the_3_prs_lacks():
    (remedy,) = remedies(identifiability(load_robot("3-prs"), five_dof(), poses=36))
    assert remedy.cures[0].words == "psi"
    assert str(remedy).startswith("a1y, a2y and a3y: measuring psi as well would determine them (a1y to 0.")
    words = {cure.words for cure in remedy.cures}
    assert "the pose" in words
    # the length of the normal's path, heights and a point in the axis of the turn show nothing of it
    assert not words & {"z", "x", "y", "theta", "phi and theta", "the position", "the direction", "the autocollimation"}


@pytest.mark.parametrize(("unknown", "datum"), [("frame", "the pose"), ("tool", "the pose")])
def test_a_known_frame_is_what_an_unknown_one_lacks(unknown, datum):
    instrument = Instrument((Sensor(Pose(unknown=(unknown,)), tracker().sensors[0].noise),))
    found = remedies(identifiability(hexapod(), hexapod_data(60, instrument=instrument)))
    assert len(found) == 6
    for remedy in found:
        words = {cure.words for cure in remedy.cures}
        assert datum in words
        assert "the pose (frame and tool unknown)" not in words


def test_what_no_pose_depends_on_only_a_sensor_on_the_joint_could_tell(tmp_path):
    path = tmp_path / "robot.yaml"
    path.write_text(shipped_robots()["3-prs"].read_text("utf-8") + "parameters: fourteen\n", "utf-8")
    found = {r.combination.names[0]: r for r in remedies(identifiability(load_robot(path), tracker(), poses=36))}
    assert str(found["thB1z"]) == "thB1z: none of the known kinds of measurement would tell; fix it"
    assert {cure.words for cure in found["thC1y"].cures} == {"the joint chain1.joint"}
    assert "fix one of them" in str(found["b1z"])


def test_nothing_is_proposed_where_nothing_is_open():
    assert remedies(identifiability(hexapod(), hexapod_data(60))) == ()


def test_every_cure_is_of_a_known_kind_and_leaves_less():
    found = identifiability(hexapod(), hexapod_data(60, instrument=five_dof()))
    before = {v.name: v.left for v in found.parameters}
    (remedy,) = remedies(found)
    for cure in remedy.cures:
        assert cure.kind in KINDS
        assert cure.left < before[remedy.combination.names[0]]
    assert remedy.to_dict()["sentence"] == str(remedy)


def test_a_robot_without_a_workspace_is_looked_at_about_home():
    found = identifiability(hexapod(), hexapod_data(60, instrument=five_dof()))
    assert not hexapod().assembly.workspace
    assert "psi" in {cure.words for cure in remedies(found)[0].cures}
