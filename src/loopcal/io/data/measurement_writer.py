# SPDX-License-Identifier: Apache-2.0
"""Writing measurement files and templates of them; what is read by
`loopcal.io.data.measurement_file`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from loopcal.errors import DataError
from loopcal.io.core.csv_table import quoted
from loopcal.io.core.numbers import exactly, shortest
from loopcal.io.core.text_file import write_text
from loopcal.io.data.context_columns import context_header
from loopcal.io.data.kind_rows import COVARIANCE, SIGMA
from loopcal.io.data.kind_settings import SYMBOLS, quantity_text, write_sensor
from loopcal.io.data.measurement_file import FORMAT
from loopcal.io.data.nuisance_settings import known_text
from loopcal.io.data.pose_rows import LINK, measured_name
from loopcal.units import Dimension, find_unit

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import ArrayLike

    from loopcal.measure import Column, Instrument, Kind, Measurements, Observations
    from loopcal.mechanism import Mechanism

EQUAL = 1e-9
"""Relative difference up to which standard deviations of all rows are one number, and a correlation
is none [1].
"""

ADDED = (
    (
        "# Below come the rows, one line for each: a name of the pose, readings, measured values; "
        "empty where not measured."
    ),
    (
        "# Columns that may be added: block, session, group, time, temperature [degC], sigma.NAME, "
        "note; see docs/files.md."
    ),
)
"""What a template says below its header."""

COMPARED = (
    (
        f"# A row of the kind {{}} compares two poses: it names them in the column pose as "
        f"a{LINK}b, "
        "and leaves readings empty;"
    ),
    (
        "# each of these poses has a row of its own with its readings, in which the measured value "
        "is "
        "empty."
    ),
)
"""What a template says of kinds that compare poses."""


def save_measurements(
    data: Measurements, path: str | Path, robot: Mechanism, remark: str = ""
) -> None:
    """Write measurements as a CSV file that `load_measurements` reads back.

    Parameters
    ----------
    data : Measurements
    path : str or Path
        Written whole or not at all.
    robot : Mechanism
        Names the readings.
    remark : str
        One line for people, at the top.

    Raises
    ------
    FileError
        The file cannot be written.
    DataError
        A name that a file cannot hold.
    """
    write_text(path, format_measurements(data, robot, remark))


def format_measurements(data: Measurements, robot: Mechanism, remark: str = "") -> str:
    """Return the text of a measurement file; see `save_measurements`."""
    names = _kind_labels([rows.kind for rows in data.observations])
    parts = [_Part(name, rows, robot) for name, rows in zip(names, data.observations, strict=True)]
    _refuse_names(data)
    readings = _Readings(data, robot)
    told = {
        int(pose[0])
        for part in parts
        if part.rows.kind.poses_per_row == 1
        for pose, _ in part.cells()
    }
    untold = [pose for pose in range(data.n_poses) if pose not in told]
    lines = _settings(robot, [(part.label, part.rows.kind, part.common) for part in parts], remark)
    known = known_text(data.stated_values, data.nuisance_parameters.table.entries)
    lines += [
        f"# {key}: {text}"
        for key, text in (("unknowns", known), ("reading_noise", readings.common))
        if text
    ]
    columns = {"pose": "pose"} | (
        {"block": "block"} if len(set(data.block.tolist())) < data.n_poses else {}
    )
    columns |= {
        name: name
        for name in ("session", "group")
        if any((getattr(part.rows, name) != "").any() for part in parts)
    }
    columns |= ({"kind": "kind"} if len(parts) > 1 else {}) | readings.headers
    columns |= {name: context_header(name) for part in parts for name in part.rows.context}
    for part in parts:
        columns |= part.headers
    lines.append(",".join(columns.values()))
    rows = [((pose,), {}) for pose in untold]  # poses that no row of their own measures
    rows += [
        (seen, {"kind": part.label, **values}) for part in parts for seen, values in part.cells()
    ]
    for seen, values in rows:
        cells = {"pose": quoted(LINK.join(data.labels[pose] for pose in seen)), **values}
        if len(seen) == 1:
            cells |= {"block": str(int(data.block[seen[0]])), **readings.cells(seen[0])}
        lines.append(",".join(cells.get(name, "") for name in columns))
    return "\n".join(lines) + "\n"


def format_template(robot: Mechanism, instrument: Instrument) -> str:
    """Return settings and header of a measurement file, to be filled in by hand.

    Parameters
    ----------
    robot : Mechanism
        Its actuators become columns.
    instrument : Instrument
        Its kinds become columns, its noise a setting.
    """
    sensors = _stated(instrument)
    units = {a.name: _unit(robot, a.dimension)[0] for a in robot.actuators}
    compared = [
        line.format(label)
        for label, kind, _ in sensors
        if kind.poses_per_row > 1
        for line in COMPARED
    ]
    header = ",".join(_template_columns(robot, sensors, units))
    return "\n".join([*_settings(robot, sensors, ""), header, *ADDED, *compared]) + "\n"


def format_data_sheet(
    robot: Mechanism, instrument: Instrument, readings: ArrayLike, labels: Sequence[str] = ()
) -> str:
    """Return a measurement file whose poses are stated and whose measured values are to be filled
    in.

    Parameters
    ----------
    robot : Mechanism
        Its actuators become columns.
    instrument : Instrument
        Says which kind sees which poses, in which session and group.
    readings : (n, a) [SI]
        Of the poses to be measured.
    labels : sequence of str, optional
        Names of the poses; default "1", "2", ...

    Raises
    ------
    DataError
        The instrument sees a pose that is not there, or there is not one name for each pose.
    """
    import numpy as np

    from loopcal.measure import Measurements, Observations

    mounted = instrument.with_tool(robot)
    looks = [sensor.assign_rows(len(np.asarray(readings))) for sensor in mounted.sensors]
    empty = [
        np.full((len(one.rows if one.rows is not None else ()), len(one.kind.columns)), np.nan)
        for one in looks
    ]
    rows = [
        Observations.from_sigma(one.kind, one.rows, values, one.noise.sigma, one.session, one.group)
        for one, values in zip(looks, empty, strict=True)
        if one.rows is not None
    ]
    return format_measurements(
        Measurements(robot.name, np.asarray(readings), tuple(rows), labels=tuple(labels)), robot
    )


def _stated(instrument: Instrument) -> list[tuple[str, Kind, dict[str, float]]]:
    """Return label, kind and noise of each sensor."""
    names = _kind_labels([sensor.kind for sensor in instrument.sensors])
    return [
        (
            name,
            s.kind,
            dict(zip((c.name for c in s.kind.noise_columns), s.noise.sigma.tolist(), strict=True)),
        )
        for name, s in zip(names, instrument.sensors, strict=True)
    ]


def _kind_labels(kinds: Sequence[Kind]) -> list[str]:
    """Return what a file calls its kinds: by name, with a number where there are several of that
    name.
    """
    names = [kind.name for kind in kinds]
    return [
        name if names.count(name) == 1 else f"{name}-{names[: i + 1].count(name)}"
        for i, name in enumerate(names)
    ]


def _template_columns(
    robot: Mechanism,
    sensors: Sequence[tuple[str, Kind, Mapping[str, float]]],
    units: Mapping[str, str],
) -> list[str]:
    """Return the headers of poses, readings and measured values."""
    columns = [
        "pose",
        *(["kind"] if len(sensors) > 1 else []),
        *(f"{name} [{symbol}]" for name, symbol in units.items()),
    ]
    for _, kind, _ in sensors:
        names = [measured_name(column.name, robot) for column in kind.columns]
        columns += [
            header for header in _headers(names, kind.columns).values() if header not in columns
        ]
    return columns


def _refuse_names(data: Measurements) -> None:
    """Refuse names of poses, sessions and groups that a file cannot hold; DataError."""
    sets = {"pose": data.labels}
    for name in ("session", "group"):
        sets[name] = tuple(
            text for rows in data.observations for text in set(getattr(rows, name).tolist())
        )
    for what, names in sets.items():
        for name in names:
            broken = any(ord(c) < 32 for c in name) or name != name.strip()
            if broken or (what == "pose" and (not name or LINK in name)):
                has = f"the {what} {name!r} cannot be written: names of poses are not empty, and hold no {LINK!r}"
                raise DataError(
                    f"{has}; no name begins or ends with a blank or holds a line break; rename it"
                )
    if len(set(data.labels)) < len(data.labels):
        again = next(name for name in data.labels if data.labels.count(name) > 1)
        raise DataError(
            f"two poses are called {again!r}, and a file tells poses by their names; rename one"
        )


class _Readings:
    """Readings and how far they are believed: one number for all poses in the settings, the rest in
    columns.
    """

    def __init__(self, data: Measurements, robot: Mechanism) -> None:
        import numpy as np

        self.data = data
        self.units = {a.name: _unit(robot, a.dimension) for a in robot.actuators}
        self.own: list[int] = []
        self.common = ""
        if data.reading_sigma is None:
            return
        said = []
        for i, actuator in enumerate(robot.actuators):
            values = np.unique(data.reading_sigma[~np.isnan(data.readings[:, i]), i])
            if len(values) == 1 and np.isfinite(values[0]):
                said.append(
                    f"{actuator.name}: "
                    f"{quantity_text(float(values[0]), SYMBOLS[actuator.dimension])}"
                )
            elif len(values):
                self.own.append(i)
        self.common = f"{{{', '.join(said)}}}"

    @property
    def headers(self) -> dict[str, str]:
        """Column -> header."""
        found = {name: f"{name} [{symbol}]" for name, (symbol, _) in self.units.items()}
        names = list(self.units)
        return found | {
            SIGMA + names[i]: f"{SIGMA}{names[i]} [{self.units[names[i]][0]}]" for i in self.own
        }

    def cells(self, pose: int) -> dict[str, str]:
        """Cells of a row that has readings of its own."""
        cells = {}
        for i, (name, (_, factor)) in enumerate(self.units.items()):
            reading = float(self.data.readings[pose, i])
            cells[name] = "" if math.isnan(reading) else exactly(reading, factor)
            if i in self.own and self.data.reading_sigma is not None and not math.isnan(reading):
                sigma = float(self.data.reading_sigma[pose, i])
                cells[SIGMA + name] = "inf" if math.isinf(sigma) else exactly(sigma, factor)
        return cells


class _Part:
    """Rows of one kind with their noise: `common` in the settings, the rest in columns of their
    own.
    """

    def __init__(self, label: str, rows: Observations, robot: Mechanism) -> None:
        import numpy as np

        self.label, self.rows = label, rows
        self.names = [measured_name(column.name, robot) for column in rows.kind.columns]
        self.noise = [measured_name(column.name, robot) for column in rows.kind.noise_columns]
        N = rows.kind.linearize_noise(rows.measured)
        half = np.linalg.solve(N, rows.covariance)
        self.covariance = np.linalg.solve(N, np.swapaxes(half, -1, -2))
        self.sigma = np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))
        columns = rows.kind.noise_columns
        alike = np.all(
            np.abs(self.sigma - self.sigma[:1]) <= EQUAL * self.sigma[:1], axis=0
        ).tolist()
        self.common = {c.name: float(self.sigma[0, i]) for i, c in enumerate(columns) if alike[i]}
        self.own = [i for i, c in enumerate(columns) if not alike[i]]
        scale = self.sigma[:, :, None] * self.sigma[:, None, :]
        related = np.any(np.abs(self.covariance) > EQUAL * scale, axis=0).tolist()
        self.pairs = [(a, b) for a in range(len(columns)) for b in range(a) if related[a][b]]

    @property
    def headers(self) -> Mapping[str, str]:
        """Column -> header of the measured values and of noise that differs from row to row."""
        noise = self.rows.kind.noise_columns
        found = dict(_headers(self.names, self.rows.kind.columns))
        for i in self.own:
            found[SIGMA + self.noise[i]] = (
                f"{SIGMA}{self.noise[i]} [{SYMBOLS[noise[i].dimension][0]}]"
            )
        for a, b in self.pairs:
            units = f"{SYMBOLS[noise[a].dimension][0]}*{SYMBOLS[noise[b].dimension][0]}"
            name = f"{COVARIANCE}{self.noise[a]}.{self.noise[b]}"
            found[name] = f"{name} [{units}]"
        return found

    def cells(self) -> Iterator[tuple[tuple[int, ...], dict[str, str]]]:
        """Yield the poses and the cells of each row that counts; a row of weight 0 is not written."""
        import numpy as np

        kind, noise = self.rows.kind, self.rows.kind.noise_columns
        for i, poses in enumerate(self.rows.rows):
            if self.rows.weight[i] == 0.0:
                continue
            values = zip(self.names, kind.columns, self.rows.measured[i], strict=True)
            cells = {name: _cell(value, column.dimension) for name, column, value in values}
            cells |= {
                "session": quoted(str(self.rows.session[i])),
                "group": quoted(str(self.rows.group[i])),
            }
            cells |= {name: _plain(v[i]) for name, v in self.rows.context.items()}
            for k in self.own:
                cells[SIGMA + self.noise[k]] = _cell(self.sigma[i, k], noise[k].dimension)
            for a, b in self.pairs:
                factor = SYMBOLS[noise[a].dimension][1] * SYMBOLS[noise[b].dimension][1]
                cells[f"{COVARIANCE}{self.noise[a]}.{self.noise[b]}"] = shortest(
                    float(self.covariance[i, a, b]), factor
                )
            yield tuple(np.atleast_1d(poses).tolist()), cells


def _settings(
    robot: Mechanism, sensors: Sequence[tuple[str, Kind, Mapping[str, float]]], remark: str
) -> list[str]:
    """Return the front matter."""
    lines = [f"## {' '.join(remark.split())}"] if remark else []
    lines += [f"# format: {FORMAT}", f"# robot: {robot.name}"]
    if len(sensors) == 1:
        _, kind, noise = sensors[0]
        return lines + [
            f"# {key}: {text}" for key, text in write_sensor(kind, noise, robot.tool).items()
        ]
    lines.append("# kinds:")
    for label, kind, noise in sensors:
        settings = ", ".join(
            f"{key}: {text}" for key, text in write_sensor(kind, noise, robot.tool).items()
        )
        lines.append(f"#   '{label}': {{{settings}}}")
    return lines


def _headers(names: Sequence[str], columns: Sequence[Column]) -> Mapping[str, str]:
    """Return name -> header with its unit."""
    return {
        name: f"{name} [{SYMBOLS[c.dimension][0]}]" for name, c in zip(names, columns, strict=True)
    }


def _unit(robot: Mechanism, dimension: Dimension) -> tuple[str, float]:
    """Return symbol and factor of the robot's unit."""
    found = find_unit(robot.units[dimension])
    return found.symbol, found.factor_to_si


def _cell(value: np.floating, dimension: Dimension) -> str:
    """Return a number in the unit of its column; nothing for what was not measured."""
    number = float(value)
    return "" if math.isnan(number) else exactly(number, SYMBOLS[dimension][1])


def _plain(value: np.floating) -> str:
    """Return a number as it is; nothing for what was not noted."""
    return "" if math.isnan(float(value)) else exactly(float(value), 1.0)
