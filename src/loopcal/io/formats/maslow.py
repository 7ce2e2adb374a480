# SPDX-License-Identifier: Apache-2.0
"""Calibration data of a Maslow, a cutter that four belts pull across a sheet.

The configuration states where the belts are anchored, in millimeters (`Maslow_tlX: -27.6`): top and
bottom, left and right; bottom left is (0, 0), and bottom right (x, 0). At each waypoint of its
calibration the firmware measures four distances from the anchors to the tool in the plane of the
sheet, and prints all of them as `CLBM:[{bl:2376.69, br:923.40, tr:1733.87, tl:2801.87},..]`. The
waypoints are not known: two of the four lengths contradict a wrong frame. Source: FluidNC for the
Maslow (print_calibration_data and measurementToXYPlane in Maslow.cpp, maslow.yaml).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from loopcal.errors import DataError, FileError
from loopcal.findings import Quantity, report_finding
from loopcal.io.core.text_file import read_text
from loopcal.io.core.yaml_file import format_yaml
from loopcal.io.formats.program_format import (
    MM,
    Exported,
    ExportSource,
    Format,
    Imported,
    ImportOptions,
    Name,
    ValueFile,
    format_head,
    parse_number,
    round_digits,
    round_length,
)
from loopcal.measure.kinds.joints import Closure
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import Observations

BELTS = ("bl", "br", "tr", "tl")  # belts in the order of CLBM, which is that of the readings
# Coordinates by which the firmware defines its frame.
ORIGIN = ("bl.anchor.x", "bl.anchor.y", "br.anchor.y")
ANCHOR_SD = 30.0  # tolerance of anchors that were taped [mm]
SMALLEST = 100.0  # size of a frame that is one in millimeters [mm]
BLOCK = re.compile(r"CLBM:\s*\[(.*?)\]")
WAYPOINT = re.compile(
    r"\{" + r",\s*".join(rf"{belt}:\s*([^\s,{{}}]+)" for belt in BELTS) + r"\s*\}"
)


@dataclass(frozen=True)
class MaslowConfig(ValueFile):
    """A configuration, whose values are the coordinates of anchors."""

    what = "configuration of a Maslow"
    title = phrase = "{0}_{1}"
    missing = "{0}_{1} is missing: name the maslow.yaml of the machine"
    group = "Maslow"
    entry: ClassVar[re.Pattern[str]] = re.compile(r"\s*Maslow_([tb][lr][XY])\s*:\s*([^\s#]+)")
    new = "{0}_{1}: {2}"

    def list_anchors(self) -> dict[str, list[float]]:
        """Return belt -> x, y of its anchor [mm]; FileError where one is missing."""
        return {b: [self.number("Maslow", b + axis) for axis in "XY"] for b in BELTS}


def read(path: Path, options: ImportOptions) -> Imported:
    """Read the anchors, and the belt lengths of a log; FileError where one is missing."""
    anchors = MaslowConfig.load(path).list_anchors()
    sigma = options.choose_noise("line") / MM
    corners = np.array(list(anchors.values()))
    low, high = corners.min(axis=0), corners.max(axis=0)
    if (size := float((high - low).max())) < SMALLEST:
        raise FileError(report_finding("files.frame-in-meters", size=Quantity(size, "mm")), path)
    drive = {"reads": "length", "sigma": round_digits(sigma)}
    anchor = {"of": "base", "shift": ["x", "y"], "name": "anchor", "tolerance": {"sd": ANCHOR_SD}}
    content: dict[str, Any] = {
        "freedoms": ["x", "y"],
        "controlled": ["x", "y"],
        "actuators": dict.fromkeys(BELTS, drive),
        "limbs": [
            {"name": belt, "tip": [*place, 0], "ending": "distance", "actuated": belt}
            | {"length": 0, "errors": [anchor]}
            for belt, place in anchors.items()
        ],
        "home": {axis: round_length(v) for axis, v in zip("xy", (low + high) / 2, strict=True)},
        "workspace": {
            axis: [round_length(0.8 * a + 0.2 * b), round_length(0.2 * a + 0.8 * b)]
            for axis, a, b in zip("xy", low.tolist(), high.tolist(), strict=True)
        },
        "fixed": list(ORIGIN),
    }
    comments = {"fixed": "the frame of the firmware", "workspace": "assumed: 60 % of the frame"}
    head = format_head(path, "configuration of a Maslow", "limbs", options.name, ("mm", "deg"))
    text = head + format_yaml(content, comments)
    if not options.probes:
        return Imported(text)
    lengths = np.array([row for log in options.probes for row in _read_log(log)])
    rows = Observations.from_sigma(Closure(), range(len(lengths)), lengths[:, :0], [])
    finding = report_finding(
        "files.waypoints-imported",
        count=len(lengths),
        sigma=Quantity(sigma, "mm"),
        assumed=options.is_noise_assumed("line"),
    )
    labels = tuple(str(i) for i in range(len(lengths)))  # as the firmware counts waypoints
    return Imported(
        text, Measurements(options.name, MM * lengths, (rows,), labels=labels), (finding,)
    )


def _read_log(path: Path) -> list[list[float]]:
    """Return the lengths of the last CLBM of a log, which has all waypoints."""
    blocks = [
        (i, match[1])
        for i, line in enumerate(read_text(path, "log").splitlines(), 1)
        if (match := BLOCK.search(line))
    ]
    if not blocks:
        raise FileError.of("files.no-waypoints", path)
    line, block = blocks[-1]
    rows = WAYPOINT.findall(block)
    if not rows or len(rows) != block.count("{"):
        raise FileError.of("files.waypoint-incomplete", path, line)
    return [[parse_number(cell, "a length of CLBM", path, line) for cell in row] for row in rows]


def write(source: ExportSource, into: Path | None) -> Exported:
    """Return the anchors, in an existing configuration or alone; DataError for other belts."""
    file = MaslowConfig.parse((), Path("maslow.yaml"))
    if into is not None:
        file = MaslowConfig.load(into)
        file.list_anchors()
    values, wanted = source.values(), dict[Name, float | str]()
    for belt in BELTS:
        for axis in "xy":
            if (name := f"{belt}.anchor.{axis}") not in values:
                sentence = f"{source.robot.name} lacks {name}, which the format maslow needs"
                raise DataError(f"{sentence}. Use json or csv")
            number = source.round_number(values[name] / MM, name, MM, 3)
            wanted["Maslow", belt + axis.upper()] = number
    return file.export(into, wanted, {})


FORMAT = Format(
    "maslow",
    "maslow.yaml of a cutter with four belts",
    (),
    read,
    write,
    read_options={"sigma_line": "belts", "probes": "log with CLBM"},
    mark="Maslow_tlX",
)
