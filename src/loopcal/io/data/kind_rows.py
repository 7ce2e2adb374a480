# SPDX-License-Identifier: Apache-2.0
"""The rows of each kind in one measurement file: which they are, what was measured, and how far it
is believed.
"""

from __future__ import annotations

import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from loopcal.errors import DataError, UnitError, suggest_names
from loopcal.io.core.csv_table import Table, meant, require_columns
from loopcal.io.core.yaml_file import Location, refuse_unknown_keys
from loopcal.io.data.context_columns import is_context
from loopcal.io.data.kind_settings import list_kind_settings, read_kind, read_noise
from loopcal.io.data.pose_rows import COMMANDED, OWN_COLUMNS, measured_name
from loopcal.units import EXAMPLES, find_unit

if TYPE_CHECKING:
    import numpy as np

    from loopcal.measure import Column, Kind, Observations
    from loopcal.mechanism import Mechanism

SIGMA, COVARIANCE = "sigma.", "cov."
SETTINGS: Mapping[str, str] = {
    "format": "1",
    "robot": "name of the robot; another than the one used is noted",
    "instrument": "what measured; information",
    "controller": "robot file of the geometry that turned commanded coordinates into readings; "
    "default: nominal",
    "kind": "the kind of all rows, followed by its own settings and noise",
    "kinds": "label -> kind, settings and noise, where a file holds several kinds",
    "noise": "standard deviation of each noise column, with its unit; by name or pattern, such as "
    '`"*.x": 5 um`',
    "unknowns": "name or pattern -> what is known of an unknown of the kinds: a prior, or that it "
    "is fixed",
    "session": "session of all rows that state none in their column",
    "group": "group of all rows that state none in their column",
    "reading_noise": "standard deviation of the readings, one for all or actuator -> one; default: "
    "as the robot file says",
    "poses": "another file, beside this one, that holds readings of the poses",
}
OF_POSES = ("format", "robot", "controller", "reading_noise")
"""Settings of a file that measures nothing."""


@dataclass(frozen=True)
class Sensor:
    """A kind in a file: its rows, and where its settings stand."""

    kind: Kind
    noise: dict[str, float]
    rows: np.ndarray
    location: Location


def measures(table: Table) -> bool:
    """Tell whether a file holds measured values; one that does not only says where poses are."""
    return any(key in table.settings.content for key in ("kind", "kinds"))


def read_sensors(table: Table, robot: Mechanism) -> tuple[Sensor, ...]:
    """Return the kinds of a file, mounted on the robot's tool, with the indices of their rows.

    Raises
    ------
    FileError
        Settings or columns that mean nothing here.
    """
    sensors = _sensors(table, robot)
    _refuse_unknown_columns(table, robot, sensors)
    return sensors


def read_poses_only(table: Table, robot: Mechanism) -> None:
    """Refuse what has no place in a file that only says where poses are.

    Raises
    ------
    FileError
        As `read_sensors`; the file states no kind and no readings either.
    """
    refuse_unknown_keys(table.settings, list(table.settings.content), OF_POSES)
    _refuse_unknown_columns(table, robot, ())


def read_observations(
    table: Table,
    robot: Mechanism,
    sensor: Sensor,
    members: Sequence[tuple[int, ...]],
    context: Mapping[str, np.ndarray],
    of_poses: Mapping[str, np.ndarray],
) -> tuple[Observations, tuple[str, ...]]:
    """Read the rows of one kind, and where each of them stands.

    Parameters
    ----------
    table, robot, sensor : the file, what was measured, and one of `read_sensors`.
    members : the poses that each row of the file saw.
    context : name -> (rows,) of the file. of_poses : name -> (n,) of the poses, for rows that say
        nothing themselves.

    Raises
    ------
    FileError
        What does not fit, at its line.
    DataError
        Noise that is no covariance; with the file.
    """
    import numpy as np

    from loopcal.measure import Observations

    chosen = _seen(table, sensor, members)
    measured, covariance = _values(table, robot, chosen)
    seen = np.array([members[row] for row in chosen.rows], dtype=np.intp).reshape(
        -1, chosen.kind.poses_per_row
    )
    beside = {}
    for name in dict.fromkeys([*context, *of_poses]):
        own = context[name][chosen.rows] if name in context else np.full(len(seen), np.nan)
        values = (
            np.where(np.isnan(own), of_poses[name][seen].mean(axis=1), own)
            if name in of_poses
            else own
        )
        if not np.isnan(values).all():
            beside[name] = values
    try:
        found = Observations(
            chosen.kind,
            seen[:, 0] if chosen.kind.poses_per_row == 1 else seen,
            measured,
            covariance,
            session=_texts(table, "session", chosen.rows),
            group=_texts(table, "group", chosen.rows),
            context=beside,
        )
    except DataError as error:
        raise DataError(f"{table.path}: {error}") from None
    return found, tuple(table.place(int(row)) for row in chosen.rows)


def _sensors(table: Table, robot: Mechanism) -> tuple[Sensor, ...]:
    """Return the kinds of the file, mounted on the robot's tool, with the indices of their rows."""
    import numpy as np

    file = table.settings
    content, several = file.content, file.content.get("kinds")
    if several is None:
        kind = read_kind(file, content, ()).with_tool(robot.tool)
        refuse_unknown_keys(file, list(content), [*SETTINGS, *list_kind_settings(type(kind))])
        return (Sensor(kind, read_noise(file, content, kind, ()), np.arange(len(table.rows)), ()),)
    refuse_unknown_keys(
        file, list(content), [key for key in SETTINGS if key not in ("kind", "noise")]
    )
    if not isinstance(several, dict) or not all(
        isinstance(node, dict) for node in several.values()
    ):
        raise file.error(
            "'kinds' must name each kind, as 'kinds: {height: {kind: component, ..}}'; correct it",
            ("kinds",),
        )
    require_columns(table, ["kind"], "says which of the kinds each row is")
    cells, sensors = np.array(table.text("kind")), []
    for row, cell in enumerate(cells):
        if cell and cell not in several:  # without a kind a row only says where a pose is
            raise table.row_error(
                row,
                f"{cell!r} is not one of the kinds of this file: {', '.join(several)}; correct it",
            )
    for label, node in several.items():
        location = ("kinds", label)
        kind = read_kind(file, node, location).with_tool(robot.tool)
        refuse_unknown_keys(
            file, list(node), ["kind", "noise", *list_kind_settings(type(kind))], location
        )
        sensors.append(
            Sensor(
                kind,
                read_noise(file, node, kind, location),
                np.flatnonzero(cells == label),
                location,
            )
        )
    return tuple(sensors)


def _refuse_unknown_columns(table: Table, robot: Mechanism, sensors: tuple[Sensor, ...]) -> None:
    """Refuse columns that mean nothing here."""
    known = {
        *OWN_COLUMNS,
        *(a.name for a in robot.actuators),
        *(SIGMA + a.name for a in robot.actuators),
    }
    known |= {COMMANDED + name for name in robot.controlled}
    for sensor in sensors:
        noise = [measured_name(column.name, robot) for column in sensor.kind.noise_columns]
        known |= {measured_name(column.name, robot) for column in sensor.kind.columns} | {
            SIGMA + name for name in noise
        }
        known |= {f"{COVARIANCE}{a}.{b}" for a in noise for b in noise if a != b}
    why = (
        ""
        if sensors
        else " (this file states no kind of measurement, so that it only says where poses are)"
    )
    for name in table.names:
        if name not in known and not is_context(name) and not name.startswith("note"):
            hint = meant(name, table.units[name], {*known, *OWN_COLUMNS}) or suggest_names(
                name, known
            )
            hint = hint or f"; columns of this file can be {', '.join(sorted(known))}"
            raise table.header_error(
                f"column {name!r} is unknown{hint}; correct it, or call it 'note {name}' to ignore "
                f"it{why}"
            )


def _seen(table: Table, sensor: Sensor, members: Sequence[tuple[int, ...]]) -> Sensor:
    """Return the sensor with those of its rows that measure: for a kind that compares poses, not
    those that name one.
    """
    links = sensor.kind.poses_per_row
    if links > 1 and "kind" not in table.units:
        sensor = replace(sensor, rows=sensor.rows[[len(members[row]) > 1 for row in sensor.rows]])
    for row in sensor.rows:
        found = len(members[row])
        if found != links:
            sentence = f"this row names {found} poses, but the kind {sensor.kind.name!r} sees {links}; correct the names"
            raise table.row_error(int(row), sentence)
    return sensor


def _values(table: Table, robot: Mechanism, sensor: Sensor) -> tuple[np.ndarray, np.ndarray]:
    """Return measured values (r, c) and the covariance (r, m, m) of their residuals [SI]."""
    import numpy as np

    kind, rows = sensor.kind, sensor.rows
    columns = {measured_name(column.name, robot): column.dimension for column in kind.columns}
    require_columns(table, list(columns), f"belongs to the kind {kind.name!r}")
    measured = np.column_stack(
        [table.numbers(name, dimension) for name, dimension in columns.items()]
    )[rows]
    for i, doubt in kind.find_invalid_rows(measured):
        raise table.row_error(int(rows[i]), f"this row {doubt}")
    # where the noise columns are the measured ones, what was not measured needs no sigma
    absent = (
        np.isnan(measured)
        if kind.noise_columns == kind.columns
        else np.zeros((len(rows), len(kind.noise_columns)), bool)
    )
    sigma = np.column_stack(
        [_sigma(table, robot, sensor, i, absent[:, i]) for i in range(len(kind.noise_columns))]
    )
    covariance = sigma[:, :, None] * np.eye(sigma.shape[1]) * sigma[:, None, :]
    for a, left in enumerate(kind.noise_columns):
        for b, right in enumerate(kind.noise_columns):
            name = (
                f"{COVARIANCE}{measured_name(left.name, robot)}.{measured_name(right.name, robot)}"
            )
            if name in table.units:
                covariance[:, a, b] = covariance[:, b, a] = _products(table, name, left, right)[
                    rows
                ]
    N = kind.linearize_noise(measured)
    return measured, N @ covariance @ np.swapaxes(N, -1, -2)


def _texts(table: Table, name: str, rows: np.ndarray) -> np.ndarray:
    """Return the sessions or groups (r,) of rows: of their cells, else of the setting, else without
    a name.
    """
    import numpy as np

    stated = table.settings.content.get(name, "")
    if isinstance(stated, (dict, list)):
        raise table.settings.error(
            f"{name!r} names the {name} of all rows; write a name or a number", (name,)
        )
    usual = str(stated if stated is not None else "").strip()
    cells = table.text(name) if name in table.units else ("",) * len(table.rows)
    return np.array(
        [unicodedata.normalize("NFC", cells[row] or usual) for row in rows], dtype=np.str_
    )


def _sigma(
    table: Table, robot: Mechanism, sensor: Sensor, place: int, absent: np.ndarray
) -> np.ndarray:
    """Return the standard deviations (r,) [SI] of one noise column: from its sigma column, else
    from the settings.

    An empty cell of a value that is `absent` (r,) gets the sigma of another row, which counts for
    nothing.
    """
    import numpy as np

    column = sensor.kind.noise_columns[place]
    name = SIGMA + measured_name(column.name, robot)
    if name in table.units:
        found = table.numbers(name, column.dimension)[sensor.rows]
        sigma = np.where(np.isnan(found), sensor.noise.get(column.name, np.nan), found)
        if (stated := sigma[sigma > 0]).size:
            sigma = np.where(absent & np.isnan(sigma), stated[0], sigma)
        for i in np.flatnonzero(~(sigma > 0)):
            sentence = f"column {name!r} holds no number above zero; write a standard deviation"
            raise table.row_error(int(sensor.rows[i]), sentence)
        return sigma
    if column.name not in sensor.noise:
        raise table.settings.error(
            f"no noise is stated for {column.name!r}, and without it rows cannot be weighed; add "
            "'noise: "
            f"{{{column.name}: {EXAMPLES[column.dimension]}}}' to the settings, or a column "
            f"{name!r} (not known: a guess, "
            "and calibrate with --noise estimated)",
            (*sensor.location, "noise"),
        )
    return np.full(len(sensor.rows), sensor.noise[column.name])


def _products(table: Table, name: str, left: Column, right: Column) -> np.ndarray:
    """Return a covariance column (rows,) [SI]; its unit is written `[mm*mrad]`."""
    import numpy as np

    symbols = (table.units[name] or "").split("*")
    if len(symbols) != 2:
        raise table.header_error(
            f"column {name!r} needs two units, as in '{name} [mm*mrad]'; write them"
        )
    factor = 1.0
    for symbol, column in zip(symbols, (left, right), strict=True):
        try:
            factor *= find_unit(symbol.strip(), column.dimension).factor_to_si
        except UnitError as error:
            raise table.header_error(f"column {name!r}: {error}") from None
    return (
        np.array(
            [table.number(name, i, cell, empty=False) for i, cell in enumerate(table.text(name))]
        )
        * factor
    )
