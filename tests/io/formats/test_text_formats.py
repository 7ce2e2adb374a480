# SPDX-License-Identifier: Apache-2.0
"""Files of controllers: what is written is read back, other lines are kept, wrong files refused."""

import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from loopcal.errors import FileError
from loopcal.io.formats import FORMATS
from loopcal.io.formats.import_export import build_imported_robot
from loopcal.io.formats.program_format import ExportSource, ImportOptions
from loopcal.mechanism.model import Mechanism
from tools.fuzz.sources import GENHEX, MARLIN, REPRAP

PRINTER = """\
[printer]
kinematics: delta
delta_radius: 130
[stepper_a]
arm_length = 250 ; mm
position_endstop: 300
rotation_distance: 40
microsteps: 16
[stepper_b]
[stepper_c]
"""
SAVED = """
#*# <---------------------- SAVE_CONFIG ---------------------->
#*# DO NOT EDIT THIS BLOCK OR BELOW. The contents are auto-generated.
#*#
#*# [stepper_b]
#*# angle = 330.500000
#*#
#*# [printer]
#*# delta_radius = 131.000000
"""
HEXAPOD = re.sub(r"(?m)^(setp .*)$", r"\1  # as built", GENHEX) + "".join(
    f"setp genhexkins.{side}-n.{n}.{axis} {value}\n"
    for side in ("base", "platform")
    for n in range(6)
    for axis, value in zip("xyz", (0, 0, 1), strict=True)
)
HEXAPOD += "setp genhexkins.screw-lead = 4.0\nsetp genhexkins.spindle-offset 7.5\n"


class Case(NamedTuple):
    """A file of a format, lines with its values, and the rounding of written values [m, rad]."""

    format: str
    text: str
    values: str
    rounding: float


FIRMWARE, OPTIONS = "M665|M666", "delta_radius|arm_length|position_endstop|angle"
CASES = {
    # six decimals are written; two such numbers make a stop
    "reprap": Case("reprap", REPRAP, FIRMWARE, 9e-9),
    "marlin": Case("marlin", MARLIN, FIRMWARE, 9e-9),
    "klipper": Case("klipper", PRINTER, OPTIONS, 1e-8),
    "klipper, saved": Case("klipper", PRINTER + SAVED, OPTIONS, 1e-8),
    "klipper, no line end": Case("klipper", PRINTER.rstrip("\n"), OPTIONS, 1e-8),
    "klipper, empty lines": Case("klipper", PRINTER + "\n\n", OPTIONS, 1e-8),
    "linuxcnc": Case("linuxcnc", HEXAPOD, r"genhexkins\.(base|platform)\.", 1e-15),
    "linuxcnc, no line end": Case("linuxcnc", GENHEX.rstrip("\n"), r"genhexkins\.", 1e-15),
}


def read(path: Path, name: str, text: str, **options: Any) -> Mechanism:
    path.write_text(text)
    reader = FORMATS[name].read
    assert reader is not None
    stated = {"length_unit": "mm"} if name == "linuxcnc" else {}
    return build_imported_robot(path, reader(path, ImportOptions("r", **{**stated, **options})))


def write(robot: Mechanism, name: str, into: Path | None = None) -> str:
    writer = FORMATS[name].write
    assert writer is not None
    return writer(ExportSource(robot), into).text


EQUAL = (130.25, (210.0, 330.0, 90.0), (269.1,) * 3, (300.5, 300.0, 300.0))
DELTAS = [
    # stops are the homed height plus the adjustments
    ("reprap", REPRAP, 130.25, (209.9, 330.2, 90.0), (269.1, 269.2, 269.3), (302.0, 301.3, 301.2)),
    # stops are the height less the adjustments and the probe
    ("marlin", MARLIN, 130.25, (209.9, 330.2, 90.0), (269.1, 269.2, 269.0), (302.0, 301.5, 301.75)),
    # the main part hides the saved block; others are defaults
    ("klipper", PRINTER + SAVED, 130.0, (210.0, 330.5, 90.0), (250.0,) * 3, (300.0,) * 3),
    # any notation of commands
    ("reprap", "m665 l269.1 r130.25 h300\nm666 x0.5\n", *EQUAL),
    ("reprap", "N10 M665 L269.1 R130.25 H300*33\nN11 M666 X0.5 * 12 ; stops\n", *EQUAL),
    ("reprap", "M665L269.1R130.25H300\nM666X0.5\n", *EQUAL),
    ("reprap", 'M665 L269.1 (10" rods) R130.25 H300 (height\nM666 X0.5\n', *EQUAL),
    ("reprap", "G21 M665 L269.1 R130.25 H300 M666 X0.5 G28\n", *EQUAL),
    (
        "reprap",
        'M117 M665 L1 R1 H1\nM550 P"M665 R7"\nM665 L 269.1 R 130.25 H 300\nM666 X.5\n',
        *EQUAL,
    ),
]
"""Format, text, and radius, tower angles, arms and stops that it states [mm, deg]."""


@pytest.mark.parametrize(("name", "text", "radius", "angles", "arms", "stops"), DELTAS)
def test_geometry_of_a_delta_is_read_completely(
    tmp_path, name, text, radius, angles, arms, stops
) -> None:
    robot = read(tmp_path / "file", name, text)
    values = dict(zip(robot.parameters.names, robot.values, strict=True))
    assert 1e3 * values["radius"] == pytest.approx(radius)
    for form, factor, expected in (
        ("tower{}.angle", 180.0 / np.pi, angles),
        ("arm{}.length", 1e3, arms),
        ("tower{}.stop", 1e3, stops),
    ):
        assert [factor * values[form.format(k)] for k in (1, 2, 3)] == pytest.approx(expected)
    assert write(robot, name, tmp_path / "file") == text


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_file_with_the_same_numbers_is_unchanged(tmp_path, case: Case) -> None:
    robot = read(tmp_path / "file", case.format, case.text)
    assert write(robot, case.format, tmp_path / "file") == case.text


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_corrected_values_are_read_as_written_and_other_lines_are_kept(tmp_path, case) -> None:
    path = tmp_path / "file"
    robot = read(path, case.format, case.text)
    names = np.array(robot.parameters.names)
    is_stored = np.array([not re.search(r"tower3\.angle|leg\d\.length", name) for name in names])
    shift = 1e-4 * np.random.default_rng(3).uniform(-1, 1, len(names)) * is_stored
    moved = robot.with_values(robot.values + shift)
    written = write(moved, case.format, path)
    new = write(moved, case.format)
    if case.format == "klipper":  # a block to paste, which other options of the file hide
        assert all(line.startswith("#*#") for line in new.splitlines())
        assert written.count("SAVE_CONFIG") == 1
        new = re.sub(rf"(?m)^({OPTIONS}).*\n", "", PRINTER) + f"\n{new}"
    kept = [line for line in case.text.splitlines() if not re.search(case.values, line)]
    lines = iter(written.splitlines())
    assert all(line in lines for line in kept)  # in their order
    for remark in ("B140.0", "# as built", "; mm", "; ours"):
        assert written.count(remark) == case.text.count(remark)
    for text in (written, new):
        values = read(path, case.format, text).values
        np.testing.assert_allclose(values, moved.values, rtol=0, atol=case.rounding)


REFUSED = [
    ("reprap", "G28\n", "no M665"),
    ("reprap", "M665 R1 H2\n", "L of M665 is missing"),
    ("reprap", "G20\nM665 L2 R1 H2\n", ":1: G20 selects inches"),
    ("reprap", "G28\nM665 L2:2:2:2 R1 H2\n", ":2: L of M665 has 4 lengths"),
    ("reprap", "M665 L250 R130 H2-3\n", ":1: H of M665 is '2-3', but must be a finite number"),
    ("reprap", "M665 L250 R130 H200\nM666 A0.3\n", ":2: M666 A tilts the bed"),
    ("reprap", "M665 L100 R130 H200\n", "the delta radius is 130 mm and the shortest arm 100 mm"),
    (
        "reprap",
        "G28\nM665 L269 R130,25 H250\n",
        ":2: R of M665 is '130,25', but must be a finite number",
    ),
    ("reprap", "M665 L269 R130 ,25 H250\n", ":1: M665 has ',25 H250', but a letter and its number"),
    ("reprap", "M665 269 R130 H250\n", ":1: M665 has '269 R130 H250', but a letter"),
    ("reprap", "M665 L269 R130 H250\nM666 X - 0.5\n", ":2: M666 has '0.5', but a letter"),
    (
        "reprap",
        "M665 L{var.rod} R130 H250\n",
        ":1: L of M665 is '{var.rod}', but must be a finite number",
    ),
    ("reprap", "M665 L269 R130 R131 H250\n", ":1: M665 has R twice"),
    ("reprap", "G28 G20\nM665 L269 R130 H250\n", ":1: G20 selects inches"),
    ("marlin", "M665 L250 R130 H200 B80\n", ":1: M665 B without A and C"),
    ("marlin", "M665 L269 R130 H250 M666 X-0.5\n", ":1: M666 is not the first command of this"),
    ("marlin", "M665 L250 R130 H200\nM666 X0.1\n", ":2: M666 X is 0.1, but is never positive in"),
]
"""Format, text and beginning of the sentence, with the line that it names."""

CHANGES = [
    ("kinematics: delta", "kinematics: corexy", ":2: "),
    ("kinematics: delta", "kinematics: corexy", "its kinematics is 'corexy'"),
    ("delta_radius: 130", "", "option 'delta_radius' of [printer] is missing"),
    ("delta_radius: 130", "[include geometry.cfg]", "if geometry.cfg contains it"),
    (
        "endstop: 300",
        "endstop: high",
        ":6: 'position_endstop' of [stepper_a] is 'high', but must be a",
    ),
    ("position_endstop: 300", "position_endstop: inf", ":6: "),
    ("arm_length = 250", "arm_length = 120", "delta radius is 130 mm and the shortest arm 120 mm"),
    ("[stepper_c]\n", "[delta_calibrate]\nheight0: 0\nheight0_pos: 1,2\n", ":12: 'height0_pos' "),
    ("[stepper_c]\n", "[delta_calibrate]\nheight0: 0\nheight0_pos: 1,2\n", " has 2 numbers"),
    ("[stepper_c]\n", "[delta_calibrate]\nheight0: 0\n", ":11: 'height0' "),
    (
        "[stepper_c]\n",
        "[delta_calibrate]\nheight0: 0\nheight0_pos: 1,2,3\n",
        "'rotation_distance' of [stepper_b] is missing",
    ),
    ("[stepper_c]\n", SAVED + "[tmc]\n", ":19: this line below SAVE_CONFIG"),
]
REFUSED += [("klipper", PRINTER.replace(old, new), sentence) for old, new, sentence in CHANGES]
REFUSED += [
    ("linuxcnc", GENHEX.replace("genhexkins.", "hexkins."), "this file has no 'setp genhexkins"),
    (
        "linuxcnc",
        GENHEX.replace("setp genhexkins.base.0.x", "# setp"),
        "'setp genhexkins.base.0.x ..' is missing",
    ),
    (
        "linuxcnc",
        re.sub(r"(base\.0\.y) \S+", r"\1 [HEX]B0Y", GENHEX),
        "genhexkins.base.0.y is '[HEX]B0Y', but must be a finite number",
    ),
]


@pytest.mark.parametrize(("name", "text", "sentence"), REFUSED)
def test_invalid_file_is_refused_in_one_sentence(tmp_path, name, text, sentence) -> None:
    with pytest.raises(FileError) as refused:
        read(tmp_path / "file", name, text)
    assert sentence in str(refused.value)


def test_a_hal_file_states_no_unit_of_length(tmp_path) -> None:
    with pytest.raises(FileError, match="a HAL file contains no unit of length"):
        read(tmp_path / "file", "linuxcnc", GENHEX, length_unit=None)
