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

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import xor
from pathlib import Path
from typing import Any

from loopcal.errors import FileError
from loopcal.findings import Finding, report_finding
from loopcal.io.core.text_file import read_text
from loopcal.io.core.yaml_file import format_yaml
from loopcal.io.formats.probe_reports import import_probes
from loopcal.io.formats.program_format import (
    MM,
    Exported,
    ExportSource,
    Format,
    Imported,
    ImportOptions,
    Name,
    Value,
    ValueFile,
    format_head,
    format_number,
    get_record,
    is_same,
    round_digits,
    round_length,
    shorten_numbers,
)
from loopcal.mechanism.families.linear_delta import LinearDelta
from loopcal.plain_text import quote

# Angles of the towers in firmware, before any correction [deg].
NOMINAL_ANGLES = (210.0, 330.0, 90.0)

Triple = tuple[float, ...]
Words = dict[Name, float | str]


@dataclass(frozen=True)
class DeltaGeometry:
    """Radius, tower angles, arms and end stops [mm, deg].

    A stop is the height of the nozzle over the bed's center, with this carriage at its end stop.
    """

    radius: float
    angles: Triple
    arms: Triple
    stops: Triple


# Kinematics of firmware with closed loops -> the shipped robot that is most like it.
CLOSED = {
    **dict.fromkeys(("corexy", "hybrid_corexy", "corexyu", "corexyuv"), "core-xy"),
    **dict.fromkeys(("winch", "hangprinter"), "cable-4"),
    "rotary_delta": "rotary-delta",
    "five-bar": "five-bar",
    "deltesian": "linear-delta",
}

# Kinematics of RepRapFirmware by the number K of M669.
KINEMATICS = (
    *("cartesian", "corexy", "corexz", "delta", "scara", "corexyu", "hangprinter"),
    *("polar", "corexyuv", "five-bar", "rotary_delta"),
)


def report_kinematics(kinematics: str, sections: Sequence[str]) -> Finding:
    """Report that a configuration is of another machine, and whether loopcal calibrates it."""
    code, robot = "files.not-a-delta-configuration", CLOSED.get(kinematics, "")
    return report_finding(code, kinematics=kinematics, robot=robot, sections=sections)


COMMENTS = {
    "angles": "of the towers; the third defines the x axis and stays fixed",
    "stops": "height of the nozzle, in the center, with the carriage at its end stop",
    "readings": "carriage positions count down from the end stops",
    "workspace": "assumed. Replace by the real workspace",
    "tolerances": "measured by hand: prior knowledge",
    "fixed": "heights alone do not determine the arms; distances do",
}


def format_robot(
    geometry: DeltaGeometry, options: ImportOptions, path: Path, program: str, has_distances: bool
) -> str:
    """Return the robot file of a delta.

    Its arms are fixed unless distances determine them, or the options state how accurately they
    were measured by hand.
    """
    if not min(geometry.arms) > geometry.radius > 0:
        sentence = f"the delta radius is {geometry.radius:g} mm and the shortest arm"
        act = "the radius must be positive and every arm longer than it. Correct them"
        raise FileError(f"{sentence} {min(geometry.arms):g} mm; {act}", path)
    half = round_length(0.5 * geometry.radius)
    content: dict[str, Any] = {
        **vars(geometry),
        "readings": "drop",
        "home": {"z": 0},
        "workspace": {"x": [-half, half], "y": [-half, half], "z": [0, half]},
    }
    if options.sigma_tape is not None:
        sd = round_digits(options.choose_noise("tape") / MM)
        content["tolerances"] = {"arms": {"sd": sd}}
    elif not has_distances:
        content["fixed"] = ["arm*.length"]
    head = format_head(path, program, "linear-delta", options.name, ("mm", "deg"))
    return head + format_yaml(content, COMMENTS)


def get_geometry(source: ExportSource, format_name: str, decimals: int) -> DeltaGeometry:
    """Return the geometry of a robot of the family linear-delta; DataError for another.

    `decimals` : that the firmware stores, the most that people type.
    """
    get_record(source, LinearDelta, format_name, "a robot of the family linear-delta")
    values = source.values()

    def convert(name: str, factor: float) -> float:
        return source.round_number(values[name] * factor, name, 1.0 / factor, decimals)

    def list_towers(name: str, factor: float) -> Triple:
        return tuple(convert(name.format(k), factor) for k in (1, 2, 3))

    return DeltaGeometry(
        convert("radius", 1e3),
        list_towers("tower{}.angle", math.degrees(1)),
        list_towers("arm{}.length", 1e3),
        list_towers("tower{}.stop", 1e3),
    )


COMMAND = re.compile(r"\s*([GM]\d+)(?![\d.])")
# What a terminal (time, Recv:, >>>) and the firmware (echo:) write in front of a command.
FRONT = re.compile(
    r"[\s\[\]\d\-:.,]*(?:(?:RECV|SEND)\s*:|[<>]+)?\s*(ECHO:)?\s*(?:N\s*\d+)?", re.IGNORECASE
)
WORD = re.compile(r"\s*([A-Z])[ \t]*(\{[^}]*\}|[^A-Z\s{]*)")
ASIDE = re.compile(r'"[^"]*"?|;.*|\([^)]*\)?')
CHECKSUM = re.compile(r"\*\s*\d*\s*$")
UPPER = {ord(small): small.upper() for small in "abcdefghijklmnopqrstuvwxyz"}
READ = ("M665", "M666", "M669", "M851")
# Commands whose words are read, and commands that are followed by text.
WITH_TEXT = ("M16", "M23", "M28", "M30", "M32", "M117", "M118")


@dataclass(frozen=True)
class GcodeFile(ValueFile):
    """A file whose values are words, by command and letter.

    `commands` has the line (from 0) and the column behind the last word of each command.
    """

    commands: Mapping[str, tuple[int, int]]

    what = "G-code file"
    missing = "{1} of {0} is missing. Write it as {0} {1}.."

    @classmethod
    def parse(cls, lines: Sequence[str], path: Path, is_one_in_a_line: bool = False) -> GcodeFile:
        """Find the words; FileError for text that is not words, for a letter that occurs twice, and
        for a second command in a line where the firmware runs only one.
        """
        words: dict[Name, Value] = {}
        commands: dict[str, tuple[int, int]] = {}
        for i, line in enumerate(lines):
            for position, (command, letters, end, rest) in enumerate(_split_commands(line)):
                commands[command] = (i, end)
                if command not in READ:
                    continue
                if position and is_one_in_a_line:
                    sentence = f"{command} is not the first command of this line"
                    raise FileError(f"{sentence}. Move it to its own line", path, i + 1)
                if rest:
                    sentence = f"{command} has {quote(rest)}, but a letter and its number are"
                    raise FileError(f"{sentence} needed. Correct it", path, i + 1)
                for k, (letter, start, length) in enumerate(letters):
                    if any(letter == other for other, *_ in letters[:k]):
                        raise FileError(f"{command} has {letter} twice. Remove one", path, i + 1)
                    words[command, letter] = Value(line[start : start + length], i, start)
        return cls(path, tuple(lines), words, commands)

    def insert(self, lines: list[str], name: Name, text: str) -> None:
        """Insert a new word behind the others of its command, or a new command at the end."""
        command, letter = name
        if command in self.commands:
            number, end = self.commands[command]
            line = lines[number]
            lines[number] = self.finish_line(f"{line[:end]} {letter}{text}{line[end:]}")
        else:
            lines.append(f"{command} {letter}{text}{self.line_end}")

    def finish_line(self, line: str) -> str:
        """Return a line with the checksum of its text, where it has one: all bytes before `*`."""
        code = _blank_asides(line).rstrip()
        match = CHECKSUM.search(code)
        if match is None:
            return line
        text = line[: match.start()]
        return f"{text}*{reduce(xor, text.encode(), 0)}{line[len(code) :]}"


def _split_commands(line: str) -> Iterator[tuple[str, list[tuple[str, int, int]], int, str]]:
    """Yield the commands of a line: name, words (letter, column, length), end, other text."""
    code = CHECKSUM.sub("", _blank_asides(line).rstrip()).translate(UPPER)
    front = FRONT.match(code)
    column = front.end() if front is not None else 0
    while (command := COMMAND.match(code, column)) is not None:
        column, words = command.end(), []
        while not COMMAND.match(code, column) and (word := WORD.match(code, column)):
            words.append((word[1], word.start(2), len(word[2])))
            column = word.end()
        rest = "" if COMMAND.match(code, column) else code[column:].strip()
        yield command[1], words, len(code[:column].rstrip()), rest
        if command[1] in WITH_TEXT:
            return


def _blank_asides(line: str) -> str:
    """Return a line of the same length, with blanks for remarks and no letters in quotes."""
    return ASIDE.sub(
        lambda match: ("\0" if match[0].startswith('"') else " ") * len(match[0]), line
    )


TOWERS, TRIMS = "XYZ", "ABC"


@dataclass(frozen=True)
class DeltaFirmware:
    """Reader and writer of M665 and M666; the height of stop k is H + `sign` * adjustment_k.

    `name` is that of the format, `program` that of the firmware, `printed` where its words are,
    `remark` the first line of a new file. `has_trims` where rod k is L plus its trim, in lines of
    one command; otherwise L is one length, or a list. `decimals` : what the firmware keeps of a
    number in mm or degrees. `choose_height` : of a stop without adjustment, from those of all
    stops. `probe` : the word that H contains besides the height [mm]. `others` : the program,
    format and commands of the other firmware. `ending`, `probes` : see `Format`.
    """

    name: str
    program: str
    printed: str
    remark: str
    has_trims: bool
    sign: float
    decimals: int
    choose_height: Callable[[Triple], float]
    others: tuple[str, str, tuple[str, ...]]
    ending: str
    probes: str
    probe: Name | None = None

    @property
    def format(self) -> Format:
        """The format."""
        about = f"M665 and M666 of {self.program} ({self.printed})"
        used = {"sigma_height": "", "sigma_tape": "arms", "probes": self.probes}
        functions = {"read": self.read, "write": self.write, "read_options": used}
        return Format(self.name, about, (self.ending,), **functions, mark="M66[59]")

    def find_foreign(self, file: GcodeFile) -> tuple[str, int] | None:
        """Return what only the other firmware writes, with its line (from 0)."""
        rod, front = file.values.get(("M665", "L")), file.commands["M665"][0]
        if self.has_trims and rod is not None and ":" in rod.text:
            return "a list of lengths in M665 L", rod.line
        found = FRONT.match(file.lines[front])
        if not self.has_trims and found and found[1]:
            return "'echo:' in front of M665", front
        known = ((c, file.commands[c][0]) for c in self.others[2] if c in file.commands)
        return next(known, None)

    def refuse(self, file: GcodeFile) -> None:
        """Refuse a single trim B, positive adjustments, or a tilted bed."""
        for letter in "AB" if not self.has_trims else "":
            if file.number("M666", letter, 0.0) != 0.0:
                sentence = f"M666 {letter} tilts the bed, which a robot of the family linear-delta"
                raise file.error(f"{sentence} lacks. Set it to 0 and probe again", "M666", letter)
        if not self.has_trims:
            return
        if [letter for letter in TRIMS if file.has("M665", letter)] == ["B"]:
            sentence = "M665 B without A and C is a radius in older Marlin and a rod trim in newer"
            raise file.error(f"{sentence}. Remove it, or write all three", "M665", "B")
        for tower in TOWERS:
            if (adjustment := file.number("M666", tower, 0.0)) > 0:
                sentence = f"M666 {tower} is {adjustment:g}, but is never positive in Marlin"
                act = "(in RepRapFirmware it may be). Correct it"
                raise file.error(f"{sentence} {act}", "M666", tower)

    def parse_arms(self, file: GcodeFile) -> Triple:
        """Return the lengths of the arms [mm]: L plus each trim, or those of L, of which the
        firmware uses the first for those that are left out.
        """
        if self.has_trims:
            rod = file.number("M665", "L")
            return tuple(rod + file.number("M665", letter, 0.0) for letter in TRIMS)
        lengths = file.numbers("M665", "L", ":")
        if len(lengths) > len(TOWERS):
            sentence = f"L of M665 has {len(lengths)} lengths, but a delta of loopcal has three"
            raise file.error(f"{sentence} towers. Remove the others", "M665", "L")
        return lengths + lengths[:1] * (3 - len(lengths))

    def list_arms(self, arms: Triple, is_new: bool) -> tuple[Words, tuple[Finding, ...]]:
        """Return the words of arms and what they need: one length, or trims in an existing file."""
        is_equal = is_same(*((arm, arms[0]) for arm in arms))
        code = "files.marlin-rod-trims" if self.has_trims else "files.reprap-rod-lengths"
        findings = () if is_equal else (report_finding(code),)
        if not self.has_trims:
            texts = [format_number(arm) for arm in arms]
            return {("M665", "L"): texts[0] if is_equal else ":".join(texts)}, findings
        mean = arms[0] if is_equal else sum(arms) / 3
        words: Words = {("M665", "L"): mean}
        if not (is_equal and is_new):
            words |= {("M665", t): arm - mean for t, arm in zip(TRIMS, arms, strict=True)}
        return words, findings

    def load(self, path: Path) -> GcodeFile:
        """Read a file.

        FileError : no M665, inches, a word that is not a number or contradicts the firmware.
        """
        lines = read_text(path, GcodeFile.what).splitlines(keepends=True)
        file = GcodeFile.parse(lines, path, is_one_in_a_line=self.has_trims)
        number = file.number("M669", "K", math.nan)
        if number in range(len(KINEMATICS)) and KINEMATICS[int(number)] != "delta":
            finding = report_kinematics(KINEMATICS[int(number)], ())
            raise file.error(finding, "M669", "K")
        if "M665" not in file.commands:
            sentence = "no M665, the geometry of a delta, in this file; print it by M503"
            raise FileError(sentence, path)
        if "G20" in file.commands:
            sentence = "G20 selects inches. Write the geometry in millimeters"
            raise FileError(sentence, path, file.commands["G20"][0] + 1)
        if foreign := self.find_foreign(file):
            (what, line), (program, name, _) = foreign, self.others
            code = "files.other-firmware"
            raise FileError.of(code, path, line + 1, what=what, program=program, format=name)
        self.refuse(file)
        return file

    def read(self, path: Path, options: ImportOptions) -> Imported:
        """Read M665 and M666, and M851 where the firmware has it; FileError as `load`. The anchors
        of a hanging printer (M669 K6) are read as `hangprinter` does.
        """
        lines = read_text(path, GcodeFile.what).splitlines(keepends=True)
        hanging = GcodeFile.parse(lines, path)
        if hanging.number("M669", "K", 0.0) == KINEMATICS.index("hangprinter"):
            from loopcal.io.formats.hangprinter import read_config

            return read_config(hanging, options)
        file = self.load(path)
        turns = zip(TOWERS, NOMINAL_ANGLES, strict=True)
        geometry = DeltaGeometry(
            file.number("M665", "R"),
            tuple(nominal + file.number("M665", tower, 0.0) for tower, nominal in turns),
            self.parse_arms(file),
            self.parse_stops(file),
        )
        offset = self.get_probe_offset(file)
        findings = (report_finding("files.probe-offset", offset=offset),) if offset else ()
        if "M666" not in file.commands:
            findings += (report_finding("files.stops-assumed"),)
        program = f"M665 and M666 of {self.program}"
        text = format_robot(geometry, options, path, program, has_distances=False)
        if not options.probes:
            return Imported(text, None, findings)
        measurements, noted = import_probes(text, path, options, self.name)
        return Imported(text, measurements, (*findings, *noted))

    def write(self, source: ExportSource, into: Path | None) -> Exported:
        """Return the corrected words in an existing file, or two lines of their own."""
        geometry = get_geometry(source, self.name, self.decimals)
        is_new = into is None
        file = GcodeFile.parse([self.remark], Path("config.g")) if is_new else self.load(into)
        arms, findings = self.list_arms(geometry.arms, is_new)
        height = self.choose_height(geometry.stops)
        height = source.round_number(height, "tower1.stop", MM, self.decimals)
        turns = zip(TOWERS, geometry.angles, NOMINAL_ANGLES, strict=True)
        words: Words = {("M665", "R"): geometry.radius}
        words["M665", "H"] = height + self.get_probe_offset(file)
        words |= {("M665", tower): angle - nominal for tower, angle, nominal in turns}
        stops = zip(TOWERS, geometry.stops, strict=True)
        # 0.0 + makes zero of a negative zero
        words |= {("M666", tower): 0.0 + self.sign * (z - height) for tower, z in stops}
        if not is_new and is_same(*zip(self.parse_stops(file), geometry.stops, strict=True)):
            # the stops are these already, however the file divides them between H and M666
            words = {n: word for n, word in words.items() if n[0] != "M666" and n[1] != "H"}
        if is_new or not is_same(*zip(self.parse_arms(file), geometry.arms, strict=True)):
            words = arms | words
        zeros = {("M665", letter): 0.0 for letter in TOWERS + TRIMS}
        if "M666" in file.commands:  # otherwise its words may have other values in the printer
            zeros |= {("M666", letter): 0.0 for letter in TOWERS}
        if source.is_for_people and is_new:
            words = shorten_numbers(words, self.decimals)
        return file.export(into, words, zeros, findings)

    def get_probe_offset(self, file: GcodeFile) -> float:
        """Return how much H exceeds the height of the nozzle [mm]."""
        return file.number(*self.probe, 0.0) if self.probe is not None else 0.0

    def parse_stops(self, file: GcodeFile) -> Triple:
        """Return the heights of the nozzle at the end stops."""
        height = file.number("M665", "H") - self.get_probe_offset(file)
        return tuple(height + self.sign * file.number("M666", t, 0.0) for t in TOWERS)


MARLIN = DeltaFirmware(
    "marlin",
    "Marlin",
    "as M503 prints them",
    "; Delta geometry by loopcal, for Marlin without a bed probe: with one, add its Z offset "
    "(M851) to H\n",
    has_trims=True,
    sign=-1.0,
    decimals=4,  # single precision resolves 0.00003 mm of 300 mm
    choose_height=min,  # adjustments are never positive
    others=("RepRapFirmware", "reprap", ("M307", "M584")),
    ending=".gcode",
    probes="G30, G33 P3 V0, M114",
    probe=("M851", "Z"),
).format
REPRAP = DeltaFirmware(
    "reprap",
    "RepRapFirmware",
    "config.g, config-override.g",
    "; Delta geometry by loopcal; L with three lengths needs RepRapFirmware 2.03 or later\n",
    has_trims=False,
    sign=1.0,
    decimals=3,  # of M500
    choose_height=lambda stops: sum(stops) / 3,  # it keeps the mean adjustment at zero
    others=("Marlin", "marlin", ("M851",)),
    ending=".g",
    probes="G32 or G30 S-1 with their points, heightmap.csv",
).format
