# SPDX-License-Identifier: Apache-2.0
"""Marlin's geometry of a delta printer, M665 and M666, as M503 prints it.

    M665 L.. R.. H.. X.. Y.. Z.. A.. B.. C..    rod, radius, height, turns of the towers, trims of the three rods
    M666 X.. Y.. Z..                            end-stop adjustments, none above zero

Towers X, Y and Z stand at 210 + X, 330 + Y and 90 + Z degrees; rod k is L plus its trim. After
homing each carriage backs off from its end stop by its adjustment and stands at height H then, so
stop_k = H - adjustment_k: the opposite sign of RepRapFirmware's. With a bed probe the height is H
less the probe's Z offset (M851). A line holds one command. Source: Marlin's documentation of M665,
M666 and M851, and its modules delta and motion.
"""

from __future__ import annotations

from pathlib import Path

from loopcal.io.formats import gcode
from loopcal.io.formats.delta_geometry import (
    NOMINAL_ANGLES,
    DeltaNumbers,
    numbers_of,
    robot_text,
    same,
    three,
    written,
)
from loopcal.io.formats.program_format import (
    UNCHANGED,
    Exported,
    ExportSource,
    Format,
    Imported,
    ImportOptions,
    byte_order_mark,
)

TOWERS, TRIMS = "XYZ", "ABC"
REMARK = "; Delta geometry by loopcal, for Marlin without a bed probe: with one, add its Z offset (M851) to H\n"
OLD = "rod trims (M665 A, B, C) need Marlin 2.0.6 or later; older ones know one rod length only, and take B for a radius"


def read(path: Path, reading: ImportOptions) -> Imported:
    """Read M665 and M666 (and the probe's offset M851); FileError for what is missing, no number or
    contradictory.
    """
    file = gcode.read(path, one_in_a_line=True)
    found = _present(file)
    offset = file.number("M851", "Z", 0.0)
    notes = (f"M851 Z{offset:g}: the height at home is H less this probe offset",) if offset else ()
    return Imported(
        robot_text(found, reading.name, path, "M665 and M666 of Marlin", arms_known=False),
        None,
        notes,
    )


def write(source: ExportSource, into: Path | None) -> Exported:
    """The corrected words in a file whose other bytes stay, or two lines of their own."""
    numbers = numbers_of(source, "marlin")
    file = None if into is None else gcode.read(into, one_in_a_line=True)
    lowest = min(numbers.stops)
    wanted = {
        ("M665", "R"): numbers.radius,
        ("M665", "H"): lowest + (file.number("M851", "Z", 0.0) if file else 0.0),
    }
    wanted |= {
        ("M665", t): a - n for t, a, n in zip(TOWERS, numbers.angles, NOMINAL_ANGLES, strict=True)
    }
    wanted |= {("M666", t): lowest - stop for t, stop in zip(TOWERS, numbers.stops, strict=True)}
    unlike = not all(same(arm, numbers.arms[0]) for arm in numbers.arms)
    mean = sum(numbers.arms) / 3 if unlike else numbers.arms[0]
    rods = {("M665", "L"): mean} | {
        ("M665", t): arm - mean for t, arm in zip(TRIMS, numbers.arms, strict=True)
    }
    notes = (OLD,) if unlike else ()
    if file is None or into is None:
        words: dict[str, list[str]] = {"M665": [], "M666": []}
        for (command, letter), value in (
            (rods if unlike else {("M665", "L"): mean}) | wanted
        ).items():
            words[command].append(f"{letter}{written(value)}")
        return Exported(
            REMARK + "".join(f"{command} {' '.join(found)}\n" for command, found in words.items()),
            notes,
        )
    present = _present(file)
    if all(same(one, other) for one, other in zip(present.stops, numbers.stops, strict=True)):
        wanted = {key: value for key, value in wanted.items() if key[0] != "M666" and key[1] != "H"}
    if not all(same(one, other) for one, other in zip(present.arms, numbers.arms, strict=True)):
        wanted |= rods
    zero = {("M665", letter): 0.0 for letter in TOWERS + TRIMS} | {
        ("M666", letter): 0.0 for letter in TOWERS
    }
    file, changes = gcode.corrected(file, wanted, zero)
    return Exported(
        byte_order_mark(into) + "".join(file.lines), (*(changes or [UNCHANGED]), *notes)
    )


def _present(file: gcode.Gcode) -> DeltaNumbers:
    """The numbers of a file."""
    given = [letter for letter in TRIMS if ("M665", letter) in file.words]
    if given == ["B"]:
        raise file.error(
            "M665 B without A and C is a radius in older Marlin and a rod trim in newer; leave it "
            "out, or write all three",
            "M665",
            "B",
        )
    rod, height = file.number("M665", "L"), file.number("M665", "H") - file.number("M851", "Z", 0.0)
    stops = []
    for letter in TOWERS:
        adjustment = file.number("M666", letter, 0.0)
        if adjustment > 0:
            raise file.error(
                f"M666 {letter} is {adjustment:g}, but Marlin takes none above zero (--format "
                "reprap does); correct it",
                "M666",
                letter,
            )
        stops.append(height - adjustment)
    angles = [
        nominal + file.number("M665", letter, 0.0)
        for letter, nominal in zip(TOWERS, NOMINAL_ANGLES, strict=True)
    ]
    arms = [rod + file.number("M665", letter, 0.0) for letter in TRIMS]
    return DeltaNumbers(file.number("M665", "R"), three(angles), three(arms), three(stops))


FORMAT = Format("marlin", "M665 and M666 of Marlin (what M503 prints)", (".gcode",), read, write)
