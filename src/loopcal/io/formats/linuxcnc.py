# SPDX-License-Identifier: Apache-2.0
"""LinuxCNC's genhexkins: joints of a hexapod, and the lead of its screws, as `setp` lines of HAL.

    setp genhexkins.base.N.x ..        center of a joint on the base (platform.N: on the platform)
    setp genhexkins.base-n.N.x ..      axis of that joint (platform-n.N), used with a screw lead
    setp genhexkins.screw-lead ..      change of a strut's length in one turn;  N = 0..5

A strut's joint position is the distance between its centers (plus the screw's correction), so the
lengths of the robot file are zero, and what a calibration adds to them shifts the zero of the
joint, which these pins cannot express. The correction is screw-lead * asin(sin a) / (2 pi) of the
angle a about the strut between the two axes, where loopcal has the angle itself: the same below a
quarter turn. A strut beyond a quarter turn at home is read as what the formula makes of it there, a
screw of the other hand counted from the other side of its axis (-lead, -platform-n).
`spindle-offset` and `tool-offset` are added to z of all centers. No unit is stated: it is the
machine's. Source: the documentation of genhexkins (LinuxCNC, "Kinematics").
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from loopcal.errors import DataError, FileError
from loopcal.findings import Finding, report_finding
from loopcal.io.core.numbers import format_scaled
from loopcal.io.core.text_file import read_text
from loopcal.io.formats.program_format import (
    Exported,
    ExportSource,
    Format,
    Imported,
    ImportOptions,
    get_byte_order_mark,
    get_record,
    parse_number,
    report_change,
    report_changes,
)
from loopcal.mechanism.families.gough import Gough
from loopcal.units import Dimension, find_unit

SETP = re.compile(r"\s*setp\s+(genhexkins\.[\w.-]+)(\s*=\s*|\s+)([^\s#]+)")
LEAD, OFFSETS = "genhexkins.screw-lead", ("genhexkins.spindle-offset", "genhexkins.tool-offset")
SIDES = ("base", "platform")
Point = tuple[float, float, float]
ROUNDING = 1e-12
"""Relative difference of numbers that count as the same."""

ROBOT = """\
# Read from {origin}, the genhexkins settings of LinuxCNC. Readings are strut lengths, so the
# lengths at reading zero are 0.
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
    """The value of a pin, with its line (from 0) and column."""

    text: str
    line: int
    start: int


@dataclass(frozen=True)
class _Hal:
    """A HAL file: its lines and pins."""

    path: Path
    lines: tuple[str, ...]
    pins: Mapping[str, _Pin]

    def number(self, name: str, default: float | None = None) -> float:
        """Return the number of a pin, or the default; FileError where there is neither."""
        pin = self.pins.get(name)
        if pin is None:
            if default is not None:
                return default
            sentence = f"'setp {name} ..' is missing, and loopcal assumes no default"
            raise FileError(f"{sentence}; add it", self.path)
        return parse_number(pin.text, name, self.path, pin.line + 1)

    def points(self, kind: str) -> list[Point]:
        """Return the six centers or axes; LinuxCNC has z at 0 where it is not set."""
        names = [f"genhexkins.{kind}.{n}" for n in range(6)]
        return [
            (self.number(f"{n}.x"), self.number(f"{n}.y"), self.number(f"{n}.z", 0.0))
            for n in names
        ]

    @property
    def lift(self) -> float:
        """Height that is added to all centers."""
        return sum(self.number(name, 0.0) for name in OFFSETS)


def read(path: Path, options: ImportOptions) -> Imported:
    """Read the pins.

    Raises
    ------
    FileError : a pin is missing or not a number, or no unit of length is given.
    """
    hal = _read_hal(path)
    if options.length_unit is None:
        raise FileError(report_finding("files.unit-missing"), path)
    unit = find_unit(options.length_unit, Dimension.LENGTH)
    lift, lead = hal.lift, hal.number(LEAD, 0.0)
    centers = {side: [(x, y, z + lift) for x, y, z in hal.points(side)] for side in SIDES}
    findings: tuple[Finding, ...] = ()
    if options.home_height is None:
        home = sum(math.hypot(x, y) for x, y, _ in centers["base"]) / 6
        findings = (report_finding("files.home-assumed", height=f"{home:g} {unit}"),)
    else:
        home = options.home_height / unit.factor_to_si
    screw = ""
    if lead:
        low, high = hal.points("base-n"), hal.points("platform-n")
        struts = zip(centers["base"], centers["platform"], low, high, strict=True)
        signs = [_get_hand(*strut, home) for strut in struts]
        turned = [_flip(axis, sign) for axis, sign in zip(high, signs, strict=True)]
        leads = lead if min(signs) > 0 else [sign * lead for sign in signs]
        screw = SCREW.format(
            lead=leads, base=_format_list(low, 4), platform=_format_list(turned, 4)
        )
    text = ROBOT.format(
        origin=path.name,
        name=json.dumps(options.name),
        source=json.dumps(f"{path.name}, genhexkins settings of LinuxCNC"),
        unit=json.dumps(unit.symbol),
        legs="ups" if lead else "rod",
        base=_format_list(centers["base"], 2),
        platform=_format_list(centers["platform"], 2),
        home=home,
        screw=screw,
    )
    return Imported(text, None, findings)


def write(source: ExportSource, into: Path | None) -> Exported:
    """Return the corrected pins in an existing HAL file, or `setp` lines of their own."""
    record: Gough = get_record(source, Gough, "linuxcnc", "a hexapod of the family gough")
    unit = find_unit(source.robot.units[Dimension.LENGTH])
    hal = _Hal(Path("hexapod.hal"), (), {}) if into is None else _read_hal(into)
    lead = hal.number(LEAD) if LEAD in hal.pins else None
    lines, changes = list(hal.lines), []
    has_end = not lines or lines[-1].endswith("\n")
    if not has_end:
        lines[-1] += "\n"
    for name, value in _list_pins(source, record, unit.factor_to_si, hal.lift, lead):
        pin = hal.pins.get(name)
        if pin is None:
            if into is not None and value == 0.0:
                continue
            text = format_scaled(value, 1.0)
            lines.append(f"setp {name} {text}\n")
            changes.append(report_change(len(lines), name, None, text))
            continue
        if abs(hal.number(name) - value) <= ROUNDING * max(1.0, abs(value)):
            continue
        text = format_scaled(value, 1.0)
        line = lines[pin.line]
        lines[pin.line] = line[: pin.start] + text + line[pin.start + len(pin.text) :]
        changes.append(report_change(pin.line + 1, name, pin.text, text))
    if not has_end and len(lines) == len(hal.lines):
        lines[-1] = lines[-1].removesuffix("\n")
    first = report_changes(changes)
    if into is None:
        first = (report_finding("files.machine-unit", unit=unit.symbol),)
    mark = "" if into is None else get_byte_order_mark(into)
    rest = _report_inexpressible(source, unit.factor_to_si, unit.symbol)
    return Exported(mark + "".join(lines), (*first, *rest))


def _list_pins(
    source: ExportSource, record: Gough, factor: float, lift: float, present: float | None
) -> Iterator[tuple[str, float]]:
    """Yield pin and value in the file's unit; `present` is the lead there, whose sign is kept."""
    values = source.values()
    for n in range(6):
        for side in SIDES:
            for axis in "xyz":
                value = values[f"leg{n + 1}.{side}.{axis}"] / factor
                shifted = value - (lift if axis == "z" else 0.0)
                yield f"genhexkins.{side}.{n}.{axis}", float(format_scaled(shifted, 1.0))
    if record.screw is None:
        return
    legs = record.screw.legs()
    lead = abs(legs[0].lead) if present is None else math.copysign(legs[0].lead, present)
    if any(abs(abs(leg.lead) - abs(lead)) > ROUNDING * abs(lead) for leg in legs):
        sentence = f"{source.robot.name} has screws of different lead, but genhexkins has one lead"
        raise DataError(f"{sentence}; use json or csv")
    yield LEAD, lead / factor
    for n, leg in enumerate(legs):
        upper = _flip(leg.platform_axis, math.copysign(1.0, leg.lead * lead))
        for side, direction in (("base-n", leg.base_axis), ("platform-n", upper)):
            for axis, value in zip("xyz", direction, strict=True):
                yield f"genhexkins.{side}.{n}.{axis}", value


def _report_inexpressible(source: ExportSource, factor: float, symbol: str) -> Iterator[Finding]:
    """Yield what has no pin: lengths at reading zero, and further parameters."""
    values = source.values()
    for n in range(6):
        length = values.pop(f"leg{n + 1}.length", 0.0) / factor
        if abs(length) > ROUNDING:
            text = f"{format_scaled(length, 1.0)} {symbol}"
            yield report_finding("files.strut-length", strut=n, length=text)
    expressed = re.compile(r"leg\d\.(base|platform)\.[xyz]$")
    table = source.robot.parameters
    changed = zip(table.names, source.robot.values, table.nominal, strict=True)
    others = [name for name, value, nominal in changed if value != nominal and name in values]
    others = [name for name in others if not expressed.match(name)]
    if others:
        yield report_finding("files.not-expressed", format="genhexkins", names=tuple(others))


def _read_hal(path: Path) -> _Hal:
    """Read the pins of a file; FileError where it has none."""
    lines = tuple(read_text(path, "HAL file").splitlines(keepends=True))
    pins = {
        match[1]: _Pin(match[3], i, match.start(3))
        for i, line in enumerate(lines)
        if (match := SETP.match(line))
    }
    if not pins:
        sentence = "this file has no 'setp genhexkins...'"
        raise FileError(f"{sentence}; name the HAL file that sets the geometry", path)
    return _Hal(path, lines, pins)


def _get_hand(base: Point, top: Point, low: Point, high: Point, home: float) -> float:
    """Return -1 where the axes are beyond a quarter turn about the strut at home, else 1.

    `home` is the height of the platform.
    """
    strut = (top[0] - base[0], top[1] - base[1], top[2] + home - base[2])
    across = _dot(low, high) * _dot(strut, strut) - _dot(low, strut) * _dot(high, strut)
    return -1.0 if across < 0 else 1.0


def _dot(a: Point, b: Point) -> float:
    return sum(x * y for x, y in zip(a, b, strict=True))


def _flip(axis: Sequence[float], sign: float) -> Point:
    x, y, z = axis
    return (x, y, z) if sign > 0 else (0.0 - x, 0.0 - y, 0.0 - z)


def _format_list(points: list[Point], indent: int) -> str:
    return "\n".join(f"{' ' * indent}- [{', '.join(repr(v) for v in point)}]" for point in points)


FORMAT = Format(
    "linuxcnc",
    "genhexkins settings of a LinuxCNC hexapod",
    (".hal",),
    read,
    write,
    reads=("length_unit", "home_height"),
)
