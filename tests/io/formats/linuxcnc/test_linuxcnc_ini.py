# SPDX-License-Identifier: Apache-2.0
"""HOME_OFFSET lines of a LinuxCNC hexapod carry what a calibration adds to the struts."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from loopcal.cli.entry_point import main
from loopcal.errors import DataError, FileError
from loopcal.io.formats import FORMATS
from loopcal.io.formats.program_format import ExportSource
from loopcal.io.robot.robot_file import load_robot

ADDED = [0.0123456789, -0.02, 0.0, 0.031, -0.04, 0.05]
"""Identified minus nominal length of each strut [mm]."""


def make_ini(units: str | None = "mm", end: str = "\n") -> str:
    lines = ["[EMC]", "# HOME_OFFSET = 1", "[TRAJ]"]
    lines += [f"LINEAR_UNITS = {units}"] if units else []
    for n in range(6):
        lines += [f"[JOINT_{n}]", f"HOME_OFFSET= {250 + n}.5", "HOME = 250", "MIN_LIMIT = 150"]
    return end.join(lines) + end


@pytest.fixture
def source():
    robot = load_robot("hexapod-42")
    values = robot.values.copy()
    for n, added in enumerate(ADDED):
        values[robot.parameters.names.index(f"leg{n + 1}.length")] += added * 1e-3
    return ExportSource(robot.with_values(values))


def export(source: ExportSource, into: Path | None):
    write = FORMATS["linuxcnc-ini"].write
    assert write is not None
    return write(source, into)


@pytest.mark.parametrize(("units", "scale"), [("mm", 1.0), ("inch", 25.4), (None, 1.0)])
def test_offsets_grow_by_the_identified_change(units, scale, source, tmp_path) -> None:
    file = tmp_path / "machine.ini"
    file.write_bytes(make_ini(units, "\r\n").encode())
    exported = export(source, file)
    offsets = [float(x.split("=")[1]) for x in exported.text.splitlines() if x.startswith("HOME_O")]
    expected = [250.5 + n + added / scale for n, added in enumerate(ADDED)]
    np.testing.assert_allclose(offsets, expected, atol=5.1e-7)  # [machine unit], six decimals
    assert exported.text.count("\r\n") == exported.text.count("\n")
    assert "HOME_OFFSET= 252.5\r\n" in exported.text  # strut 2 has not changed
    assert "[JOINT_0]HOME_OFFSET" in str(exported.findings[0])
    codes = {finding.code for finding in exported.findings}
    assert ("files.machine-unit" in codes) == (units is None)


def test_new_lines_state_the_length_at_reading_zero(source, tmp_path, monkeypatch, capsys) -> None:
    exported = export(source, None)
    assert exported.text.startswith("[JOINT_0]\nHOME_OFFSET = 233.250422\n[JOINT_1]\n")
    assert {f.code for f in exported.findings} >= {"files.offset-at-reading-zero"}
    monkeypatch.chdir(tmp_path)
    (tmp_path / "machine.ini").write_text(make_ini())
    words = "export hexapod-42 --into machine.ini -o new.ini"
    assert main(words.split()) == 0
    assert (tmp_path / "new.ini").read_text() == make_ini()
    assert main(["export", "hexapod-42", "-o", "new.hal"]) == 0
    assert "--format linuxcnc-ini --into machine.ini" in " ".join(capsys.readouterr().out.split())


def test_files_without_what_is_needed_are_refused(source, tmp_path) -> None:
    file = tmp_path / "machine.ini"
    file.write_text(make_ini().replace("HOME_OFFSET= 253.5\n", ""))
    with pytest.raises(FileError, match=r"\[JOINT_3\] has no HOME_OFFSET. Add"):
        export(source, file)
    file.write_text(make_ini("furlong"))
    with pytest.raises(FileError, match=r"machine.ini:4: LINEAR_UNITS is 'furlong'. Allowed: mm"):
        export(source, file)
    with pytest.raises(DataError, match="the format linuxcnc-ini holds"):
        export(ExportSource(load_robot("core-xy")), file)


def test_readings_that_are_lengths_need_the_file(tmp_path) -> None:
    (tmp_path / "h.yaml").write_text(
        load_robot("hexapod-42")
        .record.text.replace("lengths: 233.238076", "lengths: 0")
        .replace("stroke: [-75, 75]", "stroke: [150, 310]")
    )
    with pytest.raises(DataError, match="Name the INI file to correct"):
        export(ExportSource(load_robot(tmp_path / "h.yaml")), None)


def test_lines_for_people_say_what_to_add(source) -> None:
    half = {f"leg{n}.length": 0.0123 for n in range(1, 7)}
    shown = export(replace(source, plus_minus=half, is_for_people=True), None).text
    assert shown.startswith("[JOINT_0]\n# add +0.0123 mm to HOME_OFFSET\n[JOINT_1]\n# add -0.02 mm")
