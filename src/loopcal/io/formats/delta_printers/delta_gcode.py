# SPDX-License-Identifier: Apache-2.0
"""Geometry of a delta printer in M665 and M666, of Marlin and of RepRapFirmware.

    M665 L.. R.. H.. X.. Y.. Z..    rods, radius, homed height, tower turns
    M666 X.. Y.. Z..                end-stop adjustments

Towers X, Y and Z are at 210 + X, 330 + Y and 90 + Z degrees, counterclockwise from above.

Marlin: rod k is L plus its trim A, B or C. After homing each carriage backs off from its end stop
by its adjustment (never positive) and is then at height H, so that stop_k = H - adjustment_k. With
a bed probe the height is H less the probe's Z offset (M851). A line holds one command. Source:
Marlin's documentation of M665, M666 and M851, and its modules delta and motion.

RepRapFirmware: L is one length or, from 2.03 on, a:b:c; stop_k = H + adjustment_k, and the firmware
keeps the mean adjustment at zero. M666 A and B tilt the bed in percent. Source: Duet's G-code
dictionary (M665, M666) and LinearDeltaKinematics of RepRapFirmware.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from loopcal.errors import FileError
from loopcal.findings import Finding, report_finding
from loopcal.io.formats.delta_printers.delta_geometry import (
    NOMINAL_ANGLES,
    DeltaGeometry,
    format_robot,
    get_geometry,
)
from loopcal.io.formats.delta_printers.probe_reports import import_probes
from loopcal.io.formats.gcode_file import GcodeFile, parse_gcode, read_gcode
from loopcal.io.formats.program_format import (
    Exported,
    ExportSource,
    Format,
    Imported,
    ImportOptions,
)
from loopcal.io.formats.value_file import Name, format_number, is_same, shorten_numbers

ECHO = re.compile(r"\s*echo:", re.IGNORECASE)
MARLIN_COMMANDS, REPRAP_COMMANDS = ("M851",), ("M307", "M584")
"""What only a report of Marlin begins with, and commands that only one of the firmwares has."""

MM = 1e-3
MARLIN_DECIMALS, REPRAP_DECIMALS = 4, 3
"""Decimals that a firmware keeps: Marlin has numbers of single precision, which resolve 0.00003 mm
of 300 mm; RepRapFirmware writes three decimals (M500).
"""

TOWERS, TRIMS = "XYZ", "ABC"
Numbers = tuple[float, ...]
Words = dict[Name, float | str]


@dataclass(frozen=True)
class DeltaFirmware:
    """Reader and writer of M665 and M666; the height of stop k is H + `sign` * adjustment_k.

    Attributes
    ----------
    name : of the format. program : of the firmware. remark : first line of a new file.
    one_in_a_line : whether the firmware runs one command in a line.
    decimals : that the firmware keeps of a number in mm or degrees.
    probe : word that H contains besides the height [mm]; None without one.
    choose_height : returns the height of a stop without adjustment, from those of all stops [mm].
    refuse : raises FileError for words that contradict the firmware, or that loopcal lacks.
    parse_arms : returns the lengths of the arms [mm].
    list_arms : returns the words of arms, in a new file or not, and what they need.
    """

    name: str
    program: str
    remark: str
    sign: float
    one_in_a_line: bool
    decimals: int
    probe: Name | None
    choose_height: Callable[[Numbers], float]
    refuse: Callable[[GcodeFile], None]
    parse_arms: Callable[[GcodeFile], Numbers]
    list_arms: Callable[[Numbers, bool], tuple[Words, tuple[Finding, ...]]]

    def read(self, path: Path, options: ImportOptions) -> Imported:
        """Read M665 and M666, and M851 where the firmware has it.

        Raises
        ------
        FileError : a word is missing, not a number, or contradicts the rules of the firmware.
        """
        file = read_gcode(path, self.one_in_a_line)
        self.refuse(file)
        turns = zip(TOWERS, NOMINAL_ANGLES, strict=True)
        geometry = DeltaGeometry(
            file.number("M665", "R"),
            tuple(nominal + file.number("M665", tower, 0.0) for tower, nominal in turns),
            self.parse_arms(file),
            self._parse_stops(file),
        )
        offset = self._get_probe_offset(file)
        findings = (report_finding("files.probe-offset", offset=offset),) if offset else ()
        program = f"M665 and M666 of {self.program}"
        text = format_robot(geometry, options, path, program, has_distances=False)
        if not options.probes:
            return Imported(text, None, findings)
        measurements, finding = import_probes(text, path, options, self.name)
        return Imported(text, measurements, (*findings, finding))

    def write(self, source: ExportSource, into: Path | None) -> Exported:
        """Return the corrected words in an existing file, or two lines of their own."""
        geometry = get_geometry(source, self.name, self.decimals)
        file = parse_gcode([self.remark], Path("config.g"))
        if into is not None:
            file = read_gcode(into, self.one_in_a_line)
            self.refuse(file)
        arms, findings = self.list_arms(geometry.arms, into is None)
        height = self.choose_height(geometry.stops)
        height = source.round_number(height, "tower1.stop", MM, self.decimals)
        turns = zip(TOWERS, geometry.angles, NOMINAL_ANGLES, strict=True)
        words: Words = {("M665", "R"): geometry.radius}
        words["M665", "H"] = height + self._get_probe_offset(file)
        words |= {("M665", tower): angle - nominal for tower, angle, nominal in turns}
        stops = zip(TOWERS, geometry.stops, strict=True)
        # 0.0 + makes zero of a negative zero
        words |= {("M666", tower): 0.0 + self.sign * (z - height) for tower, z in stops}
        if into is not None and is_same(*zip(self._parse_stops(file), geometry.stops, strict=True)):
            # the stops are these already, however the file divides them between H and M666
            words = {n: word for n, word in words.items() if n[0] != "M666" and n[1] != "H"}
        if into is None or not is_same(*zip(self.parse_arms(file), geometry.arms, strict=True)):
            words = arms | words
        zeros = {("M665", letter): 0.0 for letter in TOWERS + TRIMS}
        zeros |= {("M666", letter): 0.0 for letter in TOWERS}
        if source.is_for_people and into is None:
            words = shorten_numbers(words, self.decimals)
        return file.export(into, words, zeros, findings)

    def _get_probe_offset(self, file: GcodeFile) -> float:
        """Return how much H exceeds the height of the nozzle [mm]."""
        return file.number(*self.probe, 0.0) if self.probe is not None else 0.0

    def _parse_stops(self, file: GcodeFile) -> Numbers:
        """Return the heights of the nozzle at the end stops."""
        height = file.number("M665", "H") - self._get_probe_offset(file)
        return tuple(height + self.sign * file.number("M666", t, 0.0) for t in TOWERS)


def _refuse_marlin(file: GcodeFile) -> None:
    """Raise FileError for a file of RepRapFirmware, a single trim B, and positive adjustments."""
    program, name = "RepRapFirmware", "reprap"
    if file.has("M665", "L") and ":" in file.text("M665", "L"):
        finding = report_finding(
            "files.other-firmware", what="a list of lengths in M665 L", program=program, format=name
        )
        raise file.error(finding, "M665", "L")
    _refuse_commands(file, REPRAP_COMMANDS, program, name)
    if [letter for letter in TRIMS if file.has("M665", letter)] == ["B"]:
        sentence = "M665 B without A and C is a radius in older Marlin and a rod trim in newer"
        raise file.error(f"{sentence}; remove it, or write all three", "M665", "B")
    for tower in TOWERS:
        if (adjustment := file.number("M666", tower, 0.0)) > 0:
            sentence = f"M666 {tower} is {adjustment:g}, but is never positive in Marlin"
            act = "(in RepRapFirmware it may be); correct it"
            raise file.error(f"{sentence} {act}", "M666", tower)


def _refuse_commands(file: GcodeFile, commands: Sequence[str], program: str, name: str) -> None:
    """Raise FileError for commands that only another firmware has."""
    for command in commands:
        if command in file.commands:
            finding = report_finding(
                "files.other-firmware", what=command, program=program, format=name
            )
            raise FileError(finding, file.path, file.commands[command][0] + 1)


def _refuse_reprap(file: GcodeFile) -> None:
    """Raise FileError for a file of Marlin, and for a tilted bed."""
    program, name = "Marlin", "marlin"
    number = file.commands["M665"][0]
    if ECHO.match(file.lines[number]):
        finding = report_finding(
            "files.other-firmware", what="'echo:' in front of M665", program=program, format=name
        )
        raise FileError(finding, file.path, number + 1)
    _refuse_commands(file, MARLIN_COMMANDS, program, name)
    for letter in "AB":
        if file.number("M666", letter, 0.0) != 0.0:
            sentence = f"M666 {letter} tilts the bed, which a robot of the family linear-delta"
            raise file.error(f"{sentence} lacks; set it to 0 and probe again", "M666", letter)


def _parse_trims(file: GcodeFile) -> Numbers:
    """Return L plus each trim."""
    rod = file.number("M665", "L")
    return tuple(rod + file.number("M665", letter, 0.0) for letter in TRIMS)


def _parse_lengths(file: GcodeFile) -> Numbers:
    """Return the lengths of L; the firmware uses the first for those that are left out."""
    lengths = file.numbers("M665", "L", ":")
    if len(lengths) > len(TOWERS):
        sentence = f"L of M665 has {len(lengths)} lengths, but a delta of loopcal has three towers"
        raise file.error(f"{sentence}; remove the others", "M665", "L")
    return lengths + lengths[:1] * (3 - len(lengths))


def _list_trims(arms: Numbers, is_new: bool) -> tuple[Words, tuple[Finding, ...]]:
    """Return L and the trims; L alone in a new file of equal arms."""
    is_equal = is_same(*((arm, arms[0]) for arm in arms))
    mean = arms[0] if is_equal else sum(arms) / 3
    words: Words = {("M665", "L"): mean}
    if not (is_equal and is_new):
        words |= {("M665", t): arm - mean for t, arm in zip(TRIMS, arms, strict=True)}
    return words, () if is_equal else (report_finding("files.marlin-rod-trims"),)


def _list_lengths(arms: Numbers, is_new: bool) -> tuple[Words, tuple[Finding, ...]]:
    """Return L: one length where all arms are equal."""
    del is_new
    texts = [format_number(arm) for arm in arms]
    is_equal = len(set(texts)) == 1
    words: Words = {("M665", "L"): texts[0] if is_equal else ":".join(texts)}
    return words, () if is_equal else (report_finding("files.reprap-rod-lengths"),)


MARLIN_FIRMWARE = DeltaFirmware(
    "marlin",
    "Marlin",
    "; Delta geometry by loopcal, for Marlin without a bed probe: with one, add its Z offset "
    "(M851) to H\n",
    -1.0,
    True,
    MARLIN_DECIMALS,
    ("M851", "Z"),
    min,
    _refuse_marlin,
    _parse_trims,
    _list_trims,
)
REPRAP_FIRMWARE = DeltaFirmware(
    "reprap",
    "RepRapFirmware",
    "; Delta geometry by loopcal; L with three lengths needs RepRapFirmware 2.03 or later\n",
    1.0,
    False,
    REPRAP_DECIMALS,
    None,
    lambda stops: sum(stops) / 3,
    _refuse_reprap,
    _parse_lengths,
    _list_lengths,
)
MARLIN = Format(
    "marlin",
    "M665 and M666 of Marlin (as M503 prints them)",
    (".gcode",),
    MARLIN_FIRMWARE.read,
    MARLIN_FIRMWARE.write,
    read_options=("sigma_height", "sigma_tape", "probes"),
)
REPRAP = Format(
    "reprap",
    "M665 and M666 of RepRapFirmware (config.g, config-override.g)",
    (".g",),
    REPRAP_FIRMWARE.read,
    REPRAP_FIRMWARE.write,
    read_options=("sigma_height", "sigma_tape", "probes"),
)
