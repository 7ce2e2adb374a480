# SPDX-License-Identifier: Apache-2.0
"""SDF and MJCF: read as the machine that another solver or MuJoCo closes, and written back."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from loopcal import forward, inverse
from loopcal.errors import LoopcalError
from loopcal.io.formats import FORMATS
from loopcal.io.formats.import_export import build_imported_robot
from loopcal.io.formats.linkages import mjcf, sdf
from loopcal.io.formats.linkages.tree import LinkTree, draw_links
from loopcal.io.formats.program_format import ExportSource, ImportOptions
from loopcal.mechanism.model import Mechanism
from tests.io.formats.linkages.linkage_texts import write_mjcf, write_sdf
from tests.io.formats.linkages.urdf_chains import make_digger, make_leg
from tests.io.formats.linkages.urdf_machines import (
    MachineJoint,
    UrdfSolver,
    make_pose,
    write_machine,
)
from tools.fuzz.sources import SOURCES

AGREES = 1e-9
"""Largest difference of two solutions [m, 1]; both close loops to 1e-12."""
MACHINES = {"leg": make_leg, "rocker": lambda: make_digger(has_rocker=True)}


def write(folder: Path, joints: list[MachineJoint], name: str) -> Path:
    path = folder / {"sdf": "robot.sdf", "mjcf": "robot.xml"}[name]
    if name == "sdf":
        text, motors = write_sdf(joints)
        path.with_suffix(".yaml").write_text(motors)
    else:
        text = write_mjcf(joints)
    path.write_text(text)
    return path


def read(path: Path, name: str, platform: str | None = None) -> Mechanism:
    entry = FORMATS[name]
    assert entry.read is not None
    imported = entry.read(path, ImportOptions("machine", platform=platform))
    return build_imported_robot(path, imported)


def export(robot: Mechanism, path: Path, name: str) -> str:
    entry = FORMATS[name]
    assert entry.write is not None
    exported = entry.write(ExportSource(robot), path)
    assert "files.not-expressed" not in {finding.code for finding in exported.findings}
    return exported.text


def draw_readings(robot: Mechanism) -> np.ndarray:
    home = inverse(robot, robot.home[None]).q
    return home + np.random.default_rng(2).uniform(-0.05, 0.05, (3, home.shape[1]))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sdf", "mjcf"])
@pytest.mark.parametrize("machine", MACHINES)
def test_machine_agrees_with_the_solver_and_is_written_back(tmp_path, machine, name) -> None:
    joints = MACHINES[machine]()
    path = write(tmp_path, joints, name)
    robot = read(path, name, "tool")
    q = draw_readings(robot)
    urdf, closures = write_machine(joints)
    (tmp_path / "m.urdf").write_text(urdf)
    (tmp_path / "m.loops").write_text(closures)
    solver = UrdfSolver(tmp_path / "m.urdf", tmp_path / "m.loops")
    order = [[actuator.name for actuator in robot.actuators].index(m) for m in solver.motors]
    found = forward(robot, q).T
    expected = [solver.forward(one[order], "tool") for one in q]
    np.testing.assert_allclose(found, expected, rtol=0, atol=AGREES)
    assert export(robot, path, name) == path.read_text()

    changes = 1e-3 * np.random.default_rng(3).uniform(-1, 1, len(robot.values))
    changed = robot.with_values(robot.values + changes)
    text = export(changed, path, name)
    assert text.count("<!--") == path.read_text().count("<!--")
    path.write_text(text)
    moved = forward(changed, q).T
    np.testing.assert_allclose(forward(read(path, name, "tool"), q).T, moved, rtol=0, atol=AGREES)
    assert np.abs(moved - found).max() > 1e-4  # [m, 1]: the changes matter


WELDED = """\
<mujoco><compiler angle="radian"/><worldbody>
<body name="crank" pos="0 0 0"><joint name="m" axis="0 0 1"/>
<body name="rod" pos="0.1 0.1 0"><joint name="p" axis="0 0 1"/>
<body name="tool" pos="0.2 0.05 0.01"/><body name="end" pos="0.4 0 0" euler="0 0 0.3"/></body>
</body>
<body name="rocker" pos="0.5 -0.1 0"><joint name="r" axis="0 0 1"/>
<body name="head" pos="0 0.2 0"><joint name="s" axis="0 0 1"/>
<body name="pin" euler="0 0 0.3"/></body>
</body>
</worldbody><equality><weld body1="end" body2="pin"/></equality>
<actuator><motor joint="m"/></actuator></mujoco>
"""
COUPLED = """\
<mujoco><worldbody><body name="a" pos="0.1 0 0"><joint name="m" axis="0 0 1"/>
<body name="b" pos="0.3 0 0"><joint name="n" axis="0 0 1"/><body name="tool" pos="0.2 0 0"/></body>
</body></worldbody><equality><joint joint1="n" joint2="m" polycoef="0.2 -1.5 0 0 0"/></equality>
<actuator><motor joint="m"/></actuator></mujoco>
"""
TEXTS = {
    "leg: connect": lambda: write_mjcf(make_leg()),
    "digger: connect": lambda: write_mjcf(make_digger(has_rocker=True)),
    "four-bar: weld": lambda: WELDED,
    "arm: joint": lambda: COUPLED,
}
INERTIA = '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'


def close_by_mujoco(text: str, motors: dict[str, float]) -> np.ndarray:
    """Return the pose (4, 4) of the body `tool` with motors at given angles [rad] or lengths [m],
    by Newton's method on the residuals and Jacobians of MuJoCo's constraints.
    """
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_string(re.sub(r"(<body [^>/]*>)", rf"\1{INERTIA}", text))
    model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    data, passive = mujoco.MjData(model), np.ones(model.nv, bool)
    for name, value in motors.items():
        joint = model.joint(name)
        data.qpos[joint.qposadr[0]] += value
        passive[joint.dofadr[0]] = False
    gap = np.array([np.inf])
    for _ in range(60):
        mujoco.mj_fwdPosition(model, data)
        gap = np.array(data.efc_pos[: data.ne])
        if np.abs(gap).max() < 1e-13:
            break
        J = data.efc_J.reshape(-1, model.nv)[: data.ne, passive]
        step = np.zeros(model.nv)
        step[passive] = -np.linalg.lstsq(J, gap, rcond=1e-9)[0]
        mujoco.mj_integratePos(model, data.qpos, step, 1.0)
    assert np.abs(gap).max() < 1e-12
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = data.body("tool").xmat.reshape(3, 3), data.body("tool").xpos
    return T


@pytest.mark.parametrize("name", TEXTS)
def test_forward_kinematics_agrees_with_mujoco(tmp_path: Path, name: str) -> None:
    pytest.importorskip("mujoco")
    text, path = TEXTS[name](), tmp_path / "robot.xml"
    path.write_text(text)
    robot = read(path, "mjcf", "tool")
    home = inverse(robot, robot.home[None]).q
    q = home + np.random.default_rng(4).uniform(-0.05, 0.05, (10, home.shape[1]))
    found, motors = forward(robot, q).T, [actuator.name for actuator in robot.actuators]
    for T, readings in zip(found, q, strict=True):
        expected = close_by_mujoco(text, dict(zip(motors, readings, strict=True)))
        np.testing.assert_allclose(T, expected, rtol=0, atol=AGREES)  # [m, 1]


ARM = {
    "sdf": """\
<sdf version="1.11"><model name="m"><link name="base"/>
<link name="a"><pose>0.1 0 0 0 0 0</pose></link><link name="b"><pose>0.4 0 0 0 0 0</pose></link>
<joint name="j1" type="revolute"><parent>base</parent><child>a</child>
<axis><xyz>0 0 1</xyz></axis></joint>
<joint name="j2" type="revolute"><parent>a</parent><child>b</child>
<axis><xyz>0 0 1</xyz>
<mimic joint="j1" axis="axis"><multiplier>-2.5</multiplier><offset>0.3</offset>
<reference>0.04</reference></mimic><!-- belt --></axis></joint>
<plugin name="p" filename="f"><joint_name>j1</joint_name></plugin>
</model></sdf>
""",
    "gearbox": """\
<sdf version="1.8"><model name="m"><link name="base"/>
<link name="a"><pose>0.1 0 0 0 0 0</pose></link><link name="b"><pose>0.4 0 0 0 0 0</pose></link>
<joint name="j1" type="revolute"><parent>base</parent><child>a</child>
<axis><xyz>0 0 1</xyz></axis></joint>
<joint name="j2" type="revolute"><parent>a</parent><child>b</child>
<axis><xyz>0 0 1</xyz></axis></joint>
<joint name="g" type="gearbox"><parent>a</parent><child>b</child><gearbox_ratio>2.5</gearbox_ratio>
<gearbox_reference_body>base</gearbox_reference_body></joint>
<plugin name="p" filename="f"><joint_name>j1</joint_name></plugin></model></sdf>
""",
    "mjcf": """\
<mujoco><compiler angle="radian"/><worldbody>
<body name="a" pos="0.1 0 0"><joint name="j1"/><!-- arm -->
<body name="b" pos="0.3 0 0"><joint name="j2" ref="0.1"/></body></body></worldbody>
<equality><joint joint1="j2" joint2="j1" polycoef="0.4 -2.5 0 0 0"/></equality>
<actuator><motor joint="j1"/></actuator></mujoco>
""",
}  # fmt: skip
OFFSETS = {"sdf": 0.3 + 2.5 * 0.04, "gearbox": 0.0, "mjcf": 0.4}
"""Value of the second joint where the first one is zero [rad]."""


@pytest.mark.parametrize("case", ARM)
def test_coupled_joints_have_any_factor_and_are_written_back(tmp_path, case) -> None:
    name = "mjcf" if case == "mjcf" else "sdf"
    path = tmp_path / {"sdf": "r.sdf", "mjcf": "r.xml"}[name]
    path.write_text(ARM[case])
    robot = read(path, name, "b")
    q = np.linspace(-0.3, 0.3, 5)[:, None]
    T = forward(robot, q).T
    place = 0.1 + 0.3 * np.exp(1j * q[:, 0])
    np.testing.assert_allclose(T[:, 0, 3] + 1j * T[:, 1, 3], place, rtol=0, atol=1e-12)
    turn = q[:, 0] - 2.5 * q[:, 0] + OFFSETS[case]
    np.testing.assert_allclose(np.arctan2(T[:, 1, 0], T[:, 0, 0]), turn, rtol=0, atol=1e-12)
    assert export(robot, path, name) == path.read_text()
    changes = 1e-3 * np.random.default_rng(3).uniform(-1, 1, len(robot.values))
    changed = robot.with_values(robot.values + changes)
    text = export(changed, path, name)
    assert text.count("<!--") == path.read_text().count("<!--")
    path.write_text(text)
    moved = forward(changed, q).T
    np.testing.assert_allclose(forward(read(path, name, "b"), q).T, moved, rtol=0, atol=AGREES)
    assert np.abs(moved - T).max() > 1e-4  # [m, 1]: the changes matter


REFUSED = {
    "another root": ("<robot/>", "the root is <robot>, not <mujoco>"),
    "include": (
        '<mujoco><include file="../x.xml"/></mujoco>',
        ":1: cannot read the included 'x.xml'. Put it next",
    ),
    "unknown body": (
        SOURCES["robot.xml"].replace('body2="rod2"', 'body2="rod3"'),
        ":8: <connect> names the body 'rod3', which does not exist",
    ),
    "not linear": (
        SOURCES["robot.xml"].replace(
            "</equality>", '<joint joint1="mot1" joint2="mot2" polycoef="0 1 2 0 0"/></equality>'
        ),
        "polycoef of 'mot1' is not linear",
    ),
    "generated bodies": (
        SOURCES["robot.xml"].replace("<worldbody>", '<worldbody><replicate count="3"/>'),
        "<replicate> makes bodies that the file does not write",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_mjcf_is_refused_in_one_sentence(tmp_path, case) -> None:
    text, sentence = REFUSED[case]
    (tmp_path / "robot.xml").write_text(text)
    with pytest.raises(LoopcalError, match=sentence):
        read(tmp_path / "robot.xml", "mjcf")


def shift(tree: LinkTree, name: str, by: list[float], turn: list[float] | None = None) -> LinkTree:
    """Return a tree of which the origin of a joint, or an end of a closure, moves in its frame."""
    R = Rotation.from_rotvec(turn or [0.0, 0.0, 0.0]).as_matrix()
    return tree.with_origins({name: tree.places[name].origin @ make_pose(R, by)})


def find_numbers(text: str, pattern: str) -> np.ndarray:
    """Return the numbers that a pattern finds in a file."""
    (found,) = re.findall(pattern, text)
    return np.array(found.split(), dtype=float)


def test_a_site_in_a_turned_frame_is_corrected_along_the_axes_of_that_frame(tmp_path) -> None:
    """In the body, the site (0.2, 0.3) is at (-0.3 + 0.1, 0.2), and its x axis is the y axis."""
    path = tmp_path / "a.xml"
    path.write_text(
        '<mujoco><worldbody><body name="a"><joint name="q"/><frame pos="0.1 0 0" euler="0 0 90">'
        '<site name="s" pos="0.2 0.3 0"/></frame></body><body name="b" pos="-0.2 0.2 0">'
        '<joint name="r"/><site name="t"/></body></worldbody><equality>'
        '<connect name="c" site1="s" site2="t"/></equality></mujoco>'
    )
    tree = mjcf.read_tree(path)
    np.testing.assert_allclose(tree.places["c_parent"].origin[:3, 3], [-0.2, 0.2, 0], atol=1e-15)
    text = tree.rewrite(tree, shift(tree, "c_parent", [0.05, 0.0, 0.0]))
    at = find_numbers(text, r'site name="s" pos="([^"]*)"')
    np.testing.assert_allclose(at, [0.25, 0.3, 0.0], atol=1e-12)  # [m], rounding


@pytest.mark.parametrize("order", ["qk", "kq"])
@pytest.mark.parametrize("zero", [0.0, 0.02])
def test_the_turn_of_a_locked_joint_is_not_written_into_its_body(tmp_path, order, zero) -> None:
    """Joint k is locked at 0.3 rad about y; the body b is 0.2 m above it, and q turns about z."""
    places = {"q": [0.02, 0.0, 0.0], "k": [0.0, 0.03, 0.05]}
    joints = {"q": '<joint name="q" pos="0.02 0 0"/>'}
    joints["k"] = '<joint name="k" axis="0 1 0" pos="0 0.03 0.05"/>'
    path = tmp_path / "a.xml"
    path.write_text(
        f'<mujoco><worldbody><body name="a" pos="0.1 0 0">{joints[order[0]]}{joints[order[1]]}'
        '<body name="b" pos="0 0 0.2"><joint name="r" axis="1 0 0"/></body></body></worldbody>'
        '<equality><joint joint1="k" polycoef="0.3"/></equality></mujoco>'
    )
    tree = mjcf.read_tree(path)
    assert tree.rewrite(tree, tree) == path.read_text()
    moved = shift(shift(tree, "q", [0.0, 0.01, 0.0], [0.0, 0.0, zero]), "r", [0.0, 0.0, 0.004])
    again = tmp_path / "b.xml"
    again.write_text(tree.rewrite(tree, moved))
    turns = {"q": [0.0, 0.0, zero], "k": [0.0, 0.3, 0.0]}
    T = make_pose(np.eye(3), [0.1, 0.0, 0.0])
    for name in order:
        R, shifted = Rotation.from_rotvec(turns[name]).as_matrix(), [0.0, 0.01 * (name == "q"), 0]
        pivot = make_pose(np.eye(3), places[name])
        T = T @ pivot @ make_pose(R, shifted) @ np.linalg.inv(pivot)
    T = T @ make_pose(np.eye(3), [0.0, 0.0, 0.204])
    np.testing.assert_allclose(draw_links(mjcf.read_tree(again))["b"], T, atol=1e-12)  # [m, 1]


@pytest.mark.parametrize("frame", ["", "a", "__model__", "b"])
def test_an_axis_in_the_frame_of_another_part_is_corrected(tmp_path, frame) -> None:
    """The link b turns by 0.1 rad about z at q, and its next axis, of r, stays along x of b."""
    yaw = 0.4
    turns = {"": yaw, "b": yaw, "a": 0.0, "__model__": 0.0}
    stated = Rotation.from_euler("z", turns[frame] - yaw).inv().as_matrix() @ [1.0, 0.0, 0.0]
    said = f' expressed_in="{frame}"' if frame else ""
    path = tmp_path / "a.sdf"
    path.write_text(
        '<sdf version="1.9"><model name="m"><link name="a"/>'
        f'<link name="b"><pose>0.1 0 0 0 0 {yaw}</pose></link>'
        '<link name="c"><pose relative_to="b">0 0.2 0 0 0 0</pose></link>'
        '<joint name="q" type="revolute"><parent>a</parent><child>b</child>'
        "<axis><xyz>0 0 1</xyz></axis></joint>"
        '<joint name="r" type="revolute"><parent>b</parent><child>c</child>'
        f"<axis><xyz{said}>{' '.join(map(repr, stated.tolist()))}</xyz></axis></joint>"
        "</model></sdf>"
    )
    tree = sdf.read_tree(path)
    np.testing.assert_allclose(tree.joints["r"].axis, [1.0, 0.0, 0.0], atol=1e-15)
    assert tree.rewrite(tree, tree) == path.read_text()
    moved = shift(tree, "q", [0.0, 0.0, 0.0], [0.0, 0.0, 0.1])
    text = tree.rewrite(tree, moved)
    turn = 0.1 if turns[frame] == 0.0 else 0.0
    expected = Rotation.from_euler("z", turn).as_matrix() @ stated
    written = find_numbers(text, r'name="r".*<xyz[^>]*>([^<]*)</xyz>')
    np.testing.assert_allclose(written, expected, atol=1e-12)  # [1]
