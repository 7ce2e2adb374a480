# SPDX-License-Identifier: Apache-2.0
"""Measurement files: CSV rows of readings (or commanded coordinates) and measured values, settings
in front or beside.

    # kind: pose                                       see `loopcal.io.data.kind_settings`
    # noise: {rx: 5 urad, ry: 5 urad, rz: 5 urad, x: 1 um, y: 1 um, z: 1 um}
    pose,q1 [mm],..,q6 [mm],rx [mrad],..,z [mm]

Columns: `pose` (see `loopcal.io.data.pose_rows`), `block` (poses never to be split), `session` and
`group` (rows that share frames, or a surface), one for each actuator or `commanded.<coordinate>`,
those of the kind, `sigma.<noise column>` where noise differs from row to row, `cov.<a>.<b>` (unit
`[mm*mrad]`) where errors are correlated, `time` and `temperature` (see
`loopcal.io.data.context_columns`), `note..` for remarks. Several kinds in one file stand under
`kinds: {label: {kind: ..}}`, and a column `kind` holds the label. Settings: see
`loopcal.io.data.kind_rows.SETTINGS`.

Several files are one set of measurements, joined by the names of poses: one without a kind only
says where poses are, one without readings refers to poses of the others, and a pose in two files
has the same readings in both.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from loopcal.errors import DataError, FileError
from loopcal.io.core.csv_table import Table, read_table, require_columns
from loopcal.io.data.context_columns import read_context
from loopcal.io.data.kind_rows import (
    Sensor,
    measures,
    read_observations,
    read_poses_only,
    read_sensors,
)
from loopcal.io.data.nuisance_settings import read_known
from loopcal.io.data.pose_rows import dimension_of, read_pose_rows
from loopcal.io.robot.robot_file import check_format

if TYPE_CHECKING:
    import numpy as np

    from loopcal.measure import Measurements
    from loopcal.mechanism import Mechanism

FORMAT = 1
Paths = str | Path | Sequence[str | Path]


def load_measurements(
    path: Paths,
    robot: Mechanism,
    *,
    allow_outside_stroke: bool = False,
    allow_duplicates: bool = False,
    allow_still: bool = False,
    allow_implausible: bool = False,
) -> Measurements:
    """Read a measurement file, or several as one set of measurements.

    Parameters
    ----------
    path : str, Path or a sequence of them
        The CSV files; files that they name as `poses` are read, too.
    robot : Mechanism
        The robot that was measured; its actuators name the columns of the readings.
    allow_outside_stroke, allow_duplicates : bool
        Accept readings outside the stroke, and rows that repeat another to the last digit.
    allow_still, allow_implausible : bool
        Accept targets that no pose moves, and values that fit far better in another unit, order,
        sign or column; see `loopcal.calibrate.check_arrival`.

    Returns
    -------
    Measurements
        In SI.

    Raises
    ------
    FileError
        What does not fit, at its line.
    DataError
        Readings outside the stroke, duplicates, noise that is no covariance, conventions that
        cannot be; with the file.
    """
    from loopcal.diagnose import check_conventions
    from loopcal.measure import check_duplicates, check_strokes

    tables = _tables(path)
    (data, places), files = _gathered(tables, robot), _named(tables)
    try:
        check_strokes(data, robot, allow=allow_outside_stroke, override="--allow-outside-stroke")
        check_duplicates(data, allow=allow_duplicates, override="--allow-duplicates", places=places)
        overrides = ("--allow-still", "--allow-implausible")
        allow = {"allow_still": allow_still, "allow_implausible": allow_implausible}
        parts = [next(iter(rows), "").rpartition(":")[0] for rows in places]
        told = check_conventions(robot, data, **allow, overrides=overrides, parts=parts)
        if told.sentence:
            logging.getLogger(__name__).warning("%s: %s", files, told.sentence)
    except DataError as error:
        raise DataError(f"{files}: {error}") from None
    return data


def list_measurement_files(path: Paths) -> dict[str, Path]:
    """Return role -> file of all that `load_measurements` reads, those included that files name as
    `poses`.

    Files with measured values are called `data`, `data-2` and so on, files that only say where
    poses are `poses`.

    Raises
    ------
    FileError
        One of them cannot be read, or is given twice.
    """
    tables = _tables(path)
    found: dict[str, Path] = {}
    for table in tables:
        role = "data" if len(tables) == 1 or measures(table) else "poses"
        count = sum(name.partition("-")[0] == role for name in found)
        found[role if count == 0 else f"{role}-{count + 1}"] = table.path
    return found


def load_poses(path: str | Path, robot: Mechanism) -> np.ndarray:
    """Read commanded poses from a CSV file with one column for each controlled coordinate, with its
    unit.

    Returns
    -------
    ndarray
        (n, c) controlled coordinates [m, rad], in the robot's order.

    Raises
    ------
    FileError
        What does not fit, at its line.
    """
    import numpy as np

    table = read_table(path)
    require_columns(table, robot.controlled, f"is a coordinate of {robot.name}")
    return np.column_stack(
        [table.numbers(name, dimension_of(name), empty=False) for name in robot.controlled]
    )


def _tables(path: Paths) -> tuple[Table, ...]:
    """Read the files, and those that they name as files of poses."""
    given = [Path(one) for one in ([path] if isinstance(path, (str, Path)) else path)]
    if not given:
        raise DataError("there is no measurement file to read; name at least one")
    tables: list[Table] = []
    for one in given:
        table = read_table(one)
        if any(one.samefile(other.path) for other in tables):
            raise FileError("this file is given twice; name it once", one)
        if "format" in table.settings.content:
            check_format(table.settings, FORMAT)
        tables.append(table)
    for table in tuple(tables):
        named = table.settings.content.get("poses")
        if named is None:
            continue
        beside = table.path.parent / str(named)
        if not beside.is_file():
            raise table.settings.error(
                f"there is no file {beside}, which 'poses' names; correct the name", ("poses",)
            )
        if not any(beside.samefile(other.path) for other in tables):
            tables.append(read_table(beside))
    return tuple(tables)


def _gathered(
    tables: Sequence[Table], robot: Mechanism
) -> tuple[Measurements, tuple[tuple[str, ...], ...]]:
    """Return what the files hold together, and file and line of each row of each observations."""
    from loopcal.measure import Measurements

    sensors = [_sensors_of(table, robot, len(tables) > 1) for table in tables]
    if not any(sensors):
        raise FileError(
            "neither this file nor the others state a kind of measurement; write '# kind: ..'",
            tables[0].path,
        )
    poses = read_pose_rows(tables, robot)
    beside = [read_context(table) for table in tables]
    of_poses = _context_of_poses(tables, sensors, poses.members, beside, len(poses.labels))
    read = [
        [read_observations(table, robot, sensor, members, context, of_poses) for sensor in own]
        for table, own, members, context in zip(tables, sensors, poses.members, beside, strict=True)
    ]
    observations = [[rows for rows, _ in own] for own in read]
    every = tuple(rows for own in observations for rows in own)
    places = tuple(stands for own in read for _, stands in own)
    settings = [(table.settings, own) for table, own in zip(tables, observations, strict=True)]
    try:
        known = read_known(settings, poses.labels)
        return Measurements(
            robot.name, poses.readings, every, poses.block, poses.labels, poses.sigma, known
        ), places
    except DataError as error:
        raise DataError(f"{_named(tables)}: {error}") from None


def _named(tables: Sequence[Table]) -> str:
    """Return the names of files, for messages about all of them together."""
    return " and ".join(str(table.path) for table in tables)


def _sensors_of(table: Table, robot: Mechanism, several: bool) -> tuple[Sensor, ...]:
    """Return the kinds of a file; none of one that only says where poses are."""
    if several and not measures(table):
        read_poses_only(table, robot)
        return ()
    return read_sensors(table, robot)


def _context_of_poses(
    tables: Sequence[Table],
    sensors: Sequence[tuple[Sensor, ...]],
    members: Sequence[Sequence[tuple[int, ...]]],
    beside: Sequence[Mapping[str, np.ndarray]],
    n: int,
) -> dict[str, np.ndarray]:
    """Return name -> (n,) what stands beside rows that only say where a pose is, NaN for the other
    poses.
    """
    import numpy as np

    found: dict[str, np.ndarray] = {}
    for table, own, seen, context in zip(tables, sensors, members, beside, strict=True):
        measuring = {
            int(row)
            for sensor in own
            for row in sensor.rows
            if len(seen[row]) == sensor.kind.poses_per_row
        }
        for name, values in context.items():
            for row, poses in enumerate(seen):
                if row in measuring or len(poses) != 1 or np.isnan(values[row]):
                    continue
                there = found.setdefault(name, np.full(n, np.nan))
                if not np.isnan(there[poses[0]]) and there[poses[0]] != values[row]:
                    raise table.row_error(
                        row,
                        f"column {name!r} has another value here than where this pose stood "
                        "before; keep one",
                    )
                there[poses[0]] = values[row]
    return found
