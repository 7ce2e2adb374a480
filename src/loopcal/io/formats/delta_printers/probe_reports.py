# SPDX-License-Identifier: Apache-2.0
"""Heights that the firmware of a delta printer reports, as measurements.

A firmware probes a point by lowering the nozzle, by its own geometry, until the probe touches the
bed. The reported height h is the z at which the firmware believes the nozzle to be at this moment
(less the trigger height of the probe); in truth the nozzle touches the bed, at z = 0. So the
readings of a row are those that lead, by the geometry of the firmware, to (x, y, h), and the
measured z is 0. Entered as z at the readings of (x, y, 0), h would have the wrong sign: to first
order, the nozzle is at -h there.

Marlin reports (sources: its modules G30, G33 and probe):
  G30 X.. Y..    Bed X:10.00 Y:-20.00 Z:0.123
  G33 P3 V0      Checking... AC at radius:80.00 (DRY-RUN), then c, x, y, z, yz, zx, xy: heights at
                 the center and at 210, 330, 90, 30, 150 and 270 degrees; a calibration that is no
                 dry run changes its geometry between the reports
  M114           X:10.00 Y:-20.00 Z:0.15 E:0.00 Count .., where the nozzle was lowered by hand

RepRapFirmware (sources: its modules RandomProbePointSet, Grid and GCodes4):
  G32            G32 bed probe heights: 0.012 -0.034 .., mean ..; the points are those of bed.g,
                 G30 P0 X.. Y.. Z-99999
  G29, M557      heightmap.csv: rows of heights; a cell `0` was not probed, `0.000` was

A probe beside the nozzle (M851 or G31 with X or Y) touches at the point, and the nozzle is beside.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from loopcal.errors import FileError
from loopcal.findings import Finding, Quantity, report_finding
from loopcal.io.core.text_file import read_text
from loopcal.io.core.yaml_file import parse_yaml
from loopcal.io.robot.robot_file import build_robot

if TYPE_CHECKING:
    from loopcal.io.formats.program_format import ImportOptions
    from loopcal.measure import Measurements

MM = 1e-3
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
    from loopcal.measure import Component, Measurements, Observations
    from loopcal.mechanism import inverse

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
