# SPDX-License-Identifier: Apache-2.0
"""M665 and M666 of Marlin and RepRapFirmware: import, export, correction of a file, refusals."""

import math
from pathlib import Path

import numpy as np
import pytest

from loopcal.errors import FileError
from loopcal.io.formats import FORMATS
from loopcal.io.formats.import_export import build_imported_robot
from loopcal.io.formats.program_format import ExportSource, ImportOptions
from loopcal.io.robot.robot_file import load_robot, save_robot
from loopcal.mechanism.model import Mechanism
from tools.fuzz.sources import MARLIN, REPRAP


def import_robot(folder: Path, name: str, text: str) -> Mechanism:
    path = folder / f"{name}.g"
    path.write_text(text)
    read = FORMATS[name].read
    assert read is not None
    return build_imported_robot(path, read(path, ImportOptions("printer")))


def export_robot(robot: Mechanism, name: str, into: Path | None = None) -> str:
    write = FORMATS[name].write
    assert write is not None
    return write(ExportSource(robot), into).text


def get_value(robot: Mechanism, name: str) -> float:
    """Return the value of a parameter in mm or degrees."""
    found = float(robot.values[robot.parameters.index(name)])
    return math.degrees(found) if name.endswith("angle") else found * 1e3


def test_reprap_stops_are_the_homed_height_plus_the_adjustments(tmp_path) -> None:
    robot = import_robot(tmp_path, "reprap", REPRAP)
    assert [get_value(robot, f"tower{k}.stop") for k in (1, 2, 3)] == pytest.approx(
        [302.0, 301.3, 301.2]
    )
    assert [get_value(robot, f"tower{k}.angle") for k in (1, 2, 3)] == pytest.approx(
        [209.9, 330.2, 90.0]
    )
    assert [get_value(robot, f"arm{k}.length") for k in (1, 2, 3)] == pytest.approx(
        [269.1, 269.2, 269.3]
    )
    assert get_value(robot, "radius") == pytest.approx(130.25)


def test_marlin_stops_are_the_height_less_the_adjustments_and_the_probe(tmp_path) -> None:
    robot = import_robot(tmp_path, "marlin", MARLIN)
    assert [get_value(robot, f"tower{k}.stop") for k in (1, 2, 3)] == pytest.approx(
        [302.0, 301.5, 301.75]
    )
    assert [get_value(robot, f"arm{k}.length") for k in (1, 2, 3)] == pytest.approx(
        [269.1, 269.2, 269.0]
    )


def test_marlin_and_reprap_state_adjustments_with_opposite_signs(tmp_path) -> None:
    robot = import_robot(tmp_path, "reprap", REPRAP)
    marlin = export_robot(robot, "marlin")
    assert "M666 X0.000000 " not in marlin
    assert (
        "M666 X-0.800000 Y-0.100000 Z-0.000000" in marlin
        or "M666 X-0.800000 Y-0.100000 Z0.000000" in marlin
    )
    again = import_robot(tmp_path, "marlin", marlin)
    np.testing.assert_allclose(again.values, robot.values, rtol=0, atol=2e-9)


def test_missing_word_is_added_before_the_comment(tmp_path) -> None:
    text = "M665 L250 R130 H300 ; ours\r\n"
    robot = import_robot(tmp_path, "reprap", text)
    shift = 1e-3 * np.eye(10)[1]
    save_robot(robot.with_values(robot.values + shift), tmp_path / "other.yaml")
    moved = load_robot(tmp_path / "other.yaml")
    (tmp_path / "reprap.g").write_bytes(text.encode())
    assert (
        export_robot(moved, "reprap", tmp_path / "reprap.g")
        == "M665 L250 R130 H300 X0.057296 ; ours\r\n"
    )


@pytest.mark.parametrize(
    "text",
    [
        "m665 l269.1 r130.25 h300\nm666 x0.5\n",
        "N10 M665 L269.1 R130.25 H300*33\nN11 M666 X0.5 * 12 ; stops\n",
        "M665L269.1R130.25H300\nM666X0.5\n",
        'M665 L269.1 (10" rods) R130.25 H300 (height\nM666 X0.5\n',
        "G21 M665 L269.1 R130.25 H300 M666 X0.5 G28\n",
        'M117 M665 L1 R1 H1\nM550 P"M665 R7"\nM665 L 269.1 R 130.25 H 300\nM666 X.5\n',
    ],
)
def test_commands_in_any_notation_are_read_completely(tmp_path, text) -> None:
    robot = import_robot(tmp_path, "reprap", text)
    assert [get_value(robot, f"tower{k}.stop") for k in (1, 2, 3)] == pytest.approx(
        [300.5, 300.0, 300.0]
    )
    assert [get_value(robot, f"arm{k}.length") for k in (1, 2, 3)] == pytest.approx([269.1] * 3)
    assert get_value(robot, "radius") == pytest.approx(130.25)
    assert export_robot(robot, "reprap", tmp_path / "reprap.g") == text


def test_corrected_and_added_words_update_the_checksum(tmp_path) -> None:
    text = "N1 m665 L269 R130 H300 M666 Y0.25*99 ; ours\n"
    robot = import_robot(tmp_path, "reprap", text)
    shift = 1e-3 * np.eye(len(robot.values))[robot.parameters.index("radius")]
    shift = (
        shift + np.deg2rad(0.5) * np.eye(len(robot.values))[robot.parameters.index("tower1.angle")]
    )
    written = export_robot(robot.with_values(robot.values + shift), "reprap", tmp_path / "reprap.g")
    code = "N1 m665 L269 R131.000000 H300 X0.500000 M666 Y0.25"
    checksum = 0
    for byte in code.encode():
        checksum ^= byte
    assert written == f"{code}*{checksum} ; ours\n"


@pytest.mark.parametrize(
    ("name", "text", "sentence"),
    [
        ("reprap", MARLIN, ":2: 'echo:' in front of M665 belongs to Marlin, whose end stops count"),
        ("reprap", MARLIN.replace("echo:", ""), ":4: M851 belongs to Marlin.*format marlin"),
        ("marlin", REPRAP, ":2: a list of lengths in M665 L belongs to RepRap.*format reprap"),
        ("marlin", "M665 L250 R130 H300\nM584 X0\n", ":2: M584 belongs to RepRapFirmware"),
    ],
)
def test_a_file_of_the_other_firmware_is_refused(tmp_path, name, text, sentence) -> None:
    """Their adjustments of end stops have opposite signs."""
    with pytest.raises(FileError, match=sentence):
        import_robot(tmp_path, name, text)
    robot = import_robot(tmp_path, "marlin", MARLIN)
    (tmp_path / "into.g").write_text(text)
    with pytest.raises(FileError, match=sentence):
        export_robot(robot, name, tmp_path / "into.g")
