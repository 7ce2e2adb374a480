# SPDX-License-Identifier: Apache-2.0
"""Writing measurement files and templates of them; what is read by `loopcal.io.measurement_file`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from loopcal.io.measurement_file import COVARIANCE, FORMAT, SIGMA
from loopcal.io.numbers import shortest
from loopcal.io.pose_rows import LINK, measured_name
from loopcal.io.sensor_settings import SYMBOLS, write_sensor
from loopcal.io.text_file import write_text
from loopcal.units import Dimension, unit

if TYPE_CHECKING:
    import numpy as np

    from loopcal.measure import Column, Instrument, Kind, Measurements, Observations
    from loopcal.mechanism import Mechanism

EQUAL = 1e-9
"""Relative difference up to which standard deviations of all rows are one number, and a correlation is none [1]."""


def save_measurements(data: Measurements, path: str | Path, robot: Mechanism, remark: str = "") -> None:
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
    """
    parts = [_Part(str(i + 1), rows, robot) for i, rows in enumerate(data.observations)]
    told = {int(pose[0]) for part in parts if part.rows.kind.links == 1 for pose, _ in part.cells()}
    untold = [pose for pose in range(data.n_poses) if pose not in told]
    several = len(parts) > 1
    lines = _settings(robot, [(part.label, part.rows.kind, part.common) for part in parts], remark)
    columns = {"pose": "pose"} | ({"block": "block"} if len(set(data.block.tolist())) < data.n_poses else {})
    readings = {a.name: _unit(robot, a.dimension) for a in robot.actuators}
    columns |= ({"kind": "kind"} if several else {}) | {n: f"{n} [{symbol}]" for n, (symbol, _) in readings.items()}
    for part in parts:
        columns |= part.headers
    lines.append(",".join(columns.values()))
    rows = [((pose,), {}) for pose in untold]  # poses that no row of their own measures
    rows += [(seen, {"kind": part.label, **values}) for part in parts for seen, values in part.cells()]
    for seen, values in rows:
        cells = {"pose": _quoted(LINK.join(data.labels[pose] for pose in seen)), **values}
        if len(seen) == 1:
            cells["block"] = str(int(data.block[seen[0]]))
            for (name, (_, factor)), reading in zip(readings.items(), data.readings[seen[0]], strict=True):
                cells[name] = shortest(float(reading), factor)
        lines.append(",".join(cells.get(name, "") for name in columns))
    write_text(path, "\n".join(lines) + "\n")


def template_text(robot: Mechanism, instrument: Instrument) -> str:
    """Return settings and header of a measurement file, to be filled in by hand.

    Parameters
    ----------
    robot : Mechanism
        Its actuators become columns.
    instrument : Instrument
        Its kinds become columns, its noise a setting.
    """
    sensors = [
        (str(i + 1), s.kind, dict(zip((c.name for c in s.kind.noise_columns), s.noise.sigma.tolist(), strict=True)))
        for i, s in enumerate(instrument.sensors)
    ]
    columns = ["pose", *(["kind"] if len(sensors) > 1 else [])]
    columns += [f"{a.name} [{_unit(robot, a.dimension)[0]}]" for a in robot.actuators]
    for _, kind, _ in sensors:
        names = [measured_name(column.name, robot) for column in kind.columns]
        columns += [header for header in _headers(names, kind.columns).values() if header not in columns]
    return "\n".join([*_settings(robot, sensors, ""), ",".join(columns)]) + "\n"


class _Part:
    """Rows of one kind with their noise: `common` in the settings, the rest in columns of their own."""

    def __init__(self, label: str, rows: Observations, robot: Mechanism) -> None:
        import numpy as np

        self.label, self.rows = label, rows
        self.names = [measured_name(column.name, robot) for column in rows.kind.columns]
        N = rows.kind.noise_map(rows.measured)
        half = np.linalg.solve(N, rows.covariance)
        self.covariance = np.linalg.solve(N, np.swapaxes(half, -1, -2))
        self.sigma = np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))
        columns = rows.kind.noise_columns
        alike = np.all(np.abs(self.sigma - self.sigma[:1]) <= EQUAL * self.sigma[:1], axis=0).tolist()
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
            found[SIGMA + noise[i].name] = f"{SIGMA}{noise[i].name} [{SYMBOLS[noise[i].dimension][0]}]"
        for a, b in self.pairs:
            units = f"{SYMBOLS[noise[a].dimension][0]}*{SYMBOLS[noise[b].dimension][0]}"
            name = f"{COVARIANCE}{noise[a].name}.{noise[b].name}"
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
            for k in self.own:
                cells[SIGMA + noise[k].name] = _cell(self.sigma[i, k], noise[k].dimension)
            for a, b in self.pairs:
                factor = SYMBOLS[noise[a].dimension][1] * SYMBOLS[noise[b].dimension][1]
                name = f"{COVARIANCE}{noise[a].name}.{noise[b].name}"
                cells[name] = shortest(float(self.covariance[i, a, b]), factor)
            yield tuple(np.atleast_1d(poses).tolist()), cells


def _settings(robot: Mechanism, sensors: Sequence[tuple[str, Kind, Mapping[str, float]]], remark: str) -> list[str]:
    """Return the front matter."""
    lines = [f"## {' '.join(remark.split())}"] if remark else []
    lines += [f"# format: {FORMAT}", f"# robot: {robot.name}"]
    if len(sensors) == 1:
        _, kind, noise = sensors[0]
        return lines + [f"# {key}: {text}" for key, text in write_sensor(kind, noise, robot.tool).items()]
    lines.append("# kinds:")
    for label, kind, noise in sensors:
        settings = ", ".join(f"{key}: {text}" for key, text in write_sensor(kind, noise, robot.tool).items())
        lines.append(f"#   '{label}': {{{settings}}}")
    return lines


def _headers(names: Sequence[str], columns: Sequence[Column]) -> Mapping[str, str]:
    """Return name -> header with its unit."""
    return {name: f"{name} [{SYMBOLS[c.dimension][0]}]" for name, c in zip(names, columns, strict=True)}


def _unit(robot: Mechanism, dimension: Dimension) -> tuple[str, float]:
    """Return symbol and factor of the robot's unit."""
    found = unit(robot.units[dimension])
    return found.symbol, found.factor_to_si


def _cell(value: np.floating, dimension: Dimension) -> str:
    """Return a number in the unit of its column; nothing for what was not measured."""
    number = float(value)
    return "" if math.isnan(number) else shortest(number, SYMBOLS[dimension][1])


def _quoted(text: str) -> str:
    """Return text as a CSV cell."""
    return '"' + text.replace('"', '""') + '"' if any(c in text for c in ',"#') else text
