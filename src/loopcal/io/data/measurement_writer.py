# SPDX-License-Identifier: Apache-2.0
"""Text of measurement files and of templates, in the columns of the registry."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from loopcal.errors import DataError
from loopcal.io.core.text_file import write_text
from loopcal.io.data.columns import (
    LINK,
    SIGMA,
    USE_COLUMN,
    Column,
    ContextColumn,
    list_columns,
    name_covariance,
    name_measured,
)
from loopcal.io.data.kind_settings import format_kind, format_quantity
from loopcal.io.data.measurement_file import FORMAT
from loopcal.io.data.nuisance_settings import format_known
from loopcal.io.robot.robot_file import require_robot
from loopcal.mechanism import Mechanism

if TYPE_CHECKING:
    from loopcal.measure import Instrument, Kind, Measurements, Observations

EQUAL = 1e-9
"""Relative difference up to which the standard deviations of all rows are written as one number,
and correlation up to which there is none [1].
"""

ADDED = """\
# Add one row for each pose below: its name, readings and measured values; leave empty what was not
# measured.
# Optional columns: block, session, group, time, temperature [degC], sigma.NAME, note; see
# docs/files.md."""
"""Remarks below the header of a template."""

COMPARED = f"""\
# A row of the kind {{}} compares two poses: name them in the column pose as a{LINK}b and leave its
# readings empty. Each of these poses needs a row of its own with its readings."""
"""Remark of a template on a kind that compares poses."""

Cells = dict[str, Any]
"""Column -> value [SI] or text."""


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
    FileError : the file cannot be written. DataError : a name that a file cannot hold.
    """
    write_text(path, format_measurements(data, robot, remark))


def format_measurements(
    data: Measurements, robot: Mechanism, remark: str = "", uses: Mapping[str, str] | None = None
) -> str:
    """Return the text of a measurement file; see `save_measurements`.

    Parameters
    ----------
    uses : pose -> cell of the column `use`, which the file has only where there are any.
    """
    require_robot(robot)
    _refuse_names(data)
    known = list_columns(robot, [rows.kind for rows in data.observations])
    labels = _label_kinds([rows.kind for rows in data.observations])
    parts = [_Part(*entry, robot) for entry in zip(labels, data.observations, strict=True)]
    common, listed = _split_reading_noise(data, robot)
    lines = _format_settings(robot, [(p.label, p.rows.kind, p.common) for p in parts], remark)
    knowledge = format_known(data.stated_values, data.nuisance_parameters.table.entries)
    for key, text in (("unknowns", knowledge), ("reading_noise", common)):
        lines += [f"# {key}: {text}"] if text else []

    names = ["pose", *([USE_COLUMN.name] if uses else [])]
    names += [*(["block"] if len(set(data.block.tolist())) < data.n_poses else [])]
    for name in ("session", "group"):
        names += [name] if any((getattr(p.rows, name) != "").any() for p in parts) else []
    names += ["kind"] if len(parts) > 1 else []
    names += [a.name for a in robot.actuators] + [SIGMA + robot.actuators[i].name for i in listed]
    names += [name for part in parts for name in part.rows.context]
    names += [name for part in parts for name in part.columns]
    columns: list[Column] = [known.get(n, ContextColumn(n)) for n in dict.fromkeys(names)]
    lines.append(",".join(column.header for column in columns))

    measuring = {
        int(poses[0])
        for part in parts
        if part.rows.kind.poses_per_row == 1
        for poses, _ in part.cells()
    }
    rows: list[tuple[tuple[int, ...], Cells]] = [
        ((pose,), {}) for pose in range(data.n_poses) if pose not in measuring
    ]
    rows += [(poses, {"kind": p.label, **cells}) for p in parts for poses, cells in p.cells()]
    for poses, values in rows:
        pose = LINK.join(data.labels[pose] for pose in poses)
        cells = {"pose": pose, USE_COLUMN.name: (uses or {}).get(pose, ""), **values}
        if len(poses) == 1:
            cells |= _reading_cells(data, robot, poses[0], listed)
        lines.append(",".join(c.format(cells[c.name]) if c.name in cells else "" for c in columns))
    return "\n".join(lines) + "\n"


def format_template(robot: Mechanism, instrument: Instrument) -> str:
    """Return settings and header of a measurement file, to be filled in by hand.

    Parameters
    ----------
    robot : its actuators become columns. instrument : its kinds become columns.
    """
    kinds = [sensor.kind for sensor in instrument.sensors]
    noise = [
        dict(zip((c.name for c in s.kind.noise_columns), s.noise.sigma.tolist(), strict=True))
        for s in instrument.sensors
    ]
    labels, known = _label_kinds(kinds), list_columns(robot, kinds)
    names = ["pose", *(["kind"] if len(kinds) > 1 else []), *(a.name for a in robot.actuators)]
    names += [name_measured(column.name, robot) for kind in kinds for column in kind.columns]
    header = ",".join(known[name].header for name in dict.fromkeys(names))
    compared = [
        COMPARED.format(label)
        for label, kind in zip(labels, kinds, strict=True)
        if kind.poses_per_row > 1
    ]
    settings = _format_settings(robot, list(zip(labels, kinds, noise, strict=True)), "")
    return "\n".join([*settings, header, ADDED, *compared]) + "\n"


def format_data_sheet(
    robot: Mechanism,
    instrument: Instrument,
    readings: ArrayLike,
    labels: Sequence[str] = (),
    uses: Mapping[str, str] | None = None,
) -> str:
    """Return a measurement file with poses and empty measured values, to be filled in.

    Parameters
    ----------
    robot : its actuators become columns.
    instrument : states the poses, session and group of each kind.
    readings : (n, a) [SI] of the poses to be measured.
    labels : names of the poses; default "1", "2", ... uses : see `format_measurements`.

    Raises
    ------
    DataError : the instrument measures a pose that does not exist, or the number of names is wrong.
    """
    from loopcal.measure import Measurements, Observations

    sensors = instrument.with_tool(robot).sensors
    rows = []
    for sensor in (sensor.assign_rows(len(np.asarray(readings))) for sensor in sensors):
        if sensor.rows is None:
            continue
        empty = np.full((len(sensor.rows), len(sensor.kind.columns)), np.nan)
        sigma = sensor.noise.sigma
        rows.append(
            Observations.from_sigma(
                sensor.kind, sensor.rows, empty, sigma, sensor.session, sensor.group
            )
        )
    data = Measurements(robot.name, np.asarray(readings), tuple(rows), labels=tuple(labels))
    return format_measurements(data, robot, uses=uses)


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
    for what in ("session", "group"):
        names += [(what, n) for rows in data.observations for n in getattr(rows, what).tolist()]
    for what, name in dict.fromkeys(names):
        if any(ord(c) < 32 for c in name) or name != name.strip():
            reason = "names must not begin or end with a blank or contain a line break"
        elif what == "pose" and (not name or LINK in name):
            reason = f"names of poses must not be empty or contain {LINK!r}"
        else:
            continue
        raise DataError(f"the {what} {name!r} cannot be written: {reason}; rename it")
    if len(set(data.labels)) < len(data.labels):
        name = next(name for name in data.labels if data.labels.count(name) > 1)
        raise DataError(f"two poses are named {name!r}, but names must differ; rename one")


def _split_reading_noise(data: Measurements, robot: Mechanism) -> tuple[str, list[int]]:
    """Return the setting of reading noise, and the actuators whose noise needs a column.

    An actuator whose noise is the same in all poses is in the setting.
    """
    if data.reading_sigma is None:
        return "", []
    stated, listed = [], []
    for i, actuator in enumerate(robot.actuators):
        values = np.unique(data.reading_sigma[~np.isnan(data.readings[:, i]), i])
        if len(values) == 1 and np.isfinite(values[0]):
            text = format_quantity(float(values[0]), actuator.dimension)
            stated.append(f"{actuator.name}: {text}")
        elif len(values):
            listed.append(i)
    return f"{{{', '.join(stated)}}}", listed


def _reading_cells(data: Measurements, robot: Mechanism, pose: int, listed: Sequence[int]) -> Cells:
    """Return block, readings and, of the actuators `listed`, their noise."""
    cells: Cells = {"block": int(data.block[pose])}
    for i, actuator in enumerate(robot.actuators):
        reading = float(data.readings[pose, i])
        cells[actuator.name] = reading
        if i in listed and data.reading_sigma is not None:
            is_read = reading == reading  # noqa: PLR0124
            cells[SIGMA + actuator.name] = data.reading_sigma[pose, i] if is_read else float("nan")
    return cells


class _Part:
    """Rows of one kind; noise that is `common` to all rows goes to the settings."""

    def __init__(self, label: str, rows: Observations, robot: Mechanism) -> None:
        self.label, self.rows = label, rows
        kind = rows.kind
        self.names = [name_measured(column.name, robot) for column in kind.columns]
        noise = [name_measured(column.name, robot) for column in kind.noise_columns]
        N = kind.linearize_noise(rows.measured)
        half = np.linalg.solve(N, rows.covariance)
        self.covariance = np.linalg.solve(N, np.swapaxes(half, -1, -2))
        self.sigma = np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))
        spread = np.abs(self.sigma - self.sigma[:1])
        is_common = np.all(spread <= EQUAL * self.sigma[:1], axis=0).tolist()
        self.common = {
            c.name: float(self.sigma[0, i])
            for i, c in enumerate(kind.noise_columns)
            if is_common[i]
        }
        self.sigmas = {SIGMA + n: i for i, n in enumerate(noise) if not is_common[i]}
        scale = self.sigma[:, :, None] * self.sigma[:, None, :]
        related = np.any(np.abs(self.covariance) > EQUAL * scale, axis=0).tolist()
        self.covariances = {
            name_covariance(kind.noise_columns[a].name, kind.noise_columns[b].name, robot): (a, b)
            for a in range(len(noise))
            for b in range(a)
            if related[a][b]
        }

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns of measured values, and of noise that differs from row to row."""
        return (*self.names, *self.sigmas, *self.covariances)

    def cells(self) -> Iterator[tuple[tuple[int, ...], Cells]]:
        """Yield poses and cells of each row that counts; rows of weight 0 are not written."""
        rows = self.rows
        for i, poses in enumerate(rows.rows):
            if rows.weight[i] == 0.0:
                continue
            cells: Cells = dict(zip(self.names, rows.measured[i], strict=True))
            cells |= {"session": rows.session[i], "group": rows.group[i]}
            cells |= {name: values[i] for name, values in rows.context.items()}
            cells |= {name: self.sigma[i, k] for name, k in self.sigmas.items()}
            cells |= {name: self.covariance[i, a, b] for name, (a, b) in self.covariances.items()}
            yield tuple(np.atleast_1d(poses).tolist()), cells


def _format_settings(
    robot: Mechanism, kinds: Sequence[tuple[str, Kind, Mapping[str, float]]], remark: str
) -> list[str]:
    """Return the front matter."""
    lines = [f"## {' '.join(remark.split())}"] if remark else []
    lines += [f"# format: {FORMAT}", f"# robot: {robot.name}"]
    settings = [(label, format_kind(kind, noise, robot.tool)) for label, kind, noise in kinds]
    if len(settings) == 1:
        return lines + [f"# {key}: {text}" for key, text in settings[0][1].items()]
    lines.append("# kinds:")
    for label, texts in settings:
        lines.append(f"#   '{label}': {{{', '.join(f'{k}: {t}' for k, t in texts.items())}}}")
    return lines
