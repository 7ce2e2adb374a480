# SPDX-License-Identifier: Apache-2.0
"""Measurement files: CSV rows of readings (or commanded coordinates) and measured values, settings in front or beside.

    # kind: pose                                       see `loopcal.io.sensor_settings`
    # noise: {rx: 5 urad, ry: 5 urad, rz: 5 urad, x: 1 um, y: 1 um, z: 1 um}
    pose,q1 [mm],..,q6 [mm],rx [mrad],..,z [mm]

Columns: `pose` (see `loopcal.io.pose_rows`), `block` (poses never to be split), one for each actuator or
`commanded.<coordinate>`, those of the kind, `sigma.<noise column>` where noise differs from row to row,
`cov.<a>.<b>` (unit `[mm*mrad]`) where errors are correlated, `note..` for remarks. Several kinds in one file stand
under `kinds: {label: {kind: ..}}`, and a column `kind` holds the label. Settings: see SETTINGS.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from loopcal.errors import DataError, UnitError, nearest
from loopcal.io.csv_table import Table, read_table, require_columns
from loopcal.io.pose_rows import COMMANDED, PoseRows, dimension_of, measured_name, read_pose_rows
from loopcal.io.robot_file import check_format
from loopcal.io.sensor_settings import kind_settings, read_kind, read_noise
from loopcal.io.yaml_file import Location, refuse_unknown_keys
from loopcal.units import EXAMPLES, unit

if TYPE_CHECKING:
    import numpy as np

    from loopcal.measure import Kind, Measurements
    from loopcal.mechanism import Mechanism

FORMAT = 1
SIGMA, COVARIANCE = "sigma.", "cov."
SETTINGS: Mapping[str, str] = {
    "format": "1",
    "robot": "name of the robot; another than the one used is noted",
    "instrument": "what measured; information",
    "controller": "robot file of the geometry that turned commanded coordinates into readings; default: nominal",
    "kind": "the kind of all rows, followed by its own settings and noise",
    "kinds": "label -> kind, settings and noise, where a file holds several kinds",
    "noise": "standard deviation of each noise column, with its unit",
}


@dataclass(frozen=True)
class _Sensor:
    """A kind in a file: its rows, and where its settings stand."""

    kind: Kind
    noise: dict[str, float]
    rows: np.ndarray
    location: Location


def load_measurements(
    path: str | Path, robot: Mechanism, *, allow_outside_stroke: bool = False, allow_duplicates: bool = False
) -> Measurements:
    """Read a measurement file.

    Parameters
    ----------
    path : str or Path
        The CSV file.
    robot : Mechanism
        The robot that was measured; its actuators name the columns of the readings.
    allow_outside_stroke, allow_duplicates : bool
        Accept readings outside the stroke, and rows that repeat another to the last digit.

    Returns
    -------
    Measurements
        In SI.

    Raises
    ------
    FileError
        What does not fit, at its line.
    DataError
        Readings outside the stroke, duplicates, noise that is no covariance; with the file.
    """
    import numpy as np

    from loopcal.measure import Measurements, Observations, check_duplicates, check_strokes

    table = read_table(path)
    if "format" in table.settings.content:
        check_format(table.settings, FORMAT)
    sensors = _sensors(table, robot)
    _refuse_unknown_columns(table, robot, sensors)
    try:
        poses = read_pose_rows(table, robot)
        observations = []
        for sensor in sensors:
            chosen = _seen(table, sensor, poses)
            measured, covariance = _values(table, robot, chosen)
            seen = np.array([poses.members[row] for row in chosen.rows], dtype=np.intp).reshape(-1, chosen.kind.links)
            seen = seen[:, 0] if chosen.kind.links == 1 else seen
            observations.append(Observations(chosen.kind, seen, measured, covariance))
        data = Measurements(robot.name, poses.readings, tuple(observations), poses.block, poses.labels)
        check_strokes(data, robot, allow=allow_outside_stroke, override="--allow-outside-stroke")
        check_duplicates(data, allow=allow_duplicates, override="--allow-duplicates")
    except DataError as error:
        raise DataError(f"{table.path}: {error}") from None
    return data


def load_poses(path: str | Path, robot: Mechanism) -> np.ndarray:
    """Read commanded poses from a CSV file with one column for each controlled coordinate, with its unit.

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
    return np.column_stack([table.numbers(name, dimension_of(name), empty=False) for name in robot.controlled])


def _sensors(table: Table, robot: Mechanism) -> tuple[_Sensor, ...]:
    """Return the kinds of the file, mounted on the robot's tool, with the indices of their rows."""
    import numpy as np

    file = table.settings
    content, several = file.content, file.content.get("kinds")
    if several is None:
        kind = read_kind(file, content, ()).mounted(robot.tool)
        refuse_unknown_keys(file, list(content), [*SETTINGS, *kind_settings(type(kind))])
        return (_Sensor(kind, read_noise(file, content, kind, ()), np.arange(len(table.rows)), ()),)
    refuse_unknown_keys(file, list(content), [key for key in SETTINGS if key not in ("kind", "noise")])
    if not isinstance(several, dict) or not all(isinstance(node, dict) for node in several.values()):
        raise file.error("'kinds' must name each kind, as 'kinds: {height: {kind: component, ..}}'; correct it", ("kinds",))
    require_columns(table, ["kind"], "says which of the kinds each row is")
    cells, sensors = np.array(table.text("kind")), []
    for row, cell in enumerate(cells):
        if cell and cell not in several:  # without a kind a row only says where a pose is
            raise table.row_error(row, f"{cell!r} is not one of the kinds of this file: {', '.join(several)}; correct it")
    for label, node in several.items():
        location = ("kinds", label)
        kind = read_kind(file, node, location).mounted(robot.tool)
        refuse_unknown_keys(file, list(node), ["kind", "noise", *kind_settings(type(kind))], location)
        sensors.append(_Sensor(kind, read_noise(file, node, kind, location), np.flatnonzero(cells == label), location))
    return tuple(sensors)


def _refuse_unknown_columns(table: Table, robot: Mechanism, sensors: tuple[_Sensor, ...]) -> None:
    """Refuse columns that mean nothing here."""
    known = {"pose", "block", "kind", *(a.name for a in robot.actuators)}
    known |= {COMMANDED + name for name in robot.controlled}
    for sensor in sensors:
        noise = [column.name for column in sensor.kind.noise_columns]
        known |= {measured_name(column.name, robot) for column in sensor.kind.columns} | {SIGMA + name for name in noise}
        known |= {f"{COVARIANCE}{a}.{b}" for a in noise for b in noise if a != b}
    for name in table.names:
        if name not in known and not name.startswith("note"):
            hint = nearest(name, known) or f"; columns of this file can be {', '.join(sorted(known))}"
            raise table.header_error(f"column {name!r} is unknown{hint}; correct it, or call it 'note {name}' to ignore it")


def _seen(table: Table, sensor: _Sensor, poses: PoseRows) -> _Sensor:
    """Return the sensor with those of its rows that measure: for a kind that compares poses, not those that name one."""
    links = sensor.kind.links
    if links > 1 and "kind" not in table.units:
        sensor = replace(sensor, rows=sensor.rows[[len(poses.members[row]) > 1 for row in sensor.rows]])
    for row in sensor.rows:
        found = len(poses.members[row])
        if found != links:
            sentence = f"this row names {found} poses, but the kind {sensor.kind.name!r} sees {links}; correct the names"
            raise table.row_error(int(row), sentence)
    return sensor


def _values(table: Table, robot: Mechanism, sensor: _Sensor) -> tuple[np.ndarray, np.ndarray]:
    """Return measured values (r, c) and the covariance (r, m, m) of their residuals [SI]."""
    import numpy as np

    kind, rows = sensor.kind, sensor.rows
    columns = {measured_name(column.name, robot): column.dimension for column in kind.columns}
    require_columns(table, list(columns), f"belongs to the kind {kind.name!r}")
    measured = np.column_stack([table.numbers(name, dimension) for name, dimension in columns.items()])[rows]
    for i, doubt in kind.doubts(measured):
        raise table.row_error(int(rows[i]), f"this row {doubt}")
    sigma = np.column_stack([_sigma(table, sensor, i) for i in range(len(kind.noise_columns))])
    covariance = sigma[:, :, None] * np.eye(sigma.shape[1]) * sigma[:, None, :]
    for a, left in enumerate(kind.noise_columns):
        for b, right in enumerate(kind.noise_columns):
            name = f"{COVARIANCE}{left.name}.{right.name}"
            if name in table.units:
                covariance[:, a, b] = covariance[:, b, a] = _products(table, name, left, right)[rows]
    N = kind.noise_map(measured)
    return measured, N @ covariance @ np.swapaxes(N, -1, -2)


def _sigma(table: Table, sensor: _Sensor, place: int) -> np.ndarray:
    """Return the standard deviations (r,) [SI] of one noise column: from its sigma column, else from the settings."""
    import numpy as np

    column = sensor.kind.noise_columns[place]
    name = SIGMA + column.name
    if name in table.units:
        found = table.numbers(name, column.dimension)[sensor.rows]
        sigma = np.where(np.isnan(found), sensor.noise.get(column.name, np.nan), found)
        for i in np.flatnonzero(~(sigma > 0)):
            sentence = f"column {name!r} holds no number above zero; write a standard deviation"
            raise table.row_error(int(sensor.rows[i]), sentence)
        return sigma
    if column.name not in sensor.noise:
        raise table.settings.error(
            f"no noise is stated for {column.name!r}, and without it rows cannot be weighed; add 'noise: "
            f"{{{column.name}: {EXAMPLES[column.dimension]}}}' to the settings, or a column {name!r} (not known: a guess, "
            "and calibrate with --noise estimated)",
            (*sensor.location, "noise"),
        )
    return np.full(len(sensor.rows), sensor.noise[column.name])


def _products(table: Table, name: str, left: Any, right: Any) -> np.ndarray:
    """Return a covariance column (rows,) [SI]; its unit is written `[mm*mrad]`."""
    import numpy as np

    symbols = (table.units[name] or "").split("*")
    if len(symbols) != 2:
        raise table.header_error(f"column {name!r} needs two units, as in '{name} [mm*mrad]'; write them")
    factor = 1.0
    for symbol, column in zip(symbols, (left, right), strict=True):
        try:
            factor *= unit(symbol.strip(), column.dimension).factor_to_si
        except UnitError as error:
            raise table.header_error(f"column {name!r}: {error}") from None
    return np.array([table.number(name, i, cell, empty=False) for i, cell in enumerate(table.text(name))]) * factor
