# SPDX-License-Identifier: Apache-2.0
"""Robot files: the nominal robot, and behind it, after a calibration, one `identified:` table.

    format: 1
    units: {length: mm, angle: deg}
    family: gough                    the other keys are the fields of the family's record
    ...
    identified:                      delete this table and the nominal robot is back
      - {name: leg1.base.x, value: 120.0213, +/-: 0.0004, unit: mm}

A robot that was read keeps the text of its file, so that writing it back changes nothing but the
table.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

from loopcal.errors import FileError, LoopcalError, MechanismError, suggest_names
from loopcal.io.core.records import read_record, read_units
from loopcal.io.core.text_file import write_text
from loopcal.io.core.yaml_file import YamlFile, read_yaml
from loopcal.io.robot.identified_table import TABLE, nominal_text, table_text, table_values

if TYPE_CHECKING:
    import numpy as np

    from loopcal.mechanism import Assembly, Mechanism, RobotRecord

FORMAT = 1
HEADER = ("format", "units", "family", TABLE)
WHAT = "robot file"


@dataclass(frozen=True)
class RobotSource:
    """What a robot was read from; a loaded Mechanism holds it as its `record`.

    Parameters
    ----------
    path : Path
        The file.
    text : str
        The nominal file: its text without the `identified:` table.
    record : object
        The family's record, in SI.
    """

    path: Path
    text: str
    record: Any


def load_robot(source: str | Path) -> Mechanism:
    """Read a robot file and build the robot, with its identified values where the file has them.

    Parameters
    ----------
    source : str or Path
        A file, or the name of a robot that comes with loopcal, such as "hexapod-42".

    Raises
    ------
    FileError
        The file cannot be read, or something in it is missing, unknown or of the wrong kind; with
        its line.
    MechanismError
        The robot that it describes cannot be built; with its file.
    """
    from loopcal.mechanism import FAMILIES, build

    file = read_yaml(find_robot_file(source), WHAT)
    check_format(file, FORMAT)
    units = read_units(file)
    family = _family(file, sorted(FAMILIES))
    content = {key: value for key, value in file.content.items() if key not in HEADER}
    with _naming(file):
        record = read_record(file, content, FAMILIES[family], units)
        symbols = {dimension: found.symbol for dimension, found in units.items()}
        robot = build(
            _assembly(record, file), symbols, RobotSource(file.path, nominal_text(file), record)
        )
    return robot.with_values(table_values(file, robot)) if TABLE in file.content else robot


def save_robot(robot: Mechanism, path: str | Path, plus_minus: np.ndarray | None = None) -> None:
    """Write a robot file: the nominal file, comments kept, and the `identified:` table.

    Parameters
    ----------
    robot : Mechanism
        A robot that came from `load_robot`, with any values.
    path : str or Path
        The file to write; written whole or not at all.
    plus_minus : ndarray, optional
        (p,) uncertainty of each value [SI]; what is not finite is written as null.

    Raises
    ------
    FileError
        The file cannot be written.
    MechanismError
        The robot did not come from a file.
    """
    write_text(path, format_robot(robot, plus_minus))


def format_robot(robot: Mechanism, plus_minus: np.ndarray | None = None) -> str:
    """Return the text that `save_robot` writes.

    Raises
    ------
    MechanismError
        The robot did not come from a file.
    """
    source = robot.record
    if not isinstance(source, RobotSource):
        raise MechanismError(
            f"{robot.name} was not read from a robot file, so there is none to correct; use "
            "load_robot"
        )
    return source.text + table_text(robot, plus_minus)


def find_robot_file(source: str | Path) -> Path:
    """Return the file of a robot that is given as a file or by the name of a shipped one.

    Raises
    ------
    FileError
        Neither a file nor a shipped robot.
    """
    path = Path(source)
    if path.exists():
        return path
    shipped = list_shipped_robots()
    if str(source) in shipped:
        return shipped[str(source)]
    hint = suggest_names(str(source), shipped)
    names = ", ".join(shipped) or "none"
    raise FileError(
        f"there is no such robot file{hint}; name a file, or one of the shipped robots: {names}",
        path,
    )


def list_shipped_robots() -> dict[str, Path]:
    """Return name -> file of the robots that come with loopcal."""
    folder = Path(str(resources.files("loopcal"))) / "robots"
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def check_format(file: YamlFile, newest: int) -> None:
    """Refuse a file without `format:`, or with one newer than this version of loopcal reads.

    Raises
    ------
    FileError
        Missing, not a whole number, or too new.
    """
    found = file.content.get("format")
    if "format" not in file.content:
        raise file.error(f"this file states no format; begin it with 'format: {newest}'")
    if not isinstance(found, int) or isinstance(found, bool) or found < 1:
        raise file.error(
            f"'format' is {found!r} where a whole number is needed; write 'format: {newest}'",
            ("format",),
        )
    if found > newest:
        raise file.error(
            f"this file has format {found}, but this loopcal reads formats up to {newest}; use a "
            "newer loopcal",
            ("format",),
        )


def _family(file: YamlFile, known: Sequence[str]) -> str:
    """Return the family that a robot file names."""
    found = file.content.get("family")
    if "family" not in file.content:
        raise file.error(
            f"this file names no family; write 'family:' and one of {', '.join(known)}"
        )
    if found not in known:
        hint = suggest_names(str(found), known)
        raise file.error(
            f"{found!r} is not a family of robots{hint}; known are {', '.join(known)}", ("family",)
        )
    return str(found)


def _assembly(record: RobotRecord, file: YamlFile) -> Assembly:
    """Return what a record expands to; a name under `fixed` that calls no parameter is refused at
    its line.
    """
    from loopcal.mechanism import match_parameter_names

    names = [parameter.name for parameter in record.expand().parameters] if record.fixed else []
    for i, pattern in enumerate(record.fixed):
        try:
            match_parameter_names(pattern, names)
        except MechanismError as error:
            raise file.error(str(error), ("fixed", i)) from None
    return record.assembly()


@contextmanager
def _naming(file: YamlFile) -> Iterator[None]:
    """Put the name of the file before the text of an error that does not name it."""
    try:
        yield
    except FileError:
        raise
    except LoopcalError as error:
        raise type(error)(f"{file.path}: {error}") from error
