# SPDX-License-Identifier: Apache-2.0
"""Which pose each row of measurement files saw, and the readings of every pose.

Rows with one name in the column `pose` saw one pose, in whichever file they stand; its readings
stand in the first of them and are the same, or left out, in the others. `a;b` names the poses that
a row compares, which have rows of their own. A file without readings refers to poses of other files
by name.
"""

from __future__ import annotations

import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from loopcal.errors import DataError, suggest_names
from loopcal.io.core.csv_table import Table, require_columns
from loopcal.io.data.reading_noise import read_reading_sigma, says_noise
from loopcal.io.robot.robot_file import load_robot
from loopcal.units import Dimension

if TYPE_CHECKING:
    import numpy as np

    from loopcal.mechanism import Mechanism

COMMANDED, LINK = "commanded.", ";"
OWN_COLUMNS = ("pose", "use", "block", "kind", "session", "group", "time", "temperature")
"""Names of columns that mean the same in every file."""

ALIKE, LEAST = 1e-12, 1e-12
"""Relative difference [1], and difference [m or rad], up to which readings in different units are
the same.
"""


@dataclass(frozen=True)
class PoseRows:
    """The n poses of some files.

    Parameters
    ----------
    labels : tuple of str
        Names of the poses.
    readings : ndarray
        (n, a) [SI], NaN where not read.
    sigma : ndarray or None
        (n, a) standard deviations of the readings [SI], see `loopcal.measure.Measurements`; None
        where no file says any.
    block : ndarray
        (n,) poses of equal number are never split.
    members : tuple of tuple of tuple of int
        The poses that each row of each file saw.
    """

    labels: tuple[str, ...]
    readings: np.ndarray
    sigma: np.ndarray | None
    block: np.ndarray
    members: tuple[tuple[tuple[int, ...], ...], ...]


@dataclass(frozen=True)
class _File:
    """One file: what its rows call their poses, where each stands first, and the readings of these
    rows.

    `readings` and `sigma` are (rows, a), NaN where a row states none, `None` where the file has no
    such columns; `stated` are the poses whose readings stand in this file, `unread` those of which
    it says that nothing was read.
    """

    table: Table
    names: tuple[str, ...]
    first: dict[str, int]
    readings: np.ndarray | None
    sigma: np.ndarray | None
    stated: frozenset[str]
    unread: frozenset[str]


def read_pose_rows(tables: Sequence[Table], robot: Mechanism) -> PoseRows:
    """Read the columns `pose`, `block`, and those of the readings or of commanded coordinates.

    Raises
    ------
    FileError
        A pose without readings or with two sets of them, a comparison with a pose that is not
        there.
    DataError
        A commanded pose that the controller cannot reach.
    """
    files = [_read(table, robot, several=len(tables) > 1) for table in tables]
    elsewhere = frozenset().union(*(file.stated for file in files))
    origin: dict[str, tuple[int, int]] = {}
    for i, file in enumerate(files):
        for name, row in file.first.items():
            if name in file.stated or (name in file.unread and name not in elsewhere):
                there = origin.setdefault(name, (i, row))
                if there != (i, row):
                    _refuse_other_readings(file, row, files[there[0]], there[1])
            elif name not in elsewhere and file.readings is not None:
                raise file.table.row_error(
                    row,
                    f"pose {name!r} has no readings, here or in another file; write them in one",
                )
    if not origin:
        raise tables[0].row_error(
            0, "no row has readings of a pose; give each compared pose a row of its own"
        )
    place = {name: i for i, name in enumerate(origin)}
    members = tuple(
        tuple(_members(file.table, row, cell, place) for row, cell in enumerate(file.names))
        for file in files
    )
    readings, sigma = _gathered(files, list(origin.values()), robot)
    return PoseRows(tuple(origin), readings, sigma, _blocks(files, tuple(origin)), members)


def measured_name(column: str, robot: Mechanism) -> str:
    """Return what a file calls a measured column: `measured.q1` where a reading has the plain name."""
    taken = {*OWN_COLUMNS, *(actuator.name for actuator in robot.actuators)}
    return f"measured.{column}" if column in taken else column


def dimension_of(coordinate: str) -> Dimension:
    """Return what a controlled coordinate measures: x, y, z lengths, the others angles."""
    return Dimension.LENGTH if coordinate in ("x", "y", "z") else Dimension.ANGLE


def has_readings(table: Table, robot: Mechanism) -> bool:
    """Tell whether a file has columns of readings, or of commanded coordinates."""
    names = {actuator.name for actuator in robot.actuators}
    return any(column in names or column.startswith(COMMANDED) for column in table.names)


def _read(table: Table, robot: Mechanism, several: bool) -> _File:
    """Read the poses of one file."""
    import numpy as np

    if several and "pose" not in table.units:
        raise table.header_error(
            "poses of several files are joined by name, and this one names none; add a column "
            "'pose'"
        )
    written = (
        table.text("pose")
        if "pose" in table.units
        else tuple(str(i + 1) for i in range(len(table.rows)))
    )
    names = tuple(unicodedata.normalize("NFC", cell) for cell in written)
    first = _first_rows(table, names)
    if several and not has_readings(table, robot):
        return _File(table, names, first, None, None, frozenset(), frozenset())
    controller = _controller(table, robot)
    rows, told = _rows(table, robot, controller), list(_dimensions(robot, controller))
    absent = np.isnan(rows)
    partly_read = controller is None and says_noise(table, robot)
    for row, name in enumerate(names):
        begin = first.get(name)
        if row == begin:
            if absent[row].any() and not partly_read and not (several and absent[row].all()):
                column = told[int(np.argmax(absent[row]))]
                way = (
                    ""
                    if controller is not None
                    else ", or state 'reading_noise' where empty means not read"
                )
                raise table.row_error(row, f"column {column!r} is empty; write its value{way}")
        elif not absent[row].all() and (
            begin is None or not np.array_equal(rows[row], rows[begin], equal_nan=True)
        ):
            links = f"a row that compares poses ({name!r}) has no readings of its own; leave these cells empty"
            has = f"pose {name!r} has other readings here than in line {table.lines[begin or 0]}; give it another name"
            raise table.row_error(row, links if begin is None else has)
    unread = frozenset(name for name, row in first.items() if absent[row].all())
    stated = frozenset(first) - unread
    if controller is not None:
        rows = _from_commanded(
            table,
            controller,
            robot,
            rows,
            {row: name for name, row in first.items() if name in stated},
        )
    sigma = read_reading_sigma(table, robot, rows)
    return _File(table, names, first, rows, sigma, stated, unread if partly_read else frozenset())


def _first_rows(table: Table, names: tuple[str, ...]) -> dict[str, int]:
    """Return pose -> its first row, in the order of the file."""
    first: dict[str, int] = {}
    for row, cell in enumerate(names):
        if not cell:
            raise table.row_error(
                row, "column 'pose' is empty, but every row needs it; write a name or a number"
            )
        if LINK not in cell:
            first.setdefault(cell, row)
    return first


def _members(table: Table, row: int, cell: str, place: dict[str, int]) -> tuple[int, ...]:
    """Return the poses that a row saw."""
    found = []
    for name in (part.strip() for part in cell.split(LINK)):
        if name not in place:
            hint = suggest_names(name, place)
            raise table.row_error(
                row, f"there is no pose {name!r}{hint}; give it a row with its readings"
            )
        found.append(place[name])
    return tuple(found)


def _dimensions(robot: Mechanism, controller: Mechanism | None) -> dict[str, Dimension]:
    """Return column -> dimension of the readings, or of what the controller was commanded to."""
    if controller is None:
        return {actuator.name: actuator.dimension for actuator in robot.actuators}
    return {COMMANDED + name: dimension_of(name) for name in controller.controlled}


def _rows(table: Table, robot: Mechanism, controller: Mechanism | None) -> np.ndarray:
    """Return (rows, a or c) readings or commanded coordinates [SI], NaN where a row has none."""
    import numpy as np

    dimensions = _dimensions(robot, controller)
    why = f"is the reading of an actuator of {robot.name}"
    if controller is not None:
        why = f"is a coordinate that {controller.name} is commanded in"
        read = [a.name for a in robot.actuators if a.name in table.units]
        if read:
            raise table.header_error(
                f"there are readings ({read[0]!r}) and commanded coordinates; keep one of the two"
            )
    require_columns(table, list(dimensions), why)
    return np.column_stack(
        [table.numbers(name, dimension) for name, dimension in dimensions.items()]
    )


def _controller(table: Table, robot: Mechanism) -> Mechanism | None:
    """Return the robot whose geometry turned commanded coordinates into readings; None where
    readings are given.
    """
    name = table.settings.content.get("controller")
    if not any(column.startswith(COMMANDED) for column in table.names):
        if name is not None:
            sentence = "a controller is named, but there are readings, not commanded coordinates; remove 'controller'"
            raise table.settings.error(sentence, ("controller",))
        return None
    if name is None:
        return robot.nominal
    beside = table.path.parent / str(name)
    return load_robot(beside if beside.exists() else str(name))


def _from_commanded(
    table: Table,
    controller: Mechanism,
    robot: Mechanism,
    rows: np.ndarray,
    first: Mapping[int, str],
) -> np.ndarray:
    """Return (rows, a) readings, in the rows `first` (row -> pose), from their commanded
    coordinates (rows, c).
    """
    import numpy as np

    from loopcal.measure import solve_commanded_readings

    readings = np.full((len(rows), len(robot.actuators)), np.nan)
    try:
        if first:
            readings[list(first)] = solve_commanded_readings(
                controller, rows[list(first)], tuple(first.values())
            )
    except DataError as error:
        raise DataError(f"{table.path}: {error}") from None
    return readings


def _refuse_other_readings(file: _File, row: int, other: _File, there: int) -> None:
    """Refuse a pose that two files give different readings, or different sigma of them, beyond
    rounding of units.
    """
    import numpy as np

    for what, here, before in (
        ("readings", file.readings, other.readings),
        ("sigma", file.sigma, other.sigma),
    ):
        if here is None or before is None:
            continue
        a, b = here[row], before[there]
        same = np.isclose(a, b, rtol=ALIKE, atol=LEAST, equal_nan=True)
        unsaid = (np.isnan(a) | np.isnan(b)) & (what == "sigma")
        if not (same | unsaid).all():
            raise file.table.row_error(
                row,
                f"pose {file.names[row]!r} has other {what} here than in "
                f"{other.table.place(there)}; poses of one name are "
                "one pose in all files, so correct them, or give it another name in one of the "
                "files",
            )


def _gathered(
    files: Sequence[_File], origin: Sequence[tuple[int, int]], robot: Mechanism
) -> tuple[np.ndarray, np.ndarray | None]:
    """Return readings (n, a) and, where any file says it, their sigma: what none says is the
    robot's, else exact.
    """
    import numpy as np

    blank = np.full(len(robot.actuators), np.nan)
    readings = np.stack(
        [blank if (r := files[i].readings) is None else r[row] for i, row in origin]
    )
    if all(file.sigma is None for file in files):
        return readings, None
    usual = np.array([actuator.sigma or 0.0 for actuator in robot.actuators])
    sigma = np.stack([usual if (s := files[i].sigma) is None else s[row] for i, row in origin])
    return readings, np.where(np.isnan(readings), np.inf, np.where(np.isnan(sigma), usual, sigma))


def _blocks(files: Sequence[_File], labels: tuple[str, ...]) -> np.ndarray:
    """Return (n,) block numbers: those that a file's column `block` gives a pose in its first row,
    else each pose alone.
    """
    import numpy as np

    named: dict[str, tuple[str, str]] = {}
    for file in files:
        if "block" not in file.table.units:
            continue
        cells = file.table.text("block")
        for name, row in file.first.items():
            if not cells[row]:
                raise file.table.row_error(
                    row,
                    "column 'block' is empty, but every pose needs it; write a name or a number",
                )
            block, where = named.setdefault(name, (cells[row], file.table.place(row)))
            if block != cells[row]:
                raise file.table.row_error(
                    row,
                    f"pose {name!r} is in block {cells[row]!r} here, but in {block!r} in {where}; "
                    "correct one",
                )
    keys = [("block", named[name][0]) if name in named else ("pose", name) for name in labels]
    order = {key: i for i, key in enumerate(dict.fromkeys(keys))}
    return np.array([order[key] for key in keys])
