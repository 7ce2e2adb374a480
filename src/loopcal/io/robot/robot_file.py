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

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from loopcal.errors import DataError, FileError, MechanismError, suggest_names
from loopcal.findings import report_finding
from loopcal.io.core.records import read_record, read_units
from loopcal.io.core.text_file import as_path, name_files, write_text
from loopcal.io.core.yaml_file import YamlFile, read_yaml
from loopcal.io.core.yaml_text import remove_key
from loopcal.io.data.column_names import find_column_fault
from loopcal.io.robot.identified_table import (
    TABLE,
    add_table,
    read_identified_values,
    read_possible_values,
    remove_mark,
)
from loopcal.mechanism import (
    FAMILIES,
    Assembly,
    Mechanism,
    RobotRecord,
    build,
    match_parameter_names,
    stages,
)
from loopcal.mechanism.families.summed_records import SumError
from loopcal.typing import FloatArray

FORMAT = 1
HEADER = ("format", "units", "family", TABLE)
KEY = "stages"
"""The key of the list of stages, and the name of the family of chains."""
WHAT = "robot file"
SHIPPED_ROBOTS = Path(__file__).parents[2] / "robots"

PROGRAMS = {".cfg": "Klipper", ".g": "RepRapFirmware", ".gcode": "Marlin"}
"""Ending of a printer's configuration -> its firmware."""


class RobotSource(NamedTuple):
    """The origin of a loaded robot, kept as its `record`.

    Parameters
    ----------
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
            from loopcal.io.robot.stage_records import place_stages

            record = place_stages(file, record, units)
        symbols = {dimension: unit.symbol for dimension, unit in units.items()}
        origin = RobotSource(file, record)
        robot = build(_assemble(record, file), symbols, origin)
        _refuse_column_names(robot, file)
    if TABLE not in file.content:
        return robot
    return robot.with_values(read_possible_values(file, robot))


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
    count = len(robot.parameters.names)
    if plus_minus is not None and np.shape(plus_minus) != (count,):
        raise DataError(
            f"plus_minus has shape {np.shape(plus_minus)}; give one uncertainty for each of the "
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
        sentence = f"{robot.name} was not loaded from a robot file and has no text to write"
        raise MechanismError(f"{sentence}; use load_robot")
    return robot.record


def find_robot_file(source: str | Path) -> Path:
    """Return the file of a robot that is given as a file or by the name of a shipped robot.

    Raises
    ------
    FileError : neither of them.
    """
    path, shipped = as_path(source, WHAT), list_shipped_robots()
    # a folder is no robot file: `loopcal example hexapod-42` makes one with the name of a robot
    if str(source) in shipped and not path.is_file():
        return shipped[str(source)]
    if path.exists():
        _refuse_file_of_program(path)
        return path
    hint, names = suggest_names(str(source), shipped), ", ".join(shipped) or "none"
    act = f"name a file, or one of the shipped robots: {names}"
    raise FileError(f"this robot file does not exist{hint}; {act}", path)


def _refuse_file_of_program(path: Path) -> None:
    """Raise FileError for the configuration of a printer, which must be imported first."""
    if path.suffix.lower() not in PROGRAMS or not path.is_file():
        return
    program = PROGRAMS[path.suffix.lower()]
    finding = report_finding("files.robot-of-program", program=program)
    raise FileError(finding, path)


def list_shipped_robots() -> dict[str, Path]:
    """Return name -> file of the robots that come with loopcal."""
    return {path.stem: path for path in sorted(SHIPPED_ROBOTS.glob("*.yaml"))}


def check_format(file: YamlFile, newest: int) -> None:
    """Raise FileError for a file without `format:`, or with a newer format than `newest`."""
    stated, place = file.content.get("format"), ("format",)
    if "format" not in file.content:
        raise file.error(f"this file states no format; begin it with 'format: {newest}'")
    if not isinstance(stated, int) or isinstance(stated, bool) or stated < 1:
        raise file.error(f"'format' is {stated!r}; write 'format: {newest}'", place)
    if stated > newest:
        sentence = f"this file has format {stated}, but this loopcal reads formats up to {newest}"
        raise file.error(f"{sentence}; use a newer loopcal", place)


def _read_family(file: YamlFile, known: Sequence[str]) -> str:
    """Return the family that a robot file names."""
    family = file.content.get("family")
    if "family" not in file.content and KEY in file.content:
        return KEY
    if "family" not in file.content:
        for key in file.content:
            if suggestion := suggest_names(key, ["family"]):
                raise file.error(f"unknown key {key!r}{suggestion}; correct it", (key,))
        raise file.error(
            f"this file names no family; write 'family:' and one of {', '.join(known)}"
        )
    if family not in known:
        sentence = f"{family!r} is not a family of robots{suggest_names(str(family), known)}"
        raise file.error(f"{sentence}; allowed: {', '.join(known)}", ("family",))
    return str(family)


def _refuse_column_names(robot: Mechanism, file: YamlFile) -> None:
    """Raise FileError for an actuator or joint that measurement files cannot have as a column."""
    for actuator in robot.actuators:
        if fault := find_column_fault(actuator.name, "actuator"):
            raise file.error(fault, ("actuators", actuator.name))
    for i, limb in enumerate(robot.assembly.limbs):
        for joint in limb.joints:
            if fault := find_column_fault(f"{limb.name}.{joint.name}", "joint"):
                raise file.error(fault, ("limbs", i))


def _assemble(record: RobotRecord, file: YamlFile) -> Assembly:
    """Return the assembly of a record; an unknown name in a list of parameters, and a common error
    that cannot be, are refused at their line.
    """
    try:
        expanded = record.expand()
    except stages.StageError as error:
        raise file.error(str(error), (KEY, error.index)) from None
    except SumError as error:
        raise file.error(str(error), ("actuators", error.actuator)) from None
    parameters = expanded.parameters
    names = [parameter.name for parameter in parameters]
    for key in ("fixed", "stored_parameters"):
        for i, pattern in enumerate(getattr(record, key)):
            try:
                match_parameter_names(pattern, names, key)
            except MechanismError as error:
                raise file.error(str(error), (key, i)) from None
    for i, common in enumerate(record.common_errors):
        try:
            common.resolve(parameters)
        except MechanismError as error:
            raise file.error(str(error), ("common_errors", i)) from None
    return record.assembly(expanded)
