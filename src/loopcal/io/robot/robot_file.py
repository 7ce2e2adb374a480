# SPDX-License-Identifier: Apache-2.0
"""Robot files: the nominal robot and, after a calibration, one `identified:` table.

    format: 1
    units: {length: mm, angle: deg}
    family: gough                    the other keys are the fields of the family's record
    ...
    identified:                      delete this table to restore the nominal robot
      - {name: leg1.base.x, value: 120.0213, +/-: 0.0004, unit: mm}

A loaded robot keeps the text of its file, so that writing it back changes only the table.
"""

from __future__ import annotations

import dataclasses
import inspect
import json
import math
import re
import textwrap
import types
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin

import numpy as np

from loopcal.errors import DataError, FileError, MechanismError, UnitError, suggest_names
from loopcal.io.core.records import Units, get_field_types, read_record, read_units
from loopcal.io.core.text_file import as_path, name_files, write_text
from loopcal.io.core.yaml_file import (
    Location,
    YamlFile,
    add_key,
    quote_scalar,
    read_yaml,
    refuse_unknown_keys,
    remove_key,
)
from loopcal.io.data.columns import find_column_fault
from loopcal.mechanism.compilation import build, find_impossible_values
from loopcal.mechanism.families import FAMILIES
from loopcal.mechanism.families.placement import RecordError
from loopcal.mechanism.families.records import RobotRecord
from loopcal.mechanism.model import Mechanism
from loopcal.typing import FloatArray
from loopcal.units import Dimension, find_unit, format_scaled, to_si

# The `identified:` table of a corrected robot file: values of parameters.

TABLE = "identified"
PLUS_MINUS = "+/-"
KEYS = ("name", "value", PLUS_MINUS, "unit")
NOT_CALIBRATED = "# NOT CALIBRATED"  # beginning of a robot file that a failed calibration made
EXAMPLE = "'{name: .., value: .., unit: ..}'"
# Ending of the configuration of a printer -> its firmware; the formats build on this module.
PROGRAMS = {".cfg": "Klipper", ".g": "RepRapFirmware", ".gcode": "Marlin"}


def add_table(file: YamlFile, robot: Mechanism, plus_minus: FloatArray | None = None) -> YamlFile:
    """Return a robot file without a table with one of its free parameters, and of others that
    differ from their nominal value; unchanged where all are nominal and none has an uncertainty.

    `plus_minus` : (p,) uncertainty of each value [SI]; what is not finite is written as null.
    """
    if plus_minus is None and (robot.values == robot.parameters.nominal).all():
        return file
    text, content = f"{TABLE}:  # delete this table to restore the nominal robot\n", []
    for i, parameter in enumerate(robot.parameters.entries):
        if not parameter.free and robot.values[i] == parameter.nominal:
            continue
        unit = find_unit(robot.units[parameter.dimension])
        value = format_scaled(float(robot.values[i]), unit.factor_to_si)
        half = math.nan if plus_minus is None else float(plus_minus[i]) / unit.factor_to_si
        shown = f"{half:.2g}" if math.isfinite(half) else "null"
        # JSON reads these numbers, and `null`, as YAML does
        cells = (parameter.name, json.loads(value), json.loads(shown), unit.symbol)
        content.append(dict(zip(KEYS, cells, strict=True)))
        name, symbol = quote_scalar(parameter.name), quote_scalar(unit.symbol)
        text += f"  - {{name: {name}, value: {value}, {PLUS_MINUS}: {shown}, unit: {symbol}}}\n"
    return add_key(file, text, {TABLE: content}) if content else file


def remove_mark(text: str) -> str:
    """Return the text of a robot file without the lines that say that its calibration failed."""
    while text.startswith(NOT_CALIBRATED):
        text = text.partition("\n")[2]
    return text


def read_identified_values(file: YamlFile, robot: Mechanism) -> FloatArray:
    """Return the robot's values (p,) [SI], with those of the file's table in place.

    FileError : a bad row, an unknown or duplicate parameter, no number, or a wrong unit.
    """
    values = robot.values.copy()
    for name, value in read_rows(file, robot).items():
        values[robot.parameters.index(name)] = value
    return values


def read_rows(file: YamlFile, robot: Mechanism) -> dict[str, float]:
    """Return the values [SI] of the file's table by name; raise as `read_identified_values`."""
    rows = file.content[TABLE]
    if not isinstance(rows, list):
        raise file.error(f"{TABLE!r} must be a list of {EXAMPLE}", (TABLE,))
    values: dict[str, float] = {}
    for i, row in enumerate(rows):
        place: Location = (TABLE, i)
        if not isinstance(row, dict):
            raise file.error(f"this row is not a mapping. Write {EXAMPLE}", place)
        refuse_unknown_keys(file, list(row), KEYS, place)
        for key in (k for k in KEYS if k != PLUS_MINUS and k not in row):
            raise file.error(f"this row has no {key!r}. Write {EXAMPLE}", place)
        name, value, symbol = row["name"], row["value"], row["unit"]
        if name not in robot.parameters.names:
            hint = suggest_names(str(name), robot.parameters.names)
            sentence = f"{name!r} is not a parameter of this robot{hint}. Correct the name"
            raise file.error(sentence, place)
        if name in values:
            raise file.error(f"duplicate parameter {name!r}. Remove one", place)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise file.error(f"the value of {name!r} is {value!r}. Write a number", place)
        dimension = robot.parameters.dimensions[robot.parameters.index(name)]
        try:
            values[name] = to_si(value, find_unit(str(symbol), dimension))
        except UnitError as error:
            raise file.error(f"{name!r}: {error}", place) from None
    return values


FORMAT = 1
HEADER = ("format", "units", "family", TABLE)
KEY = "stages"  # the key of the list of stages, and the name of the family of chains
WHAT = "robot file"
SHIPPED_ROBOTS = Path(__file__).parents[2] / "robots"


class RobotSource(NamedTuple):
    """The origin of a loaded robot, kept as its `record`.

    file : the robot file. record : the family's record, in SI.
    """

    file: YamlFile
    record: Any

    @property
    def path(self) -> Path:
        """The file."""
        return self.file.path

    @property
    def nominal_file(self) -> YamlFile:
        """The file without the `identified:` table."""
        return remove_key(self.file, TABLE)

    @property
    def text(self) -> str:
        """Text of the nominal file."""
        return self.nominal_file.text


def load_robot(source: str | Path) -> Mechanism:
    """Read a robot file and build the robot, with the identified values that the file has.

    Parameters
    ----------
    source : a file, or the name of a robot that comes with loopcal, such as "hexapod-42".

    Raises
    ------
    FileError : unreadable, or a key is missing, unknown or of the wrong type; with its line.
    MechanismError : the described robot cannot be built; with its file.
    """
    return build_robot(read_yaml(find_robot_file(source), WHAT))


def build_robot(file: YamlFile) -> Mechanism:
    """Build the robot that a robot file describes; raise as `load_robot`."""
    check_format(file, FORMAT)
    units = read_units(file)
    name = _read_family(file, sorted(FAMILIES))
    content = {key: value for key, value in file.content.items() if key not in HEADER}
    with name_files(file.path):
        record = read_record(file, content, FAMILIES[name], units)
        if name == KEY:
            record = place_stages(file, record, units)
        symbols = {dimension: unit.symbol for dimension, unit in units.items()}
        origin = RobotSource(file, record)
        try:
            assembly = record.assembly()
        except RecordError as error:
            raise file.error(str(error), _find_drives(file, error.location)) from None
        robot = build(assembly, symbols, origin)
        commanded = [actuator for actuator in robot.actuators if actuator.reference is None]
        for actuator in commanded:  # measurement files have them as columns
            if fault := find_column_fault(actuator.name, "actuator"):
                raise file.error(fault, _find_drives(file, ("drives", actuator.name)))
        for i, limb in enumerate(robot.assembly.limbs):
            for joint in limb.joints:
                if fault := find_column_fault(f"{limb.name}.{joint.name}", "joint"):
                    raise file.error(fault, ("limbs", i))
    if TABLE not in file.content:
        return robot
    values = read_identified_values(file, robot)
    # a file of a calibration that failed keeps values that no machine has, to be looked at
    is_calibrated = not file.text.startswith(NOT_CALIBRATED)
    for name, finding in find_impossible_values(robot, values) if is_calibrated else ():
        rows = [row.get("name") for row in file.content[TABLE]]
        place: Location = (TABLE, rows.index(name)) if name in rows else (TABLE,)
        advice = "Correct the value, or delete this table to restore the nominal robot"
        raise file.error(f"{finding}. {advice}", place)
    return robot.with_values(values)


def save_robot(robot: Mechanism, path: str | Path, plus_minus: FloatArray | None = None) -> None:
    """Write a robot file: the nominal file, comments kept, and the `identified:` table.

    Parameters
    ----------
    robot : from `load_robot`, with any values. path : written whole or not at all.
    plus_minus : (p,) uncertainty of each value [SI]; what is not finite is written as null.

    Raises
    ------
    FileError : the file cannot be written. MechanismError : the robot was not loaded from a file.
    DataError : there is not one uncertainty for each parameter.
    """
    path, count = as_path(path, WHAT), len(robot.parameters.names)
    if plus_minus is not None and np.shape(plus_minus) != (count,):
        raise DataError(
            f"plus_minus has shape {np.shape(plus_minus)}. Give one uncertainty for each of the "
            f"{count} parameters, such as fit.plus_minus"
        )
    write_text(path, format_robot(robot, plus_minus))


def format_robot(robot: Mechanism, plus_minus: FloatArray | None = None) -> str:
    """Return the text that `save_robot` writes.

    That the calibration of the file failed is not said of other values.
    """
    source = get_source(robot)
    text = add_table(source.nominal_file, robot, plus_minus).text
    stored = robot.parameters.nominal
    if TABLE in source.file.content:
        stored = read_identified_values(source.file, robot.nominal)
    return text if np.array_equal(robot.values, stored) else remove_mark(text)


def get_source(robot: Mechanism) -> RobotSource:
    """Return the origin of a robot; raise MechanismError where it was not loaded from a file."""
    if not isinstance(robot.record, RobotSource):
        sentence = f"{robot.name} does not come from a robot file, so its text is missing"
        raise MechanismError(f"{sentence}. Use load_robot")
    return robot.record


def find_robot_file(source: str | Path) -> Path:
    """Return the file of a robot that is given as a file or by the name of a shipped robot.

    FileError : neither of them.
    """
    path, shipped = as_path(source, WHAT), list_shipped_robots()
    # a folder is no robot file: `loopcal example hexapod-42` makes one with the name of a robot
    if str(source) in shipped and not path.is_file():
        return shipped[str(source)]
    if path.exists():
        program = PROGRAMS.get(path.suffix.lower())
        if program is not None and path.is_file():
            raise FileError.of("files.robot-of-program", path, program=program)
        return path
    hint, names = suggest_names(str(source), shipped), ", ".join(shipped) or "none"
    act = f"name a file, or one of the shipped robots: {names}"
    raise FileError(f"this robot file does not exist{hint}; {act}", path)


def list_shipped_robots() -> dict[str, Path]:
    """Return name -> file of the robots that come with loopcal."""
    return {path.stem: path for path in sorted(SHIPPED_ROBOTS.glob("*.yaml"))}


def check_format(file: YamlFile, newest: int) -> None:
    """Raise FileError for a file without `format:`, or with a newer format than `newest`."""
    stated, place = file.content.get("format"), ("format",)
    if "format" not in file.content:
        raise file.error(f"this file has no format. Begin it with 'format: {newest}'")
    if not isinstance(stated, int) or isinstance(stated, bool) or stated < 1:
        raise file.error(f"'format' is {stated!r}. Write 'format: {newest}'", place)
    if stated > newest:
        sentence = f"this file has format {stated}, but this loopcal reads formats up to {newest}"
        raise file.error(f"{sentence}. Use a newer loopcal", place)


def _read_family(file: YamlFile, known: Sequence[str]) -> str:
    """Return the family that a robot file names."""
    family = file.content.get("family")
    if "family" not in file.content:
        if KEY in file.content:
            return KEY
        for key in file.content:
            if suggestion := suggest_names(key, ["family"]):
                raise file.error(f"unknown key {key!r}{suggestion}. Correct it", (key,))
        sentence = "this file names no family. Write 'family:' and one of"
        raise file.error(f"{sentence} {', '.join(known)}")
    if family not in known:
        sentence = f"{family!r} is not a family of robots{suggest_names(str(family), known)}"
        raise file.error(f"{sentence}. Allowed: {', '.join(known)}", ("family",))
    return str(family)


def _find_drives(file: YamlFile, location: Location) -> Location:
    """Return a location in a file that may state its drives as `actuators`."""
    is_other = location[:1] == ("drives",) and "drives" not in file.content
    return ("actuators", *location[1:]) if is_other else location


# Keys of a stage that are not those of its family; both have a name.
OWN_KEYS = ("on", "mount", "joint", "family")


def place_stages(file: YamlFile, chain: RobotRecord, units: Units) -> RobotRecord:
    """Return a chain with the records of its stages: each is a serial joint (None), or a robot of
    another family. FileError : it is neither, or a key of it does not fit; at its line.
    """
    from loopcal.mechanism.families.stages import PlacedStages, StageRecord, Stages

    assert isinstance(chain, Stages)
    families = {name: record for name, record in FAMILIES.items() if record is not Stages}
    robots: list[RobotRecord | None] = []
    for i, stage in enumerate(chain.stages):
        content: dict[str, Any] = file.content[KEY][i]
        if (stage.joint is None) == (stage.family is None):
            states = "neither 'joint' nor" if stage.joint is None else "both 'joint' and"
            sentence = f"stage {stage.name!r} states {states} 'family'. Write 'joint:' for a serial"
            act = "joint, or 'family:' with the keys of that family"
            raise file.error(f"{sentence} {act}", (KEY, i))
        if stage.family is None:
            refuse_unknown_keys(file, list(content), list(get_field_types(StageRecord)), (KEY, i))
            robots.append(None)
            continue
        if stage.family not in families:
            hint = suggest_names(stage.family, list(families))
            sentence = f"{stage.family!r} is not a family of a stage{hint}"
            allowed = ", ".join(sorted(families))
            raise file.error(f"{sentence}. Allowed: {allowed}", (KEY, i, "family"))
        rest = {key: value for key, value in content.items() if key not in OWN_KEYS}
        robots.append(read_record(file, rest, families[stage.family], units, (KEY, i)))
    own = {field.name: getattr(chain, field.name) for field in fields(chain)}
    return PlacedStages(**own, robots=tuple(robots))


# Stored values of parameters to compare a fit with: published ones, or those of a firmware.


def load_stored_values(path: str | Path, robot: Mechanism) -> dict[str, float] | Mechanism:
    """Return the stored values of a robot's parameters by name [SI], or a robot that has them.

    Parameters
    ----------
    path : a robot file, or a file with the table `identified`. robot : that is calibrated.

    Raises
    ------
    FileError : unreadable, neither of the two, or a bad row; with its line.
    """
    file = read_yaml(find_robot_file(path), "file of stored values")
    if "family" in file.content:
        return build_robot(file)
    if TABLE not in file.content:
        raise file.error(
            f"neither a robot file nor a list of values. Write a list {TABLE!r} of {EXAMPLE}"
        )
    refuse_unknown_keys(file, list(file.content), (TABLE,))
    return read_rows(file, robot)


# Reference of file keys, taken from the records that read them: types, defaults, docstrings.

# Where the entries of a docstring begin, with or without a heading, and sections behind them.
ENTRIES = re.compile(
    r"^(?:Attributes|Parameters)\n-{3,}\n|(?:\A|\n\n)(?=(?:\w+, )*\w+ :\s)", re.MULTILINE
)
BEHIND = re.compile(r"^(?:Examples|Notes|Raises|Returns)\n-{3,}\n", re.MULTILINE)
SHORT = re.compile(r"(?:^ *|(?<=[.;] ))((?:\w+, )*\w+) :\s", re.MULTILINE)
SI = re.compile(r" \[(?:m|rad|m per turn|m, rad|m or rad)\]")
ELSEWHERE = re.compile(r"(?:Others: )?[Ss]ee (?:`\w+`|the module)(?:, |; |\. ?|$)")


@dataclass(frozen=True)
class Key:
    """A key of a file.

    name : as written. holds : its type, such as `length`, `[x, y]`, or the name of a record.
    default : value without the key, "needed" where the key is mandatory, "" where it is empty.
    meaning : phrase of the docstring, possibly empty.
    """

    name: str
    holds: str
    default: str
    meaning: str


def list_keys(record: type) -> tuple[Key, ...]:
    """Return the keys that a record takes, its own before inherited ones."""
    meanings, hints = collect_meanings(record), get_field_types(record)
    own = {f.name.removesuffix("_"): f for f in fields(record) if f.init}
    bases = [base for base in record.__mro__[1:] if dataclasses.is_dataclass(base)]
    inherited = {name for base in bases for name in get_field_types(base)}
    return tuple(
        Key(n, describe_type(hints[n]), _describe_default(own[n]), meanings.get(n, ""))
        for n in sorted(own, key=lambda name: name in inherited)
    )


def split_docstring(record: type) -> tuple[str, str]:
    """Return the text of a docstring above its entries `name : phrase`, and the entries."""
    above, *entries = ENTRIES.split(BEHIND.split(inspect.cleandoc(record.__doc__ or ""))[0], 1)
    return above, "".join(entries)


def collect_meanings(record: type) -> dict[str, str]:
    """Return name -> phrase from the docstrings of a record and of its bases, from entries `name :
    phrase`, of which several may share a line. Phrases that only point elsewhere are left out.
    """
    meanings: dict[str, str] = {}
    for base in reversed(record.__mro__):
        _, *names_and_phrases = SHORT.split(split_docstring(base)[1])
        for names, written in zip(names_and_phrases[::2], names_and_phrases[1::2], strict=True):
            phrase = ELSEWHERE.sub("", SI.sub("", " ".join(written.split()))).rstrip(". ")
            named = (name.removesuffix("_") for name in names.split(", "))
            meanings |= dict.fromkeys(named, phrase) if phrase else {}
    return meanings


def name_record(record: type) -> str:
    """Return the name of a record in the file reference: `Pose` for `PoseRecord`."""
    return record.__name__.removesuffix("Record")


def describe_type(annotation: Any) -> str:
    """Return what an annotation allows, in terms of a file."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        if isinstance(arguments[1], Dimension):
            names = {Dimension.LENGTH: "length", Dimension.ANGLE: "angle"}
            return names.get(arguments[1], "number")
        words = [(mark,) if isinstance(mark, str) else mark for mark in arguments[1:]]
        return " or ".join(f"`{name}`" for names in words for name in names)  # of registries
    if origin in (Union, types.UnionType):
        branches = (describe_type(a) for a in arguments if a is not type(None))
        return " or ".join(dict.fromkeys(branches))
    if origin is Literal:
        return " or ".join(f"`{value}`" for value in arguments)
    if origin in (tuple, list):
        if arguments[-1:] == (Ellipsis,) or origin is list:
            return f"list of {describe_type(arguments[0])}"
        return f"[{', '.join(describe_type(a) for a in arguments)}]"
    if origin is not None and issubclass(origin, Mapping):
        return f"name: {describe_type(arguments[1])}"
    if isinstance(annotation, type) and dataclasses.is_dataclass(annotation):
        return name_record(annotation)
    names = {str: "text", float: "number", int: "whole number", bool: "true or false"}
    return "anything" if annotation is Any else names.get(annotation, str(annotation))


def _describe_default(field: dataclasses.Field[Any]) -> str:
    """Return a default as a file would state it."""
    if field.default is MISSING and field.default_factory is MISSING:
        return "needed"
    if field.default_factory is not MISSING or field.default in (None, (), ""):
        return ""
    if isinstance(field.default, tuple):
        return f"[{', '.join(f'{v:g}' if isinstance(v, float) else str(v) for v in field.default)}]"
    return f"{field.default:g}" if isinstance(field.default, float) else str(field.default)


# Robot files made from others: a new robot of a family, and a robot with more parameters
# fixed.

# The shipped robot of a family that does not have the name of the family.
EXAMPLES = {"gough": "hexapod-42", "limbs": "five-bar", "stages": "arm-6r"}
WIDTH = 120
# The file beside a new robot file from which editors know its keys.
EDITOR_SCHEMA = "robot.schema.json"


def format_new_robot(family: str, name: str) -> str:
    """Return the text of a robot file of a valid robot, in which the user replaces the numbers.

    family : a family, or the name of a shipped robot to start from. name : of the new robot.

    MechanismError : neither a family nor a shipped robot.
    """
    shipped = list_shipped_robots()
    example = EXAMPLES.get(family, family)
    if example not in shipped:
        known = list(dict.fromkeys([*FAMILIES, *shipped]))
        sentence = f"{family!r} is neither a family nor a shipped robot"
        hint = suggest_names(family, known)
        raise MechanismError(f"{sentence}{hint}. Allowed: {', '.join(known)}")
    text = shipped[example].read_text("utf-8")
    record = str(read_yaml(shipped[example], "robot file").content["family"])
    for key, value in (("name", quote_scalar(name)), ("source", "where these numbers come from")):
        line = f"{key}: {value}"
        text = re.sub(rf"^{key}: .*$", lambda _, line=line: line, text, count=1, flags=re.MULTILINE)
    lines = [
        f"# yaml-language-server: $schema={EDITOR_SCHEMA}",
        f"# A new robot of the family {record}, with the numbers of the shipped robot {example}.",
        "# Replace them by your own.",
        "#",
        f"# Keys of this family (docs/files.md, the interpretation: `loopcal check {name}.yaml`):",
    ]
    for key in list_keys(FAMILIES[record]):
        default = f", default {key.default}" if key.default not in ("", "needed") else ""
        meaning = f"; {key.meaning}" if key.meaning else ""
        entry = f"{key.name}: {key.holds}{default}{meaning}"
        lines += textwrap.wrap(entry, WIDTH, initial_indent="#   ", subsequent_indent="#     ")
    body = text.split("\n")
    first = next(i for i, line in enumerate(body) if not line.startswith("#"))
    return "\n".join([*lines, "", *body[first:]])


def format_reduced_robot(robot: Mechanism, dropped: Mapping[str, str]) -> str:
    """Return the text of a robot's file with further parameters fixed.

    robot : from `load_robot`, with any values.
    dropped : parameter to fix -> comment that is written after it.

    MechanismError : the robot was not loaded from a file.
    """
    source = get_source(robot)
    entries = dict.fromkeys(source.record.fixed, "") | dict(dropped)
    if not entries:
        return format_robot(robot)
    names = {name: quote_scalar(name) for name in entries}
    width = max(len(text) for text in names.values())
    lines = [
        f"  - {names[name]:<{width}}  # {comment}" if comment else f"  - {names[name]}"
        for name, comment in entries.items()
    ]
    file = add_key(remove_key(source.nominal_file, "fixed"), "\n".join(["fixed:", *lines]) + "\n")
    return add_table(file, robot).text
