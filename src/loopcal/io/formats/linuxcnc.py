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

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from loopcal.errors import DataError, FileError
from loopcal.findings import Finding, report_finding
from loopcal.io.core.yaml_file import format_yaml
from loopcal.io.formats.program_format import (
    DECIMALS,
    Exported,
    ExportSource,
    Format,
    Imported,
    ImportOptions,
    Name,
    ValueFile,
    format_head,
    get_record,
    round_digits,
)
from loopcal.mechanism.families.gough import Gough
from loopcal.mechanism.families.records import values_per_leg
from loopcal.typing import FloatArray
from loopcal.units import Dimension, find_unit, format_scaled

COMPONENT = "genhexkins"
LEAD, OFFSETS = "screw-lead", ("spindle-offset", "tool-offset")
SIDES, UP = ("base", "platform"), np.array([0.0, 0.0, 1.0])
ROUNDING = 1e-12  # relative difference of numbers that count as the same
REMARK = "Readings are strut lengths, so the lengths at reading zero are 0."
COMMENTS = {"stored_parameters": "what genhexkins stores", "tolerances": "measured by hand"}


@dataclass(frozen=True)
class HalFile(ValueFile):
    """A HAL file, whose values are pins of genhexkins."""

    what = "HAL file"
    title = phrase = "{0}.{1}"
    missing = "'setp {0}.{1} ..' is missing, and loopcal assumes no default. Add it"
    group = COMPONENT
    entry: ClassVar[re.Pattern[str]] = re.compile(
        rf"\s*setp\s+{COMPONENT}\.([\w.-]+)(?:\s*=\s*|\s+)([^\s#]+)"
    )
    new = "setp {0}.{1} {2}"

    def format(self, number: float) -> str:
        """Return a number with the fewest digits that read back equal."""
        return format_scaled(number, 1.0)

    def is_same(self, a: float, b: float) -> bool:
        """Return whether two numbers differ by rounding only."""
        return abs(a - b) <= ROUNDING * max(1.0, abs(b))

    def pin(self, name: str, default: float | None = None) -> float:
        """Return the number of a pin, or the default."""
        return self.number(COMPONENT, name, default)

    def points(self, kind: str) -> FloatArray:
        """Return the six centers or axes (6, 3); LinuxCNC has z at 0 where it is not set."""
        names = [f"{kind}.{n}" for n in range(6)]
        xyz = [(self.pin(f"{n}.x"), self.pin(f"{n}.y"), self.pin(f"{n}.z", 0.0)) for n in names]
        return np.array(xyz)

    @property
    def lift(self) -> float:
        """Height that is added to all centers."""
        return sum(self.pin(name, 0.0) for name in OFFSETS)


def read(path: Path, options: ImportOptions) -> Imported:
    """Read the pins.

    FileError : a pin is missing or not a number, or no unit of length is given.
    """
    hal = _read_hal(path)
    if options.length_unit is None:
        raise FileError.of("files.unit-missing", path)
    unit = find_unit(options.length_unit, Dimension.LENGTH)
    lift, lead = hal.lift, hal.pin(LEAD, 0.0)
    base, platform = (hal.points(side) + lift * UP for side in SIDES)
    findings: tuple[Finding, ...] = ()
    if options.home_height is None:
        home = sum(math.hypot(x, y) for x, y, _ in base.tolist()) / 6
        findings = (report_finding("files.home-assumed", height=f"{home:g} {unit}"),)
    else:
        home = round_digits(options.home_height / unit.factor_to_si)
    content: dict[str, Any] = {
        "legs": "ups" if lead else "rod",
        "base": base.tolist(),
        "platform": platform.tolist(),
        "lengths": 0,
        "home": {"z": home},
        "stored_parameters": ["leg*.base.?", "leg*.platform.?"],
    }
    if options.sigma_tape is not None:  # joint centers were measured by hand
        sd = round_digits(options.sigma_tape / unit.factor_to_si)
        content["tolerances"] = {"base": {"sd": sd}, "platform": {"sd": sd}}
    if lead:
        low, high = hal.points("base-n"), hal.points("platform-n")
        struts = platform + home * UP - base
        across = (low * high).sum(1) * (struts * struts).sum(1)
        across -= (low * struts).sum(1) * (high * struts).sum(1)
        # of the other hand where the axes are beyond a quarter turn about the strut at home
        hands = np.where(across < 0, -1.0, 1.0)
        content["screw"] = {
            "lead": lead if min(hands) > 0 else (hands * lead).tolist(),
            "base_axes": low.tolist(),
            "platform_axes": (hands[:, None] * high).tolist(),
        }
    what, units = "genhexkins settings of LinuxCNC", (unit.symbol, "deg")
    head = format_head(path, what, "gough", options.name, units, REMARK)
    text = head + format_yaml(content, COMMENTS)
    return Imported(text, None, findings)


def write(source: ExportSource, into: Path | None) -> Exported:
    """Return the corrected pins in an existing HAL file, or `setp` lines of their own."""
    record: Gough = get_record(source, Gough, "linuxcnc", "a hexapod of the family gough")
    unit = find_unit(source.robot.units[Dimension.LENGTH])
    hal = HalFile.parse((), Path("hexapod.hal")) if into is None else _read_hal(into)
    lead = hal.pin(LEAD) if hal.has(COMPONENT, LEAD) else None
    wanted = _list_pins(source, record, unit.factor_to_si, hal.lift, lead)
    findings = _report_inexpressible(source, unit.factor_to_si, unit.symbol)
    if into is None:
        findings = (report_finding("files.machine-unit", unit=unit.symbol), *findings)
    return hal.export(into, wanted, dict.fromkeys(wanted, 0.0), tuple(findings))


def _list_pins(
    source: ExportSource, record: Gough, factor: float, lift: float, present: float | None
) -> dict[Name, float | str]:
    """Return pin -> value in the file's unit; `present` is the lead there, whose sign is kept."""
    values, pins = source.values(), {}
    for n in range(6):
        for side in SIDES:
            for axis in "xyz":
                name = f"leg{n + 1}.{side}.{axis}"
                value = values[name] / factor
                shifted = value - (lift if axis == "z" else 0.0)
                shifted = source.round_number(shifted, name, factor, DECIMALS)
                pins[f"{side}.{n}.{axis}"] = float(format_scaled(shifted, 1.0))
    if (screw := record.screw) is not None:
        leads = values_per_leg(screw.lead, 6, "the screw's lead")
        lead = abs(leads[0]) if present is None else math.copysign(leads[0], present)
        if any(abs(abs(own) - abs(lead)) > ROUNDING * abs(lead) for own in leads):
            sentence = f"{source.robot.name} has screws of different lead, but genhexkins has one"
            raise DataError(f"{sentence} lead. Use json or csv")
        pins[LEAD] = lead / factor
        for n, own in enumerate(leads):
            turned = np.copysign(1.0, own * lead) * np.array(screw.platform_axes[n]) + 0.0
            for side, axes in (("base-n", screw.base_axes[n]), ("platform-n", turned.tolist())):
                pins |= {f"{side}.{n}.{axis}": axes[i] for i, axis in enumerate("xyz")}
    return {(COMPONENT, pin): value for pin, value in pins.items()}


def _report_inexpressible(source: ExportSource, factor: float, symbol: str) -> Iterator[Finding]:
    """Yield what has no pin: lengths at reading zero, and further parameters."""
    values = source.values()
    for n in range(6):
        name = f"leg{n + 1}.length"
        length = values.pop(name, 0.0) / factor
        if abs(length) > ROUNDING:
            shown = source.round_number(length, name, factor, DECIMALS)
            text = f"{shown:.{DECIMALS}f}".rstrip("0").rstrip(".")
            yield report_finding("files.strut-length", strut=n, length=f"{text} {symbol}")
    expressed = re.compile(r"leg\d\.(base|platform)\.[xyz]$")
    table = source.robot.parameters
    changed = zip(table.names, source.robot.values, table.nominal, strict=True)
    others = [name for name, value, nominal in changed if value != nominal and name in values]
    others = [name for name in others if not expressed.match(name)]
    if others:
        yield report_finding("files.not-expressed", format="genhexkins", names=tuple(others))


def _read_hal(path: Path) -> HalFile:
    """Read the pins of a file; FileError where it has none."""
    hal = HalFile.load(path)
    if not hal.values:
        sentence = f"this file has no 'setp {COMPONENT}...'"
        raise FileError(f"{sentence}. Name the HAL file that sets the geometry", path)
    return hal


FORMAT = Format(
    "linuxcnc",
    "genhexkins settings of a LinuxCNC hexapod",
    (".hal",),
    read,
    write,
    read_options={"length_unit": "", "home_height": "", "sigma_tape": "joint centers"},
)


# LinuxCNC's INI file: HOME_OFFSET of the struts of a hexapod with the kinematics genhexkins.

STRUTS = 6
OFFSET = "HOME_OFFSET"
UNITS_NAME = ("TRAJ", "LINEAR_UNITS")
LINEAR_UNITS = {"mm": "mm", "metric": "mm", "in": "in", "inch": "in", "imperial": "in"}


@dataclass(frozen=True)
class IniFile(ValueFile):
    """An INI file, whose values are entries by section."""

    what = "INI file"
    title = "[{0}]{1}"
    phrase = "{1} of [{0}]"
    missing = "[{0}] has no {1}. Add the one of the machine"
    section: ClassVar[re.Pattern[str] | None] = re.compile(r"\s*\[(\w+)\]")
    entry: ClassVar[re.Pattern[str]] = re.compile(r"\s*(\w+)\s*=\s*([^\s#;]+)")
    new = "[{0}]\n{1} = {2}"
    does_first_count = True


def write_ini(source: ExportSource, into: Path | None) -> Exported:
    """Return an INI file with corrected offsets, or entries; for people what to add to each."""
    get_record(source, Gough, "linuxcnc-ini", "a hexapod of the family gough")
    values, table = source.values(), source.robot.parameters
    nominal = dict(zip(table.names, table.nominal.tolist(), strict=True))
    lengths = {f"JOINT_{n}": f"leg{n + 1}.length" for n in range(STRUTS)}
    unit = source.robot.units[Dimension.LENGTH]
    ini = None if into is None else IniFile.load(into)
    findings = [report_finding("files.machine-unit", unit=unit)]
    if ini is not None and ini.has(*UNITS_NAME):
        text, findings = ini.text(*UNITS_NAME), []
        if text.lower() not in LINEAR_UNITS:
            allowed = ", ".join(LINEAR_UNITS)
            raise ini.error(f"{UNITS_NAME[1]} is {text!r}. Allowed: {allowed}", *UNITS_NAME)
        unit = LINEAR_UNITS[text.lower()]
    factor = find_unit(unit).factor_to_si

    def scale(name: str, start: float, origin: float) -> float:
        number = start + (values[name] - origin) / factor
        return source.round_number(number, name, factor, DECIMALS)

    if ini is not None:
        wanted: dict[Name, float | str] = {
            (joint, OFFSET): scale(name, ini.number(joint, OFFSET), nominal[name])
            for joint, name in lengths.items()
        }
        return ini.export(into, wanted, {}, findings)
    if source.is_for_people:
        lines = []
        for joint, name in lengths.items():
            number = f"{scale(name, 0.0, nominal[name]) + 0.0:+.{DECIMALS}f}"
            shown = number.rstrip("0").rstrip(".")
            lines += [f"[{joint}]", f"# add {shown} {unit} to {OFFSET}"]
        return Exported("\n".join(lines) + "\n")
    if not all(nominal[name] for name in lengths.values()):
        raise DataError.of("files.ini-needed", robot=source.robot.name)
    wanted = {(joint, OFFSET): scale(name, 0.0, 0.0) for joint, name in lengths.items()}
    notes = (*findings, report_finding("files.offset-at-reading-zero"))
    return IniFile.parse((), Path("machine.ini")).export(None, wanted, {}, notes)


INI_FORMAT = Format(
    "linuxcnc-ini", "HOME_OFFSET of a LinuxCNC hexapod in its INI file", (".ini",), None, write_ini
)
