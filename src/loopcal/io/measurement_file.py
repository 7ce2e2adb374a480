# SPDX-License-Identifier: Apache-2.0
"""Measurement files: CSV rows of readings (or commanded coordinates) and measured values, settings in front or beside.

    # kind: pose                                       see `loopcal.io.sensor_settings`
    # noise: {rx: 5 urad, ry: 5 urad, rz: 5 urad, x: 1 um, y: 1 um, z: 1 um}
    pose,q1 [mm],..,q6 [mm],rx [mrad],..,z [mm]

Columns: `pose` (a name; rows of one name saw one pose), `block` (poses never to be split), one for each actuator or
`commanded.<coordinate>`, those of the kind, `sigma.<noise column>` where noise differs from row to row,
`cov.<a>.<b>` (unit `[mm*mrad]`) where errors are correlated, `note..` for remarks. Several kinds in one file stand
under `kinds: {label: {kind: ..}}`, and a column `kind` holds the label. Settings: see SETTINGS.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from loopcal.errors import DataError, UnitError, nearest
from loopcal.io.csv_table import Table, read_table, require_columns
from loopcal.io.robot_file import check_format, load_robot
from loopcal.io.sensor_settings import kind_settings, read_kind, read_noise
from loopcal.io.yaml_file import Location, refuse_unknown_keys
from loopcal.units import EXAMPLES, unit

if TYPE_CHECKING:
    import numpy as np

    from loopcal.measure import Kind, Measurements
    from loopcal.mechanism import Mechanism

FORMAT = 1
COMMANDED, SIGMA, COVARIANCE = "commanded.", "sigma.", "cov."
SETTINGS: Mapping[str, str] = {
    "format": "1",
    "robot": "name of the robot; information",
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
    labels, pose = _groups(table, "pose")
    first = np.array([int(np.flatnonzero(pose == i)[0]) for i in range(len(labels))])
    try:
        readings = _readings(table, robot, labels, pose, first)
        observations = []
        for sensor in sensors:
            measured, covariance = _values(table, sensor)
            observations.append(Observations(sensor.kind, pose[sensor.rows], measured, covariance))
        block = _groups(table, "block")[1][first] if "block" in table.units else np.arange(len(labels))
        data = Measurements(robot.name, readings, tuple(observations), block, labels)
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


def dimension_of(coordinate: str) -> Any:
    """Return what a controlled coordinate measures: x, y, z lengths, the others angles."""
    from loopcal.units import Dimension

    return Dimension.LENGTH if coordinate in ("x", "y", "z") else Dimension.ANGLE


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
        if cell not in several:
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
        known |= {column.name for column in sensor.kind.columns} | {SIGMA + name for name in noise}
        known |= {f"{COVARIANCE}{a}.{b}" for a in noise for b in noise if a != b}
    for name in table.names:
        if name not in known and not name.startswith("note"):
            hint = nearest(name, known) or f"; columns of this file can be {', '.join(sorted(known))}"
            raise table.header_error(f"column {name!r} is unknown{hint}; correct it, or call it 'note {name}' to ignore it")


def _groups(table: Table, column: str) -> tuple[tuple[str, ...], np.ndarray]:
    """Return the distinct texts of a column in order, and (rows,) which of them each row has; without it, row by row."""
    import numpy as np

    if column not in table.units:
        return tuple(str(i + 1) for i in range(len(table.rows))), np.arange(len(table.rows))
    places: dict[str, int] = {}
    for row, cell in enumerate(table.text(column)):
        if not cell:
            raise table.row_error(row, f"column {column!r} is empty, but every row needs it; write a name or a number")
        places.setdefault(cell, len(places))
    return tuple(places), np.array([places[cell] for cell in table.text(column)])


def _readings(table: Table, robot: Mechanism, labels: tuple[str, ...], pose: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Return (n, a) readings of the poses, from their columns or from commanded coordinates."""
    import numpy as np

    from loopcal.measure import readings_from_commanded

    commanded = [name for name in table.names if name.startswith(COMMANDED)]
    read = [a.name for a in robot.actuators if a.name in table.units]
    if commanded and read:
        raise table.header_error(
            f"there are readings ({read[0]!r}) and commanded coordinates ({commanded[0]!r}); keep one kind"
        )
    controller = _controller(table, robot) if commanded else None
    if controller is not None:
        dimensions = {COMMANDED + name: dimension_of(name) for name in controller.controlled}
        require_columns(table, list(dimensions), f"is a coordinate that {controller.name} is commanded in")
    else:
        dimensions = {actuator.name: actuator.dimension for actuator in robot.actuators}
        require_columns(table, list(dimensions), f"is the reading of an actuator of {robot.name}")
    rows = np.column_stack([table.numbers(name, dimension, empty=False) for name, dimension in dimensions.items()])
    differs = np.flatnonzero((rows != rows[first[pose]]).any(axis=1))
    if len(differs):
        row = int(differs[0])
        line = table.lines[first[pose[row]]]
        raise table.row_error(row, f"pose {labels[pose[row]]!r} has other readings here than in line {line}; name it anew")
    if controller is not None:
        return readings_from_commanded(controller, rows[first], labels)
    return rows[first]


def _controller(table: Table, robot: Mechanism) -> Mechanism:
    """Return the robot whose geometry turned commanded coordinates into readings."""
    name = table.settings.content.get("controller")
    if name is None:
        return robot.nominal
    beside = table.path.parent / str(name)
    return load_robot(beside if beside.exists() else str(name))


def _values(table: Table, sensor: _Sensor) -> tuple[np.ndarray, np.ndarray]:
    """Return measured values (r, c) and the covariance (r, m, m) of their residuals [SI]."""
    import numpy as np

    kind, rows = sensor.kind, sensor.rows
    require_columns(table, [column.name for column in kind.columns], f"belongs to the kind {kind.name!r}")
    measured = np.column_stack([table.numbers(column.name, column.dimension) for column in kind.columns])[rows]
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
