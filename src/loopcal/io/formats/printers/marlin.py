# SPDX-License-Identifier: Apache-2.0
"""Marlin's geometry of a delta printer, M665 and M666, as M503 prints it.

    M665 L.. R.. H.. X.. Y.. Z.. A.. B.. C..    rod, radius, height, tower turns, trims of the rods
    M666 X.. Y.. Z..                            end-stop adjustments, never positive

Towers X, Y and Z are at 210 + X, 330 + Y and 90 + Z degrees; rod k is L plus its trim. After homing
each carriage backs off from its end stop by its adjustment and is then at height H, so that
stop_k = H - adjustment_k: the opposite sign of RepRapFirmware's. With a bed probe the height is H
less the probe's Z offset (M851). A line holds one command. Source: Marlin's documentation of M665,
M666 and M851, and its modules delta and motion.
"""

from __future__ import annotations

from pathlib import Path

from loopcal.findings import report_finding
from loopcal.io.formats.printers import gcode
from loopcal.io.formats.printers.delta_geometry import (
    NOMINAL_ANGLES,
    DeltaGeometry,
    as_three,
    format_number,
    format_robot,
    get_geometry,
    is_same,
)
from loopcal.io.formats.program_format import (
    Exported,
    ExportSource,
    Format,
    Imported,
    ImportOptions,
    get_byte_order_mark,
    report_changes,
)

TOWERS, TRIMS = "XYZ", "ABC"
REMARK = (
    "; Delta geometry by loopcal, for Marlin without a bed probe: with one, add its Z offset "
    "(M851) to H\n"
)


def read(path: Path, options: ImportOptions) -> Imported:
    """Read M665, M666 and the probe offset M851.

    Raises
    ------
    FileError : a word is missing, not a number, or contradicts Marlin's rules.
    """
    file = gcode.read(path, one_in_a_line=True)
    geometry = _parse_geometry(file)
    offset = file.number("M851", "Z", 0.0)
    findings = (report_finding("files.probe-offset", offset=offset),) if offset else ()
    program = "M665 and M666 of Marlin"
    text = format_robot(geometry, options.name, path, program, has_distances=False)
    return Imported(text, None, findings)


def write(source: ExportSource, into: Path | None) -> Exported:
    """Return the corrected words in an existing file, or two lines of their own."""
    geometry = get_geometry(source, "marlin")
    file = None if into is None else gcode.read(into, one_in_a_line=True)
    lowest, arms = min(geometry.stops), geometry.arms
    wanted = {
        ("M665", "R"): geometry.radius,
        ("M665", "H"): lowest + (file.number("M851", "Z", 0.0) if file else 0.0),
    }
    turns = zip(TOWERS, geometry.angles, NOMINAL_ANGLES, strict=True)
    wanted |= {("M665", tower): angle - nominal for tower, angle, nominal in turns}
    stops = zip(TOWERS, geometry.stops, strict=True)
    wanted |= {("M666", tower): lowest - stop for tower, stop in stops}
    has_trims = not is_same(*((arm, arms[0]) for arm in arms))
    mean = sum(arms) / 3 if has_trims else arms[0]
    rods = {("M665", "L"): mean}
    trims = {("M665", letter): arm - mean for letter, arm in zip(TRIMS, arms, strict=True)}
    findings = (report_finding("files.marlin-rod-trims"),) if has_trims else ()
    if file is None or into is None:
        words = rods | (trims if has_trims else {}) | wanted
        texts = {key: format_number(value) for key, value in words.items()}
        return Exported(REMARK + gcode.format_commands(texts), findings)
    present = _parse_geometry(file)
    if is_same(*zip(present.stops, geometry.stops, strict=True)):
        wanted = {key: v for key, v in wanted.items() if key[0] != "M666" and key[1] != "H"}
    if not is_same(*zip(present.arms, arms, strict=True)):
        wanted |= rods | trims
    zeros = {("M665", letter): 0.0 for letter in TOWERS + TRIMS}
    zeros |= {("M666", letter): 0.0 for letter in TOWERS}
    file, changes = gcode.correct(file, wanted, zeros)
    text = get_byte_order_mark(into) + "".join(file.lines)
    return Exported(text, (*report_changes(changes), *findings))


def _parse_geometry(file: gcode.Gcode) -> DeltaGeometry:
    """Return the geometry of a file."""
    if [letter for letter in TRIMS if ("M665", letter) in file.words] == ["B"]:
        sentence = "M665 B without A and C is a radius in older Marlin and a rod trim in newer"
        raise file.error(f"{sentence}; remove it, or write all three", "M665", "B")
    rod, height = file.number("M665", "L"), file.number("M665", "H") - file.number("M851", "Z", 0.0)
    stops = []
    for letter in TOWERS:
        adjustment = file.number("M666", letter, 0.0)
        if adjustment > 0:
            sentence = f"M666 {letter} is {adjustment:g}, but is never positive in Marlin"
            raise file.error(
                f"{sentence} (in RepRapFirmware it may be); correct it", "M666", letter
            )
        stops.append(height - adjustment)
    angles = [
        nominal + file.number("M665", letter, 0.0)
        for letter, nominal in zip(TOWERS, NOMINAL_ANGLES, strict=True)
    ]
    arms = [rod + file.number("M665", letter, 0.0) for letter in TRIMS]
    radius = file.number("M665", "R")
    return DeltaGeometry(radius, as_three(angles), as_three(arms), as_three(stops))


FORMAT = Format("marlin", "M665 and M666 of Marlin (as M503 prints them)", (".gcode",), read, write)
