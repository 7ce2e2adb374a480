# SPDX-License-Identifier: Apache-2.0
"""halcompile accepts the component of every robot, whatever its names and units are."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

import loopcal as lc
from loopcal.io.formats.linuxcnc_kinematics import NAME, write
from loopcal.io.formats.program_format import ExportSource
from tests.robot_texts import load_text

NAMES = ("q 1", "1a", "ü", "a*/", 'x"y', "a#", "a_b", "__comp_inst", "d" * 60)
"""Names of drives that C, halcompile or HAL do not accept as they are."""


def load_gantry(folder: Path, **replaced: str) -> lc.Mechanism:
    """Return the robot core-xy with some of its text replaced."""
    text = (Path(lc.__file__).parent / "robots" / "core-xy.yaml").read_text("utf-8")
    for old, new in replaced.items():
        text = re.sub(rf"\b{old}\b: ", new.replace("\\", r"\\"), text, count=1)
    return load_text(folder, text)


def write_component(robot: lc.Mechanism) -> str:
    """Return the text of the component of a robot."""
    return write(ExportSource(robot, {}, {}), None).text


@pytest.mark.parametrize("name", NAMES)
def test_pins_have_names_that_hal_accepts_and_say_which_parameter(
    name: str, tmp_path: Path
) -> None:
    robot = load_gantry(tmp_path, b=f"'{name}': ")
    text = write_component(robot)
    pins = re.findall(r"^pin in float ([a-zA-Z][a-zA-Z0-9.-]*) = \S+ \"", text, re.M)
    assert len(pins) == text.count("pin in float")
    assert len({pin.replace(".", "-") for pin in pins}) == len(pins)
    assert max(len(f"{NAME}.{pin}") for pin in pins) <= 47
    assert f"{name.replace(chr(34), chr(39))}.offset in mm" in text
    if shutil.which("halcompile") and name != "d" * 60:
        (tmp_path / f"{NAME}.comp").write_text(text, "utf-8")
        subprocess.run(["halcompile", "--compile", f"{NAME}.comp"], cwd=tmp_path, check=True)


def test_names_that_are_the_same_in_c_become_different_pins(tmp_path: Path) -> None:
    robot = load_gantry(tmp_path, a="u.v: ", b="u-v: ")
    assert re.findall(r"pin in float (u\S+radius\S*)", write_component(robot)) == [
        "u.v.radius",
        "u-v.radius-2",
    ]


def test_settings_are_in_degrees_for_a_robot_file_in_radians(tmp_path: Path) -> None:
    text = (Path(lc.__file__).parent / "robots" / "core-xy.yaml").read_text("utf-8")
    text = text.replace("angle: deg", "angle: rad").replace("[-3600, 3600]", "[-50, 50]")
    written = write_component(load_text(tmp_path, text))
    assert "MIN_LIMIT = -2864.788976" in written
