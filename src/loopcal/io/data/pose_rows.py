# SPDX-License-Identifier: Apache-2.0
"""The poses of measurement files: their names, readings, reading noise and blocks.

Rows with the same name in the column `pose` belong to one pose, in all files. The first of them
holds the readings; the others repeat them or leave them empty. `a;b` names two poses that a row
compares; each of them has a row of its own.

Reading noise is `reading_noise: 5 um` (of all readings) or `{q1: 5 um, q2: 8 um}` in the settings,
or a column `sigma.q1 [um]`, where `inf` marks a reading that is not trusted and an empty cell falls
back to the setting, then to the robot file. Where noise is stated, an empty reading was not taken;
otherwise it is refused.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from loopcal.errors import suggest_names
from loopcal.findings import report_finding
from loopcal.io.core.csv_table import Table, require_columns
from loopcal.io.core.references import find_reference
from loopcal.io.core.yaml_file import Location, refuse_unknown_keys
from loopcal.io.data.base_targets import refuse_poses_of_base
from loopcal.io.data.columns import COMMANDED, LINK, SIGMA, NumberColumn, TextColumn, list_columns
from loopcal.io.robot.robot_file import list_shipped_robots, load_robot
from loopcal.mechanism import Mechanism
from loopcal.typing import BoolArray, FloatArray, IntArray
from loopcal.units import SMALLEST_SD, find_sd_fault

READING_NOISE = "reading_noise"
RELATIVE_ROUNDING, ABSOLUTE_ROUNDING = 1e-12, 1e-12
"""Differences [1] and [m or rad] up to which readings in different units are the same."""


class PoseRows(NamedTuple):
    """The n poses of some files.

    Parameters
    ----------
    labels : names of the poses.
    readings : (n, a) [SI], NaN where not read.
    sigma : (n, a) standard deviations of the readings [SI]; None where no file states any.
    block : (n,) poses with the same number are never split.
    members : the poses of each row of each file.
    """

    labels: tuple[str, ...]
    readings: FloatArray
    sigma: FloatArray | None
    block: IntArray
    members: tuple[tuple[tuple[int, ...], ...], ...]


class _FilePoses(NamedTuple):
    """The poses of one file.

    `names` of each row; `first` row of each pose; `readings` and `sigma` (rows, a), NaN where a row
    states none; `read` are the poses with readings in this file, `unread` those whose readings were
    not taken.
    """

    table: Table
    names: tuple[str, ...]
    first: dict[str, int]
    readings: FloatArray
    sigma: FloatArray
    read: frozenset[str]
    unread: frozenset[str]


def read_pose_rows(
    tables: Sequence[Table], robot: Mechanism, of_base: Sequence[BoolArray]
) -> PoseRows:
    """Read the columns `pose` and `block`, and those of readings or commanded coordinates.

    Parameters
    ----------
    tables : of all files. robot : its actuators name the readings.
    of_base : (rows,) of each file, rows that measure the base and belong to no pose.

    Raises
    ------
    FileError : a pose without readings or with contradicting ones, an unknown pose in a comparison.
    DataError : a commanded pose that the controller cannot reach.
    """
    several = len(tables) > 1
    files = [_read_file(*each, robot, several) for each in zip(tables, of_base, strict=True)]
    read = frozenset().union(*(file.read for file in files))
    origin: dict[str, tuple[int, int]] = {}
    for i, file in enumerate(files):
        states_readings = has_readings(file.table, robot)
        repeated: dict[int, tuple[int, int]] = {}
        for name, row in file.first.items():
            if name in file.read or (name in file.unread and name not in read):
                if name in origin:
                    repeated[row] = origin[name]
                else:
                    origin[name] = (i, row)
            elif name not in read and states_readings:
                sentence = f"pose {name!r} has no readings in any file; add them in one"
                raise file.table.row_error(row, sentence)
        _refuse_contradictions(file, files, repeated)
    if not origin:
        why = "no row has readings; add a row with readings for each pose"
        if all(rows.all() for rows in of_base):
            why = (
                "all rows measure targets on the base, so that there is no pose; give the file of "
                "the poses, too"
            )
        raise tables[0].row_error(0, why)
    alone = {name: (i,) for i, name in enumerate(origin)}
    members = tuple(
        tuple(
            () if is_base[row] else alone.get(cell) or _find_members(file.table, row, cell, alone)
            for row, cell in enumerate(file.names)
        )
        for file, is_base in zip(files, of_base, strict=True)
    )
    begin = np.cumsum([0, *(len(file.names) for file in files)])
    file, row = np.array(tuple(origin.values())).T
    places = begin[file] + row
    readings = np.concatenate([file.readings for file in files])[places]
    sigma = None
    if any(states_reading_noise(table, robot) for table in tables):
        stated = np.concatenate([file.sigma for file in files])[places]
        sigma = np.where(np.isnan(stated), robot.stated_sigma, stated)
    return PoseRows(tuple(origin), readings, sigma, _number_blocks(files, list(origin)), members)


def has_readings(table: Table, robot: Mechanism) -> bool:
    """Return whether a file has columns of readings, or of commanded coordinates."""
    names = {actuator.name for actuator in robot.actuators}
    return any(column in names or column.startswith(COMMANDED) for column in table.names)


def _read_file(table: Table, is_base: BoolArray, robot: Mechanism, several: bool) -> _FilePoses:
    """Read the poses of one file, which the rows (rows,) of the base do not name."""
    from loopcal.measure import solve_commanded_poses

    refuse_poses_of_base(table, is_base, robot)
    if is_base.all() and len(is_base):
        nothing = np.full((len(table), len(robot.actuators)), np.nan)
        names = ("",) * len(table)
        return _FilePoses(table, names, {}, nothing, nothing, frozenset(), frozenset())
    if several and "pose" not in table.units:
        sentence = "files are joined by the names of poses, and this file names none"
        raise table.header_error(f"{sentence}; add a column 'pose'")
    names = TextColumn("pose").parse(table) if "pose" in table.units else table.pose_names()
    first = _find_first_rows(table, names, is_base)
    blank = np.full((len(names), len(robot.actuators)), np.nan)
    if several and not has_readings(table, robot):
        return _FilePoses(table, names, first, blank, blank, frozenset(), frozenset())
    controller = _load_controller(table, robot)
    columns = _reading_columns(table, robot, controller)
    rows = np.column_stack([column.parse(table) for column in columns])
    may_be_absent = controller is None and states_reading_noise(table, robot)
    hint = (
        ""
        if controller is not None
        else f", or state '{READING_NOISE}', so that empty means not read"
    )
    begin = np.array(
        [-1 if base else first.get(name, -1) for name, base in zip(names, is_base, strict=True)]
    )
    if not may_be_absent:
        _refuse_empty_cells(
            table, columns, rows, begin, several, hint if controller is None else ""
        )
    _refuse_other_readings(table, names, rows, begin)
    is_unread = np.asarray(np.isnan(rows).all(axis=1))
    unread = frozenset(name for name, row in first.items() if is_unread[row])
    read = frozenset(first) - unread
    if controller is not None:
        chosen = [first[name] for name in first if name in read]
        if chosen:
            poses, places = [names[row] for row in chosen], [table.place(row) for row in chosen]
            blank[chosen] = solve_commanded_poses(controller, rows[chosen], poses, places).q
        rows = blank
    sigma = read_reading_sigma(table, robot, rows)
    return _FilePoses(
        table, names, first, rows, sigma, read, unread if may_be_absent else frozenset()
    )


def _refuse_empty_cells(
    table: Table,
    columns: Sequence[NumberColumn],
    rows: FloatArray,
    begin: IntArray,
    several: bool,
    hint: str,
) -> None:
    """Raise FileError where the first row of a pose lacks readings (rows, a); with `several` files,
    another one may state all of them.

    Parameters
    ----------
    begin : (rows,) first row of the pose, -1 for rows of two poses. hint : what else helps.
    """
    absent = np.isnan(rows)
    is_first = begin == np.arange(len(rows))
    for row in np.flatnonzero(is_first & absent.any(axis=1) & ~(several & absent.all(axis=1))):
        column = columns[int(np.argmax(absent[row]))].name
        raise table.row_error(int(row), f"column {column!r} is empty; write its value{hint}")


def _refuse_other_readings(
    table: Table, names: tuple[str, ...], rows: FloatArray, begin: IntArray
) -> None:
    """Raise FileError where readings (rows, a) differ from those in the first row `begin` (rows,)
    of their pose, or belong to a row of two poses, where `begin` is -1.
    """
    absent = np.isnan(rows)
    is_same = (rows == rows[begin]) | (absent & absent[begin])
    is_wrong = (begin < 0) | ~is_same.all(axis=1)
    for row in np.flatnonzero(is_wrong & ~absent.all(axis=1)):
        if begin[row] < 0:
            sentence = f"the row of {names[row]!r} compares poses and has no readings of its own"
            raise table.row_error(int(row), f"{sentence}; leave these cells empty")
        line = table.lines[begin[row]]
        sentence = f"pose {names[row]!r} has other readings in line {line}"
        raise table.row_error(int(row), f"{sentence}; correct them, or rename one of the two poses")


def _find_first_rows(table: Table, names: tuple[str, ...], is_base: BoolArray) -> dict[str, int]:
    """Return pose -> its first row, in the order of the file; rows of the base name none."""
    first: dict[str, int] = {}
    for row, name in enumerate(names):
        if is_base[row]:
            continue
        if not name:
            raise table.row_error(row, "column 'pose' is empty; write a name or a number")
        if LINK not in name:
            first.setdefault(name, row)
    return first


def _find_members(
    table: Table, row: int, cell: str, alone: Mapping[str, tuple[int]]
) -> tuple[int, ...]:
    """Return the poses of a row; `alone` are those of a row that names one pose."""
    names = [part.strip() for part in cell.split(LINK)]
    for name in names:
        if name not in alone:
            sentence = f"unknown pose {name!r}{suggest_names(name, alone)}"
            raise table.row_error(row, f"{sentence}; add a row with its readings")
    return tuple(pose for name in names for pose in alone[name])


def _reading_columns(
    table: Table, robot: Mechanism, controller: Mechanism | None
) -> list[NumberColumn]:
    """Return the columns of the readings, or of the coordinates of the controller."""
    readings = [actuator.name for actuator in robot.actuators]
    if controller is None:
        names, why = readings, f"the reading of an actuator of {robot.name}"
    else:
        names = [COMMANDED + name for name in controller.controlled]
        why = f"a commanded coordinate of {controller.name}"
        both = next((name for name in readings if name in table.units), None)
        if both is not None:
            sentence = f"this file has readings ({both!r}) and commanded coordinates"
            raise table.header_error(f"{sentence}; remove one of the two")
    require_columns(table, names, why)
    known = list_columns(robot, ()) | list_columns(controller or robot, ())
    return [column for name in names if isinstance(column := known[name], NumberColumn)]


def _load_controller(table: Table, robot: Mechanism) -> Mechanism | None:
    """Return the geometry that converts commanded coordinates; None where readings are given."""
    name = table.settings.content.get("controller")
    if not any(column.startswith(COMMANDED) for column in table.names):
        if name is not None:
            sentence = (
                "a controller is named, but this file has readings, not commanded coordinates"
            )
            raise table.settings.error(f"{sentence}; remove 'controller'", ("controller",))
        return None
    if name is None:
        return robot.nominal
    beside = find_reference(table.settings, "controller")
    if beside is None:
        beside = list_shipped_robots().get(str(name))
    if beside is None:
        finding = report_finding("files.reference-missing", key="controller", path=str(name))
        raise table.settings.error(finding, ("controller",))
    return load_robot(beside)


def states_reading_noise(table: Table, robot: Mechanism) -> bool:
    """Return whether a file states the noise of its readings."""
    names = (SIGMA + actuator.name for actuator in robot.actuators)
    return READING_NOISE in table.settings.content or any(name in table.units for name in names)


def read_reading_sigma(table: Table, robot: Mechanism, readings: FloatArray) -> FloatArray:
    """Return the standard deviations (rows, a) [SI] of readings (rows, a).

    They are NaN where the file states none for a reading, and infinite where it was not taken.

    Raises
    ------
    FileError
        An unknown actuator, a missing or wrong unit, a negative number, or an empty cell where no
        setting and no robot file states the noise.
    """
    stated = _read_setting(table, robot)
    usual = [stated.get(actuator.name, np.nan) for actuator in robot.actuators]
    sigma = np.tile(usual, (len(readings), 1))
    known = list_columns(robot, ())
    for i, actuator in enumerate(robot.actuators):
        name = SIGMA + actuator.name
        if name not in table.units:
            continue
        cells = known[name].parse(table)
        for row in np.flatnonzero((cells != 0.0) & (cells < SMALLEST_SD)):
            size = "negative" if cells[row] < 0.0 else "too small"
            sentence = f"column {name!r} is {size}; write a standard deviation, 0 where exact"
            raise table.row_error(int(row), sentence)
        sigma[:, i] = np.where(np.isnan(cells), sigma[:, i], cells)
        if actuator.sigma is None:
            for row in np.flatnonzero(np.isnan(sigma[:, i]) & ~np.isnan(readings[:, i])):
                sentence = f"column {name!r} is empty, and no other noise of this reading is stated"
                act = f"write it, 0 where it is exact or inf, or state '{READING_NOISE}'"
                raise table.row_error(int(row), f"{sentence}; {act}")
    return np.where(np.isnan(readings), np.inf, sigma)


def _read_setting(table: Table, robot: Mechanism) -> dict[str, float]:
    """Return actuator -> standard deviation [SI] of the settings."""
    file, node = table.settings, table.settings.content.get(READING_NOISE, {})
    dimensions = {actuator.name: actuator.dimension for actuator in robot.actuators}
    places: dict[str, Location] = {name: (READING_NOISE, name) for name in dimensions}
    if not isinstance(node, dict):
        node = dict.fromkeys(dimensions, node)
        places = dict.fromkeys(dimensions, (READING_NOISE,))
    refuse_unknown_keys(file, list(node), list(dimensions), (READING_NOISE,))
    stated = {}
    for name, text in node.items():
        stated[name] = file.quantity(text, dimensions[name], places[name])
        if stated[name] != 0.0 and (fault := find_sd_fault(stated[name])):
            sentence = f"the noise of readings is {text}; {fault}, or 0 where exact"
            raise file.error(sentence, places[name])
    return stated


def _refuse_contradictions(
    file: _FilePoses, files: Sequence[_FilePoses], repeated: Mapping[int, tuple[int, int]]
) -> None:
    """Raise FileError where two files state different readings, or sigmas, of one pose.

    `repeated` : row of the file -> number of another file, and its row of the same pose.
    """
    if not repeated:
        return
    rows = np.array(tuple(repeated))
    number, other = np.array(tuple(repeated.values())).T
    begin = np.cumsum([0, *(len(each.names) for each in files)])
    for what in ("readings", "sigma"):
        a = getattr(file, what)[rows]
        b = np.concatenate([getattr(each, what) for each in files])[begin[number] + other]
        same = np.isclose(a, b, rtol=RELATIVE_ROUNDING, atol=ABSOLUTE_ROUNDING, equal_nan=True)
        unstated = (np.isnan(a) | np.isnan(b)) & (what == "sigma")
        for i in np.flatnonzero(~(same | unstated).all(axis=1)):
            row, place = int(rows[i]), files[number[i]].table.place(int(other[i]))
            sentence = f"pose {file.names[row]!r} has other {what} here than in {place}"
            act = "correct them, or rename the pose in one of the files"
            raise file.table.row_error(row, f"{sentence}; {act}")


def _number_blocks(files: Sequence[_FilePoses], labels: Sequence[str]) -> IntArray:
    """Return block numbers (n,): by the column `block` of a pose's first row, else each alone."""
    if not any("block" in file.table.units for file in files):
        return np.arange(len(labels))
    named: dict[str, tuple[str, str]] = {}
    for file in (file for file in files if "block" in file.table.units):
        cells = file.table.text("block")
        for name, row in file.first.items():
            if not cells[row]:
                raise file.table.row_error(row, "column 'block' is empty; write a name or a number")
            block, place = named.setdefault(name, (cells[row], file.table.place(row)))
            if block != cells[row]:
                sentence = f"pose {name!r} is in block {cells[row]!r} here and {block!r} in {place}"
                raise file.table.row_error(row, f"{sentence}; correct one")
    keys = [("block", named[name][0]) if name in named else ("pose", name) for name in labels]
    numbers = {key: i for i, key in enumerate(dict.fromkeys(keys))}
    return np.array([numbers[key] for key in keys])
