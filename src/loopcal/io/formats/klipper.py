# SPDX-License-Identifier: Apache-2.0
"""Klipper's printer.cfg of a delta printer: geometry, probes of `DELTA_CALIBRATE`, corrections.

Options are `name: value` or `name = value` in `[sections]`. What `SAVE_CONFIG` stored follows a
header line, with `#*# ` in front of each line; an option of the main part hides a stored one.

Tower k = a, b, c has `angle`, `arm_length` and `position_endstop` in [stepper_k]; `delta_radius` is
in [printer]. A stable position counts the motor steps of each tower below its end stop, so that
readings do not depend on the geometry: reading = steps * rotation_distance / (microsteps *
full_steps_per_rotation * gear_ratio), or older `step_distance`. [delta_calibrate] contains heights
(`height0`, `height0_pos`, also `manual_height0`) and distances (`distance0`, `distance0_pos1`,
`distance0_pos2`). Source: the documents "Configuration reference", "G-Codes" (SAVE_CONFIG) and
"Delta calibrate" of Klipper, and how its configfile module reads the two parts.

Of a rotary delta, motor k at `angle` turns an upper arm in the plane of the z axis, by t upwards
from outwards: its elbow is at `shoulder_radius` + `upper_arm_length` cos t from the axis, at the
height `shoulder_height` + `upper_arm_length` sin t, and `lower_arm_length` from the nozzle. At its
end stop it leads the nozzle to (0, 0, `position_endstop`). Steps are angles. Source: Klipper's
"Configuration reference" and its module rotary_delta.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from loopcal.errors import DataError, FileError
from loopcal.findings import Quantity, report_finding
from loopcal.io.core.csv_table import parse_finite
from loopcal.io.core.yaml_file import format_yaml, parse_yaml
from loopcal.io.formats import delta_gcode
from loopcal.io.formats.probe_reports import check_heights
from loopcal.io.formats.program_format import (
    DECIMALS,
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
    round_digits,
    round_length,
    shorten_numbers,
)
from loopcal.io.robot.robot_file import build_robot
from loopcal.measure.kinds.distance import Separation
from loopcal.measure.kinds.poses import Component
from loopcal.measure.measurements import Measurements
from loopcal.mechanism.solutions import forward

STEPPERS = ("stepper_a", "stepper_b", "stepper_c")
PROBED = "delta_calibrate"
MARK = "#*#"
HEADER = "#*# <---------------------- SAVE_CONFIG ---------------------->"
NEW_BLOCK = (HEADER, "#*# DO NOT EDIT THIS BLOCK OR BELOW. The contents are auto-generated.", MARK)
SECTION = re.compile(r"\[([^]]+)\]")
OPTION = re.compile(r"([^:=\s][^:=]*?)(\s*[:=]\s*)(.*?)\s*$")
COMMENT = re.compile(r"#.*|(?:^|(?<=\s));.*")


@dataclass(frozen=True)
class KlipperConfig(ValueFile):
    """A configuration file, whose values are options by section and name.

    `saved` : section -> line of its header in the saved part. `header` : first line of that part,
    None without one. `includes` : files that it includes.
    """

    saved: Mapping[str, int]
    header: int | None
    includes: tuple[str, ...]

    what = "printer.cfg"
    title = "[{0}] {1}"
    phrase = "{1!r} of [{0}]"

    def describe_missing(self, group: str, name: str) -> str:
        """Return the sentence about an option that does not exist."""
        files = ", ".join(self.includes)
        hint = f" (if {files} contains it, move it into this file)" if files else ""
        return f"option {name!r} of [{group}] is missing{hint}. Add it"

    def positive(self, section: str, option: str, default: float | None = None) -> float:
        """Return a positive number of an option, or the default; FileError for another."""
        value = self.number(section, option, default)
        if not value > 0:
            sentence = f"{option!r} of [{section}] is {value:g}. Write a positive number"
            raise self.error(sentence, section, option)
        return value

    @classmethod
    def parse(cls, lines: Sequence[str], path: Path) -> KlipperConfig:
        """Find options and sections."""
        header = next((i for i, line in enumerate(lines) if line.rstrip() == HEADER), None)
        options: dict[Name, Value] = {}
        saved: dict[str, int] = {}
        includes: list[str] = []
        section, main_part = "", frozenset[Name]()
        last = max((i for i, line in enumerate(lines) if line.strip()), default=0)
        for i, line in enumerate(lines[: last + 1]):
            if i == header:
                section, main_part = "", frozenset(options)
            offset = 0
            if header is not None and i >= header:
                if not line.startswith(MARK) or line[3:4] not in ("", " ", "\n", "\r"):
                    sentence = f"this line below SAVE_CONFIG has no {MARK!r}, so Klipper ignores"
                    raise FileError(f"{sentence} the block. Move it up", path, i + 1)
                offset = 4
            content = COMMENT.sub("", line[offset:].rstrip("\r\n")).rstrip()
            if not content or content[0].isspace():
                continue
            if match := SECTION.match(content):
                section = match[1]
                if section.startswith("include "):
                    includes.append(section.removeprefix("include ").strip())
                if offset:
                    saved[section] = i
            elif (match := OPTION.match(content)) and section:
                key = (section, match[1].lower())
                if key not in main_part:
                    options[key] = Value(match[3], i, offset + match.start(3))
        return cls(path, tuple(lines), options, saved, header, tuple(includes))

    def insert(self, lines: list[str], name: Name, text: str) -> None:
        """Insert a new option into the saved part, which is added where there is none."""
        (section, option), end = name, self.line_end
        line = f"{MARK} {option} = {text}{end}"
        if self.header is None:
            lines += [*([end] if lines else []), *(line + end for line in NEW_BLOCK)]
        if section in self.saved:
            lines.insert(self.saved[section] + 1, line)
            return
        while not lines[-1].strip():
            lines.pop()
        first = [] if lines[-1].strip() == MARK else [MARK + end]
        lines += [*first, f"{MARK} [{section}]{end}", line]


DELTAS = ("delta", "rotary_delta")  # kinematics that are read and written


def read_config(path: Path, allowed: Sequence[str] = DELTAS) -> KlipperConfig:
    """Read a configuration; FileError where its saved part was edited, or it is of no delta."""
    cfg = KlipperConfig.load(path)
    is_stated = cfg.has("printer", "kinematics")
    kinematics = cfg.text("printer", "kinematics") if is_stated else ""
    sections = tuple(dict.fromkeys(section for section, _ in cfg.values))
    if kinematics in allowed or (not is_stated and (cfg.includes or STEPPERS[0] in sections)):
        return cfg
    if kinematics in DELTAS:
        sentence = f"this printer's kinematics is {kinematics!r}, but the robot is {allowed[0]!r}"
        raise cfg.error(f"{sentence}. Name the file of the robot", "printer", "kinematics")
    raise cfg.error(
        delta_gcode.report_kinematics(kinematics, sections[:4]), "printer", "kinematics"
    )


def read(path: Path, options: ImportOptions) -> Imported:
    """Read geometry and measurements: heights as component z, distances as separations of poses.

    FileError : an option is missing or not a number, or the printer is not a delta.
    """
    cfg, ends = read_config(path), ("_pos1", "_pos2")
    sorts = ("height", "manual_height")
    heights = [record for sort in sorts for record in _list_records(cfg, sort, ("", "_pos"))]
    distances = _list_records(cfg, "distance", ("", *ends))
    positions = {record: _parse_steps(cfg, f"{record}_pos") for record in heights}
    for option in (f"{record}{end}" for record in distances for end in ends):
        positions[option] = _parse_steps(cfg, option)
    values = {record: cfg.number(PROBED, record) * MM for record in (*heights, *distances)}
    program = "a printer.cfg of Klipper"
    is_rotary = cfg.values.get(("printer", "kinematics"), Value("", 0, 0)).text == "rotary_delta"
    if is_rotary:
        text = format_rotary(cfg, options, path, bool(distances))
    else:
        text = delta_gcode.format_robot(
            parse_geometry(cfg), options, path, program, bool(distances)
        )
    if not positions:
        return Imported(text, None, (report_finding("files.no-probed-heights"),))
    steps = [get_step_distance(cfg, section, is_rotary) for section in STEPPERS]
    finding = report_finding(
        "files.probe-noise-assumed",
        heights=len(heights),
        distances=len(distances),
        sigma_height=Quantity(options.choose_noise("height") / MM, "mm"),
        sigma_distance=Quantity(options.choose_noise("distance") / MM, "mm"),
        height_assumed=options.is_noise_assumed("height"),
        distance_assumed=bool(distances) and options.is_noise_assumed("distance"),
    )
    labels = tuple(positions)
    rows = [labels.index(record) for record in heights]
    pairs = [[labels.index(f"{record}{end}") for end in ends] for record in distances]
    observations = tuple(
        options.observe(kind, of, np.array([[values[record]] for record in records]), what)
        for kind, of, records, what in (
            (Component(components=("z",)), rows, heights, "height"),
            (Separation(), pairs, distances, "distance"),
        )
        if records
    )
    readings = np.array(list(positions.values())) * np.array(steps) * (1.0 if is_rotary else MM)
    measurements = Measurements(options.name, readings, observations, labels=labels)
    robot = build_robot(parse_yaml(text, path, "robot file"))
    reached = forward(robot, readings[rows]).T[:, 2, 3] - [values[record] for record in heights]
    offset = next((n for n in cfg.values if n[1] == "z_offset"), None)
    trigger = None if offset is None else cfg.number(*offset)
    noted = check_heights(reached / MM, trigger, "klipper", path) if heights else []
    return Imported(text, measurements, (finding, *noted))


def parse_geometry(cfg: KlipperConfig) -> delta_gcode.DeltaGeometry:
    """Return the geometry with Klipper's defaults: arm and stop of tower a, angles 210, 330, 90."""
    angles = zip(STEPPERS, delta_gcode.NOMINAL_ANGLES, strict=True)
    arm = cfg.number(STEPPERS[0], "arm_length")
    stop = cfg.number(STEPPERS[0], "position_endstop")
    return delta_gcode.DeltaGeometry(
        cfg.number("printer", "delta_radius"),
        tuple(cfg.number(s, "angle", nominal) for s, nominal in angles),
        tuple(cfg.number(s, "arm_length", arm) for s in STEPPERS),
        tuple(cfg.number(s, "position_endstop", stop) for s in STEPPERS),
    )


ROTARY_ANGLES = (30.0, 150.0, 270.0)  # angles of the motors of a rotary delta by default [deg]
SHOULDER = ("shoulder_radius", "shoulder_height")
# Parameters of an arm, by its letter: end stop, angle of the motor, upper and lower arm.
ROTARY_PARTS = ("{}.offset", "angle_{}.offset", "arm_{}.tip.x", "arm_{}.length")


def format_rotary(
    cfg: KlipperConfig, options: ImportOptions, path: Path, has_distances: bool
) -> str:
    """Return the robot file of a rotary delta. Free is what Klipper's own calibration adjusts, and
    the arms if the options state how accurately they were measured.
    """
    radius, height = (cfg.positive("printer", name) for name in SHOULDER)
    arms = [cfg.positive(STEPPERS[0], f"{part}_arm_length") for part in ("upper", "lower")]
    first = (*arms, cfg.number(STEPPERS[0], "position_endstop"))
    tolerance: dict[str, Any] = {}
    if options.sigma_tape is not None:
        tolerance = {"tolerance": {"sd": round_digits(options.sigma_tape / MM)}}
    errors = [{"of": of, "shift": [s], **tolerance} for of, s in (("tip", "x"), ("rod", "length"))]
    drives, couplings, limbs = dict[str, Any](), dict[str, Any](), list[dict[str, Any]]()
    for section, nominal in zip(STEPPERS, ROTARY_ANGLES, strict=True):
        k, angle = section[-1], cfg.number(section, "angle", nominal)
        names = ("upper_arm_length", "lower_arm_length", "position_endstop")
        upper, lower, stop = map(cfg.number, [section] * 3, names, first)
        at_stop, at_bed = (-_raise_arm(radius, z - height, upper, lower) for z in (stop, 0.0))
        if not math.isfinite(at_stop + at_bed):
            found = report_finding("files.arms-out-of-reach", section=section)
            raise cfg.error(found, section, "position_endstop")
        drives[k] = {"reads": "angle", "offset": at_stop, "unknown": ["offset"]}
        turn = {"sum": {f"arm_{k}.angle": 1}, "offset": angle, "unknown": ["offset"]}
        couplings[f"angle_{k}"] = turn
        shoulder = {"joint": "R", "name": "shoulder", "at": [radius, 0, height], "axis": "y"}
        shoulder |= {"actuated": k, "start": at_bed}
        chain = [{"joint": "R", "name": "angle", "axis": "z", "start": angle}, shoulder]
        limb = {"name": f"arm_{k}", "chain": chain, "tip": [upper, 0, 0], "ending": "distance"}
        limbs.append(limb | {"length": lower, "errors": errors})
    fixed = [] if tolerance else ["arm_*.tip.x", "arm_*.length"]
    fixed += ["angle_c.offset"] if has_distances else ["angle_*.offset", "shoulder_radius"]
    half, axes = round_length(0.4 * min(radius + arms[0], arms[1] - radius)), ["x", "y", "z"]
    places = [{"limb": limb["name"], "element": "shoulder"} for limb in limbs]
    content = {"freedoms": axes, "controlled": axes, "drives": drives, "couplings": couplings}
    content |= {"limbs": limbs, "fixed": fixed, "home": {"z": 0}}
    content["parameters"] = [
        {"name": name, "length": value, "maps": [{**place, "axis": axis} for place in places]}
        for name, value, axis in zip(SHOULDER, (radius, height), "xz", strict=True)
    ]
    content["workspace"] = {"x": [-half, half], "y": [-half, half], "z": [0, half]}
    what = "a printer.cfg of Klipper, kinematics rotary_delta"
    remark = "Readings are the angles of the arms below their end stops."
    head = format_head(path, what, "limbs", options.name, ("mm", "deg"), remark)
    return head + format_yaml(content)


def _raise_arm(radius: float, depth: float, upper: float, lower: float) -> float:
    """Return the angle [deg] of an upper arm whose shoulder is at a radius [mm], with the nozzle on
    the axis at a depth below it (negative); NaN where the arms do not reach.
    """
    reach = math.hypot(radius, depth)
    cosine = (upper**2 + reach**2 - lower**2) / (2 * upper * reach)
    bend = math.acos(cosine) if abs(cosine) <= 1 else math.nan
    return math.degrees(math.atan2(depth, -radius) + bend)


def _list_rotary(source: ExportSource) -> dict[Name, float | str]:
    """Return the options of a rotary delta."""
    values, wanted = source.values(), dict[Name, float | str]()

    def show(number: float, name: str, factor: float = MM) -> float:
        return source.round_number(number / factor, name, factor, DECIMALS)

    for name in SHOULDER:
        wanted["printer", name] = show(values[name], name)
    for section in STEPPERS:
        names = [part.format(section[-1]) for part in ROTARY_PARTS]
        offset, angle, upper, lower = (values[name] for name in names)
        x = values["shoulder_radius"] + upper * math.cos(offset)
        if lower < abs(x):
            raise DataError.of("files.arms-out-of-reach", section=section)
        z = values["shoulder_height"] - upper * math.sin(offset) - math.sqrt(lower**2 - x**2)
        wanted[section, "angle"] = show(angle, names[1], math.radians(1))
        wanted[section, "upper_arm_length"] = show(upper, names[2])
        wanted[section, "lower_arm_length"] = show(lower, names[3])
        stop = source.round_number(z / MM, names[0], MM / upper, DECIMALS)
        wanted[section, "position_endstop"] = stop
    return wanted


def get_step_distance(cfg: KlipperConfig, section: str, is_rotary: bool = False) -> float:
    """Return the path of one motor step [mm], the angle [rad] of a rotary delta; the gear ratio
    `57:11, 2:1` is 57 / 11 * 2.
    """
    has_rotation = is_rotary or cfg.has(section, "rotation_distance")
    if not has_rotation and cfg.has(section, "step_distance"):
        return cfg.positive(section, "step_distance")
    rotation = math.tau if is_rotary else cfg.positive(section, "rotation_distance")
    steps = cfg.positive(section, "microsteps")
    steps *= cfg.positive(section, "full_steps_per_rotation", 200.0)
    if not is_rotary and not cfg.has(section, "gear_ratio"):
        return rotation / steps
    text, ratio = cfg.text(section, "gear_ratio"), 1.0
    for pair in text.split(","):
        teeth = [parse_finite(part.strip()) or 0.0 for part in pair.split(":")]
        ratio *= teeth[0] / teeth[1] if len(teeth) == 2 and teeth[1] else 0.0
    if not ratio > 0:
        sentence = f"gear_ratio is {text!r}. Write it as 80:16, or 57:11, 2:1 for several gears"
        raise cfg.error(sentence, section, "gear_ratio")
    return rotation / (steps * ratio)


def _list_records(cfg: KlipperConfig, name: str, suffixes: Sequence[str]) -> list[str]:
    """Return the names of the records `height0`, `height1`, ... of which any part exists.

    Klipper reads up to the first number that is missing, and ignores all records behind it, and
    numbers with zeros in front.

    FileError : a record lacks one of its parts (suffixes of its name), or a number is left out.
    """
    pattern = re.compile(rf"{name}(0|[1-9]\d{{0,8}})({'|'.join(suffixes)})")
    records: dict[int, list[str]] = {}
    for section, option in cfg.values:
        if section == PROBED and (match := pattern.fullmatch(option)):
            records.setdefault(int(match[1]), []).append(option)
    for place, number in enumerate(sorted(records)):
        present = records[number]
        lacking = [part for part in suffixes if f"{name}{number}{part}" not in present]
        code = "files.probe-part-missing" if lacking else "files.probe-left-out"
        if lacking or number != place:
            missing = f"{name}{number}{lacking[0]}" if lacking else f"{name}{place}"
            finding = report_finding(code, present=present[0], missing=missing, section=PROBED)
            raise cfg.error(finding, PROBED, present[0])
    return [f"{name}{number}" for number in range(len(records))]


def _parse_steps(cfg: KlipperConfig, option: str) -> tuple[float, ...]:
    """Return the steps of the towers, separated by commas."""
    steps = cfg.numbers(PROBED, option, ",")
    if len(steps) != len(STEPPERS):
        sentence = f"{option!r} of [{PROBED}] has {len(steps)} numbers, but must have three"
        raise cfg.error(f"{sentence}, the steps of the towers. Correct it", PROBED, option)
    return steps


def write(source: ExportSource, into: Path | None) -> Exported:
    """Return the corrected numbers in an existing printer.cfg, or a saved block to paste.

    Options change where they are: one of the main part would hide one of a pasted block.
    """
    own = {part.format(k) for k in "abc" for part in ROTARY_PARTS} | {"shoulder_radius"}
    is_rotary = own <= set(source.robot.parameters.names)
    if is_rotary:
        wanted = _list_rotary(source)
    else:
        geometry = delta_gcode.get_geometry(source, "klipper", DECIMALS)
        wanted = {("printer", "delta_radius"): geometry.radius}
        for k, section in enumerate(STEPPERS):
            wanted[section, "angle"] = geometry.angles[k]
            wanted[section, "arm_length"] = geometry.arms[k]
            wanted[section, "position_endstop"] = geometry.stops[k]
    angles = ROTARY_ANGLES if is_rotary else delta_gcode.NOMINAL_ANGLES
    defaults = {(s, "angle"): angle for s, angle in zip(STEPPERS, angles, strict=True)}
    for section, option in wanted:  # left out, it is that of tower a
        if section in STEPPERS[1:] and option != "angle":
            defaults[section, option] = float(wanted[STEPPERS[0], option])
    if into is not None:
        kinematics = ("rotary_delta",) if is_rotary else ("delta",)
        return read_config(into, kinematics).export(into, wanted, defaults)
    if source.is_for_people:
        lines: list[str] = []
        for (section, option), text in shorten_numbers(wanted, DECIMALS).items():
            header = f"[{section}]"
            lines += [header] if header not in lines else []
            lines.append(f"{option}: {text}")
        return Exported("\n".join(lines) + "\n", (report_finding("files.options-to-change"),))
    new = KlipperConfig.parse((), Path("printer.cfg"))
    return new.export(None, wanted, defaults, (report_finding("files.saved-block"),))


FORMAT = Format(
    "klipper",
    "printer.cfg of a Klipper delta printer",
    (".cfg",),
    read,
    write,
    read_options={"sigma_height": "", "sigma_distance": "", "sigma_tape": "arms"},
    stores_fit=True,
)
