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
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from operator import xor
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from loopcal.errors import FileError
from loopcal.findings import Finding, Quantity, report_finding
from loopcal.io.core.text_file import read_text
from loopcal.io.core.yaml_file import parse_yaml
from loopcal.io.formats.program_format import (
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
    shorten_numbers,
)
from loopcal.io.robot.robot_file import build_robot
from loopcal.mechanism.families.linear_delta import LinearDelta
from loopcal.plain_text import quote

if TYPE_CHECKING:
    from loopcal.measure.measurements import Measurements


# The geometry of a linear delta in the mm and degrees of printer firmware, and its robot file.

NOMINAL_ANGLES = (210.0, 330.0, 90.0)
"""Angles of the towers in firmware, before any correction [deg]."""


@dataclass(frozen=True)
class DeltaGeometry:
    """Radius, tower angles, arms and end stops [mm, deg].

    A stop is the height of the nozzle over the bed, in the center, with the carriage of this tower
    at its end stop.
    """

    radius: float
    angles: tuple[float, ...]
    arms: tuple[float, ...]
    stops: tuple[float, ...]


ROBOT = """\
radius: {radius}
angles: {angles}     # of the towers; the third defines the x axis and stays fixed
arms: {arms}
stops: {stops}       # height of the nozzle, in the center, with the carriage at its end stop
readings: drop       # carriage positions count down from the end stops
home: {{z: 0}}
workspace: {{x: {side}, y: {side}, z: [0, {top:g}]}}     # assumed; replace by the real workspace
{arms_sd}{fixed}"""
ARMS = "tolerances: {{arms: {{sd: {sd:.7g}}}}}     # measured by hand: prior knowledge\n"
FIXED = "fixed: [arm*.length]     # heights alone do not determine the arms; distances do\n"


def format_robot(
    geometry: DeltaGeometry, options: ImportOptions, path: Path, program: str, has_distances: bool
) -> str:
    """Return the robot file of a delta.

    Its arms are fixed unless distances determine them, or the options state how accurately they
    were measured by hand.
    """
    if not min(geometry.arms) > geometry.radius > 0:
        sentence = f"the delta radius is {geometry.radius:g} mm and the shortest arm"
        act = "the radius must be positive and every arm longer than it; correct them"
        raise FileError(f"{sentence} {min(geometry.arms):g} mm; {act}", path)
    half = round(0.5 * geometry.radius)
    head = format_head(path, program, "linear-delta", options.name, ("mm", "deg"))
    is_taped = options.sigma_tape is not None
    return head + ROBOT.format(
        radius=geometry.radius,
        angles=list(geometry.angles),
        arms=list(geometry.arms),
        stops=list(geometry.stops),
        side=[-half, half],
        top=half,
        arms_sd=ARMS.format(sd=options.choose_noise("tape") * 1e3) if is_taped else "",
        fixed="" if has_distances or is_taped else FIXED,
    )


def get_geometry(source: ExportSource, format_name: str, decimals: int) -> DeltaGeometry:
    """Return the geometry of a robot of the family linear-delta; DataError for another.

    Parameters
    ----------
    decimals : that the firmware stores, the most that people type.
    """
    get_record(source, LinearDelta, format_name, "a robot of the family linear-delta")
    values = source.values()

    def convert(name: str, factor: float) -> float:
        return source.round_number(values[name] * factor, name, 1.0 / factor, decimals)

    def list_towers(name: str, factor: float) -> tuple[float, ...]:
        return tuple(convert(name.format(k), factor) for k in (1, 2, 3))

    return DeltaGeometry(
        convert("radius", 1e3),
        list_towers("tower{}.angle", math.degrees(1)),
        list_towers("arm{}.length", 1e3),
        list_towers("tower{}.stop", 1e3),
    )


# Words of G-code commands in a file: read with their places, replaced, and added.

COMMAND = re.compile(r"\s*([GM]\d+)(?![\d.])")
FRONT = re.compile(r"\s*(?:ECHO:)?\s*(?:N\s*\d+)?")
WORD = re.compile(r"\s*([A-Z])[ \t]*(\{[^}]*\}|[^A-Z\s{]*)")
ASIDE = re.compile(r'"[^"]*"?|;.*|\([^)]*\)?')
CHECKSUM = re.compile(r"\*\s*\d*\s*$")
UPPER = {ord(small): small.upper() for small in "abcdefghijklmnopqrstuvwxyz"}

READ = ("M665", "M666", "M851")
"""Commands whose words are read."""

WITH_TEXT = ("M16", "M23", "M28", "M30", "M32", "M117", "M118")
"""Commands that are followed by text."""


@dataclass(frozen=True)
class GcodeFile(ValueFile):
    """A file whose values are words, by command and letter.

    `commands` has the line (from 0) and the column behind the last word of each command.
    """

    commands: Mapping[str, tuple[int, int]]

    def describe_missing(self, group: str, name: str) -> str:
        """Return the sentence about a word that does not exist."""
        return f"{group} has no {name}; write it as {group} {name}.."

    def with_lines(self, lines: Sequence[str]) -> GcodeFile:
        """Return the file with other lines."""
        return parse_gcode(lines, self.path)

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


def read_gcode(path: Path, one_in_a_line: bool = False) -> GcodeFile:
    """Read a file.

    Raises
    ------
    FileError : no M665, inches, or several commands in a line where the firmware runs only one.
    """
    file = parse_gcode(
        read_text(path, "G-code file").splitlines(keepends=True), path, one_in_a_line
    )
    if "M665" not in file.commands:
        raise FileError("no M665, the geometry of a delta, in this file; print it by M503", path)
    if "G20" in file.commands:
        sentence = "G20 selects inches; write the geometry in millimeters"
        raise FileError(sentence, path, file.commands["G20"][0] + 1)
    return file


def parse_gcode(lines: Iterable[str], path: Path, one_in_a_line: bool = False) -> GcodeFile:
    """Find the words; FileError for text that is not words, and for a letter that occurs twice."""
    complete = tuple(lines)
    words: dict[Name, Value] = {}
    commands: dict[str, tuple[int, int]] = {}
    for i, line in enumerate(complete):
        for position, (command, letters, end, rest) in enumerate(_split_commands(line)):
            commands[command] = (i, end)
            if command not in READ:
                continue
            if position and one_in_a_line:
                sentence = (
                    f"{command} is not the first command of this line; move it to its own line"
                )
                raise FileError(sentence, path, i + 1)
            if rest:
                sentence = f"{command} has {quote(rest)}, but a letter and its number are needed"
                raise FileError(f"{sentence}; correct it", path, i + 1)
            for k, (letter, start, length) in enumerate(letters):
                if any(letter == other for other, *_ in letters[:k]):
                    raise FileError(f"{command} has {letter} twice; remove one", path, i + 1)
                words[command, letter] = Value(line[start : start + length], i, start)
    return GcodeFile(path, complete, words, commands)


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

    def blank(match: re.Match[str]) -> str:
        return ("\0" if match[0].startswith('"') else " ") * len(match[0])

    return ASIDE.sub(blank, line)


# Heights that the firmware of a delta printer reports, as measurements.

FEWEST = 7
"""Points below which six numbers of a firmware cannot be determined and tested."""

NUMBER = r"([-+]?\d+(?:\.\d*)?|[-+]?\.\d+)"
SINGLE = re.compile(rf"Bed X:\s*{NUMBER}\s*Y:\s*{NUMBER}\s*Z:\s*{NUMBER}(?![\d.,])", re.IGNORECASE)
TOUCH = re.compile(r"\bBed X:|^.*?\bX:\s*[-+]?\d*,\d+.*\bCount\b", re.IGNORECASE)
"""A line that reports a point, whether or not its numbers can be read."""
POSITION = re.compile(rf"^.*?\bX:\s*{NUMBER}\s*Y:\s*{NUMBER}\s*Z:\s*{NUMBER}\s.*\bCount\b")
DRY_RUN = re.compile(r"Checking\.\.\. AC(?: at radius:\s*" + NUMBER + r")?.*\(DRY-RUN\)")
CHECKING = re.compile(r"Checking\.\.\. AC")
PART = re.compile(rf"(?<![A-Za-z])(yz|zx|xy|c|x|y|z):\s*{NUMBER}")
AROUND = {"x": 210.0, "y": 330.0, "z": 90.0, "yz": 30.0, "zx": 150.0, "xy": 270.0}
"""Angles of the points of G33 around the center [deg]."""

HEIGHTS = re.compile(r"G32 bed probe heights:(.*?)(?:,\s*mean|$)", re.IGNORECASE)
POINT = re.compile(rf"^\s*(?:N\d+\s*)?G30(?!\d)(?=.*P(\d+))(?=.*X\s*{NUMBER})(?=.*Y\s*{NUMBER})")
HEIGHT_MAP = "RepRapFirmware height map file"
UNPROBED = "0"
"""Cell of a height map that was not probed."""

OFFSETS = {"marlin": re.compile(r"\bM851\b(.*)"), "reprap": re.compile(r"\bG31\b(.*)")}
"""Command that states where the probe is beside the nozzle."""


class ProbedPoint(NamedTuple):
    """A probed point: coordinates of the touched point and reported height [mm], and its label."""

    label: str
    x: float
    y: float
    height: float


def import_probes(
    robot_text: str, path: Path, options: ImportOptions, firmware: str
) -> tuple[Measurements, Finding]:
    """Return the probed heights of the reports as measurements, and a finding about them.

    Parameters
    ----------
    robot_text : robot file with the geometry with which the firmware probed. path : of the file
        that states it. options : with `probes`. firmware : "marlin" or "reprap".

    Raises
    ------
    FileError : no heights, a report that cannot be used, or a point out of reach.
    """
    from loopcal.measure.kinds.poses import Component
    from loopcal.measure.measurements import Measurements
    from loopcal.measure.observations import Observations
    from loopcal.mechanism.solutions import inverse

    points = read_reports(options.probes, firmware)
    first = options.probes[0]
    if len(points) < FEWEST:
        finding = report_finding("files.probes-too-few", count=len(points), least=FEWEST)
        raise FileError(finding, first)
    dx, dy = _find_offset((path, *options.probes), firmware)
    robot = build_robot(parse_yaml(robot_text, path, "robot file"))
    target = MM * np.array([(p.x - dx, p.y - dy, p.height) for p in points])
    solution = inverse(robot, target)
    if not solution.converged.all():
        label = points[int(np.argmin(solution.converged))].label
        raise FileError(report_finding("files.probe-out-of-reach", point=label), first)
    sigma, is_assumed = options.choose_noise("height"), options.is_noise_assumed("height")
    kind = Component(components=("z",)).with_tool(np.eye(4))
    rows = Observations.from_sigma(kind, range(len(points)), np.zeros((len(points), 1)), sigma)
    heights = np.array([p.height for p in points])
    finding = report_finding(
        "files.probes-imported",
        count=len(points),
        rms=Quantity(float(np.sqrt((heights**2).mean())), "mm"),
        largest=Quantity(float(np.abs(heights).max()), "mm"),
        sigma=Quantity(sigma / MM, "mm"),
        assumed=is_assumed,
    )
    labels = tuple(p.label for p in points)
    observations = (replace(rows, is_noise_assumed=is_assumed),)
    return Measurements(options.name, solution.q, observations, labels=labels), finding


def read_reports(paths: Sequence[Path], firmware: str) -> list[ProbedPoint]:
    """Return the probed points of the reports of a firmware; FileError where there are none."""
    texts = {path: read_text(path, "probe report") for path in paths}
    points = _read_marlin(texts) if firmware == "marlin" else _read_reprap(texts)
    if not points:
        raise FileError(report_finding("files.no-probe-report", firmware=firmware), paths[0])
    return points


def _read_marlin(texts: Mapping[Path, str]) -> list[ProbedPoint]:
    """Return the points of G30 and of dry runs of G33; those of M114 where there are no others."""
    probed: list[ProbedPoint] = []
    touched: list[ProbedPoint] = []
    for path, text in texts.items():
        radius: float | None = None
        for i, line in enumerate(text.splitlines()):
            if match := SINGLE.search(line):
                probed.append(_label(len(probed), match))
            elif CHECKING.search(line):
                dry = DRY_RUN.search(line)
                if dry is None or dry[1] is None:
                    reason = "calibrates" if dry is None else "radius"
                    raise FileError(
                        report_finding("files.g33-unusable", reason=reason), path, i + 1
                    )
                radius = float(dry[1])
            elif TOUCH.search(line):
                finding = report_finding("files.probe-line-unreadable", line=line.strip())
                raise FileError(finding, path, i + 1)
            elif radius is not None and line.startswith("."):
                probed += _read_ring(line, radius, len(probed))
            elif match := POSITION.match(line):
                touched.append(_label(len(touched), match))
    return probed or touched


def _read_ring(line: str, radius: float, count: int) -> list[ProbedPoint]:
    """Return the points of a line of G33; none for a line of settings."""
    if "Height" in line or "Radius" in line or re.search(r"\b[ET][xyz]:", line):
        return []
    points = []
    for name, height in PART.findall(line):
        angle = math.radians(AROUND.get(name, 0.0))
        r = 0.0 if name == "c" else radius
        where = (r * math.cos(angle), r * math.sin(angle))
        points.append(ProbedPoint(f"{count + len(points) + 1}-{name}", *where, float(height)))
    return points


def _label(count: int, match: re.Match[str]) -> ProbedPoint:
    """Return a point with its number as its label."""
    return ProbedPoint(str(count + 1), *(float(cell) for cell in match.groups()))


def _read_reprap(texts: Mapping[Path, str]) -> list[ProbedPoint]:
    """Return the points of height maps, and of G32 with the points of bed.g."""
    places: dict[int, tuple[float, float]] = {}
    reports: list[tuple[Path, int, str]] = []
    points: list[ProbedPoint] = []
    for path, text in texts.items():
        if text.lstrip().startswith(HEIGHT_MAP):
            points += _read_height_map(path, text, len(points))
            continue
        for i, line in enumerate(text.splitlines()):
            if match := HEIGHTS.search(line):
                reports.append((path, i + 1, match[1]))
            elif match := POINT.match(line.partition(";")[0].upper()):
                places[int(match[1])] = (float(match[2]), float(match[3]))
    for path, number, cells in reports:
        if not re.fullmatch(rf"(?:\s+{NUMBER})+\s*", cells):
            if re.search(r"not set|failed", cells, re.IGNORECASE):
                raise FileError(report_finding("files.g32-failed"), path, number)
            finding = report_finding("files.g32-unreadable", cells=cells.strip())
            raise FileError(finding, path, number)
        heights = [float(cell) for cell in cells.split()]
        wanted = set(range(len(heights)))
        if not wanted <= set(places):
            missing = min(wanted - set(places))
            finding = report_finding("files.g32-no-points", count=len(heights), missing=missing)
            raise FileError(finding, path, number)
        if set(places) - wanted:
            finding = report_finding("files.g32-too-few", count=len(heights), points=len(places))
            raise FileError(finding, path, number)
        start = len(points) + 1
        points += [
            ProbedPoint(str(start + k), *places[k], height) for k, height in enumerate(heights)
        ]
    return points


def _read_height_map(path: Path, text: str, count: int) -> list[ProbedPoint]:
    """Return the probed cells of a height map."""
    lines = [line for line in text.splitlines() if line.strip()]
    try:
        titles = [cell.strip() for cell in lines[1].split(",")]
        stated = dict(zip(titles, (cell.strip() for cell in lines[2].split(",")), strict=True))
        names = ("min0", "min1", "spacing0", "spacing1", "num0", "num1")
        if "xmin" in stated:
            names = ("xmin", "ymin", "xspacing", "yspacing", "xnum", "ynum")
        x0, y0, dx, dy, columns, rows = (float(stated[name]) for name in names)
        cells = [[cell.strip() for cell in line.split(",")] for line in lines[3:]]
        shape = [len(row) for row in cells]
        if shape != [int(columns)] * int(rows):
            raise ValueError
        probed = [
            (x0 + k * dx, y0 + j * dy, float(cell))
            for j, row in enumerate(cells)
            for k, cell in enumerate(row)
            if cell != UNPROBED
        ]
    except (IndexError, KeyError, ValueError):
        raise FileError(report_finding("files.height-map-damaged"), path) from None
    return [ProbedPoint(str(count + k + 1), *point) for k, point in enumerate(probed)]


def _find_offset(paths: Sequence[Path], firmware: str) -> tuple[float, float]:
    """Return where the probe is beside the nozzle [mm], as the files of the firmware state it."""
    offset = [0.0, 0.0]
    for line in "\n".join(read_text(path, "G-code file") for path in paths).splitlines():
        if match := OFFSETS[firmware].search(line.partition(";")[0].upper()):
            for k, letter in enumerate("XY"):
                if word := re.search(rf"{letter}\s*{NUMBER}", match[1]):
                    offset[k] = float(word[1])
    return offset[0], offset[1]


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
