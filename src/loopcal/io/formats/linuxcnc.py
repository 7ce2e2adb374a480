# SPDX-License-Identifier: Apache-2.0
"""LinuxCNC's genhexkins and lineardeltakins: what their formulas hold, as `setp` lines of HAL.

    setp genhexkins.base.N.x ..        center of a joint on the base (platform.N: on the platform)
    setp genhexkins.base-n.N.x ..      axis of that joint (platform-n.N), used with a screw lead
    setp genhexkins.screw-lead ..      change of a strut's length in one turn;  N = 0..5
    setp lineardeltakins.R ..          radius of a delta;  L: length of its rods

No unit is stated: it is the machine's. Positions of joints follow from the pose alone. They are the
readings of a robot file that is read, and what a calibration adds to them shifts the zero of the
joint, which the pins cannot express: it belongs to HOME_OFFSET in the INI file.

genhexkins: a joint is the distance of a strut's centers, plus the screw's correction. It is
screw-lead * asin(sin a) / (2 pi) of the angle a about the strut between the two axes, where loopcal
has the angle itself: the same below a quarter turn. A strut beyond a quarter turn at home is read
as what the formula makes of it there, a screw of the other hand counted from the other side of its
axis (-lead, -platform-n). `spindle-offset` and `tool-offset` are added to z of all centers.
lineardeltakins: a joint is the height z + sqrt(L^2 - d^2) of a carriage at the horizontal distance
d. The towers are at 90, 210 and 330 degrees. Source: LinuxCNC, "Kinematics" and lineardeltakins(9).
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from loopcal.errors import DataError, FileError
from loopcal.findings import Finding, report_finding
from loopcal.io.core.yaml_file import format_yaml
from loopcal.io.formats import program_format
from loopcal.io.formats.delta_gcode import COMMENTS
from loopcal.mechanism.families.gough import Gough, Screw
from loopcal.mechanism.families.linear_delta import LinearDelta
from loopcal.mechanism.families.records import RobotRecord, values_per_leg
from loopcal.typing import FloatArray
from loopcal.units import Dimension, find_unit, format_scaled

HEXAPOD, DELTA = "genhexkins", "lineardeltakins"
LEAD = f"{HEXAPOD}.screw-lead"
OFFSETS = (f"{HEXAPOD}.spindle-offset", f"{HEXAPOD}.tool-offset")
SIDES, UP = ("base", "platform"), np.array([0.0, 0.0, 1.0])
TOWERS = (90.0, 210.0, 330.0)  # angles of the towers of joints 0, 1 and 2 [deg]
ROUNDING = 1e-12  # relative difference of numbers that count as the same

Values = Mapping[str, float]


@dataclass(frozen=True)
class HalFile(program_format.ValueFile):
    """A HAL file, whose values are pins."""

    what = "HAL file"
    title = phrase = "{1}"
    missing = "'setp {1} ..' is missing, and loopcal assumes no default. Add it"
    entry: ClassVar[re.Pattern[str]] = re.compile(
        rf"\s*setp\s+((?:{HEXAPOD}|{DELTA})\.[\w.-]+)(?:\s*=\s*|\s+)([^\s#]+)"
    )
    new = "setp {1} {2}"

    def format(self, number: float) -> str:
        """Return a number with the fewest digits that read back equal."""
        return format_scaled(number, 1.0)

    def is_same(self, a: float, b: float) -> bool:
        """Return whether two numbers differ by rounding only."""
        return abs(a - b) <= ROUNDING * max(1.0, abs(b))

    def pin(self, name: str, default: float | None = None) -> float:
        """Return the number of a pin, or the default."""
        return self.number("", name, default)

    def points(self, kind: str) -> FloatArray:
        """Return the six centers or axes (6, 3); LinuxCNC has z at 0 where it is not set."""
        names = [f"{HEXAPOD}.{kind}.{n}" for n in range(6)]
        xyz = [(self.pin(f"{n}.x"), self.pin(f"{n}.y"), self.pin(f"{n}.z", 0.0)) for n in names]
        return np.array(xyz)

    @property
    def lift(self) -> float:
        """Height that is added to all centers."""
        return sum(self.pin(name, 0.0) for name in OFFSETS)


@dataclass(frozen=True)
class Component:
    """A kinematics component: the parameters that its pins hold, and the robot that it is for.

    taped : what is measured by hand. joints : what the position of a joint is. pins : name ->
    parameter. read : pins, height of the home pose -> content of a robot file.
    hold : values [SI] -> those with which the formulas compute, and the position of each joint at
        reading zero by the name of the parameter that shifts it.
    """

    name: str
    taped: tuple[str, ...]
    joints: str
    pins: Mapping[str, str]
    read: Callable[[HalFile, float | None], dict[str, Any]]
    hold: Callable[[Values], tuple[Values, Values]]


def _read_hexapod(hal: HalFile, home: float | None) -> dict[str, Any]:
    """Return a hexapod; home is assumed at the radius of the base."""
    lift, lead = hal.lift, hal.pin(LEAD, 0.0)
    base, platform = (hal.points(side) + lift * UP for side in SIDES)
    if home is None:
        home = sum(math.hypot(x, y) for x, y, _ in base.tolist()) / 6
    content: dict[str, Any] = {
        "legs": "ups" if lead else "rod",
        "base": base.tolist(),
        "platform": platform.tolist(),
        "lengths": 0,
        "home": {"z": home},
        "stored_parameters": ["leg*.base.?", "leg*.platform.?"],
    }
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
    return content


def _hold_hexapod(values: Values) -> tuple[Values, Values]:
    """Return the centers, and the lengths of the struts."""
    lengths = [f"leg{n}.length" for n in range(1, 7)]
    return {n: values[n] for n in CENTERS.values()}, {name: values[name] for name in lengths}


def _list_screw_pins(screw: Screw, hal: HalFile, robot: str, factor: float) -> dict[str, float]:
    """Return lead and axes of the screws of a robot; the sign of a lead in the file is kept."""
    leads = values_per_leg(screw.lead, 6, "the screw's lead")
    lead = math.copysign(leads[0], hal.pin(LEAD)) if hal.has("", LEAD) else abs(leads[0])
    if any(abs(abs(own) - abs(lead)) > ROUNDING * abs(lead) for own in leads):
        sentence = f"{robot} has screws of different lead, but genhexkins has one lead"
        raise DataError(f"{sentence}. Use json or csv")
    pins = {LEAD: lead / factor}
    for n, own in enumerate(leads):
        turned = np.copysign(1.0, own * lead) * np.array(screw.platform_axes[n]) + 0.0
        for side, axes in (("base-n", screw.base_axes[n]), ("platform-n", turned.tolist())):
            pins |= {f"{HEXAPOD}.{side}.{n}.{axis}": axes[i] for i, axis in enumerate("xyz")}
    return pins


def _read_delta(hal: HalFile, home: float | None) -> dict[str, Any]:
    """Return a delta; its home is at zero by default."""
    radius, rod = (hal.pin(f"{DELTA}.{name}") for name in "RL")
    if not rod > radius > 0:
        sentence = f"R is {radius:g} and L is {rod:g}, but R must be positive and L longer"
        raise hal.error(f"{sentence}. Correct them", "", f"{DELTA}.L")
    content = {"radius": radius, "angles": list(TOWERS), "arms": rod, "readings": "height"}
    content |= {"stops": -math.sqrt(rod**2 - radius**2), "home": {"z": home or 0.0}}
    half = program_format.round_length(0.5 * radius)
    content["workspace"] = {"x": [-half, half], "y": [-half, half], "z": [0, half]}
    return content | {"stored_parameters": ["radius", "arm*.length", "tower*.stop"]}


def _hold_delta(values: Values) -> tuple[Values, Values]:
    """Return the radius, the mean of the rods and angles a third of a turn apart, and the heights
    of the carriages: they bring the nozzle to the height of a stop, in the center.
    """
    rods = [f"arm{k}.length" for k in (1, 2, 3)]
    rod, radius = math.fsum(values[name] for name in rods) / 3, values["radius"]
    held, joints = {"radius": radius, **dict.fromkeys(rods, rod)}, dict[int, str]()
    for k in (1, 2, 3):
        third = round((math.degrees(values[f"tower{k}.angle"]) - TOWERS[0]) / 120)
        held[f"tower{k}.angle"] = math.radians(TOWERS[0] + 120 * third)
        joints[third % 3] = f"tower{k}.stop"
    if len(joints) < 3:
        raise DataError.of("files.towers-together")
    rise = math.sqrt(rod**2 - radius**2)
    return held, {joints[n]: values[joints[n]] + rise for n in range(3)}


CENTERS = {
    f"{side}.{n}.{i}": f"leg{n + 1}.{side}.{i}" for n in range(6) for side in SIDES for i in "xyz"
}
RODS = {"R": "radius", "L": "arm1.length"}
COMPONENTS: Mapping[type[RobotRecord], Component] = {
    Gough: Component(
        HEXAPOD, SIDES, "lengths of the struts", CENTERS, _read_hexapod, _hold_hexapod
    ),
    LinearDelta: Component(
        DELTA, ("arms",), "heights of the carriages", RODS, _read_delta, _hold_delta
    ),
}


def read(path: Path, options: program_format.ImportOptions) -> program_format.Imported:
    """Read the pins.

    FileError : a pin is missing or not a number, or no unit of length is given.
    """
    hal, family = _read_hal(path)
    if options.length_unit is None:
        raise FileError.of("files.unit-missing", path)
    unit, kins = find_unit(options.length_unit, Dimension.LENGTH), COMPONENTS[family]
    stated = options.home_height
    home = None if stated is None else program_format.round_digits(stated / unit.factor_to_si)
    content = kins.read(hal, home)
    findings: tuple[Finding, ...] = ()
    if home is None and (assumed := content["home"]["z"]):
        findings = (report_finding("files.home-assumed", height=f"{assumed:g} {unit}"),)
    if options.sigma_tape is not None:
        sd = program_format.round_digits(options.sigma_tape / unit.factor_to_si)
        content["tolerances"] = {name: {"sd": sd} for name in kins.taped}
    what, units = f"{kins.name} settings of LinuxCNC", (unit.symbol, "deg")
    remark = f"Readings are positions of joints: {kins.joints}."
    head = program_format.format_head(path, what, family.family, options.name, units, remark)
    comments = {name: COMMENTS[name] for name in ("tolerances", "workspace")}
    comments["stored_parameters"] = f"what {kins.name} stores"
    return program_format.Imported(head + format_yaml(content, comments), None, findings)


def write(source: program_format.ExportSource, into: Path | None) -> program_format.Exported:
    """Return the corrected pins in an existing HAL file, or `setp` lines of their own."""
    record, kins = _find_component(source, FORMAT.name)
    unit = find_unit(source.robot.units[Dimension.LENGTH])
    factor, (held, zeros) = unit.factor_to_si, kins.hold(source.values())
    hal = HalFile.parse((), Path("machine.hal")) if into is None else _read_hal(into, kins)[0]
    wanted, findings = dict[program_format.Name, float | str](), list[Finding]()
    for pin, name in kins.pins.items():
        number = held[name] / factor - (hal.lift if pin.endswith(".z") else 0.0)
        number = source.round_number(number, name, factor, program_format.DECIMALS)
        wanted["", f"{kins.name}.{pin}"] = float(format_scaled(number, 1.0))
    if (screw := getattr(record, "screw", None)) is not None:
        of_screw = _list_screw_pins(screw, hal, source.robot.name, factor)
        wanted |= {("", pin): number for pin, number in of_screw.items()}
    if into is None:
        findings = [report_finding("files.machine-unit", unit=unit.symbol)]
    for n, (name, zero) in enumerate(zeros.items()):
        if abs(zero / factor) > ROUNDING:
            shown = source.round_number(zero / factor, name, factor, program_format.DECIMALS)
            text = program_format.format_short(shown, program_format.DECIMALS)
            facts = {"joint": n, "length": f"{text} {unit.symbol}", "component": kins.name}
            findings.append(report_finding("files.joint-position", **facts))
    stored = {**program_format.ExportSource(source.robot.nominal).values(), **held}
    others = ((n, v) for n, v in source.values().items() if n not in zeros)
    lost = [name for name, value in others if abs(value - stored[name]) > ROUNDING]
    if lost:
        findings.append(report_finding("files.not-expressed", format=kins.name, names=tuple(lost)))
    return hal.export(into, wanted, dict.fromkeys(wanted, 0.0), findings)


def _find_component(
    source: program_format.ExportSource, format_name: str
) -> tuple[RobotRecord, Component]:
    """Return the record of a robot and its component; DataError where no component is for it."""
    needed = "a hexapod (family gough) or a delta (family linear-delta)"
    record = program_format.get_record(source, tuple(COMPONENTS), format_name, needed)
    return record, COMPONENTS[type(record)]


def _read_hal(path: Path, *wanted: Component) -> tuple[HalFile, type[RobotRecord]]:
    """Read a file with pins of a component, and return its family; FileError without any."""
    hal, wanted = HalFile.load(path), wanted or tuple(COMPONENTS.values())
    for family, kins in COMPONENTS.items():
        if kins in wanted and any(pin.startswith(kins.name) for _, pin in hal.values):
            return hal, family
    names = " or ".join(f"'setp {kins.name}...'" for kins in wanted)
    raise FileError(f"this file has no {names}. Name the HAL file that sets the geometry", path)


FORMAT = program_format.Format(
    "linuxcnc",
    "genhexkins or lineardeltakins settings of LinuxCNC",
    (".hal",),
    read,
    write,
    read_options={"length_unit": "", "home_height": "", "sigma_tape": "joint centers, arms"},
)


# LinuxCNC's INI file: HOME_OFFSET of the joints of these components.

OFFSET = "HOME_OFFSET"
UNITS_NAME = ("TRAJ", "LINEAR_UNITS")
LINEAR_UNITS = {"mm": "mm", "metric": "mm", "in": "in", "inch": "in", "imperial": "in"}


@dataclass(frozen=True)
class IniFile(program_format.ValueFile):
    """An INI file, whose values are entries by section."""

    what = "INI file"
    title = "[{0}]{1}"
    phrase = "{1} of [{0}]"
    missing = "[{0}] has no {1}. Add the one of the machine"
    section: ClassVar[re.Pattern[str] | None] = re.compile(r"\s*\[(\w+)\]")
    entry: ClassVar[re.Pattern[str]] = re.compile(r"\s*(\w+)\s*=\s*([^\s#;]+)")
    new = "[{0}]\n{1} = {2}"
    does_first_count = True


def write_ini(source: program_format.ExportSource, into: Path | None) -> program_format.Exported:
    """Return an INI file with corrected offsets, or entries; for people what to add to each."""
    _, kins = _find_component(source, INI_FORMAT.name)
    before = program_format.ExportSource(source.robot.nominal)
    zeros, nominal = (kins.hold(of.values())[1] for of in (source, before))
    joints = {f"JOINT_{n}": name for n, name in enumerate(zeros)}
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
        number = start + (zeros[name] - origin) / factor
        return source.round_number(number, name, factor, program_format.DECIMALS)

    if ini is not None:
        wanted: dict[program_format.Name, float | str] = {
            (joint, OFFSET): scale(name, ini.number(joint, OFFSET), nominal[name])
            for joint, name in joints.items()
        }
        return ini.export(into, wanted, {}, findings)
    if source.is_for_people:
        lines = []
        for joint, name in joints.items():
            number = f"{scale(name, 0.0, nominal[name]) + 0.0:+.{program_format.DECIMALS}f}"
            shown = number.rstrip("0").rstrip(".")
            lines += [f"[{joint}]", f"# add {shown} {unit} to {OFFSET}"]
        return program_format.Exported("\n".join(lines) + "\n")
    if not all(abs(zero) > ROUNDING for zero in nominal.values()):
        raise DataError.of("files.ini-needed", robot=source.robot.name)
    wanted = {(joint, OFFSET): scale(name, 0.0, 0.0) for joint, name in joints.items()}
    notes = (*findings, report_finding("files.offset-at-reading-zero"))
    return IniFile.parse((), Path("machine.ini")).export(None, wanted, {}, notes)


INI_FORMAT = program_format.Format(
    "linuxcnc-ini",
    "HOME_OFFSET of a LinuxCNC hexapod or delta in its INI file",
    (".ini",),
    None,
    write_ini,
)
