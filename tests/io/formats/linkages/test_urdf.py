# SPDX-License-Identifier: Apache-2.0
"""URDF with loop closures: two public files, agreement with the tree, corrected origins."""

import re
from pathlib import Path

import numpy as np
import pytest

from loopcal.errors import DataError, FileError, LoopcalError
from loopcal.io.formats.import_export import build_imported_robot, export_robot
from loopcal.io.formats.linkages import linkage_format, urdf
from loopcal.io.formats.linkages.closures import read_mechanism
from loopcal.io.formats.program_format import ExportSource, Imported, ImportOptions
from loopcal.mechanism.joint_graph.paths import find_stage_paths
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import forward, inverse
from tests.io.formats.linkages.urdf_machines import UrdfSolver

FIVE_BAR, DELTA = "5bar_linkage", "robot_delta"
FRAME = {FIVE_BAR: "effector", DELTA: "eff"}
# bodies with the base, joints, loops, mobility: by hand from the drawings; 3 (bodies - 1) - 2
# joints = mobility in a plane
COUNTS = {FIVE_BAR: (5, 5, 1, 2), DELTA: (9, 11, 3, 2)}


@pytest.fixture(scope="module")
def files(data_folder) -> dict[str, Path]:
    return {name: data_folder / "urdf_closures" / name / "robot.urdf" for name in COUNTS}


@pytest.fixture(scope="module")
def read(files) -> dict[str, tuple[Imported, Mechanism]]:
    found = {
        name: linkage_format.read(urdf.read_tree(path), ImportOptions(name), "a URDF")
        for name, path in files.items()
    }
    return {name: (one, build_imported_robot(files[name], one)) for name, one in found.items()}


@pytest.mark.parametrize("name", COUNTS)
def test_counts_of_bodies_joints_loops_and_mobility_are_reported(files, read, name) -> None:
    bodies, joints, loops, mobility = COUNTS[name]
    assert 3 * (bodies - 1) - 2 * joints == mobility
    assert joints - (bodies - 1) == loops
    first, second = map(str, read[name][0].findings[:2])
    assert f"{bodies} rigid bodies with the base" in first
    closing = "closes a loop" if loops == 1 else "close loops"
    assert f"{joints} joints ({loops} {closing}), 2 motors, mobility {mobility}" in first
    assert float(re.findall(r"residual at home (\S+) m", second)[0]) < 1e-12  # [m]


@pytest.mark.parametrize("name", COUNTS)
def test_loops_are_closed_at_the_home_pose(read, name) -> None:
    robot = read[name][1]
    found = inverse(robot, robot.home[None])
    assert found.residual[0] < 1e-12  # [m]
    np.testing.assert_allclose(found.T[0], robot.home, rtol=0, atol=1e-12)
    assert len(robot.controlled) == COUNTS[name][3]


@pytest.mark.parametrize("name", COUNTS)
def test_poses_agree_with_the_tree_after_closing_its_loops(files, read, name) -> None:
    """The reference closes all loops of the tree by Newton's method, branches included."""
    robot = read[name][1]
    solver = UrdfSolver(files[name], files[name].with_name("robot.yaml"))
    mechanism = read_mechanism(urdf.read_tree(files[name]), files[name].with_name("robot.yaml"))
    paths = find_stage_paths(mechanism.graph, mechanism.locate(FRAME[name])[0], lambda _: np.eye(4))
    start = np.zeros(len(solver.values))
    for joint, value in zip(paths.graph.names, paths.home, strict=True):
        start[solver.columns[joint]] = value
    near = paths.home[paths.graph.is_driven] + 0.05 * np.random.default_rng(1).uniform(
        -1, 1, (5, 2)
    )
    found = forward(robot, near)
    assert found.converged.all()
    start = solver.solve(paths.home[paths.graph.is_driven], start)
    expected = [solver.forward(q, FRAME[name], start) for q in near]
    np.testing.assert_allclose(found.T, expected, rtol=0, atol=1e-11)  # [m, 1]
    np.testing.assert_allclose(inverse(robot, found.T).q, near, rtol=0, atol=1e-10)  # [rad]


@pytest.mark.parametrize("name", COUNTS)
def test_unchanged_robot_keeps_the_file_byte_for_byte(files, read, name) -> None:
    assert (
        export_robot(ExportSource(read[name][1]), urdf.FORMAT, files[name]).text.encode()
        == files[name].read_bytes()
    )


@pytest.mark.parametrize("name", COUNTS)
def test_export_changes_only_attributes_of_origins(files, read, name) -> None:
    robot = perturb(read[name][1])
    before, after = (
        files[name].read_text(),
        export_robot(ExportSource(robot), urdf.FORMAT, files[name]).text,
    )
    changed = [
        (a, b) for a, b in zip(before.splitlines(), after.splitlines(), strict=True) if a != b
    ]
    assert len(changed) == {FIVE_BAR: 6, DELTA: 14}[name]
    for a, b in changed:
        assert re.sub(r'(xyz|rpy)="[^"]*"', "", a) == re.sub(r'(xyz|rpy)="[^"]*"', "", b)
        assert a.strip().startswith("<origin")


def test_corrected_origins_are_read_as_the_same_machine(tmp_path, files, read) -> None:
    robot = perturb(read[FIVE_BAR][1])
    (tmp_path / "robot.urdf").write_text(
        export_robot(ExportSource(robot), urdf.FORMAT, files[FIVE_BAR]).text
    )
    (tmp_path / "robot.yaml").write_text(files[FIVE_BAR].with_name("robot.yaml").read_text())
    again = build_imported_robot(
        tmp_path / "robot.urdf",
        linkage_format.read(
            urdf.read_tree(tmp_path / "robot.urdf"), ImportOptions("again"), "a URDF"
        ),
    )
    T = inverse(again, again.home[None]).T
    q = inverse(again, T).q + 0.05 * np.random.default_rng(2).uniform(-1, 1, (20, 2))
    one, other = forward(again, q), forward(robot, q)
    assert one.converged.all()
    assert other.converged.all()
    np.testing.assert_allclose(other.T, one.T, rtol=0, atol=1e-10)  # [m, 1]


def perturb(robot: Mechanism) -> Mechanism:
    """Change every parameter by up to a millimeter or a milliradian."""
    shift = 1e-3 * np.random.default_rng(1).uniform(-1, 1, len(robot.values))
    return robot.with_values(robot.values + shift)


def test_export_to_urdf_needs_a_file_to_correct(read) -> None:
    with pytest.raises(DataError, match=r"Name the file to correct"):
        export_robot(ExportSource(read[FIVE_BAR][1]), urdf.FORMAT, None)


def test_urdf_of_another_machine_is_refused(tmp_path, files, read) -> None:
    (tmp_path / "other.urdf").write_text(
        files[FIVE_BAR].read_text().replace('xyz="0.1000', 'xyz="0.2000')
    )
    with pytest.raises(FileError, match="Export into the file of origin"):
        export_robot(ExportSource(read[FIVE_BAR][1]), urdf.FORMAT, tmp_path / "other.urdf")


JOINT = '<joint name="a" type="revolute"><origin xyz="0 0 1"/><parent link="base"/><child link="arm"/><axis xyz="0 0 1"/></joint>'  # noqa: E501


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("<robot><link name='a'>", ":1: not valid XML"),
        ("<!DOCTYPE robot><robot/>", ":1: this URDF file has a document type"),
        (
            "<robot><link name='base'/><link name='arm'/>\n"
            + JOINT.replace("0 0 1", "0 1", 1)
            + "</robot>",
            ":2: xyz of joint 'a' is",
        ),
        (
            "<robot><link name='base'/><link name='arm'/>\n"
            + JOINT.replace('axis xyz="0', 'axis xyz="one')
            + "</robot>",
            ":2: the axis of joint 'a' is 'one', but must be a finite number",
        ),
        (
            "<robot><link name='base'/><link name='arm'/>\n"
            + JOINT.replace("revolute", "planar")
            + "</robot>",
            ":2: joint 'a' is of type",
        ),
        (
            "<robot><link name='base'/>\n" + JOINT + "</robot>",
            ":2: joint 'a' names the link 'arm', which does not exist",
        ),
        ("<robot><link name='base'/><link name='arm'/></robot>", "this URDF has 2 root links"),
        (
            "<robot><link name='base'/><link name='arm'/>\n" + JOINT + JOINT + "</robot>",
            ":2: duplicate joint 'a'",
        ),
        (
            "<robot><link name='base'/><link name='arm'/>\n" + JOINT + "</robot>",
            "Name the file of its loop closures",
        ),
    ],
)
def test_invalid_urdf_is_refused_in_one_sentence(tmp_path, text, sentence) -> None:
    (tmp_path / "a.urdf").write_text(text)
    with pytest.raises(FileError, match=sentence):
        linkage_format.read(urdf.read_tree(tmp_path / "a.urdf"), ImportOptions("a"), "a URDF")


@pytest.mark.parametrize(
    ("closures", "sentence"),
    [
        (
            "closed_loop: [[a, b]]\ntype: ['6d']\nname_mot: [a]\n",
            ":1: the closure 'b' is not a joint or link of a.urdf",
        ),
        ("closed_loop: []\ntype: []\nname_mot: []\n", "the list of motors is empty"),
        (
            "closed_loop: [[a, arm]]\ntype: ['2d']\nname_mot: []\n",
            ":2: closure 'a' is of type '2d'",
        ),
        (
            "closed_loop: [[a, a]]\ntype: ['3d']\nname_mot: [a]\n",
            ":1: .* names the frame 'a' twice",
        ),
        ("closed_loop: [[a, arm]]\ntype: ['6d']\nname_mot: []\n", "the list of motors is empty"),
        ("closed_loop: 1\n", ":1: 'closed_loop' is '1', but must be a list"),
        ("closed_loop: []\ntype: []\nname_mot: [z]\n", ":3: the motor 'z' is not a movable joint"),
    ],
)
def test_invalid_closures_are_refused_in_one_sentence(tmp_path, closures, sentence) -> None:
    (tmp_path / "a.urdf").write_text(
        "<robot><link name='base'/><link name='arm'/>\n" + JOINT + "</robot>"
    )
    (tmp_path / "a.yaml").write_text(closures)
    with pytest.raises(LoopcalError, match=sentence):
        linkage_format.read(urdf.read_tree(tmp_path / "a.urdf"), ImportOptions("a"), "a URDF")


CIRCLE = """<robot name="r">
<link name="root"/><link name="a"/><link name="b"/><link name="c"/><link name="d"/><link name="e"/>
<joint name="j" type="fixed"><parent link="a"/><child link="b"/></joint>
<joint name="k" type="fixed"><parent link="b"/><child link="a"/></joint>
<joint name="motor" type="revolute"><parent link="root"/><child link="c"/></joint>
<joint name="one" type="revolute"><parent link="c"/><child link="d"/></joint>
<joint name="other" type="revolute"><parent link="b"/><child link="e"/></joint>
</robot>
"""


def test_circle_of_fixed_joints_is_refused(tmp_path) -> None:
    path = tmp_path / "robot.urdf"
    path.write_text(CIRCLE)
    with pytest.raises(FileError, match=r"urdf:4: joint 'k' closes a circle of links: 'a' carr"):
        urdf.read_tree(path)
    path.write_text(CIRCLE.replace('"fixed"', '"revolute"'))
    with pytest.raises(FileError, match="closes a circle of links"):
        urdf.read_tree(path)


def test_urdf_is_limited_in_joints_elements_and_nesting(tmp_path) -> None:
    path = tmp_path / "robot.urdf"
    joint = '<joint name="j{}" type="fixed"><parent link="a"/><child link="b"/></joint>'
    many = "".join(joint.format(i) for i in range(301))
    for content, reason in (
        (many, "has 301 joints, but the limit is 300"),
        ("<visual/>" * 20_001, "more than 20,000 elements"),
        ("<a>" * 60 + "</a>" * 60, "more than 50 levels of nesting"),
    ):
        path.write_text(f'<robot name="r">{content}</robot>')
        with pytest.raises(FileError, match=reason):
            urdf.read_tree(path)
