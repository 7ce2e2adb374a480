# SPDX-License-Identifier: Apache-2.0
"""RepRapFirmware's geometry of a delta printer, M665 and M666, in config.g or config-override.g.

    M665 L.. R.. H.. X.. Y.. Z..    rods (one length, or a:b:c from 2.03 on), radius, homed height,
                                    tower turns
    M666 X.. Y.. Z.. A.. B..        end-stop adjustments, tilt of the bed in percent

Towers X, Y and Z are at 210 + X, 330 + Y and 90 + Z degrees, counterclockwise from above. A
positive adjustment means a higher end stop: stop_k = H + adjustment_k, and the firmware keeps the
mean adjustment at zero. Source: Duet's G-code dictionary (M665, M666) and LinearDeltaKinematics of
RepRapFirmware.
"""

from __future__ import annotations

from pathlib import Path

from loopcal.findings import report_finding
from loopcal.io.formats.printers import gcode
from loopcal.io.formats.printers.delta_geometry import (
    NOMINAL_ANGLES,
    DeltaGeometry,
    Three,
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
    report_change,
    report_changes,
)

TOWERS = "XYZ"
REMARK = "; Delta geometry by loopcal; L with three lengths needs RepRapFirmware 2.03 or later\n"


def read(path: Path, options: ImportOptions) -> Imported:
    """Read M665 and M666.

    Raises
    ------
    FileError : a word is missing or not a number, there are not three towers, or the bed is tilted.
    """
    file = gcode.read(path)
    for letter in "AB":
        if file.number("M666", letter, 0.0) != 0.0:
            sentence = (
                f"M666 {letter} tilts the bed, which a robot of the family linear-delta lacks"
            )
            raise file.error(f"{sentence}; set it to 0 and probe again", "M666", letter)
    turns = [
        nominal + file.number("M665", letter, 0.0)
        for letter, nominal in zip(TOWERS, NOMINAL_ANGLES, strict=True)
    ]
    geometry = DeltaGeometry(
        file.number("M665", "R"), as_three(turns), _parse_arms(file), _parse_stops(file)
    )
    program = "M665 and M666 of RepRapFirmware"
    return Imported(format_robot(geometry, options.name, path, program, has_distances=False))


def write(source: ExportSource, into: Path | None) -> Exported:
    """Return the corrected words in an existing file, or two lines of their own."""
    geometry = get_geometry(source, "reprap")
    height = sum(geometry.stops) / 3
    all_equal = is_same(*((arm, geometry.arms[0]) for arm in geometry.arms))
    arms = geometry.arms[:1] if all_equal else geometry.arms
    wanted = {("M665", "R"): geometry.radius, ("M665", "H"): height}
    turns = zip(TOWERS, geometry.angles, NOMINAL_ANGLES, strict=True)
    wanted |= {("M665", letter): angle - nominal for letter, angle, nominal in turns}
    stops = zip(TOWERS, geometry.stops, strict=True)
    wanted |= {("M666", letter): stop - height for letter, stop in stops}
    length = ":".join(format_number(arm) for arm in arms)
    findings = () if all_equal else (report_finding("files.reprap-rod-lengths"),)
    if into is None:
        texts = {key: format_number(value) for key, value in wanted.items()}
        return Exported(REMARK + gcode.format_commands({("M665", "L"): length} | texts), findings)
    file = gcode.read(into)
    if is_same(*zip(_parse_stops(file), geometry.stops, strict=True)):
        # the stops are these already, however the file divides them between H and M666
        wanted = {key: v for key, v in wanted.items() if key[0] != "M666" and key[1] != "H"}
    word, present = file.words.get(("M665", "L")), _parse_arms(file)
    zeros = {(command, letter): 0.0 for command in ("M665", "M666") for letter in TOWERS}
    file, changes = gcode.correct(file, wanted, zeros)
    if not is_same(*zip(present, geometry.arms, strict=True)):
        file = file.replace("M665", "L", length)
        line = file.words["M665", "L"].line + 1
        changes.append(report_change(line, "M665 L", None if word is None else word.text, length))
    text = get_byte_order_mark(into) + "".join(file.lines)
    return Exported(text, (*report_changes(changes), *findings))


def _parse_stops(file: gcode.Gcode) -> Three:
    """Return the heights of the end stops."""
    height = file.number("M665", "H")
    return as_three([height + file.number("M666", letter, 0.0) for letter in TOWERS])


def _parse_arms(file: gcode.Gcode) -> Three:
    """Return the lengths of the arms; the firmware uses the first for those that are left out."""
    lengths = file.numbers("M665", "L") or (file.number("M665", "L"),)
    if len(lengths) > len(TOWERS):
        sentence = f"L of M665 has {len(lengths)} lengths, but a delta of loopcal has three towers"
        raise file.error(f"{sentence}; remove the others", "M665", "L")
    return as_three([*lengths, *[lengths[0]] * (3 - len(lengths))])


FORMAT = Format(
    "reprap", "M665 and M666 of RepRapFirmware (config.g, config-override.g)", (".g",), read, write
)
