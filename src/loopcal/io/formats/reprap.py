# SPDX-License-Identifier: Apache-2.0
"""RepRapFirmware's geometry of a delta printer, M665 and M666, as in config.g or config-override.g.

    M665 L.. R.. H.. X.. Y.. Z..    rods (one length, or a:b:c from 2.03 on), radius, homed height, turns of the towers
    M666 X.. Y.. Z.. A.. B..        end-stop adjustments, tilt of the bed in percent

Towers X, Y and Z stand at 210 + X, 330 + Y and 90 + Z degrees, counted anti-clockwise from above. A
positive adjustment means a higher end stop: stop_k = H + adjustment_k, and the firmware keeps the
mean adjustment at zero. Source: Duet's G-code dictionary (M665, M666) and LinearDeltaKinematics of
RepRapFirmware.
"""

from __future__ import annotations

from pathlib import Path

from loopcal.io.formats import gcode
from loopcal.io.formats.delta_geometry import (
    NOMINAL_ANGLES,
    DeltaNumbers,
    Three,
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

TOWERS = "XYZ"
REMARK = "; Delta geometry by loopcal; L with three lengths needs RepRapFirmware 2.03 or later\n"


def read(path: Path, reading: ImportOptions) -> Imported:
    """Read M665 and M666; FileError for what is missing, no number, or not of three towers, and for
    a tilted bed.
    """
    file = gcode.read(path)
    for letter in "AB":
        if file.number("M666", letter, 0.0) != 0.0:
            raise file.error(
                f"M666 {letter} tilts the bed, which the family linear-delta cannot say; set it to "
                "0 and probe again",
                "M666",
                letter,
            )
    height = file.number("M665", "H")
    turns = [
        nominal + file.number("M665", letter, 0.0)
        for letter, nominal in zip(TOWERS, NOMINAL_ANGLES, strict=True)
    ]
    stops = [height + file.number("M666", letter, 0.0) for letter in TOWERS]
    found = DeltaNumbers(file.number("M665", "R"), three(turns), _arms(file), three(stops))
    return Imported(
        robot_text(found, reading.name, path, "M665 and M666 of RepRapFirmware", arms_known=False)
    )


def write(source: ExportSource, into: Path | None) -> Exported:
    """The corrected words in a file whose other bytes stay, or two lines of their own."""
    numbers = numbers_of(source, "reprap")
    height = sum(numbers.stops) / 3
    arms = (
        numbers.arms[:1]
        if all(same(arm, numbers.arms[0]) for arm in numbers.arms)
        else numbers.arms
    )
    wanted = {("M665", "R"): numbers.radius, ("M665", "H"): height}
    turns, stops = (
        zip(TOWERS, numbers.angles, NOMINAL_ANGLES, strict=True),
        zip(TOWERS, numbers.stops, strict=True),
    )
    wanted |= {("M665", letter): angle - nominal for letter, angle, nominal in turns}
    wanted |= {("M666", letter): stop - height for letter, stop in stops}
    length = ":".join(written(arm) for arm in arms)
    if into is None:
        words = {"M665": [f"L{length}"], "M666": []}
        for (command, letter), value in wanted.items():
            words[command].append(f"{letter}{written(value)}")
        return Exported(
            REMARK + "".join(f"{command} {' '.join(found)}\n" for command, found in words.items()),
            _notes(arms),
        )
    file = gcode.read(into)
    present_stops = [
        file.number("M665", "H") + file.number("M666", letter, 0.0) for letter in TOWERS
    ]
    if all(same(one, other) for one, other in zip(present_stops, numbers.stops, strict=True)):
        # the stops are these already, however the file shares them between H and M666
        wanted = {key: value for key, value in wanted.items() if key[0] != "M666" and key[1] != "H"}
    present = file.words.get(("M665", "L"))
    file, notes = gcode.corrected(
        file, wanted, {(c, letter): 0.0 for c in ("M665", "M666") for letter in TOWERS}
    )
    if not all(same(one, other) for one, other in zip(_arms(file), numbers.arms, strict=True)):
        file = file.replaced("M665", "L", length)
        line = file.words["M665", "L"].line + 1
        notes.append(f"line {line}: M665 L {present.text if present else 'added'} -> {length}")
    return Exported(
        byte_order_mark(into) + "".join(file.lines), (*(notes or [UNCHANGED]), *_notes(arms))
    )


def _notes(arms: tuple[float, ...]) -> tuple[str, ...]:
    return (
        ("three rod lengths need RepRapFirmware 2.03 or later; older ones take the first for all",)
        if len(arms) > 1
        else ()
    )


def _arms(file: gcode.Gcode) -> Three:
    lengths = file.numbers("M665", "L") or (file.number("M665", "L"),)
    if len(lengths) > len(TOWERS):
        words = f"L of M665 has {len(lengths)} lengths; loopcal knows deltas of three towers"
        raise file.error(words, "M665", "L")
    # the firmware fills up with the first
    return three([*lengths, *[lengths[0]] * (3 - len(lengths))])


FORMAT = Format(
    "reprap", "M665 and M666 of RepRapFirmware (config.g, config-override.g)", (".g",), read, write
)
