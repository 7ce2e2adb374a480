# SPDX-License-Identifier: Apache-2.0
"""Measurement files: CSV rows of readings (or commanded coordinates) and measured values.

    # kind: pose                                       settings: `kind_settings.SETTINGS`
    # noise: {rx: 5 urad, ry: 5 urad, rz: 5 urad, x: 1 um, y: 1 um, z: 1 um}
    pose,q1 [mm],..,q6 [mm],rx [mrad],..,z [mm]        columns: `columns.RULES`

Rows of a kind `of: base` belong to no pose: their cells of poses and readings are empty.

Several kinds share a file under `kinds: {label: {kind: ..}}`; the column `kind` then holds the
label. Several files are one set of measurements, joined by the names of poses: a file without a
kind only holds readings, a file without readings refers to the poses of others, and a pose in two
files has the same readings in both.
"""

from __future__ import annotations

import unicodedata
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from loopcal.errors import DataError, FileError, suggest_names
from loopcal.estimate.determinable_setup import fix_undetermined_setup
from loopcal.findings import Finding, report_finding
from loopcal.io.core.csv_table import (
    Places,
    Table,
    format_row,
    read_table,
    read_template,
    refuse_settings_beside,
    require_columns,
)
from loopcal.io.core.limits import find_fault, format_comment
from loopcal.io.core.text_file import as_path, name_files, write_text
from loopcal.io.core.yaml_file import find_reference, format_flow, quote_scalar
from loopcal.io.data.columns import (
    COMMANDED,
    COVARIANCE,
    LINK,
    MEASURED,
    POSE_COLUMNS,
    ROW_COLUMNS,
    SIGMA,
    USE_COLUMN,
    Column,
    ContextColumn,
    PoseColumn,
    TextColumn,
    find_column_fault,
    list_columns,
    name_covariance,
    name_measured,
    read_context,
)
from loopcal.io.data.kind_settings import (
    KindRows,
    describe_instrument,
    describe_kind,
    describe_quantity,
    describe_stated_values,
    has_measured_values,
    match_names,
    read_kinds,
    read_observations,
    read_setup_priors,
    read_stated_values,
)
from loopcal.io.robot.robot_file import check_format, list_shipped_robots, load_robot
from loopcal.measure.data_checks import check_duplicates, check_kinds, check_strokes
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.kind import Kind
from loopcal.measure.measurements import Measurements, list_moving_targets
from loopcal.measure.observations import Observations
from loopcal.measure.readings import solve_commanded_poses
from loopcal.mechanism.assembly import FORCES
from loopcal.mechanism.kinematics import load_readings
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.platform_coordinates import get_dimension
from loopcal.mechanism.transmission import LOAD
from loopcal.typing import BoolArray, FloatArray
from loopcal.units import EXAMPLES, SMALLEST_SD, find_sd_fault, find_unit

# Fewest targets on the base that may determine the frame of an instrument. A single one shows no
# rotation, and no other target would reveal its error.
FEWEST = 2

READING_NOISE = "reading_noise"
# Difference, relative or in m or rad, up to which readings in different units are the same.
ROUNDING = 1e-12

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class _File:
    """One of the files that are read together.

    `kinds` and times or temperatures (`context`) of its rows; `is_base` (rows,) are rows that
    measure the base and belong to no pose. `names` of the poses of each row, and the `first` row of
    each pose. `readings` and `sigma` (rows, a) [SI] are NaN where a row states none; `read` are the
    poses with readings in this file, `unread` those whose readings were not taken. `members` are
    the poses of each row by index, known once the poses of all files are.
    """

    table: Table
    kinds: tuple[KindRows, ...]
    context: Mapping[str, FloatArray]
    is_base: BoolArray
    names: tuple[str, ...]
    first: Mapping[str, int]
    readings: FloatArray
    sigma: FloatArray
    read: frozenset[str] = frozenset()
    unread: frozenset[str] = frozenset()
    members: Sequence[tuple[int, ...]] = ()


def _check_base_targets(kinds: Sequence[tuple[Table, Sequence[KindRows]]]) -> None:
    """Refuse a target on the base that is also on a platform, a single target on the base, and
    targets in a frame in which no pose is measured; FileError at the settings of the kind.
    """
    all_kinds = [entry.kind for _, entries in kinds for entry in entries]
    known = {target for kind in all_kinds if kind.is_of_base for target in kind.target_columns}
    moving = [kind for kind in all_kinds if not kind.is_of_base]
    frames = tuple(dict.fromkeys(name for kind in moving if (name := _find_frame(kind))))
    of_base = ((t, entry) for t, entries in kinds for entry in entries if entry.kind.is_of_base)
    for table, entry in of_base:
        name, key, finding = _find_frame(entry.kind), "targets", None
        if shared := list_moving_targets(entry.kind, all_kinds):
            finding = report_finding("data.target-on-two-bodies", targets=shared)
        elif not name:
            targets, key = tuple(entry.kind.target_columns), "of"
            finding = report_finding("data.base-frame-known", targets=targets)
        elif moving and name not in frames:
            finding = report_finding("data.base-frame-unused", frame=name, frames=frames)
            key = "frame" if name != "frame" else "unknown"
        elif len(known) < FEWEST:
            finding = report_finding("data.single-base-target", targets=tuple(known))
        if finding is not None:
            raise table.settings.error(finding, (*entry.location, key))


def _find_frame(kind: Kind) -> str:
    """Return the name of the unknown frame in which a kind measures; empty without one."""
    return str(getattr(kind, "frame", "")) if "frame" in kind.unknown else ""


def _join_poses(files: Sequence[_File], robot: Mechanism) -> dict[str, tuple[int, int]]:
    """Return pose -> number of the file and row with its readings; FileError for a pose without
    readings or with contradicting ones.
    """
    read = frozenset().union(*(file.read for file in files))
    origin: dict[str, tuple[int, int]] = {}
    for i, file in enumerate(files):
        states_readings = _has_readings(file.table, robot)
        repeated: dict[int, tuple[int, int]] = {}
        for name, row in file.first.items():
            if name in file.read or (name in file.unread and name not in read):
                if name in origin:
                    repeated[row] = origin[name]
                else:
                    origin[name] = (i, row)
            elif name not in read and states_readings:
                sentence = f"pose {name!r} has no readings in any file. Add them in one"
                raise file.table.row_error(row, sentence)
        rows, others = list(repeated), list(repeated.values())
        for what in ("readings", "sigma") if repeated else ():
            a = getattr(file, what)[rows]
            b = np.array([getattr(files[of], what)[row] for of, row in others])
            same = np.isclose(a, b, rtol=ROUNDING, atol=ROUNDING, equal_nan=True)
            unstated = (np.isnan(a) | np.isnan(b)) & (what == "sigma")
            for k in np.flatnonzero(~(same | unstated).all(axis=1)):
                number, other = others[k]
                place = files[number].table.place(other)
                sentence = f"pose {file.names[rows[k]]!r} has other {what} here than in {place}"
                act = "Correct them, or rename the pose in one of the files"
                raise file.table.row_error(rows[k], f"{sentence}. {act}")
    if not origin:
        why = "no row has readings. Add a row with readings for each pose"
        if all(file.is_base.all() for file in files):
            why = "all rows measure targets on the base, none a pose"
            why += ". Give the file of the poses, too"
        raise files[0].table.row_error(0, why)
    return origin


def _find_members(file: _File, poses: Iterable[str]) -> list[tuple[int, ...]]:
    """Return the poses of each row by index; FileError for an unknown pose in a comparison."""
    number = {name: i for i, name in enumerate(poses)}
    members: list[tuple[int, ...]] = []
    for row, (cell, is_base) in enumerate(zip(file.names, file.is_base.tolist(), strict=True)):
        if is_base or cell in number:
            members.append(() if is_base else (number[cell],))
            continue
        names = [part.strip() for part in cell.split(LINK)]
        for name in (name for name in names if name not in number):
            sentence = f"unknown pose {name!r}{suggest_names(name, number)}"
            raise file.table.row_error(row, f"{sentence}. Add a row with its readings")
        members.append(tuple(number[name] for name in names))
    return members


def _collect(
    statements: Iterable[tuple[Table, Sequence[T], Iterable[tuple[int, int]]]],
    conflict: Callable[[int, T, T, str], str | Finding],
) -> dict[int, T]:
    """Return pose -> what rows state of it, from the cells of each table and its pairs of row and
    pose; FileError for another cell of a pose than before.
    """
    stated: dict[int, tuple[T, Table, int]] = {}
    for table, cells, pairs in statements:
        for row, pose in pairs:
            cell, other, place = stated.setdefault(pose, (cells[row], table, row))
            if cell != cells[row]:
                raise table.row_error(row, conflict(pose, cells[row], cell, other.place(place)))
    return {pose: cell for pose, (cell, _, _) in stated.items()}


def _read_pose_column(
    column: PoseColumn, files: Sequence[_File], labels: Sequence[str]
) -> np.ndarray:
    """Return the attribute (n,) that a column of poses states."""

    def list_statements() -> Iterator[tuple[Table, Sequence[str], list[tuple[int, int]]]]:
        for file in (file for file in files if column.name in file.table.units):
            cells = column.parse(file.table)
            pairs = [(row, i) for row, cell in enumerate(cells) if cell for i in file.members[row]]
            if column.is_required:
                pairs = [(row, file.members[row][0]) for row in file.first.values()]
            for row in (row for row, _ in pairs if not cells[row]):
                sentence = f"column {column.name!r} is empty. Write a name or a number"
                raise file.table.row_error(row, sentence)
            yield file.table, cells, pairs

    stated = _collect(list_statements(), lambda i, *what: column.conflict(labels[i], *what))
    return column.encode([stated.get(i, "") for i in range(len(labels))])


def _collect_pose_context(files: Sequence[_File], n: int) -> dict[str, FloatArray]:
    """Return name -> (n,) times and temperatures of rows that only hold readings, else NaN."""

    def list_statements(name: str) -> Iterator[tuple[Table, list[float], list[tuple[int, int]]]]:
        for file in (file for file in files if name in file.context):
            cells = file.context[name].tolist()
            is_single = np.array([len(poses) == 1 for poses in file.members], dtype=bool)
            alone = is_single & ~np.isnan(cells)
            for entry in file.kinds:
                links = entry.kind.poses_per_row
                alone[[row for row in entry.rows if len(file.members[row]) == links]] = False
            rows = np.flatnonzero(alone).tolist()
            yield file.table, cells, [(row, file.members[row][0]) for row in rows]

    found: dict[str, FloatArray] = {}
    for name in dict.fromkeys(name for file in files for name in file.context):
        fact = f"column {name!r} has another value in an earlier row of this pose. Correct one"
        stated = _collect(list_statements(name), lambda *_, fact=fact: fact)
        if stated:
            found[name] = np.array([stated.get(i, np.nan) for i in range(n)])
    return found


def _has_readings(table: Table, robot: Mechanism) -> bool:
    """Return whether a file has columns of readings, or of commanded coordinates."""
    names = {actuator.name for actuator in robot.actuators if actuator.reference is None}
    return any(column in names or column.startswith(COMMANDED) for column in table.names)


def _read_file(table: Table, kinds: tuple[KindRows, ...], robot: Mechanism, several: bool) -> _File:
    """Read the names of the poses of one file, but those of rows of the base, and any readings."""
    is_base = np.zeros(len(table), dtype=bool)
    for entry in (entry for entry in kinds if entry.kind.is_of_base):
        is_base[entry.rows] = True
    actuators = [actuator.name for actuator in robot.actuators]
    names = TextColumn("pose").parse(table) if "pose" in table.units else table.pose_names()
    of_pose = ("pose", *(column.name for column in POSE_COLUMNS), *actuators)
    for name in (*of_pose, *(COMMANDED + c for c in robot.controlled)):
        cells = table.text(name)
        for row in np.flatnonzero(is_base).tolist():
            if cells[row]:
                sentence = f"this row measures the base and belongs to no pose, but column {name!r}"
                raise table.row_error(row, f"{sentence} is {cells[row]!r}. Leave it empty")
    first: dict[str, int] = {}
    is_of_base = len(table) > 0 and bool(is_base.all())
    if several and "pose" not in table.units and not is_of_base:
        sentence = "loopcal joins files by the names of poses, and this file has none"
        raise table.header_error(f"{sentence}. Add a column 'pose'")
    for row in np.flatnonzero(~is_base).tolist():
        if not names[row]:
            raise table.row_error(row, "column 'pose' is empty. Write a name or a number")
        if LINK not in names[row]:
            first.setdefault(names[row], row)
    nothing = np.full((len(table), len(actuators)), np.nan)
    file = _File(table, kinds, read_context(table), is_base, names, first, nothing, nothing)
    if is_of_base or (several and not _has_readings(table, robot)):
        return file
    return _read_readings(file, robot, several)


def _read_readings(file: _File, robot: Mechanism, several: bool) -> _File:
    """Return a file with its readings, which a controller computes from commanded coordinates."""
    table, names = file.table, file.names
    controller = _load_controller(table, robot)
    columns = _list_reading_columns(table, robot, controller)
    known = list_columns(robot, ())
    loads = [known[name] for name in _list_load_columns(table, robot)]
    rows = np.column_stack([column.parse(table) for column in (*columns, *loads)])
    absent = np.isnan(rows)
    may_be_absent = controller is None and _states_reading_noise(table, robot)
    begin = np.array(
        [
            -1 if base else file.first.get(name, -1)
            for name, base in zip(names, file.is_base, strict=True)
        ]
    )
    if not may_be_absent:
        # with several files, another one may state all readings of a pose
        is_first = begin == np.arange(len(rows))
        hint = f", or give '{READING_NOISE}' to mark empty cells as not read"
        for row in np.flatnonzero(is_first & absent.any(axis=1) & ~(several & absent.all(axis=1))):
            name = (*columns, *loads)[int(np.argmax(absent[row]))].name
            sentence = f"column {name!r} is empty"
            act = f"Write its value{hint if controller is None else ''}"
            raise table.row_error(int(row), f"{sentence}. {act}")
    is_same = ((rows == rows[begin]) | (absent & absent[begin])).all(axis=1) & (begin >= 0)
    for row in np.flatnonzero(~is_same & ~absent.all(axis=1)).tolist():
        sentence = f"the row of {names[row]!r} compares poses and has no separate readings"
        act = "Leave these cells empty"
        if begin[row] >= 0:
            sentence = f"pose {names[row]!r} has other readings in line {table.lines[begin[row]]}"
            act = "Correct them, or rename one of the two poses"
        raise table.row_error(row, f"{sentence}. {act}")
    empty = set(np.flatnonzero(absent.all(axis=1)).tolist())
    unread = frozenset(name for name, row in file.first.items() if row in empty)
    read = frozenset(file.first) - unread
    readings = np.full(file.readings.shape, np.nan)
    chosen, own = [file.first[name] for name in file.first if name in read], len(columns)
    if controller is not None and chosen:
        poses, places = [names[row] for row in chosen], table.places(np.array(chosen))
        solution = solve_commanded_poses(controller, rows[chosen, :own], poses, places)
        readings[chosen] = solution.q
    for i, actuator in enumerate(robot.actuators):
        if actuator.name in table.units and (controller is None or actuator.reference is not None):
            readings[:, i] = known[actuator.name].parse(table)
    if chosen and loads and loads[0].name in FORCES:
        wrench = np.tile(robot.assembly.load.wrench, (len(chosen), 1))
        wrench[:, [FORCES.index(column.name) for column in loads]] = rows[chosen, own:]
        for row in np.flatnonzero(absent[chosen].any(axis=1))[:1]:
            sentence = "the load of a drive depends on all readings and forces, and one is empty"
            raise table.row_error(chosen[row], f"{sentence}; write it, or leave out this pose")
        values = robot.values[None]
        readings[chosen] = load_readings(robot, values, readings[None, chosen], wrench)[0]
    sigma = _read_reading_sigma(table, robot, readings)
    unread = unread if may_be_absent else frozenset[str]()
    return replace(file, readings=readings, sigma=sigma, read=read, unread=unread)


def _list_load_columns(table: Table, robot: Mechanism) -> list[str]:
    """Return the columns of the loads of elastic drives, or of force and moment on the platform."""
    loads = [a.name for a in robot.actuators if a.name.startswith(LOAD)]
    forces = [name for name in FORCES if name in table.units]
    names = [name for name in loads if name in table.units]
    if names and forces:
        sentence = f"this file has loads of drives ({names[0]!r}) and of the platform"
        raise table.header_error(f"{sentence} ({forces[0]!r}); remove one of the two")
    if not loads or names:
        names = loads
    else:
        stated = (*forces, *robot.assembly.load.stated)
        names = [name for name in FORCES if name in stated] or ["force.z"]
    require_columns(table, names, f"of the load on {robot.name}, 0 for none")
    return names


def _list_reading_columns(
    table: Table, robot: Mechanism, controller: Mechanism | None
) -> list[Column]:
    """Return the columns of the readings, or of the coordinates of the controller."""
    readings = [a.name for a in robot.actuators if not a.name.startswith(LOAD)]
    if controller is None:
        names, why = readings, f"the reading of an actuator of {robot.name}"
    else:
        names = [COMMANDED + name for name in controller.controlled]
        why = f"a commanded coordinate of {controller.name}"
        own = [a.name for a in robot.actuators if a.reference is None]
        both = next((name for name in own if name in table.units), None)
        if both is not None:
            sentence = f"this file has readings ({both!r}) and commanded coordinates"
            raise table.header_error(f"{sentence}. Remove one of the two")
    require_columns(table, names, why)
    known = list_columns(robot, ()) | list_columns(controller or robot, ())
    return [known[name] for name in names]


def _load_controller(table: Table, robot: Mechanism) -> Mechanism | None:
    """Return the geometry that converts commanded coordinates; None where readings are given."""
    name = table.settings.content.get("controller")
    if not any(column.startswith(COMMANDED) for column in table.names):
        if name is not None:
            sentence = "'controller' needs commanded coordinates, and this file has readings"
            raise table.settings.error(f"{sentence}. Remove 'controller'", ("controller",))
        return None
    beside = find_reference(table.settings, "controller", list_shipped_robots())
    return robot.nominal if beside is None else load_robot(beside)


def _states_reading_noise(table: Table, robot: Mechanism) -> bool:
    """Return whether a file states the noise of its readings."""
    names = (SIGMA + actuator.name for actuator in robot.actuators)
    return READING_NOISE in table.settings.content or any(name in table.units for name in names)


def _read_reading_sigma(table: Table, robot: Mechanism, readings: FloatArray) -> FloatArray:
    """Return the standard deviations (rows, a) [SI] of readings (rows, a): NaN where the file
    states none, and infinite where a reading was not taken.

    FileError : an unknown actuator, a wrong unit, a negative number, or an empty cell where
    nothing else states the noise.
    """
    file, node = table.settings, table.settings.content.get(READING_NOISE, {})
    dimensions = {actuator.name: actuator.dimension for actuator in robot.actuators}
    stated = dict.fromkeys(dimensions, np.nan)
    entries = [(node, list(dimensions), (READING_NOISE,))]
    if isinstance(node, dict):
        entries = match_names(file, node, list(dimensions), (READING_NOISE,))
    for text, names, place in entries:
        for name in names:
            stated[name] = file.quantity(text, dimensions[name], place, is_difference=True)
            if stated[name] != 0.0 and (fault := find_sd_fault(stated[name])):
                sentence = f"the noise of readings is {text}; {fault}, or 0 for exact readings"
                raise file.error(sentence, place)
    sigma = np.tile(list(stated.values()), (len(readings), 1))
    known = list_columns(robot, ())
    for i, actuator in enumerate(robot.actuators):
        name = SIGMA + actuator.name
        if name not in table.units:
            continue
        cells = known[name].parse(table)
        for row in np.flatnonzero((cells != 0.0) & (cells < SMALLEST_SD)):
            size = "negative" if cells[row] < 0.0 else "too small"
            sentence = (
                f"column {name!r} is {size}. Write a standard deviation, or 0 for exact readings"
            )
            raise table.row_error(int(row), sentence)
        sigma[:, i] = np.where(np.isnan(cells), sigma[:, i], cells)
        if actuator.sigma is None:
            for row in np.flatnonzero(np.isnan(sigma[:, i]) & ~np.isnan(readings[:, i])):
                sentence = f"column {name!r} is empty, and this reading has no other noise"
                act = f"Write it, 0 if it is exact, or inf, or give '{READING_NOISE}'"
                raise table.row_error(int(row), f"{sentence}. {act}")
    return np.where(np.isnan(readings), np.inf, sigma)


FORMAT = 1
WHAT = "measurement file"
Paths = str | Path | Sequence[str | Path]


def load_measurements(
    path: Paths,
    robot: Mechanism,
    *,
    allow_outside_stroke: bool = False,
    allow_duplicates: bool = False,
) -> Measurements:
    """Read a measurement file, or several as one set of measurements.

    Whether their units, signs and columns agree with the robot is checked later, by
    `loopcal.calibrate` or `loopcal.check_conventions`.

    Parameters
    ----------
    path : the CSV files; files that they name as `poses` are read, too.
    robot : the measured robot; its actuators name the columns of the readings.
    allow_outside_stroke, allow_duplicates : accept readings outside the stroke, and rows that
        repeat another row to the last digit.

    Returns
    -------
    In SI.

    Raises
    ------
    FileError : a value that does not fit, at its line.
    DataError : a check fails, noise is not a covariance, or a commanded pose cannot be reached.
    """
    tables = read_tables(path)
    return join_tables(tables, robot, allow_outside_stroke, allow_duplicates)


def load_contact_sheet(sheet: str | Path, plan: str | Path, robot: Mechanism) -> Measurements:
    """Read a planned sheet (of planes and lines, or of readings alone) whose readings are still to
    be measured, with the nominal readings of the operator's sheet `plan` beside it.

    FileError, DataError : as `load_measurements`, or the plan lacks a pose of the sheet.
    """
    table, planned = read_table(sheet), read_table(plan)
    kept = ("pose", *(actuator.name for actuator in robot.actuators))
    require_columns(planned, kept, f"a reading of {robot.name}")
    planned = replace(
        planned,
        units={name: planned.units[name] for name in kept},
        columns={name: planned.columns[name] for name in kept},
    )
    return join_tables((table, planned), robot, allow_outside_stroke=True, allow_duplicates=True)


def join_tables(
    tables: Sequence[Table],
    robot: Mechanism,
    allow_outside_stroke: bool = False,
    allow_duplicates: bool = False,
) -> Measurements:
    """Return the measurements of some tables; arguments as of `load_measurements`."""
    several = len(tables) > 1
    kinds = [(table, read_kinds(table, robot, several)) for table in tables]
    if not any(of_file for _, of_file in kinds):
        sentence = "no file has a kind of measurement. Write '# kind: ..' at the top of one"
        raise FileError(sentence, tables[0].path)
    _check_base_targets(kinds)
    files = [_read_file(*each, robot, several) for each in kinds]
    origin = _join_poses(files, robot)
    labels = tuple(origin)
    files = [replace(file, members=_find_members(file, labels)) for file in files]
    readings = np.array([files[i].readings[row] for i, row in origin.values()])
    sigma = None
    if any(_states_reading_noise(table, robot) for table in tables):
        stated = np.array([files[i].sigma[row] for i, row in origin.values()])
        sigma = np.where(np.isnan(stated), robot.stated_sigma, stated)
    beside_poses = _collect_pose_context(files, len(labels))
    read = [
        [
            read_observations(file.table, robot, entry, file.members, file.context, beside_poses)
            for entry in file.kinds
        ]
        for file in files
    ]
    # A file in which nothing was measured yet, the sheet of a plan, only contributes readings and
    # uses of poses that the others name; if no file has a measured value, all rows are kept.
    is_filled = [any(rows.is_measured.any() for rows, _ in of_file) for of_file in read]
    if any(is_filled):
        read = [of if filled else [] for of, filled in zip(read, is_filled, strict=True)]
    settings = [
        (
            file.table.settings,
            [rows for rows, _ in of_file],
            [value for entry in file.kinds for value in entry.shared_errors],
        )
        for file, of_file in zip(files, read, strict=True)
        if of_file
    ]
    with name_files(*(table.path for table in tables)):
        entries = [entry for of_file in read for entry in of_file]
        of_poses = [entry for entry in entries if not entry[0].kind.is_of_base]
        on_base = [entry for entry in entries if entry[0].kind.is_of_base]
        data = Measurements(
            robot.name,
            readings,
            tuple(rows for rows, _ in of_poses),
            labels=labels,
            reading_sigma=sigma,
            stated_values=read_stated_values(settings, labels),
            base_observations=tuple(rows for rows, _ in on_base),
            **{c.attribute: _read_pose_column(c, files, labels) for c in POSE_COLUMNS},
        )
        table, row = np.full((2, len(labels)), -1)  # of the first row of each pose
        for number, of_file in reversed(list(enumerate(read))):
            for rows, places in reversed(of_file):
                if not rows.kind.is_of_base:
                    poses = rows.rows.reshape(-1, rows.kind.poses_per_row)[::-1]
                    table[poses], row[poses] = number, places.rows[::-1, None]
        check_strokes(data, robot, allow=allow_outside_stroke, places=Places(tables, table, row))
        check_duplicates(data, allow=allow_duplicates, places=[at for _, at in of_poses + on_base])
    # Poses that only an unfilled sheet names were planned, not measured.
    is_named = np.zeros(len(labels), dtype=bool)
    for file, left in zip(files, read, strict=True):
        if left or not file.kinds:
            is_named[[pose for members in file.members for pose in members]] = True
    return fix_undetermined_setup(robot, data if is_named.all() else data.take(is_named))


def list_unfilled_files(tables: Sequence[Table], data: Measurements) -> tuple[Path, ...]:
    """Return the files that state a kind, but only hold poses and readings."""
    sources = {rows.source for rows in data.all_observations}
    measured = (table.path for table in tables if has_measured_values(table))
    return tuple(path for path in measured if str(path) not in sources)


def list_measurement_files(path: Paths) -> dict[str, Path]:
    """Return role -> file of all files that `load_measurements` reads: `data`, `data-2` and so on
    with measured values, `poses` with readings. FileError : one is given twice, or unreadable.
    """
    tables = read_tables(path)
    files: dict[str, Path] = {}
    for table in tables:
        role = "data" if len(tables) == 1 or has_measured_values(table) else "poses"
        count = sum(name.partition("-")[0] == role for name in files)
        files[role if count == 0 else f"{role}-{count + 1}"] = table.path
    return files


def load_poses(path: str | Path | Table, robot: Mechanism) -> FloatArray:
    """Read commanded poses (n, c) [m, rad]: one column for each controlled coordinate."""
    table = path if isinstance(path, Table) else read_table(path)
    require_columns(table, robot.controlled, f"a coordinate of {robot.name}")
    return np.column_stack(
        [table.numbers(name, get_dimension(name), empty=False) for name in robot.controlled]
    )


def load_pose_names(path: str | Path | Table) -> tuple[tuple[str, ...], Sequence[str]]:
    """Read the names of commanded poses (n,), "1", "2", ... without a column `pose`, and their
    places such as `poses.csv:12`; FileError where a name is missing, or occurs twice.
    """
    table = path if isinstance(path, Table) else read_table(path)
    names = table.pose_names()
    first: dict[str, int] = {}
    for i, name in enumerate(names):
        if first.setdefault(name, i) != i or not name:
            fact = (
                f"pose {name!r} is also row {first[name] + 1}" if name else "this pose has no name"
            )
            raise table.row_error(i, f"{fact}. Give each pose a separate name")
    return names, table.places(np.arange(len(names)))


def read_tables(path: Paths) -> tuple[Table, ...]:
    """Read the files, and those that they name under `poses`."""
    given = path if isinstance(path, list | tuple) else [path]
    paths = [as_path(file, WHAT) for file in given]
    if not paths:
        raise DataError("the list of measurement files is empty. Name at least one")
    tables: list[Table] = []
    for file in paths:
        table = read_table(file)
        if any(file.samefile(other.path) for other in tables):
            raise FileError("this file occurs twice. Name it once", file)
        if "format" in table.settings.content:
            check_format(table.settings, FORMAT)
        tables.append(table)
    for table in tuple(tables):
        beside = find_reference(table.settings, "poses")
        if beside is not None and not any(beside.samefile(other.path) for other in tables):
            tables.append(read_table(beside))
    return tuple(tables)


def load_instrument(path: str | Path, robot: Mechanism) -> Instrument:
    """Return the instrument of a measurement file, which measures every pose."""
    table = read_table(path)
    return _build_instrument(table, read_kinds(table, robot))


def load_instrument_to_plan(path: str | Path, robot: Mechanism) -> Instrument:
    """Return the instrument of a measurement file for planning poses; FileError where each group
    of rows has setup parameters of its own, such as a surface, which poses do not determine.
    """
    table = read_template(path)
    kinds = read_kinds(table, robot)
    groups, poses = table.text("group"), table.pose_names()
    moving = [entry for entry in kinds if not entry.kind.is_of_base]
    apart = len({frozenset(poses[row] for row in entry.rows) for entry in moving}) > 1
    for entry in kinds:
        parameters = [
            parameter.name
            for parameter in entry.kind.nuisance_parameters
            if parameter.scope == "group"
        ]
        if parameters and (apart or len({groups[row] for row in entry.rows}) > 1):
            facts = {"kind": entry.kind.name, "parameters": tuple(parameters)}
            problem = report_finding("files.groups-in-plan", **facts)
            raise table.settings.error(problem, entry.location)
    return _build_instrument(table, kinds)


def has_empty_readings(path: str | Path, robot: Mechanism) -> bool:
    """Return whether a sheet has columns of readings, all empty: they are to be measured."""
    table = read_table(path)
    columns = [actuator.name for actuator in robot.actuators if actuator.name in table.units]
    cells = (cell for name in columns for cell in table.text(name))
    return bool(columns and len(table)) and not any(cells)


def _build_instrument(table: Table, kinds: Sequence[KindRows]) -> Instrument:
    """Return the instrument with the noise that the settings of a table state."""
    _check_base_targets([(table, kinds)])
    sensors = []
    for entry in kinds:
        sight = {n: entry.noise[n] for n in entry.kind.sight_noise if n in entry.noise}
        if sight and np.array_equal(getattr(entry.kind, "T_base_frame", np.eye(4)), np.eye(4)):
            finding = report_finding("files.instrument-place-needed")
            raise table.settings.error(finding, (*entry.location, "noise"))
        for column in entry.kind.noise_columns:
            if not sight and column.name not in entry.noise:
                example = f"noise: {{{column.name}: {EXAMPLES[column.dimension]}}}"
                sentence = (
                    f"planning and simulation need the noise of {column.name!r}. Add '{example}'"
                )
                raise table.settings.error(sentence, (*entry.location, "noise"))
        sigma = np.array([entry.noise.get(column.name, 0.0) for column in entry.kind.noise_columns])
        sensors.append(Sensor(entry.kind, Gaussian(sigma, sight)))
    return Instrument(tuple(sensors), read_setup_priors(table.settings, kinds))


# Text of measurement files and of templates.

# Relative difference up to which the standard deviations of all rows are written as one number, and
# correlation up to which there is none [1].
EQUAL = 1e-9
# Remarks below the header of a template.
ADDED = """\
# Add one row for each pose below: its name, readings and measured values. Leave unmeasured
# cells empty.
# Optional setting for traceability: instrument: {name: .., serial_number: "..", certificate: "..",
#   laboratory: .., standard: .., calibrated: 2026-01-31, due: 2027-01-31, measured: 2026-05-31}
# Optional columns: block, session, group, time, temperature [degC], sigma.NAME, note; see
# docs/files.md."""

# Remark of a template on a kind that compares poses.
COMPARED = f"""\
# A row of the kind {{}} compares two poses: name them in the column pose as a{LINK}b and leave its
# readings empty. Each of these poses needs a separate row with its readings."""

# Remark of a template on targets of unknown place.
UNKNOWN_TARGETS = """\
# Replace the places of the targets above by yours: measured by hand from the origin of the platform
# frame, to a few millimeters. A plan uses them; a calibration identifies them. A plan
# needs no rows: it takes the instrument from the settings above."""

# Remark of a template on an instrument whose frame is unknown.
UNKNOWN_FRAME = """\
# The instrument may stand anywhere: the fit finds its frame ({}). If it moves, even a
# little, give the rows before and after it different names in a column session."""


def save_measurements(
    data: Measurements, path: str | Path, robot: Mechanism, remark: str = ""
) -> None:
    """Write measurements as a CSV file that `load_measurements` reads back.

    Parameters
    ----------
    data : to write. path : written whole or not at all. robot : names the readings.
    remark : one line for people, at the top.

    Raises
    ------
    FileError : the file cannot be written, or a file of settings has its name.
    DataError : a name that a file cannot hold.
    """
    path = as_path(path, "measurement file")
    text = format_measurements(data, robot, remark)
    refuse_settings_beside(path)
    write_text(path, text)


def format_measurements(
    data: Measurements,
    robot: Mechanism,
    remark: str = "",
    states_use: bool = False,
    is_by_pose: bool = False,
) -> str:
    """Return the text of a measurement file; `states_use` also where no pose is held out, and
    `is_by_pose` for rows of all kinds in the order of their poses.
    """
    _refuse_names(data)
    observations = data.all_observations
    kinds = [rows.kind for rows in observations]
    check_kinds(robot, kinds)
    labels, known = _label_kinds(kinds), list_columns(robot, kinds)
    tables = [_tabulate_rows(rows, robot) for rows in observations]
    reading_noise, readings = _tabulate_readings(data, robot)
    settings = [
        describe_kind(rows.kind, noise, robot.tool, rows.is_noise_assumed)
        | ({} if rows.instrument is None else {"instrument": describe_instrument(rows.instrument)})
        for rows, (noise, _) in zip(observations, tables, strict=True)
    ]
    lines = _format_settings(robot, list(zip(labels, settings, strict=True)), remark)
    stated = tuple(value for value in data.stated_values if not value.is_undetermined)
    knowledge = describe_stated_values(stated, data.nuisance_parameters.table.entries)
    for key, content in (("unknowns", knowledge), ("reading_noise", reading_noise)):
        lines += [f"# {key}: {format_flow(content)}"] if content else []

    uses = {
        column.name: column.decode(values)
        for column in POSE_COLUMNS
        if column.is_needed(values := getattr(data, column.attribute))
        or (states_use and column is USE_COLUMN)
    }
    names = ["pose", *uses]
    for name in ROW_COLUMNS:
        is_stated = any((getattr(rows, name) != "").any() for rows in observations)
        names += [name] if is_stated else []
    names += [*(["kind"] if len(kinds) > 1 else []), *readings]
    names += [name for rows in observations for name in rows.context]
    names += [name for _, table in tables for name in table]
    for name in (name for _, table in tables for name in table):
        prefixes = (SIGMA, MEASURED, COVARIANCE)
        plain = next((name.removeprefix(p) for p in prefixes if name.startswith(p)), name)
        if fault := find_column_fault(plain, "measured value"):
            raise DataError(fault)
    columns: list[Column] = [known.get(n, ContextColumn(n)) for n in dict.fromkeys(names)]
    lines.append(format_row(column.header for column in columns))

    body: list[tuple[list[int], dict[str, Any]]] = []
    for label, rows, (_, table) in zip(labels, observations, tables, strict=True):
        for i in np.flatnonzero(rows.weight):  # rows of weight 0 are not written
            cells = {name: values[i] for name, values in {**rows.context, **table}.items()}
            cells |= {"kind": label} | {name: getattr(rows, name)[i] for name in ROW_COLUMNS}
            poses = [] if rows.kind.is_of_base else np.atleast_1d(rows.rows[i]).tolist()
            body.append((poses, cells))
    measured = {poses[0] for poses, _ in body if len(poses) == 1}
    body = [([pose], {}) for pose in range(data.n_poses) if pose not in measured] + body
    if is_by_pose:
        body.sort(key=lambda row: row[0])
    for poses, cells in body:
        pose = LINK.join(data.labels[pose] for pose in poses)
        cells |= {"pose": pose}
        if len(poses) == 1:
            cells |= {name: values[poses[0]] for name, values in {**uses, **readings}.items()}
        texts = (c.format(cells[c.name]) if c.name in cells else "" for c in columns)
        lines.append(format_row(texts))
    return "\n".join(lines) + "\n"


def format_template(robot: Mechanism, instrument: Instrument) -> str:
    """Return settings and header of a measurement file, to be filled in by hand."""
    kinds = [sensor.kind for sensor in instrument.sensors]
    noise = [
        dict(zip((c.name for c in s.kind.noise_columns), s.noise.sigma.tolist(), strict=True))
        for s in instrument.sensors
    ]
    labels, known = _label_kinds(kinds), list_columns(robot, kinds)
    names = ["pose", *(["kind"] if len(kinds) > 1 else []), *(a.name for a in robot.actuators)]
    names += [name_measured(column.name, robot) for kind in kinds for column in kind.columns]
    header = format_row(known[name].header for name in dict.fromkeys(names))
    compared = [
        COMPARED.format(label)
        for label, kind in zip(labels, kinds, strict=True)
        if kind.poses_per_row > 1
    ]
    contents = (describe_kind(kind, of, robot.tool) for kind, of in zip(kinds, noise, strict=True))
    settings = _format_settings(robot, list(zip(labels, contents, strict=True)), "")
    entries = [parameter for kind in kinds for parameter in kind.nuisance_parameters]
    if knowledge := describe_stated_values(instrument.stated_values, entries):
        settings.append(f"# unknowns: {format_flow(knowledge)}")
    unknown = [(kind, getattr(kind, "unknown", ())) for kind in kinds]
    frames = [getattr(kind, "frame", "") for kind, names in unknown if "frame" in names]
    remarks = [UNKNOWN_FRAME.format(quote_scalar(name)) for name in dict.fromkeys(frames)]
    remarks += [UNKNOWN_TARGETS] * any("targets" in names for _, names in unknown)
    return "\n".join([*settings, header, ADDED, *remarks, *compared]) + "\n"


def format_data_sheet(
    robot: Mechanism,
    instrument: Instrument,
    readings: ArrayLike,
    labels: Sequence[str] = (),
    is_held_out: ArrayLike | None = None,
) -> str:
    """Return a measurement file with poses, readings (n, a) [SI], NaN for those to be measured, and
    empty measured values.

    `instrument` states the poses, session and group of each kind. Without `is_held_out` (n,), the
    file has no column `use`. DataError : a pose that does not exist, or a wrong number of names.
    """
    sensors = instrument.with_tool(robot).sensors
    rows = []
    readings = np.asarray(readings)
    for sensor in (sensor.assign_rows(len(readings)) for sensor in sensors):
        empty = np.full((len(sensor.assigned_rows), len(sensor.kind.columns)), np.nan)
        empty[:, : sensor.kind.label_count] = sensor.kind.list_labels(len(empty))
        names = (sensor.noise.sigma, sensor.session, sensor.group, sensor.noise.sight)
        rows.append(Observations.from_sigma(sensor.kind, sensor.assigned_rows, empty, *names))
    is_empty = np.isnan(readings)
    data = Measurements(
        robot.name,
        readings,
        tuple(of_sensor for of_sensor in rows if not of_sensor.kind.is_of_base),
        labels=tuple(labels),
        reading_sigma=np.where(is_empty, np.inf, 0.0) if is_empty.any() else None,
        stated_values=instrument.stated_values,
        is_held_out=np.array([] if is_held_out is None else is_held_out, dtype=bool),
        base_observations=tuple(of_sensor for of_sensor in rows if of_sensor.kind.is_of_base),
    )
    return format_measurements(data, robot, states_use=is_held_out is not None)


def _label_kinds(kinds: Sequence[Kind]) -> list[str]:
    """Return the labels of kinds in a file: their names, numbered where a name occurs twice."""
    names = [kind.name for kind in kinds]
    return [
        name if names.count(name) == 1 else f"{name}-{names[: i + 1].count(name)}"
        for i, name in enumerate(names)
    ]


def _refuse_names(data: Measurements) -> None:
    """Raise DataError for names of poses, sessions and groups that a file cannot hold."""
    names = [("pose", name) for name in data.labels]
    for what in ROW_COLUMNS:
        names += [(what, n) for rows in data.all_observations for n in getattr(rows, what).tolist()]
    for what, name in dict.fromkeys(names):
        if (fault := find_fault(name)) is not None:
            raise DataError(fault)
        if name != name.strip():
            reason = "names must not begin or end with a blank"
        elif what == "pose" and (not name or LINK in name):
            reason = f"names of poses must not be empty or contain {LINK!r}"
        else:
            continue
        raise DataError(f"cannot write the {what} {name!r}: {reason}. Rename it")
    labels = [unicodedata.normalize("NFC", name) for name in data.labels]
    if len(set(labels)) < len(labels):
        name = next(name for name in labels if labels.count(name) > 1)
        raise DataError(f"two poses have the name {name!r}, but names must differ. Rename one")


def _tabulate_readings(
    data: Measurements, robot: Mechanism
) -> tuple[dict[str, Any], dict[str, FloatArray]]:
    """Return the setting of reading noise, and column -> (n,) readings and other noise [SI].

    The noise of an actuator is in the setting where it is the same in all poses.
    """
    columns = {a.name: data.readings[:, i] for i, a in enumerate(robot.actuators)}
    if data.reading_sigma is None:
        return {}, columns
    stated: dict[str, Any] = {}
    for i, actuator in enumerate(robot.actuators):
        sigma = np.where(np.isnan(data.readings[:, i]), np.nan, data.reading_sigma[:, i])
        values = np.unique(sigma[~np.isnan(sigma)])
        if len(values) == 1 and np.isfinite(values[0]):
            stated[actuator.name] = describe_quantity(float(values[0]), actuator.dimension)
        elif len(values):
            columns[SIGMA + actuator.name] = sigma
    return stated, columns


def _tabulate_rows(
    rows: Observations, robot: Mechanism
) -> tuple[dict[str, float], dict[str, FloatArray]]:
    """Return noise column -> sigma of all rows, and column -> (r,) of what differs [SI]."""
    kind = rows.kind
    names = [name_measured(column.name, robot) for column in kind.columns]
    columns = dict(zip(names, rows.measured.T, strict=True))
    N, common = kind.linearize_noise(rows.measured), dict[str, float]()
    left = rows.covariance
    for part in rows.noise_parts:
        if part.name in kind.sight_noise and (size := part.size) is not None:
            sd = size.value * find_unit(size.unit).factor_to_si / size.divisor
            wanted = sd * sd * kind.spread_sight_noise(rows.measured)[part.name]
            if np.allclose(part.covariance, wanted, rtol=EQUAL, atol=0.0):
                common[part.name], left = sd, left - part.covariance
    left = np.where(np.abs(left) > EQUAL * np.abs(rows.covariance), left, 0.0) if common else left
    half = np.linalg.solve(N, left)
    covariance = np.linalg.solve(N, np.swapaxes(half, -1, -2))
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    is_common = np.all(np.abs(sigma - sigma[:1]) <= EQUAL * sigma[:1], axis=0)
    is_related = np.any(np.abs(covariance) > EQUAL * sigma[:, :, None] * sigma[:, None, :], axis=0)
    for i, column in enumerate(kind.noise_columns):
        if common and not sigma[:, i].any():
            continue
        if is_common[i]:
            common[column.name] = float(sigma[0, i])
        else:
            columns[SIGMA + name_measured(column.name, robot)] = sigma[:, i]
    for i, a in enumerate(kind.noise_columns):
        for j, b in enumerate(kind.noise_columns[:i]):
            if is_related[i, j]:
                columns[name_covariance(a.name, b.name, robot)] = covariance[:, i, j]
    return common, columns


def _format_settings(
    robot: Mechanism, settings: Sequence[tuple[str, Mapping[str, Any]]], remark: str
) -> list[str]:
    """Return the front matter, from the label and the settings of each kind."""
    lines = [f"## {format_comment(remark)}"] if remark else []
    content: dict[str, Any] = {"format": FORMAT, "robot": robot.name}
    if len(settings) == 1:
        content |= settings[0][1]
    lines += [f"# {key}: {format_flow(value)}" for key, value in content.items()]
    if len(settings) == 1:
        return lines
    labeled = (f"#   {quote_scalar(label)}: {format_flow(of)}" for label, of in settings)
    return [*lines, "# kinds:", *labeled]
