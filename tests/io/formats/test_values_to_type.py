# SPDX-License-Identifier: Apache-2.0
"""Lines that people type have the digits that the uncertainty supports; files have all digits."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest

import loopcal as lc
from loopcal.cli.entry_point import main
from loopcal.io.formats import FORMATS
from loopcal.io.formats.program_format import ExportSource
from loopcal.mechanism.model import Mechanism

VALUES = {"radius": 105.56123456, "tower1.angle": 210.26712345, "tower1.stop": 299.72774321}
VALUES |= {"tower2.stop": 299.64701234, "tower3.stop": 300.29862345}
"""Identified values [mm, deg]."""
PLUS_MINUS = {"radius": 0.225, "tower1.angle": 0.288, "tower2.angle": 2.15}
PLUS_MINUS |= {"tower1.stop": 0.0829, "tower2.stop": 0.104, "tower3.stop": 0.0845}
"""Half of the 95 % intervals [mm, deg]."""


@pytest.fixture(scope="module")
def printer(root) -> Mechanism:
    robot = lc.load_robot(root / "examples" / "delta-printer" / "printer.yaml")
    values = robot.values.copy()
    for name, value in VALUES.items():
        values[robot.parameters.index(name)] = (
            np.deg2rad(value) if name.endswith("angle") else 1e-3 * value
        )
    return robot.with_values(values)


def write(source: ExportSource, name: str) -> str:
    writer = FORMATS[name].write
    assert writer is not None
    return writer(source, None).text


@pytest.mark.parametrize(
    ("name", "lines"),
    [
        ("marlin", ["M665 L220 R105.561 H299.647 X0.267 Y0 Z0", "M666 X-0.0807 Y0 Z-0.6516"]),
        ("reprap", ["M665 L220 R105.561 H299.891 X0.267 Y0 Z0", "M666 X-0.163 Y-0.244 Z0.408"]),
        ("klipper", ["delta_radius: 105.561", "position_endstop: 299.7277", "angle: 210.267"]),
    ],
)
def test_values_have_three_digits_of_their_uncertainty(printer, name, lines) -> None:
    text = write(ExportSource(printer, PLUS_MINUS, is_for_people=True), name)
    for line in lines:
        assert re.search(rf"^{re.escape(line)}$", text, re.MULTILINE), text


def test_poorly_known_values_have_fewer_digits_and_none_has_more_than_the_firmware(printer) -> None:
    wide = dict.fromkeys(PLUS_MINUS, 12.3)
    text = write(ExportSource(printer, wide, is_for_people=True), "klipper")
    assert "delta_radius: 105.6\n" in text
    assert "angle: 210.3\n" in text
    narrow = dict.fromkeys(PLUS_MINUS, 1e-9)
    for name, decimals in (("klipper", 6), ("marlin", 4), ("reprap", 3)):
        text = write(ExportSource(printer, narrow, is_for_people=True), name)
        assert max(len(d) for d in re.findall(r"\d\.(\d+)", text.split("\n", 1)[1])) == decimals


def test_values_without_intervals_keep_the_digits_of_the_firmware(printer) -> None:
    for unknown in ({}, dict.fromkeys(PLUS_MINUS, None), {"radius": float("inf")}):
        text = write(ExportSource(printer, unknown, is_for_people=True), "klipper")
    assert "delta_radius: 105.561235\n" in text


def test_files_have_all_digits(printer) -> None:
    source = ExportSource(printer, PLUS_MINUS)
    assert "delta_radius = 105.561235\n" in write(source, "klipper")
    assert "R105.561235" in write(source, "marlin")
    assert write(replace(source, plus_minus={}), "reprap") == write(source, "reprap")


def test_joint_centers_of_a_hexapod_are_rounded_by_their_uncertainty() -> None:
    robot = lc.load_robot("hexapod-42")
    half = dict.fromkeys(robot.parameters.names, 0.0123)
    values = robot.values + 1e-6 * np.pi
    source = ExportSource(robot.with_values(values), half, is_for_people=True)
    numbers = re.findall(r"^setp \S+ (\S+)$", write(source, "linuxcnc"), re.MULTILINE)
    assert len(numbers) == 36
    assert max(len(number.partition(".")[2]) for number in numbers) == 4  # 0.0123 mm
    source = replace(source, is_for_people=False)
    numbers = re.findall(r"^setp \S+ (\S+)$", write(source, "linuxcnc"), re.MULTILINE)
    assert max(len(number.partition(".")[2]) for number in numbers) > 9


def test_export_without_a_file_prints_what_to_type(root, tmp_path, capsys) -> None:
    folder = root / "examples" / "delta-printer"
    files = [str(folder / "printer.yaml"), str(folder / "heights.csv")]
    run = str(tmp_path / "run")
    assert main(["calibrate", *files, "-o", run]) == 0
    capsys.readouterr()
    assert main(["export", run, "--format", "marlin"]) == 0
    printed = capsys.readouterr()
    assert re.fullmatch(r"; .*\nM665 L220 R105\.644 .*\nM666 .*\n", printed.out), printed.out
    assert main(["export", run, "--format", "klipper", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["output"] is None
    assert document["text"].startswith("[printer]\ndelta_radius: 105.644\n[stepper_a]\n")
    assert "SAVE_CONFIG" in document["notes"][0]
    assert main(["export", run]) == 1
    assert "name the file to write with -o" in capsys.readouterr().err
    assert main(["export", run, "--format", "klipper", "--into", files[0]]) == 1
    assert "--into is impossible" in capsys.readouterr().err
