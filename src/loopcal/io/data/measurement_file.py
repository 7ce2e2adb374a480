# SPDX-License-Identifier: Apache-2.0
"""Measurement files: CSV rows of readings (or commanded coordinates) and measured values.

    # kind: pose                                       settings: `kind_rows.SETTINGS`
    # noise: {rx: 5 urad, ry: 5 urad, rz: 5 urad, x: 1 um, y: 1 um, z: 1 um}
    pose,q1 [mm],..,q6 [mm],rx [mrad],..,z [mm]        columns: `columns.RULES`

Rows of a kind `of: base` belong to no pose: their cells of poses and readings are empty.

Several kinds share a file under `kinds: {label: {kind: ..}}`; the column `kind` then holds the
label. Several files are one set of measurements, joined by the names of poses: a file without a
kind only holds readings, a file without readings refers to the poses of others, and a pose in two
files has the same readings in both.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from loopcal.errors import DataError, FileError
from loopcal.findings import report_finding
from loopcal.io.core.csv_table import Table, read_table, read_template, require_columns
from loopcal.io.core.references import find_reference
from loopcal.io.core.text_file import as_path, name_files
from loopcal.io.data.base_targets import check_base_targets, find_base_rows
from loopcal.io.data.columns import get_dimension, read_context
from loopcal.io.data.kind_rows import KindRows, has_measured_values, read_kinds, read_observations
from loopcal.io.data.nuisance_settings import read_stated_values
from loopcal.io.data.pose_rows import read_pose_rows
from loopcal.io.data.pose_use import read_held_out
from loopcal.io.robot.robot_file import check_format
from loopcal.mechanism import Mechanism
from loopcal.typing import BoolArray, FloatArray
from loopcal.units import EXAMPLES

if TYPE_CHECKING:
    from loopcal.measure import Instrument, Measurements, Observations

FORMAT = 1
WHAT = "measurement file"
Paths = str | Path | Sequence[str | Path]
FileRows = list[tuple["Observations", tuple[str, ...]]]
"""Observations of a file, with the place of each row."""


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
    tables = _read_tables(path)
    return _join_tables(tables, robot, allow_outside_stroke, allow_duplicates)


def load_contact_sheet(sheet: str | Path, plan: str | Path, robot: Mechanism) -> Measurements:
    """Read a planned sheet whose readings are still to be measured, with those of the plan.

    Parameters
    ----------
    sheet : data file of a plan of planes and lines, or of readings alone.
    plan : the operator's sheet beside it, with the nominal reading of each pose.

    Raises
    ------
    FileError, DataError : as `load_measurements`, or the plan lacks a pose of the sheet.
    """
    table, planned = read_table(sheet), read_table(plan)
    readings = tuple(actuator.name for actuator in robot.actuators)
    require_columns(planned, ("pose", *readings), f"a reading of {robot.name}")
    kept = ("pose", *readings)
    planned = replace(
        planned,
        units={name: planned.units[name] for name in kept},
        columns={name: planned.columns[name] for name in kept},
    )
    return _join_tables((table, planned), robot, allow_outside_stroke=True, allow_duplicates=True)


def _join_tables(
    tables: Sequence[Table], robot: Mechanism, allow_outside_stroke: bool, allow_duplicates: bool
) -> Measurements:
    """Return the measurements of some tables; arguments as of `load_measurements`."""
    from loopcal.measure import Measurements, check_duplicates, check_strokes

    kinds = [read_kinds(table, robot, len(tables) > 1) for table in tables]
    if not any(kinds):
        sentence = "no file states a kind of measurement; write '# kind: ..' at the top of one"
        raise FileError(sentence, tables[0].path)
    check_base_targets(tables, kinds)
    of_base = [find_base_rows(t, of_file) for t, of_file in zip(tables, kinds, strict=True)]
    poses = read_pose_rows(tables, robot, of_base)
    context = [read_context(table) for table in tables]
    beside_poses = _collect_pose_context(tables, kinds, poses.members, context, len(poses.labels))
    read = [
        [read_observations(table, robot, entry, members, beside, beside_poses) for entry in of_file]
        for table, of_file, members, beside in zip(
            tables, kinds, poses.members, context, strict=True
        )
    ]
    read = _leave_out_unfilled(read)
    settings = [
        (table.settings, [rows for rows, _ in of_file], _join_shared_errors(entries))
        for table, of_file, entries in zip(tables, read, kinds, strict=True)
        if of_file
    ]
    with name_files(*(table.path for table in tables)):
        entries = [entry for of_file in read for entry in of_file]
        of_poses, on_base = (
            [entry for entry in entries if entry[0].kind.is_of_base == flag]
            for flag in (False, True)
        )
        data = Measurements(
            robot.name,
            poses.readings,
            tuple(rows for rows, _ in of_poses),
            poses.block,
            poses.labels,
            poses.sigma,
            read_stated_values(settings, poses.labels),
            read_held_out(tables, poses),
            tuple(rows for rows, _ in on_base),
        )
        places = [places for _, places in of_poses]
        check_strokes(data, robot, allow=allow_outside_stroke, places=_place_poses(data, places))
        places += [places_of_base for _, places_of_base in on_base]
        check_duplicates(data, allow=allow_duplicates, places=places)
    is_named = _find_named_poses(kinds, read, poses.members, len(poses.labels))
    return data if is_named.all() else data.take(is_named)


def _join_shared_errors(entries: Sequence[KindRows]) -> dict[str, float]:
    """Return the standard deviations of the biases and drifts of all kinds of a file."""
    return {name: sd for entry in entries for name, sd in entry.shared_errors.items()}


def _place_poses(data: Measurements, places: Sequence[Sequence[str]]) -> dict[int, str]:
    """Return the place of the first row of each pose, such as `data.csv:12`."""
    first: dict[int, str] = {}
    for rows, of_rows in zip(reversed(data.observations), reversed(places), strict=True):
        repeated = [place for place in of_rows for _ in range(rows.kind.poses_per_row)]
        first |= zip(rows.rows.ravel()[::-1].tolist(), reversed(repeated), strict=True)
    return first


def _leave_out_unfilled(read: list[FileRows]) -> list[FileRows]:
    """Return the rows of each file, none of a file in which nothing was measured yet.

    Such a file, the sheet of a plan, only contributes readings and uses of poses that the others
    name. If no file has a measured value, all rows are kept.
    """
    is_filled = [any(rows.is_measured.any() for rows, _ in of_file) for of_file in read]
    if not any(is_filled):
        return read
    return [of_file if filled else [] for of_file, filled in zip(read, is_filled, strict=True)]


def _find_named_poses(
    kinds: Sequence[Sequence[object]],
    read: Sequence[FileRows],
    members: Sequence[Sequence[tuple[int, ...]]],
    count: int,
) -> BoolArray:
    """Return which poses (count,) another file than an unfilled sheet names.

    The other poses of a sheet were planned, not measured: their uses and readings say nothing.
    """
    is_named = np.zeros(count, dtype=bool)
    for of_file, left, of_rows in zip(kinds, read, members, strict=True):
        if left or not of_file:
            is_named[[pose for poses in of_rows for pose in poses]] = True
    return is_named


def list_unfilled_files(path: Paths, data: Measurements) -> tuple[Path, ...]:
    """Return the files of `load_measurements` that state a kind, but only hold poses and readings.

    Parameters
    ----------
    path : the files. data : that were read from them.
    """
    sources = {rows.source for rows in data.all_observations}
    tables = (table for table in _read_tables(path) if has_measured_values(table))
    return tuple(table.path for table in tables if str(table.path) not in sources)


def list_measurement_files(path: Paths) -> dict[str, Path]:
    """Return role -> file of all files that `load_measurements` reads.

    Files with measured values are called `data`, `data-2` and so on, files that only hold readings
    of poses `poses`.

    Raises
    ------
    FileError : one of them cannot be read, or is given twice.
    """
    tables = _read_tables(path)
    files: dict[str, Path] = {}
    for table in tables:
        role = "data" if len(tables) == 1 or has_measured_values(table) else "poses"
        count = sum(name.partition("-")[0] == role for name in files)
        files[role if count == 0 else f"{role}-{count + 1}"] = table.path
    return files


def load_poses(path: str | Path, robot: Mechanism) -> FloatArray:
    """Read commanded poses (n, c) [m, rad]: one column for each controlled coordinate.

    Raises
    ------
    FileError : a value that does not fit, at its line.
    """
    table = read_table(path)
    require_columns(table, robot.controlled, f"a coordinate of {robot.name}")
    return np.column_stack(
        [table.numbers(name, get_dimension(name), empty=False) for name in robot.controlled]
    )


def load_pose_names(path: str | Path) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Read the names of commanded poses (n,), and their places such as `poses.csv:12`.

    The names are "1", "2", ... without a column `pose`.

    Raises
    ------
    FileError : a name occurs twice.
    """
    table = read_table(path)
    names = table.pose_names()
    first: dict[str, int] = {}
    for i, name in enumerate(names):
        if first.setdefault(name, i) != i:
            row = first[name] + 1
            sentence = f"pose {name!r} is also row {row}; give each pose a name of its own"
            raise table.row_error(i, sentence)
    return names, tuple(map(table.place, range(len(names))))


def _read_tables(path: Paths) -> tuple[Table, ...]:
    """Read the files, and those that they name under `poses`."""
    given = path if isinstance(path, list | tuple) else [path]
    paths = [as_path(file, WHAT) for file in given]
    if not paths:
        raise DataError("no measurement file is given; name at least one")
    tables: list[Table] = []
    for file in paths:
        table = read_table(file)
        if any(file.samefile(other.path) for other in tables):
            raise FileError("this file is given twice; name it once", file)
        if "format" in table.settings.content:
            check_format(table.settings, FORMAT)
        tables.append(table)
    for table in tuple(tables):
        name = table.settings.content.get("poses")
        if name is None:
            continue
        beside = find_reference(table.settings, "poses")
        if beside is None:
            finding = report_finding("files.reference-missing", key="poses", path=str(name))
            raise table.settings.error(finding, ("poses",))
        if not any(beside.samefile(other.path) for other in tables):
            tables.append(read_table(beside))
    return tuple(tables)


def _collect_pose_context(
    tables: Sequence[Table],
    kinds: Sequence[tuple[KindRows, ...]],
    members: Sequence[Sequence[tuple[int, ...]]],
    context: Sequence[Mapping[str, FloatArray]],
    n: int,
) -> dict[str, FloatArray]:
    """Return name -> (n,) times and temperatures of rows that only hold readings, else NaN."""
    of_poses: dict[str, FloatArray] = {}
    for table, of_file, of_rows, beside in zip(tables, kinds, members, context, strict=True):
        if not beside:
            continue
        measuring = {
            int(row)
            for entry in of_file
            for row in entry.rows
            if len(of_rows[row]) == entry.kind.poses_per_row
        }
        for name, values in beside.items():
            for row, poses in enumerate(of_rows):
                if row in measuring or len(poses) != 1 or np.isnan(values[row]):
                    continue
                pose = of_poses.setdefault(name, np.full(n, np.nan))
                if not np.isnan(pose[poses[0]]) and pose[poses[0]] != values[row]:
                    sentence = f"column {name!r} has another value in an earlier row of this pose"
                    raise table.row_error(row, f"{sentence}; correct one")
                pose[poses[0]] = values[row]
    return of_poses


def load_instrument(path: str | Path, robot: Mechanism) -> Instrument:
    """Return the instrument of a measurement file, which measures every pose.

    Raises
    ------
    FileError : a value that does not fit, at its line; noise that the settings do not state.
    """
    table = read_table(path)
    return build_instrument(table, read_kinds(table, robot))


def load_instrument_to_plan(path: str | Path, robot: Mechanism) -> Instrument:
    """Return the instrument of a measurement file for planning poses.

    Raises
    ------
    FileError
        As `load_instrument`; or each group of rows has setup parameters of its own, such as a
        surface, which a choice of poses does not determine.
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
            is_surface = entry.kind.name in {"plane", "line"}
            code = "files.surfaces-in-plan" if is_surface else "files.groups-in-plan"
            raise table.settings.error(
                report_finding(code, kind=entry.kind.name, parameters=tuple(parameters)),
                entry.location,
            )
    return build_instrument(table, kinds)


def has_empty_readings(path: str | Path, robot: Mechanism) -> bool:
    """Return whether a sheet has columns of readings, all empty: they are to be measured."""
    table = read_table(path)
    columns = [actuator.name for actuator in robot.actuators if actuator.name in table.units]
    cells = (cell for name in columns for cell in table.text(name))
    return bool(columns and len(table)) and not any(cells)


def build_instrument(table: Table, kinds: Sequence[KindRows]) -> Instrument:
    """Return the instrument with the noise that the settings of a table state."""
    from loopcal.measure import Gaussian, Instrument, Sensor

    check_base_targets((table,), (kinds,))
    sensors = []
    for entry in kinds:
        for column in entry.kind.noise_columns:
            if column.name not in entry.noise:
                example = f"noise: {{{column.name}: {EXAMPLES[column.dimension]}}}"
                sentence = f"the settings state no noise of {column.name!r}; add '{example}'"
                raise table.settings.error(sentence, (*entry.location, "noise"))
        sigma = np.array([entry.noise[column.name] for column in entry.kind.noise_columns])
        sensors.append(Sensor(entry.kind, Gaussian(sigma)))
    return Instrument(tuple(sensors))
