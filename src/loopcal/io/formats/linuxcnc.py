# SPDX-License-Identifier: Apache-2.0
"""LinuxCNC's genhexkins: a hexapod's joints, and the lead of its screws, as `setp` lines of a HAL
file.

    setp genhexkins.base.N.x ..        centre of a joint on the base (platform.N: on the platform), N = 0..5
    setp genhexkins.base-n.N.x ..      axis of that joint (platform-n.N likewise), used where screw-lead is not 0
    setp genhexkins.screw-lead ..      change of a strut's length in one turn

A strut's joint position is the distance between its centres (plus the screw's correction), so the
lengths of the robot file are zero, and what a calibration adds to them shifts the zero of the
joint, which these pins cannot say. The correction is screw-lead * asin(sin a) / (2 pi) of the angle
a about the strut between the two axes, where loopcal has the angle itself: the same for less than a
quarter turn. A strut that stands beyond one at home is read as what the formula makes of it there,
a screw of the other hand counted from the other side of its axis (-lead, -platform-n).
`spindle-offset` and `tool-offset` are added to z of all centres. No unit is stated: it is the
machine's. Source: the documentation of genhexkins (LinuxCNC, "Kinematics").
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from loopcal.errors import DataError, FileError
from loopcal.io.core.numbers import format_scaled
from loopcal.io.core.text_file import read_text
from loopcal.io.formats.program_format import (
    UNCHANGED,
    Exported,
    ExportSource,
    Format,
    Imported,
    ImportOptions,
    byte_order_mark,
    number,
    record_of,
)
from loopcal.mechanism.families.gough import Gough
from loopcal.units import Dimension, find_unit

SETP = re.compile(r"\s*setp\s+(genhexkins\.[\w.-]+)(\s*=\s*|\s+)([^\s#]+)")
LEAD, OFFSETS = "genhexkins.screw-lead", ("genhexkins.spindle-offset", "genhexkins.tool-offset")
Point = tuple[float, float, float]
CLOSE = 1e-12
"""Relative difference of what counts as the same number."""

ROBOT = """\
# Read from {origin}, the genhexkins settings of LinuxCNC. Strut lengths are readings: lengths at
# reading zero are 0.
format: 1
family: gough
name: {name}
source: {source}
units: {{length: {unit}, angle: deg}}

legs: {legs}
base:
{base}
platform:
{platform}
lengths: 0
home: {{z: {home}}}
{screw}"""
SCREW = """\
screw:
  lead: {lead}
  base_axes:
{base}
  platform_axes:
{platform}
"""


@dataclass(frozen=True)
class _Pin:
    """A pin's value, and where it stands: line (from 0) and column."""

    text: str
    line: int
    start: int


@dataclass(frozen=True)
class _Hal:
    path: Path
    lines: tuple[str, ...]
    pins: Mapping[str, _Pin]

    def number(self, name: str, default: float | None = None) -> float:
        found = self.pins.get(name)
        if found is None:
            if default is not None:
                return default
            raise FileError(
                f"there is no 'setp {name} ..'; loopcal takes no other machine's numbers for "
                "yours; add it",
                self.path,
            )
        return number(found.text, name, self.path, found.line + 1)

    def point(self, kind: str, n: int) -> Point:
        """Coordinates of a centre or axis; LinuxCNC has z at 0 where it is not set."""
        x, y, z = (
            self.number(f"genhexkins.{kind}.{n}.{axis}", 0.0 if axis == "z" else None)
            for axis in "xyz"
        )
        return x, y, z


def read(path: Path, reading: ImportOptions) -> Imported:
    """Read the pins; FileError for those that are missing or no number, or where no unit was
    stated.
    """
    hal = _read(path)
    if reading.length_unit is None:
        raise FileError(
            "a HAL file states no unit of length; say the machine's, as --unit mm or --unit in",
            path,
        )
    symbol = find_unit(reading.length_unit, Dimension.LENGTH)
    lift, lead = sum(hal.number(name, 0.0) for name in OFFSETS), hal.number(LEAD, 0.0)
    centres = {
        kind: [_lifted(hal.point(kind, n), lift) for n in range(6)] for kind in ("base", "platform")
    }
    notes = []
    if reading.home_height is None:
        home = sum((x * x + y * y) ** 0.5 for x, y, _ in centres["base"]) / 6
        notes.append(
            f"home is {home:g} {symbol} above the base, the radius of its joints; correct it, or "
            "state --home-z"
        )
    else:
        home = reading.home_height / symbol.factor_to_si
    screw = ""
    if lead:
        axes = {
            kind: [hal.point(f"{kind}-n", n) for n in range(6)] for kind in ("base", "platform")
        }
        signs = [
            _hand(
                centres["base"][n],
                centres["platform"][n],
                axes["base"][n],
                axes["platform"][n],
                home,
            )
            for n in range(6)
        ]
        turned = [_scaled(axis, sign) for axis, sign in zip(axes["platform"], signs, strict=True)]
        leads = lead if min(signs) > 0 else [sign * lead for sign in signs]
        screw = SCREW.format(lead=leads, base=_list(axes["base"], 4), platform=_list(turned, 4))
    text = ROBOT.format(
        origin=path.name,
        name=json.dumps(reading.name),
        source=json.dumps(f"{path.name}, genhexkins settings of LinuxCNC"),
        unit=json.dumps(symbol.symbol),
        legs="ups" if lead else "rod",
        base=_list(centres["base"], 2),
        platform=_list(centres["platform"], 2),
        home=home,
        screw=screw,
    )
    return Imported(text, None, tuple(notes))


def write(source: ExportSource, into: Path | None) -> Exported:
    """The corrected pins in a HAL file whose other bytes stay, or `setp` lines of their own."""
    record: Gough = record_of(source, Gough, "linuxcnc", "a hexapod of the family gough")
    symbol = find_unit(source.robot.units[Dimension.LENGTH])
    hal = _Hal(Path("hexapod.hal"), (), {}) if into is None else _read(into)
    lift = sum(hal.number(name, 0.0) for name in OFFSETS)
    lead = hal.number(LEAD) if LEAD in hal.pins else None
    notes = (
        []
        if into is not None
        else [f"numbers are in {symbol}; the machine's unit of length must be that"]
    )
    lines, changes = list(hal.lines), []
    if lines and not lines[-1].endswith("\n"):
        lines[-1] += "\n"
    for name, value in _pins(source, record, symbol.factor_to_si, lift, lead):
        found = hal.pins.get(name)
        present = None if found is None else hal.number(name)
        if present is None and into is not None and value == 0.0:
            continue
        if present is not None and abs(present - value) <= CLOSE * max(1.0, abs(value)):
            continue
        text = format_scaled(value, 1.0)
        if found is None:
            lines.append(f"setp {name} {text}\n")
            changes.append(f"line {len(lines)}: {name} added as {text}")
            continue
        line = lines[found.line]
        lines[found.line] = line[: found.start] + text + line[found.start + len(found.text) :]
        changes.append(f"line {found.line + 1}: {name} {found.text} -> {text}")
    if lines and hal.lines and not hal.lines[-1].endswith("\n") and len(lines) == len(hal.lines):
        lines[-1] = lines[-1].removesuffix("\n")
    notes += _unsaid(source, symbol.factor_to_si, symbol.symbol)
    mark = "" if into is None else byte_order_mark(into)
    return Exported(
        mark + "".join(lines), (*(() if into is None else changes or (UNCHANGED,)), *notes)
    )


def _pins(
    source: ExportSource, record: Gough, factor: float, lift: float, present: float | None
) -> Iterator[tuple[str, float]]:
    """Pin -> value in the file's unit; `present` is the lead there, whose sign is kept."""
    values = source.values()
    for n in range(6):
        for kind in ("base", "platform"):
            for axis in "xyz":
                value = values[f"leg{n + 1}.{kind}.{axis}"] / factor
                yield (
                    f"genhexkins.{kind}.{n}.{axis}",
                    float(format_scaled(value - (lift if axis == "z" else 0.0), 1.0)),
                )
    if record.screw is None:
        return
    legs = record.screw.legs()
    lead = abs(legs[0].lead) if present is None else math.copysign(legs[0].lead, present)
    if any(abs(abs(leg.lead) - abs(lead)) > CLOSE * abs(lead) for leg in legs):
        raise DataError(
            f"{source.robot.name} has screws of different lead, but genhexkins has one for all; "
            "use json or csv"
        )
    yield LEAD, lead / factor
    for n, leg in enumerate(legs):
        upper = _scaled(leg.platform_axis, math.copysign(1.0, leg.lead * lead))
        for kind, direction in (("base-n", leg.base_axis), ("platform-n", upper)):
            for axis, value in zip("xyz", direction, strict=True):
                yield f"genhexkins.{kind}.{n}.{axis}", value


def _unsaid(source: ExportSource, factor: float, symbol: str) -> Iterator[str]:
    """What has no pin: lengths at reading zero, and the other parameters of a complete model."""
    values = source.values()
    for n in range(6):
        length = values.pop(f"leg{n + 1}.length", 0.0) / factor
        if abs(length) > CLOSE:
            yield (
                f"not said by genhexkins: strut {n} is {format_scaled(length, 1.0)} {symbol} long at "
                "reading zero; "
                f"add this to HOME_OFFSET of [JOINT_{n}] in the INI file"
            )
    said = re.compile(r"leg\d\.(base|platform)\.[xyz]$")
    table = source.robot.parameters
    off = [name for i, name in enumerate(table.names) if source.robot.values[i] != table.nominal[i]]
    others = [name for name in off if name in values and not said.match(name)]
    if others:
        yield f"not said by genhexkins: {len(others)} parameters such as {others[0]}; use json or csv for them"


def _read(path: Path) -> _Hal:
    lines = tuple(read_text(path, "HAL file").splitlines(keepends=True))
    pins = {}
    for i, line in enumerate(lines):
        if found := SETP.match(line):
            pins[found.group(1)] = _Pin(found.group(3), i, found.start(3))
    if not pins:
        raise FileError(
            "there is no 'setp genhexkins...' in this file; name the HAL file that sets the "
            "geometry",
            path,
        )
    return _Hal(path, lines, pins)


def _hand(base: Point, top: Point, low: Point, high: Point, home: float) -> float:
    """-1 where the axes stand beyond a quarter turn about the strut at home, else 1; home: height
    of the platform.
    """
    strut = (top[0] - base[0], top[1] - base[1], top[2] + home - base[2])
    square = _dot(strut, strut)
    across = _dot(low, high) * square - _dot(low, strut) * _dot(high, strut)
    return -1.0 if across < 0 else 1.0


def _dot(one: Point, other: Point) -> float:
    return sum(a * b for a, b in zip(one, other, strict=True))


def _scaled(axis: Point, sign: float) -> Point:
    return (
        (axis[0], axis[1], axis[2]) if sign > 0 else (0.0 - axis[0], 0.0 - axis[1], 0.0 - axis[2])
    )


def _lifted(point: Point, lift: float) -> Point:
    return point[0], point[1], point[2] + lift


def _list(points: list[Point], indent: int) -> str:
    return "\n".join(f"{' ' * indent}- [{', '.join(repr(v) for v in point)}]" for point in points)


FORMAT = Format(
    "linuxcnc",
    "genhexkins settings of a LinuxCNC hexapod",
    (".hal",),
    read,
    write,
    reads=("length_unit", "home_height"),
)
