# SPDX-License-Identifier: Apache-2.0
"""Heights that the firmware of a delta printer reports, as measurements.

A report is text that a firmware printed: each line with a height matches one of the patterns below.
The firmware believes the nozzle at the reported height when the probe triggers, and the nozzle is
then at z = 0 in truth, so that the readings are those of this height and the measured z is 0. The
stopped height of `G30 S-1` contains the trigger height of the probe (G31 Z), all others do not.
Source: the functions that print these lines in Marlin 2.1 (G30, G33) and RepRapFirmware 1.18 to 3.5
(RandomProbePointSet, Move, GCodes).
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from loopcal.errors import FileError
from loopcal.findings import Finding, Quantity, Severity, report_finding
from loopcal.io.core.text_file import read_text
from loopcal.io.core.yaml_file import parse_yaml
from loopcal.io.formats.program_format import MM, ImportOptions, parse_number
from loopcal.io.robot.robot_file import build_robot
from loopcal.measure.kinds.poses import Component
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import report_days
from loopcal.mechanism.solutions import inverse
from loopcal.typing import FloatArray

FEWEST = 7  # points below which six numbers of a firmware cannot be determined and tested
NUMBER = r"([-+]?\d+(?:\.\d*)?|[-+]?\.\d+)"
SINGLE = re.compile(rf"Bed X:\s*{NUMBER}\s*Y:\s*{NUMBER}\s*Z:\s*{NUMBER}(?![\d.,])", re.IGNORECASE)
# A line that reports a point, whether or not its numbers can be read.
TOUCH = re.compile(r"\bBed X:|^.*?\bX:\s*[-+]?\d*,\d+.*\bCount\b", re.IGNORECASE)
POSITION = re.compile(rf"^.*?\bX:\s*{NUMBER}\s*Y:\s*{NUMBER}\s*Z:\s*{NUMBER}\s.*\bCount\b")
DRY_RUN = re.compile(r"Checking\.\.\. AC(?: at radius:\s*" + NUMBER + r")?.*\(DRY-RUN\)")
CHECKING = re.compile(r"Checking\.\.\. AC")
SETTING = re.compile(r"Height|Radius|\b[ET][xyz]:")
PART = re.compile(rf"(?<![A-Za-z])(yz|zx|xy|c|x|y|z):\s*{NUMBER}")
# Angles of the points of G33 around the center [deg].
AROUND = {"x": 210.0, "y": 330.0, "z": 90.0, "yz": 30.0, "zx": 150.0, "xy": 270.0}
# Before 2.0, RepRapFirmware wrote no G32; its M122 prints five heights without their mean.
HEIGHTS = re.compile(
    r"\bG32 bed probe heights:(.*?)(?:,\s*mean|$)|\bBed probe heights:(.*?),\s*mean", re.IGNORECASE
)
POINT = re.compile(rf"^\s*(?:N\d+\s*)?G30(?!\d)(?=.*P(\d+))(?=.*X\s*{NUMBER})(?=.*Y\s*{NUMBER})")
STOPPED = re.compile(r"Stopped at height\s*(.*)")
STOP_HEIGHT = re.compile(rf"{NUMBER}\s*mm\b")
MOVE = re.compile(r"(?<![A-Z\d])G0*[01](?!\d)(.*)")
# A G30 that reports the height at which it stops, at the place of the last move.
TOUCHING = re.compile(r"(?<![A-Z\d])G30(?!\d)(?!.*P\s*\d).*S\s*-1(?!\d)")
CALIBRATED = re.compile(r"Calibrated (\d+) factors using")
HEIGHT_MAP = "RepRapFirmware height map file"
DATE = re.compile(r"(?<!\d)20\d\d-\d\d-\d\d(?!\d)(?: \d\d:\d\d)?")
# What only an answer of a firmware contains, not the macro or the configuration beside it.
ANSWER = re.compile(rf"Bed X:|bed probe heights:|Stopped at height|{HEIGHT_MAP}", re.IGNORECASE)
# Commands that state the geometry, and where the probe is beside the nozzle when it triggers.
OFFSETS = {"marlin": "M851", "reprap": "G31"}
# Median deviation of heights from their median [mm]: beyond these, another unit is possible, sure.
UNEVEN, ROUGH = 1.0, 5.0
# Median height [mm] from which a wrong trigger height is as probable as wrong end stops, and beyond
# which neither explains it.
SHIFTED, FARTHEST = 1.0, 100.0
# Difference of two heights of one point, in sigmas of the probe, that its scatter does not explain.
DIFFERENT = 8.0


class ProbedPoint(NamedTuple):
    """A probed point: where the nozzle was commanded, and the height at which it touched [mm]; the
    name of the point in the report.
    """

    x: float
    y: float
    height: float
    name: str = ""


def import_probes(
    robot_text: str, path: Path, options: ImportOptions, firmware: str
) -> tuple[Measurements, list[Finding]]:
    """Return the probed heights of the reports as measurements, and findings about them.

    `robot_text` states the geometry with which the firmware probed, as `path` does.

    FileError : no heights, a report that cannot be used, or a point out of reach.
    """
    first = options.probes[0]
    probe, differing = _read_settings((path, *options.probes), firmware)
    points, noted = read_reports(options.probes, firmware, probe)
    noted += differing
    if len(points) < FEWEST:
        raise FileError.of("files.probes-too-few", first, count=len(points), least=FEWEST)
    heights = np.array([p.height for p in points])
    stored = max(DATE.findall(read_text(path, "G-code file").replace("T", " ")), default="")
    reports = (read_text(file, "probe report") for file in options.probes)
    probed = max(_list_times(reports), default="")
    if probed and stored[: len(probed)] > probed[: len(stored)]:
        noted.append(report_finding("files.configuration-later", stored=stored, probed=probed))
    noted += check_heights(heights, probe.get("Z"), firmware, first)
    noted += _compare_repeats(points, options.choose_noise("height") / MM)
    names = [p.name for p in points]
    are_names = len(set(names) - {""}) == len(names)
    labels = tuple(n if are_names else f"{i}-{n}" if n else str(i) for i, n in enumerate(names, 1))
    robot = build_robot(parse_yaml(robot_text, path, "robot file"))
    solution = inverse(robot, MM * np.array([(p.x, p.y, p.height) for p in points]))
    if not solution.converged.all():
        label = labels[int(np.argmin(solution.converged))]
        raise FileError.of("files.probe-out-of-reach", first, point=label)
    kind, zeros = Component(components=("z",)), np.zeros((len(points), 1))
    rows = options.observe(kind, range(len(points)), zeros, "height")
    finding = report_finding(
        "files.probes-imported",
        count=len(points),
        rms=Quantity(float(np.sqrt((heights**2).mean())), "mm"),
        largest=Quantity(float(np.abs(heights).max()), "mm"),
        sigma=Quantity(options.choose_noise("height") / MM, "mm"),
        assumed=rows.is_noise_assumed,
    )
    return Measurements(options.name, solution.q, (rows,), labels=labels), [finding, *noted]


def read_reports(
    paths: Sequence[Path], firmware: str, probe: Mapping[str, float]
) -> tuple[list[ProbedPoint], list[Finding]]:
    """Return the probed points of the reports of a firmware, and findings about them; FileError
    where there are none. `probe` : X, Y and Z that files state of it [mm].
    """
    texts = {path: read_text(path, "probe report") for path in paths}
    read = _read_marlin if firmware == "marlin" else _read_reprap
    probed, touched, noted = read(texts, probe)
    missing = tuple(letter for letter in "XY" if letter not in probe)
    x, y = probe.get("X", 0.0), probe.get("Y", 0.0)
    if probed and missing:
        finding = report_finding("files.probe-place-assumed", letters=missing, firmware=firmware)
        noted.append(finding)
    elif probed and (x or y):
        facts = {"x": Quantity(x, "mm"), "y": Quantity(y, "mm"), "firmware": firmware}
        noted.append(report_finding("files.probe-place", **facts))
    points = [p._replace(x=p.x - x, y=p.y - y) for p in probed]
    points += touched if firmware == "reprap" or not probed else []
    dates = [_list_times([text]) or [""] for text in texts.values() if ANSWER.search(text)]
    noted += report_days([time[:10] for of_file in dates for time in of_file])
    if not points:
        raise FileError.of("files.no-probe-report", paths[0], firmware=firmware)
    return points, noted


def _list_times(reports: Iterable[str]) -> list[str]:
    """Return the dates that reports state, with their times, if any."""
    answers = (text.replace("T", " ") for text in reports if ANSWER.search(text))
    return [time for text in answers for time in DATE.findall(text)]


def _read_settings(paths: Sequence[Path], firmware: str) -> tuple[dict[str, float], list[Finding]]:
    """Return what files state of the probe, X, Y beside the nozzle and Z [mm], by the first that
    has it; and which files contradict an earlier one in that or in the geometry.
    """
    stated, noted = dict[str, float](), list[Finding]()
    pattern = re.compile(rf"\b(M66[56]|{OFFSETS[firmware]})\b(.*)")
    for path in paths:
        own: dict[str, float] = {}
        for line in read_text(path, "G-code file").upper().splitlines():
            if match := pattern.search(line.partition(";")[0]):
                words = re.findall(rf"([LRHXYZ])\s*{NUMBER}", match[2])
                own |= {f"{match[1]} {letter}": float(number) for letter, number in words}
        if changed := [word for word in own if own[word] != stated.get(word, own[word])]:
            noted.append(report_finding("files.settings-differ", file=path.name, words=changed))
        stated = own | stated
    return {word[-1]: v for word, v in stated.items() if OFFSETS[firmware] in word}, noted


def check_heights(
    heights: FloatArray, stated: float | None, firmware: str, path: Path
) -> list[Finding]:
    """Return whether all heights (n,) [mm] are shifted, with the trigger height [mm] that a file
    has; FileError where reported ones are no millimeters. Klipper's follow from motor steps.
    """
    shift, noted = float(np.median(heights)), list[Finding]()
    deviation = float(np.median(np.abs(heights - shift)))
    if deviation > UNEVEN or abs(shift) > FARTHEST:
        least, largest = (Quantity(float(h), "mm") for h in (heights.min(), heights.max()))
        facts = {"least": least, "largest": largest, "firmware": firmware}
        if deviation > ROUGH and firmware != "klipper":
            raise FileError.of("files.heights-unit", path, **facts)
        noted.append(report_finding("files.heights-unit", Severity.WARNING, **facts))
    rest = float(np.sqrt(((heights - heights.mean()) ** 2).mean()))
    if abs(shift) < max(SHIFTED, 3.0 * rest):
        return noted
    trigger = (stated or 0.0) * (-1.0 if firmware == "marlin" else 1.0)
    finding = report_finding(
        "files.heights-shifted",
        shift=Quantity(shift, "mm"),
        rest=Quantity(rest, "mm"),
        firmware=firmware,
        stated=stated,
        is_twice=abs(shift + 2.0 * trigger) < max(0.1 * abs(shift), rest),
    )
    return [*noted, finding]


def _compare_repeats(points: Sequence[ProbedPoint], sigma: float) -> list[Finding]:
    """Return whether points that were probed again have other heights; sigma [mm] of the probe."""
    heights: dict[tuple[float, float], list[float]] = {}
    for p in points:
        heights.setdefault((round(p.x, 1), round(p.y, 1)), []).append(p.height)
    spans = [max(of_point) - min(of_point) for of_point in heights.values() if len(of_point) > 1]
    largest = max(spans, default=0.0)
    if not largest > DIFFERENT * sigma:
        return []
    facts = {"count": len(spans), "largest": Quantity(largest, "mm"), "ratio": largest / sigma}
    return [report_finding("files.probes-differ", **facts)]


def _parse_point(match: re.Match[str], path: Path, line: int) -> ProbedPoint:
    """Return the point of a line."""
    numbers = zip(("X", "Y", "Z"), match.groups(), strict=True)
    x, y, height = (parse_number(text, name, path, line) for name, text in numbers)
    return ProbedPoint(x, y, height)


def _read_marlin(
    texts: Mapping[Path, str], probe: Mapping[str, float]
) -> tuple[list[ProbedPoint], list[ProbedPoint], list[Finding]]:
    """Return the points of G30 and of dry runs of G33, where the probe is; those of M114, which the
    nozzle touched; findings.
    """
    probed: list[ProbedPoint] = []
    touched: list[ProbedPoint] = []
    for path, text in texts.items():
        radius: float | None = None
        for i, line in enumerate(text.splitlines(), 1):
            if match := SINGLE.search(line):
                probed.append(_parse_point(match, path, i))
            elif CHECKING.search(line):
                dry = DRY_RUN.search(line)
                if dry is None or dry[1] is None:
                    reason = "calibrates" if dry is None else "radius"
                    raise FileError.of("files.g33-unusable", path, i, reason=reason)
                radius = parse_number(dry[1], "the radius", path, i)
            elif TOUCH.search(line):
                raise _report_unreadable(line, "marlin", path, i)
            elif radius is not None and line.startswith("."):
                for name, height in () if SETTING.search(line) else PART.findall(line):
                    angle = math.radians(AROUND.get(name, 0.0))
                    r = 0.0 if name == "c" else radius
                    place = (r * math.cos(angle), r * math.sin(angle))
                    probed.append(ProbedPoint(*place, parse_number(height, name, path, i), name))
            elif match := POSITION.match(line):
                touched.append(_parse_point(match, path, i))
    return probed, touched, []


def _read_reprap(
    texts: Mapping[Path, str], probe: Mapping[str, float]
) -> tuple[list[ProbedPoint], list[ProbedPoint], list[Finding]]:
    """Return the points of height maps and of G32 with the points of bed.g, where the probe is;
    those of `G30 S-1`, where the nozzle is; findings.
    """
    places: dict[float, tuple[float, float]] = {}
    reports: list[tuple[Path, int, str]] = []
    probed: list[ProbedPoint] = []
    factors: tuple[Path, int, str] | None = None
    for path, text in texts.items():
        if text.lstrip().startswith(HEIGHT_MAP):
            probed += _read_height_map(path, text)
            continue
        for i, line in enumerate(text.splitlines(), 1):
            if match := HEIGHTS.search(line):
                reports.append((path, i, match[1] or match[2] or ""))
            elif match := POINT.match(line.partition(";")[0].upper()):
                names = zip(("P", "X", "Y"), match.groups(), strict=True)
                key, x, y = (parse_number(text, name, path, i) for name, text in names)
                places[key] = (x, y)
            elif match := CALIBRATED.search(line):
                factors = path, i, match[1]
    for path, number, cells in reports:
        probed += _read_heights(cells, places, path, number)
    stopped, noted = _read_stops(texts, probe), list[Finding]()
    if factors is not None:
        path, number, count = factors
        alone = not probed and not stopped
        level = Severity.REFUSAL if alone else Severity.WARNING
        finding = report_finding("files.log-calibrates", level, factors=int(count), alone=alone)
        if alone:
            raise FileError(finding, path, number)
        noted.append(finding)
    return probed, stopped, noted


def _read_heights(
    cells: str, places: Mapping[float, tuple[float, float]], path: Path, line: int
) -> list[ProbedPoint]:
    """Return the points P0, P1, ... of a list of heights."""
    heights = cells.split()
    wanted, finding = set(range(len(heights))), None
    if not re.fullmatch(rf"(?:\s+{NUMBER})+\s*", cells):
        finding = (
            report_finding("files.g32-failed")
            if re.search(r"not set|failed", cells, re.IGNORECASE)
            else report_finding("files.g32-unreadable", cells=cells.strip())
        )
    elif missing := wanted - set(places):
        finding = report_finding("files.g32-no-points", count=len(heights), missing=min(missing))
    elif set(places) - wanted:
        finding = report_finding("files.g32-too-few", count=len(heights), points=len(places))
    if finding is not None:
        raise FileError(finding, path, line)
    return [
        ProbedPoint(*places[k], parse_number(height, f"height {k}", path, line), f"P{k}")
        for k, height in enumerate(heights)
    ]


def _read_stops(texts: Mapping[Path, str], probe: Mapping[str, float]) -> list[ProbedPoint]:
    """Return the points of `G30 S-1`, each at the place of the last moves before this command,
    which are in the log or in a macro.
    """
    places: list[dict[str, float]] = []
    stops: list[tuple[Path, int, float]] = []
    unanswered: list[tuple[Path, int]] = []
    for path, text in texts.items():
        place, open_lines = dict[str, float](), list[int]()
        for i, line in enumerate(text.splitlines(), 1):
            code = line.partition(";")[0].upper()
            if match := MOVE.search(code):
                words = ((n, re.search(rf"{n}\s*{NUMBER}", match[1])) for n in "XY")
                place |= {n: parse_number(word[1], n, path, i) for n, word in words if word}
            if TOUCHING.search(code):
                places.append(dict(place))
                open_lines.append(i)
            if match := STOPPED.search(line):
                if not (height := STOP_HEIGHT.match(match[1])):
                    raise _report_unreadable(line, "reprap", path, i)
                stops.append((path, i, parse_number(height[1], "the height", path, i)))
                unanswered += [(path, line) for line in open_lines[:-1]]
                open_lines = []
    if not stops:
        return []
    finding = None
    if unanswered and len(places) - len(stops) == len(unanswered):
        raise FileError.of("files.probe-unanswered", *unanswered[0])
    if len(places) != len(stops):
        finding = report_finding("files.g32-too-few", count=len(stops), points=len(places))
    elif any(len(place) < 2 for place in places):
        finding = report_finding("files.probe-place-missing")
    elif "Z" not in probe:
        finding = report_finding("files.trigger-height-missing")
    if finding is not None:
        raise FileError(finding, *stops[0][:2])
    pairs = zip(places, stops, strict=True)
    return [ProbedPoint(p["X"], p["Y"], height - probe["Z"]) for p, (*_, height) in pairs]


def _report_unreadable(line: str, firmware: str, path: Path, number: int) -> FileError:
    """Return the error of a line that reports a point without a number that can be read."""
    finding = report_finding("files.probe-line-unreadable", line=line.strip(), firmware=firmware)
    return FileError(finding, path, number)


def _read_height_map(path: Path, text: str) -> list[ProbedPoint]:
    """Return the probed cells of a height map."""
    lines = [
        (i, [cell.strip() for cell in line.split(",")])
        for i, line in enumerate(text.splitlines(), 1)
        if line.strip()
    ]
    try:
        (_, header), (line, cells), *rows = lines[1:]
        stated = dict(zip(header, cells, strict=True))
        names = ("min0", "min1", "spacing0", "spacing1", "num0", "num1")
        if "xmin" in stated:
            names = ("xmin", "ymin", "xspacing", "yspacing", "xnum", "ynum")
        numbers = [parse_number(stated[name], name, path, line) for name in names]
    except (KeyError, ValueError):
        raise FileError.of("files.height-map-damaged", path) from None
    x0, y0, dx, dy, width, count = numbers
    if len(rows) != count or any(len(row) != width for _, row in rows):
        raise FileError.of("files.height-map-damaged", path)
    return [
        ProbedPoint(x0 + k * dx, y0 + j * dy, parse_number(cell, "a height", path, line))
        for j, (line, row) in enumerate(rows)
        for k, cell in enumerate(row)
        if cell != "0"  # which was not probed
    ]
