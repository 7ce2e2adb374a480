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
