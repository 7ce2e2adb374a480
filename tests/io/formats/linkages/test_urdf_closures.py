# SPDX-License-Identifier: Apache-2.0
"""Closures of a URDF: `<constraint>` elements, motors, replaced joints, and what is refused."""

from pathlib import Path

import numpy as np
import pytest

from loopcal.errors import FileError, LoopcalError
from loopcal.io.formats.import_export import build_imported_robot, export_robot
from loopcal.io.formats.linkages import linkage_format, urdf
from loopcal.io.formats.program_format import ExportSource, Imported, ImportOptions
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import forward, inverse
from tests.io.formats.linkages.urdf_machines import UrdfSolver, make_hexapod, write_machine


def make_joint(
    name: str, parent: str, child: str, xyz: str, yaw: float = 0.0, kind: str = "revolute"
) -> str:
    return (
        f'<joint name="{name}" type="{kind}"><origin xyz="{xyz}" rpy="0 0 {yaw}"/>\n'
        f'<parent link="{parent}"/><child link="{child}"/><axis xyz="0 0 1"/></joint>\n'
    )


PIN = """\
<constraint name="pin" type="revolute">
<parent link="rod1"/><parent_origin xyz="0.3 0 0"/><parent_axis xyz="0 0 1"/>
<child link="rod2"/><child_origin xyz="0.3 0 0"/></constraint>
"""
MOTORS = """\
<transmission name="t"><joint name="mot1"/></transmission>
<ros2_control name="c" type="system"><joint name="mot2"><command_interface name="position"/></joint>
<joint name="elbow1"><state_interface name="position"/></joint></ros2_control>
"""
TREE = (
    "".join(f'<link name="{n}"/>' for n in ("base", "arm1", "rod1", "arm2", "rod2", "tip"))
    + "\n"
    + make_joint("mot1", "base", "arm1", "-0.075 0 0", 2.3)
    + make_joint("elbow1", "arm1", "rod1", "0.2 0 0", -1.2)
    + make_joint("mot2", "base", "arm2", "0.075 0 0", 0.84)
    + make_joint("elbow2", "arm2", "rod2", "0.2 0 0", 1.2, "continuous")
    + make_joint("tip_frame", "rod1", "tip", "0.3 0 0", 0.0, "fixed")
)
FIVE_BAR = f'<robot name="five-bar">\n{TREE}{PIN}{MOTORS}</robot>\n'
BARE = f'<robot name="five-bar">\n{TREE}</robot>\n'


def read(
    folder: Path, text: str, closures: str | None = None, platform: str | None = None
) -> tuple[Imported, Mechanism]:
    path = folder / "r.urdf"
    path.write_text(text)
    if closures is not None:
        path.with_suffix(".yaml").write_text(closures)
    imported = linkage_format.read(
        urdf.read_tree(path), ImportOptions("r", platform=platform), "a URDF"
    )
    return imported, build_imported_robot(path, imported)


def list_codes(imported: Imported) -> set[str]:
    return {finding.code for finding in imported.findings}


def test_constraints_and_transmissions_need_no_other_file(tmp_path) -> None:
    imported, robot = read(tmp_path, FIVE_BAR)
    assert [actuator.name for actuator in robot.actuators] == ["mot1", "mot2"]
    assert list_codes(imported) == {"files.urdf-structure", "files.urdf-home"}
    # the same pin as a ball joint and as a weld of frames that a revolute joint moves
    ball = read(tmp_path, FIVE_BAR.replace('name="pin" type="revolute"', 'name="pin" type="ball"'))
    welded = BARE.replace(
        "</robot>",
        '<link name="pin1"/><link name="end2"/>'
        + make_joint("pin_joint", "rod1", "pin1", "0.3 0 0")
        + make_joint("end_frame", "rod2", "end2", "0.3 0 0", kind="fixed")
        + "</robot>",
    )
    text = "closed_loop: [[pin_joint, end2]]\ntype: [6d]\nname_mot: [mot1, mot2]\n"
    weld = read(tmp_path, welded, text)
    q = 0.1 * np.random.default_rng(1).uniform(-1, 1, (10, 2)) + inverse(robot, robot.home[None]).q
    for other in (ball[1], weld[1]):
        np.testing.assert_allclose(forward(other, q).T, forward(robot, q).T, rtol=0, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [None, 0, 2, 5])
def test_hexapods_with_constraints_agree_with_the_solver(tmp_path, seed) -> None:
    legs = ["UPS", "SPU", "RUS", "PUS", "SPS", "UPS"]
    text, closures = write_machine(make_hexapod(legs), seed, has_constraints=True)
    assert "<constraint" in text
    robot = read(tmp_path, text, closures)[1]
    solver = UrdfSolver(tmp_path / "r.urdf", tmp_path / "r.yaml")
    q = np.random.default_rng(2).uniform(-0.05, 0.05, (2, 6))  # [m or rad]
    found = forward(robot, q)
    expected = [solver.forward(one, "tool") for one in q]
    np.testing.assert_allclose(found.T, expected, rtol=0, atol=1e-9)  # [m, 1]: of 1 m
    np.testing.assert_allclose(inverse(robot, found.T).q, q, rtol=0, atol=1e-9)
    changes = 1e-3 * np.random.default_rng(3).uniform(-1, 1, len(robot.values))
    changed = robot.with_values(robot.values + changes)
    exported = export_robot(ExportSource(changed), urdf.FORMAT, tmp_path / "r.urdf")
    assert "files.not-expressed" not in {finding.code for finding in exported.findings}
    (tmp_path / "corrected.urdf").write_text(exported.text)
    corrected = UrdfSolver(tmp_path / "corrected.urdf", tmp_path / "r.yaml")
    expected = [corrected.forward(one, "tool") for one in q]
    np.testing.assert_allclose(forward(changed, q).T, expected, rtol=0, atol=1e-9)


def test_joint_that_its_loop_keeps_from_moving_is_closed_in_all_freedoms(tmp_path) -> None:
    """A five-bar with a joint beside its rod and a ball joint instead of the pin."""
    moved = TREE.replace(make_joint("tip_frame", "rod1", "tip", "0.3 0 0", 0.0, "fixed"), "")
    split = (
        moved
        + make_joint("tip_frame", "end", "tip", "0.3 -0.05 0", 0.0, "fixed")
        + '<link name="end"/>'
        + make_joint("twist", "rod1", "end", "0 0.05 0").replace(
            'axis xyz="0 0 1"', 'axis xyz="1 0 0"'
        )
    )
    ball = PIN.replace("revolute", "spherical").replace('"rod1"', '"end"')
    ball = ball.replace('parent_origin xyz="0.3 0 0"', 'parent_origin xyz="0.3 -0.05 0"')
    text = f'<robot name="five-bar">\n{split}{ball}{MOTORS}</robot>\n'
    robot, planar = read(tmp_path, text)[1], read(tmp_path, FIVE_BAR)[1]
    q = 0.1 * np.random.default_rng(1).uniform(-1, 1, (5, 2)) + inverse(planar, planar.home[None]).q
    np.testing.assert_allclose(forward(robot, q).T, forward(planar, q).T, rtol=0, atol=1e-12)


def test_link_outside_of_the_loops_is_left_out(tmp_path) -> None:
    camera = '<link name="camera"/>' + make_joint("pan", "rod1", "camera", "0.1 0 0") + "</robot>"
    imported, robot = read(tmp_path, FIVE_BAR.replace("</robot>", camera))
    assert "files.joints-dangling" in list_codes(imported)
    assert robot.parameters.names == read(tmp_path, FIVE_BAR)[1].parameters.names


def test_tree_without_closures_is_a_serial_arm(tmp_path) -> None:
    arm = (
        '<robot name="arm"><link name="base"/><link name="a"/><link name="b"/><link name="tool"/>'
        + make_joint("one", "base", "a", "0 0 0.1")
        + make_joint("two", "a", "b", "0.3 0 0")
        + make_joint("tool_frame", "b", "tool", "0.2 0 0", kind="fixed")
        + "</robot>"
    )
    text = "closed_loop: []\ntype: []\nname_mot: [one, two]\n"
    robot = read(tmp_path, arm, text)[1]
    q = np.random.default_rng(1).uniform(-1, 1, (20, 2))
    T = forward(robot, q).T
    reach = 0.3 * np.exp(1j * q[:, 0]) + 0.2 * np.exp(1j * q.sum(axis=1))
    np.testing.assert_allclose(T[:, 0, 3] + 1j * T[:, 1, 3], reach, rtol=0, atol=1e-12)  # [m]


def test_mimic_joint_that_a_loop_moves_is_accepted(tmp_path) -> None:
    """A parallelogram: the rod keeps its direction, so its elbow turns against the motor."""
    text = (
        '<robot name="p">'
        + "".join(f'<link name="{n}"/>' for n in ("base", "arm1", "rod", "arm2", "tip"))
        + make_joint("motor", "base", "arm1", "0 0 0", 1.0)
        + make_joint("elbow", "arm1", "rod", "0.2 0 0", -1.0)
        + make_joint("other", "base", "arm2", "0.3 0 0", 1.0)
        + make_joint("tip_frame", "rod", "tip", "0.1 0 0", kind="fixed")
        + PIN.replace("rod2", "arm2")
        .replace('child_origin xyz="0.3', 'child_origin xyz="0.2')
        .replace("rod1", "rod")
        + '<transmission name="t"><joint name="motor"/></transmission></robot>'
    )
    mimic = '<axis xyz="0 0 1"/><mimic joint="motor" multiplier="{}"/>'
    elbow = text.index('<axis xyz="0 0 1"/>', text.index("elbow"))
    with_mimic = text[:elbow] + "MIMIC" + text[elbow + len('<axis xyz="0 0 1"/>') :]
    read(tmp_path, with_mimic.replace("MIMIC", mimic.format(-1)))  # as the loops make it
    with pytest.raises(LoopcalError, match="the loops lock 'rod'"):
        read(tmp_path, with_mimic.replace("MIMIC", mimic.format(2)))


def test_fixed_override_removes_a_joint(tmp_path) -> None:
    text = "name_mot: [mot1]\njoint_name: [mot2]\njoint_type: [FIXED]\n"
    imported, robot = read(tmp_path, FIVE_BAR, text)
    assert imported.findings[0].data["mobility"] == 1
    assert len(robot.actuators) == 1


def test_platform_is_the_body_with_most_limbs(tmp_path) -> None:
    text, closures = write_machine(make_hexapod(["UPS"] * 6), None)
    frame = text[text.index('<joint name="tool_frame"') :]
    text = text.replace('<link name="tool"/>\n', "").replace(frame, "</robot>\n")
    imported = read(tmp_path, text, closures)[0]
    assert imported.findings[1].data["frame"] == "platform"


PAN = '<link name="c"/><transmission name="u"><joint name="pan"/></transmission>' + make_joint(
    "pan", "rod1", "c", "0 0 0"
)
BRACE = PIN.replace('"pin"', '"brace"').replace('"0.3 0 0"', '"0.1 0 0"').replace("rod2", "arm2")
REFUSED = {
    "unknown type": (
        FIVE_BAR.replace('"pin" type="revolute"', '"pin" type="planar"'),
        ":13: constraint 'pin' is of type 'planar'. Allowed: fixed, link",
    ),
    "unknown link": (
        FIVE_BAR.replace('<child link="rod2"/><child_o', '<child link="rad2"/><child_o'),
        ":13: constraint 'pin' names the link 'rad2', which does not exist",
    ),
    "link with itself": (
        FIVE_BAR.replace('<child link="rod2"/><child_o', '<child link="tip"/><child_o'),
        ":13: closure 'pin' joins 'rod1' to itself",
    ),
    "no axis": (
        FIVE_BAR.replace('<parent_axis xyz="0 0 1"/>', ""),
        ":13: constraint 'pin' is revolute and has no axis. Add <parent_axis",
    ),
    "another axis": (
        FIVE_BAR.replace("</constraint>", '<child_axis xyz="1 0 0"/></constraint>'),
        "its child_axis is not its parent_axis",
    ),
    "no motors": (
        FIVE_BAR.replace(MOTORS, ""),
        "the list of motors is empty. List the driven joints in 'name_mot:' of a YAML",
    ),
    "motor of the camera": (
        FIVE_BAR.replace("</robot>", f"{PAN}</robot>"),
        "motor pan moves nothing between the base and the platform 'rod1'",
    ),
    "macro": (
        FIVE_BAR.replace("</robot>", '<xacro:leg name="x"/></robot>'),
        ":19: 'xacro:leg' is a macro of xacro, not URDF",
    ),
    "macro value": (
        FIVE_BAR.replace('"0.2 0 0"', '"${arm} 0 0"'),
        ":5: 'origin' is a macro of xacro",
    ),
    "loop of another program": (
        FIVE_BAR.replace("</robot>", '<loop_joint name="x"/></robot>'),
        ":19: loopcal does not read the loop closure <loop_joint type=''>",
    ),
    "duplicate link": (
        FIVE_BAR.replace('<link name="tip"/>', '<link name="tip"/><link name="tip"/>'),
        ":2: duplicate link 'tip'. Rename one",
    ),
    "loops do not close": (
        FIVE_BAR.replace('child_origin xyz="0.3 0 0"', 'child_origin xyz="0.3 0 0.1"'),
        "the loops do not close .* 'pin', between 'rod1' and 'rod2', stays 100 mm",
    ),
    "platform in a chain": (
        FIVE_BAR.replace('"tip_frame" type="fixed"', '"tip_frame" type="revolute"'),
        "no moving body carries a frame, .* one of rod1 and rod2",
    ),
    "loop closed twice": (
        FIVE_BAR.replace(PIN, PIN + PIN.replace('"pin"', '"again"')),
        ":16: closure 'again' joins 'rod1' and 'rod2' at the points of 'pin' again",
    ),
    "joint type": (
        FIVE_BAR.replace('type="continuous"', 'type="floating"'),
        ":9: joint 'elbow2' is of type 'floating'. Allowed: revolute, continuous",
    ),
    "brace": (FIVE_BAR.replace(MOTORS, BRACE + MOTORS), ":.*the loops lock 'rod1'"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_urdf_is_refused_in_one_sentence_with_its_line(tmp_path, case) -> None:
    text, sentence = REFUSED[case]
    with pytest.raises(LoopcalError, match=sentence):
        read(tmp_path, text)


CLOSURES = {
    "unknown key": (
        "closed_loops: []\nname_mot: [mot1]\n",
        ":1: unknown key 'closed_loops' \\(did you mean 'closed_loop'",
    ),
    "unknown frame": (
        "closed_loop: [[rod1, tipp]]\ntype: [3d]\n",
        ":1: the closure 'tipp' is not a joint or link",
    ),
    "one body": (
        "closed_loop: [[rod1, tip]]\ntype: [6d]\nname_mot: [mot1]\n",
        ":1: closure 'rod1' joins 'rod1' to itself",
    ),
    "same frame": (
        "closed_loop: [[tip, tip]]\ntype: [6d]\n",
        ":1: closure 1 names the frame 'tip' twice",
    ),
    "closed twice": (
        "closed_loop: [[elbow1, elbow2], [elbow2, elbow1]]\ntype: [3d, 3d]\nname_mot: [mot1]\n",
        ":1: closure 'elbow2_ball' joins 'rod2' and 'rod1' at the points of 'elbow1_ball' again",
    ),
    "three frames": (
        "closed_loop:\n- [rod1, rod2]\n- [rod1, rod2, tip]\ntype: [3d, 3d]\n",
        ":3: closure 2 is .* but must be the names of two frames",
    ),
    "number of types": (
        "closed_loop: [[rod1, rod2]]\ntype: []\n",
        ":2: 'closed_loop' has 1 pairs, but 'type' has 0 entries",
    ),
    "motor twice": ("name_mot: [mot1, mot1]\n", ":1: motor 'mot1' occurs twice"),
    "fixed motor": (
        "name_mot: [mot1, tip_frame]\n",
        ":1: the motor 'tip_frame' is not a movable joint",
    ),
    "replaced motor": (
        "name_mot: [mot1]\njoint_name: [mot1]\njoint_type: [SPHERICAL]\n",
        "joint_type replaces it",
    ),
    "replacement": (
        "name_mot: [mot1]\njoint_name: [elbow1]\njoint_type: [BALL]\n",
        ":3: cannot replace joint 'elbow1' by 'BALL'. Allowed: SPHERICAL, FIXED, UJOINT_XY",
    ),
    "replaced joint": (
        "name_mot: [mot1]\njoint_name: [elbow]\njoint_type: [FIXED]\n",
        ":2: 'elbow' is not a movable joint of r.urdf",
    ),
    "two entries replace": (
        "name_mot: [mot1]\njoint_name: [elbow1, elbow1]\njoint_type: [FIXED, FIXED]\n",
        "two entries replace",
    ),
    "lists": (
        "name_mot: [mot1]\njoint_name: [elbow1]\n",
        "'joint_type:' must be lists of equal length",
    ),
}


@pytest.mark.parametrize("case", CLOSURES)
def test_closure_file_is_refused_in_one_sentence_with_its_line(tmp_path, case) -> None:
    closures, sentence = CLOSURES[case]
    with pytest.raises(LoopcalError, match=r"r\.yaml.*" + sentence):
        read(tmp_path, BARE, closures)


def test_urdf_in_millimeters_is_noticed(tmp_path) -> None:
    large = BARE.replace('"0.2 0 0"', '"200 0 0"').replace('"0.3 0 0"', '"300 0 0"')
    pin = PIN.replace('"0.3 0 0"', '"300 0 0"')
    imported = read(tmp_path, large.replace("</robot>", f"{pin}{MOTORS}</robot>"))[0]
    assert "files.urdf-large" in list_codes(imported)


@pytest.mark.parametrize("platform", ["arm1", "rod1", "rod2"])
def test_rigid_closure_at_a_pin_is_named_with_what_to_write_instead(tmp_path, platform) -> None:
    end = '<link name="end2"/>' + make_joint("end", "rod2", "end2", "0.3 0 0", 1.9, "fixed")
    text = BARE.replace("</robot>", end + "</robot>")
    closures = "closed_loop: [[tip_frame, end]]\ntype: [6d]\nname_mot: [mot1, mot2]\n"
    with pytest.raises(FileError) as refused:
        read(tmp_path, text, closures, platform)
    assert refused.value.finding is not None
    assert refused.value.finding.code == "files.closure-rigid"
    assert refused.value.finding.data["closures"] == ("tip_frame, end",)
    if platform != "arm1":  # both motors move it, and the sentence promises this for planar loops
        robot = read(tmp_path, text, closures.replace("6d", "3d"), platform)[1]
        q = inverse(robot, robot.home[None]).q
        assert forward(robot, q + 0.05).converged.all()


@pytest.mark.slow
def test_legs_of_one_crank_close_one_after_the_other(tmp_path) -> None:
    """24 four-bars on a crank, drawn open and stretched: no start closes all of them."""
    crank, rod, rocker, base, count = 0.15, 0.5, 0.28, 0.38, 24
    parts = [
        '<link name="base"/><link name="crank"/>',
        make_joint("axle", "base", "crank", "0 0 0"),
    ]
    angles = 2 * np.pi * np.arange(count) / count
    for i, angle in enumerate(angles):
        x, y = base * np.cos(angle), base * np.sin(angle)
        parts += [f'<link name="rod{i}"/><link name="rocker{i}"/>']
        parts += [make_joint(f"knee{i}", "crank", f"rod{i}", f"{crank} 0 0")]
        parts += [make_joint(f"hip{i}", "base", f"rocker{i}", f"{x} {y} 0")]
        pin = PIN.replace("pin", f"pin{i}").replace("rod2", f"rocker{i}").replace("rod1", f"rod{i}")
        pin = pin.replace('parent_origin xyz="0.3', f'parent_origin xyz="{rod}')
        parts += [pin.replace('child_origin xyz="0.3', f'child_origin xyz="{rocker}')]
    motor = '<transmission name="t"><joint name="axle"/></transmission>'
    text = f'<robot name="walker">{"".join(parts)}{motor}</robot>'
    robot = read(tmp_path, text, platform="rod3")[1]
    T = forward(robot, np.linspace(-0.2, 0.2, 5)[:, None]).T
    knee = T[:, :3, 3] + rod * T[:, :3, 0]
    hip = base * np.array([np.cos(angles[3]), np.sin(angles[3]), 0.0])
    turn = np.arctan2(T[:, 1, 3], T[:, 0, 3])
    np.testing.assert_allclose(turn - turn[2], np.linspace(-0.2, 0.2, 5), rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(T[:, :3, 3], axis=1), crank, rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(knee - hip, axis=1), rocker, rtol=0, atol=1e-12)
    long = text.replace(f'child_origin xyz="{rocker} 0 0"', 'child_origin xyz="1 0 0"', 1)
    with pytest.raises(LoopcalError, match=r"closure 'pin0', .* stays"):  # not of another leg
        read(tmp_path, long, platform="rod3")
