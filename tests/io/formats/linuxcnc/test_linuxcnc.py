# SPDX-License-Identifier: Apache-2.0
"""LinuxCNC's genhexkins settings: agreement with LinuxCNC's own code, import, export, refusals."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from loopcal import geometry as rigid
from loopcal.diagnose.cross_validation import list_parameter_sets
from loopcal.errors import DataError, FileError
from loopcal.io.formats import linuxcnc as hal_file
from loopcal.io.formats.import_export import build_imported_robot
from loopcal.io.formats.program_format import ExportSource, ImportOptions
from loopcal.io.robot import robot_file
from loopcal.io.robot.robot_file import load_robot
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import inverse

PINS = {
    "base": "base",
    "platform": "platform",
    "base-n": "base_joint_axis",
    "platform-n": "platform_joint_axis",
}


def format_hal(geometry: dict, lead: float = 0.0, lift: float = 0.0) -> str:
    """Return the settings as the text of a HAL file."""
    lines = ["# ours", "loadrt genhexkins", "setp stepgen.0.maxvel 1"]
    for pin, name in PINS.items():
        for n, point in enumerate(geometry[name]):
            for axis, value in zip("xyz", point, strict=True):
                shown = value - (lift if axis == "z" and not pin.endswith("-n") else 0.0)
                lines.append(f"setp genhexkins.{pin}.{n}.{axis} {shown}  # as built")
    lines += [f"setp genhexkins.screw-lead = {lead}"] if lead else []
    lines += [f"setp genhexkins.spindle-offset {lift}"] if lift else []
    return "\n".join([*lines, "net xpos joint.0.motor-pos-cmd", ""])


def read(folder: Path, text: str, **options) -> Mechanism:
    path = folder / "hexapod.hal"
    path.write_text(text)
    return build_imported_robot(
        path, hal_file.read(path, ImportOptions("hexapod", **{"length_unit": "mm", **options}))
    )


def read_geometry(data_folder: Path) -> dict:
    return json.loads((data_folder / "kinematics_oracles" / "genhexkins_geometry.json").read_text())


@pytest.fixture
def geometry(data_folder) -> dict:
    return read_geometry(data_folder)


def test_pins_are_the_parameters_that_the_controller_stores(tmp_path, geometry) -> None:
    sets = list_parameter_sets(read(tmp_path, format_hal(geometry), home_height=0.020))
    assert len(sets["controller"]) == 36
    written = hal_file.read(
        tmp_path / "hexapod.hal", ImportOptions("hexapod", length_unit="mm", home_height=0.35)
    )
    assert "\nhome: {z: 350.0}\n" in written.robot_text  # not 349.99999999999994
    assert not any(name.endswith("length") for name in sets["controller"])


@pytest.mark.parametrize("lift", [0.0, 7.5])
@pytest.mark.parametrize(("lead", "oracle"), [(0.0, "default"), (4.0, "screwlead4")])
def test_strut_lengths_agree_with_linuxcnc(
    tmp_path, data_folder, geometry, lead, oracle, lift
) -> None:
    robot = read(tmp_path, format_hal(geometry, lead, lift), home_height=0.020)
    table = np.genfromtxt(
        data_folder / "kinematics_oracles" / f"genhexkins_{oracle}_200poses.csv",
        delimiter=",",
        names=True,
    )
    angles = np.radians(np.stack([table[f"{axis}_deg"] for axis in "abc"], axis=1))
    position = np.stack([table[axis] for axis in "xyz"], axis=1) * 1e-3
    found = inverse(robot, rigid.make_pose(rigid.euler_to_matrix(angles, "xyz"), position))
    expected = np.stack([table[f"L{n}"] for n in range(6)], axis=1) * 1e-3
    off = np.abs(found.q - expected)
    if lead:
        # asin(sin a) is a while no strut turns past a quarter turn from where it was at home
        R, struts = rigid.euler_to_matrix(angles, "xyz"), np.array(geometry["platform"])
        along = position[:, None] * 1e3 + struts @ np.swapaxes(R, 1, 2) - np.array(geometry["base"])
        along /= np.linalg.norm(along, axis=2, keepdims=True)
        low, high = (
            np.array(geometry["base_joint_axis"]) + 0 * along,
            np.array(geometry["platform_joint_axis"]) @ np.swapaxes(R, 1, 2),
        )
        across = (low * high).sum(2) - (low * along).sum(2) * (high * along).sum(2)
        near = np.sign(across) == np.sign(across[0])  # the first pose is home
        assert near.mean() > 0.7
        off, reached = off[near], near.all(axis=1)
        # with a strut past a quarter turn, forward kinematics from home may lead elsewhere
        assert reached.mean() > 0.1
        assert found.converged[reached].all()
    else:
        assert found.converged.all()
    assert off.max() < 1e-12  # [m]


def test_missing_pin_is_added(tmp_path, geometry) -> None:
    text = "".join(
        line for line in format_hal(geometry).splitlines(keepends=True) if ".base.0.z" not in line
    )
    robot = read(tmp_path, text)
    values = robot.values.copy()
    values[robot.parameters.index("leg1.base.z")] = 2.5e-4
    written = hal_file.write(ExportSource(robot.with_values(values)), tmp_path / "hexapod.hal").text
    assert written == text + "setp genhexkins.base.0.z 0.25\n"


def test_export_reports_strut_lengths_without_a_pin() -> None:
    found = hal_file.write(ExportSource(load_robot("hexapod-42")), None)
    sentences = [str(f) for f in found.findings if f.code == "files.joint-position"]
    assert len(sentences) == 6
    assert "At reading 0 joint 0 is at 233.238076 mm" in sentences[0]
    assert "HOME_OFFSET of [JOINT_0]" in sentences[0]


def test_screws_with_different_leads_are_refused(tmp_path, geometry) -> None:
    robot = read(tmp_path, format_hal(geometry, 4.0))
    source = robot.record
    assert isinstance(source, robot_file.RobotSource)
    (tmp_path / "two.yaml").write_text(
        source.text.replace("  lead: [", "  lead: [5.0, 4, 4, 4, 4, 4]  # [")
    )
    with pytest.raises((DataError, FileError), match="screws of different lead"):
        hal_file.write(ExportSource(load_robot(tmp_path / "two.yaml")), None)


DELTA = "loadrt lineardeltakins\nsetp lineardeltakins.R 130.25 # rods\nsetp lineardeltakins.L=269\n"


def test_a_delta_has_the_formula_of_lineardeltakins(tmp_path) -> None:
    robot = read(tmp_path, DELTA)
    points = np.random.default_rng(1).uniform(-60, 60, (20, 3))
    towers = np.radians([90, 210, 330])
    away = points[:, None, :2] - 130.25 * np.column_stack([np.cos(towers), np.sin(towers)])
    wanted = points[:, 2:] + np.sqrt(269**2 - (away**2).sum(2))
    np.testing.assert_allclose(inverse(robot, points * 1e-3).q * 1e3, wanted, rtol=0, atol=1e-9)


def test_the_file_of_a_delta_gets_its_pins_and_the_rest_is_reported(tmp_path) -> None:
    robot, path = read(tmp_path, DELTA), tmp_path / "hexapod.hal"
    changes = {"radius": 0.5e-3, "tower1.angle": 1e-3, "tower2.stop": 2e-3}
    changes |= {f"arm{k}.length": 0.1e-3 * k for k in (1, 2, 3)}
    added = np.array([changes.get(name, 0.0) for name in robot.parameters.names])
    source = ExportSource(robot.with_values(robot.values + added))
    written = hal_file.write(source, path)
    pins = [float(number) for number in re.findall(r"[ =](\d\S*)", written.text)]
    assert pins == pytest.approx([130.75, 269.2], rel=1e-14)
    assert "130.75 # rods\n" in written.text
    (lost,) = [f.data["names"] for f in written.findings if f.code == "files.not-expressed"]
    assert lost == ("tower1.angle", "arm1.length", "arm3.length")
    # where the carriages are with the nozzle at its stops: joint 1 by its stop, all by the rods
    rises = [np.sqrt(rod**2 - radius**2) for rod, radius in ((269.2, 130.75), (269, 130.25))]
    change = rises[0] - rises[1] + np.array([0, 2, 0])
    (tmp_path / "machine.ini").write_text(
        "".join(f"[JOINT_{n}]\nHOME_OFFSET = 400 # {n}\n" for n in range(3))
    )
    lines = hal_file.write_ini(source, tmp_path / "machine.ini").text.splitlines()
    offsets = [float(line.split()[2]) for line in lines[1::2]]
    np.testing.assert_allclose(offsets, 400 + change, rtol=0, atol=1e-6)
    with pytest.raises(FileError, match="no 'setp genhexkins"):  # the file is of another machine
        hal_file.write(ExportSource(load_robot("hexapod-42")), path)
    turned = np.where(["angle" in name for name in robot.parameters.names], 0.3, robot.values)
    with pytest.raises(DataError, match="a third of a turn apart"):
        hal_file.write(ExportSource(robot.with_values(turned)), None)
    with pytest.raises(FileError, match=r"hexapod.hal:3: R is 130.25 and L is 100"):
        read(tmp_path, DELTA.replace("269", "100"))
