# SPDX-License-Identifier: Apache-2.0
"""The identifiable subset: it drops the parameters that the papers drop, keeps the rank, and its
robot file loads again.
"""

import json

import numpy as np
import pytest

from loopcal.diagnose.identifiable_parameters import choose_identifiable_subset, identifiability
from loopcal.errors import MechanismError
from loopcal.estimate.information import observe_poses
from loopcal.findings import Finding
from loopcal.io.core.text_file import to_json
from loopcal.io.robot.robot_file import format_reduced_robot, list_shipped_robots, load_robot
from loopcal.measure.instrument import Instrument, Sensor
from loopcal.measure.kinds.poses import Pose
from tests.estimate.problems import five_dof, hexapod, hexapod_data, tracker


@pytest.fixture
def load_with_line(tmp_path):
    """Return a loader of a shipped robot with an additional line in its file."""

    def load(name: str, line: str):
        path = tmp_path / "robot.yaml"
        path.write_text(list_shipped_robots()[name].read_text("utf-8") + line + "\n", "utf-8")
        return load_robot(path)

    return load


def name_parameters(*letters: str) -> set[str]:
    """Return the names of all three chains, such as b1z, b2z and b3z for bz."""
    return {f"{name[:-1]}{chain}{name[-1]}" for chain in "123" for name in letters}


def test_3_prs_with_fourteen_parameters_a_chain_drops_bz_thbz_and_thcy(load_with_line):
    robot = load_with_line("3-prs", "parameter_set: fourteen")
    result = identifiability(robot, tracker(), poses=36)
    assert (result.rank, result.n_parameters) == (33, 42)
    smaller = choose_identifiable_subset(result)
    assert {m.name for m in smaller.dropped} == name_parameters("bz", "thBz", "thCy")
    assert smaller.kept == load_robot("3-prs").parameters.names
    merged = {m.name: m for m in smaller.dropped}
    assert merged["b2z"].into == ("q2",)
    assert merged["b2z"].units == ("mm",)
    np.testing.assert_allclose(merged["b2z"].changes, [1.0], rtol=1e-9)
    assert merged["thB3z"].into == ()
    assert {v.name for v in result.parameters if v.state == "not at all"} == name_parameters(
        "thBz", "thCy"
    )


def test_ru_pus_prs_with_27_parameters_merges_two_rotations(load_with_line):
    result = identifiability(
        load_with_line("ru-pus-prs", "parameter_set: twenty-seven"), tracker(), poses=36
    )
    (merged,) = choose_identifiable_subset(result).dropped
    assert result.rank == 26
    assert {merged.name, *merged.into} == {"thOz", "thU1z"}
    assert merged.into == ("thOz",)
    np.testing.assert_allclose(merged.changes, [1.0], rtol=1e-9)
    (tied,) = result.unidentifiable
    assert set(tied.names) == {"thOz", "thU1z"}
    assert isinstance(tied.meaning, Finding)
    assert tied.meaning.code == "identifiability.no-motion"


@pytest.mark.parametrize("unknown", [("frame",), ("tool",), ("frame", "tool")])
def test_dropped_parameter_and_its_replacement_have_the_same_effect_on_rows(unknown):
    instrument = Instrument((Sensor(Pose(unknown=unknown), tracker().sensors[0].noise),))
    result = identifiability(hexapod(), hexapod_data(60, instrument=instrument))
    smaller = choose_identifiable_subset(result)
    free = result.free_parameters
    assert len(smaller.kept) == result.rank
    s = np.linalg.svd(
        result.factor[:, [free.names.index(n) for n in smaller.kept]], compute_uv=False
    )
    assert s[-1] > 1e-4 * s[0]
    factor, _ = free.display()
    for merged in smaller.dropped:
        z = np.zeros(len(free))
        place = free.names.index(merged.name)
        z[place] = factor[place] / free.tolerance[place]
        effect = result.factor @ z
        for name, change in zip(merged.into, merged.changes, strict=True):
            other = free.names.index(name)
            z[other] -= change * factor[other] / free.tolerance[other]
        assert np.linalg.norm(result.factor @ z) < 1e-5 * np.linalg.norm(
            effect
        )  # [1] parts below 1e-6 are left out


def test_identifiable_set_is_not_reduced():
    smaller = choose_identifiable_subset(identifiability(hexapod(), hexapod_data(60)))
    assert smaller.dropped == ()
    assert [f.code for f in smaller.findings] == ["model.not-reducible"]


def test_reduced_robot_file_loads_with_its_comments_and_full_rank(tmp_path):
    robot = load_robot("3-prs")
    result = identifiability(robot, five_dof(), poses=36)
    smaller = choose_identifiable_subset(result)
    path = tmp_path / "smaller.yaml"
    path.write_text(
        format_reduced_robot(smaller.robot, {m.name: m.describe_effect() for m in smaller.dropped}),
        "utf-8",
    )
    again = load_robot(path)
    assert again.parameters.free.sum() == 32
    assert np.array_equal(again.parameters.free, smaller.robot.parameters.free)
    assert "# of errors between 0.05 and 0.1 mm in size" in path.read_text("utf-8")
    once_more = identifiability(again, five_dof(), poses=36)
    assert once_more.rank == once_more.n_parameters == 32


def test_reduced_robot_file_extends_the_fixed_list_and_keeps_identified_values(load_with_line):
    robot = load_with_line("hexapod-42", "fixed: [leg1.length,\n  'leg2.base.?']\n# the end")
    robot = robot.with_values(robot.values * (1 + 1e-4))
    text = format_reduced_robot(robot, {"leg6.base.z": "1 mm of it counts as something"})
    assert text.count("fixed:") == 1
    assert '  - leg1.length\n  - "leg2.base.?"\n' in text
    assert "# the end" in text
    path = robot.record.path
    path.write_text(text, "utf-8")
    again = load_robot(path)
    pairs = zip(again.parameters.names, again.parameters.free, strict=True)
    fixed = [name for name, free in pairs if not free]
    assert fixed == ["leg1.length", "leg2.base.x", "leg2.base.y", "leg2.base.z", "leg6.base.z"]
    np.testing.assert_allclose(again.values, robot.values, rtol=1e-15)


def test_robot_without_a_file_cannot_be_reduced():
    with pytest.raises(MechanismError, match="does not come from a robot file"):
        format_reduced_robot(hexapod(), {})


def test_json_lists_dropped_and_kept_parameters():
    smaller = choose_identifiable_subset(identifiability(load_robot("3-prs"), five_dof(), poses=36))
    document = json.loads(to_json(smaller.to_dict()))
    assert [m["name"] for m in document["dropped"]] == ["a3y"]  # the last of equal parameters
    assert document["dropped"][0]["into"] == ["a1y", "a2y"]
    assert len(document["kept"]) == 32


def test_observed_poses_mark_unreached_poses_and_stay_finite():
    result = identifiability(hexapod(), hexapod_data(60))
    at = observe_poses(result.free_parameters, np.array([np.zeros(6), 9.0 * np.eye(6)[0]]))
    assert at.is_reached.tolist() == [True, False]
    assert np.isfinite(at.twists).all()
