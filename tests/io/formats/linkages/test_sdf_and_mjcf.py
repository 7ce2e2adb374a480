# SPDX-License-Identifier: Apache-2.0
"""SDF and MJCF: read as the machine that an independent solver closes, and written back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from loopcal import forward, inverse
from loopcal.errors import LoopcalError
from loopcal.io.formats import FORMATS
from loopcal.io.formats.import_export import build_imported_robot
from loopcal.io.formats.program_format import ExportSource, ImportOptions
from loopcal.mechanism.model import Mechanism
from tests.io.formats.linkages.linkage_texts import write_mjcf, write_sdf
from tests.io.formats.linkages.urdf_chains import make_digger, make_leg
from tests.io.formats.linkages.urdf_machines import MachineJoint, UrdfSolver, write_machine
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
