# SPDX-License-Identifier: Apache-2.0
"""Text of measurement files and of templates, in the columns of the registry."""

from __future__ import annotations

import unicodedata
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from loopcal.errors import DataError
from loopcal.io.core.csv_table import format_row, refuse_settings_beside
from loopcal.io.core.limits import find_fault, format_comment
from loopcal.io.core.text_file import as_path, write_text
from loopcal.io.core.yaml_file import format_flow, quote_scalar
from loopcal.io.data.columns import (
    COVARIANCE,
    LINK,
    MEASURED,
    POSE_COLUMNS,
    ROW_COLUMNS,
    SIGMA,
    USE_COLUMN,
    Column,
    ContextColumn,
    find_column_fault,
    list_columns,
    name_covariance,
    name_measured,
)
from loopcal.io.data.kind_settings import (
    describe_instrument,
    describe_kind,
    describe_quantity,
    describe_stated_values,
)
from loopcal.io.data.measurement_file import FORMAT
from loopcal.mechanism.model import Mechanism
from loopcal.typing import FloatArray

if TYPE_CHECKING:
    from loopcal.measure.instrument import Instrument
    from loopcal.measure.kinds.kind import Kind
    from loopcal.measure.measurements import Measurements
    from loopcal.measure.observations import Observations

EQUAL = 1e-9
"""Relative difference up to which the standard deviations of all rows are written as one number,
and correlation up to which there is none [1].
"""

ADDED = """\
# Add one row for each pose below: its name, readings and measured values. Leave empty what was not
# measured.
# Optional setting for traceability: instrument: {name: .., serial_number: "..", certificate: "..",
#   laboratory: .., standard: .., calibrated: 2026-01-31, due: 2027-01-31, measured: 2026-05-31}
# Optional columns: block, session, group, time, temperature [degC], sigma.NAME, note; see
# docs/files.md."""
"""Remarks below the header of a template."""

COMPARED = f"""\
# A row of the kind {{}} compares two poses: name them in the column pose as a{LINK}b and leave its
# readings empty. Each of these poses needs a separate row with its readings."""
"""Remark of a template on a kind that compares poses."""

UNKNOWN_TARGETS = """\
# Replace the places of the targets above by yours: measured by hand from the origin of the platform
# frame, to a few millimeters. A plan uses them; a calibration identifies them. A plan
# needs no rows: it takes the instrument from the settings above."""
"""Remark of a template on targets of unknown place."""

UNKNOWN_FRAME = """\
# The instrument may stand anywhere; its frame ({}) is identified. If it is moved, even a
# little, give the rows before and after it different names in a column session."""
"""Remark of a template on an instrument whose frame is unknown."""


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
    from loopcal.measure.data_checks import check_types

    path = as_path(path, "measurement file")
    check_types(robot, data)
    text = format_measurements(data, robot, remark)
    refuse_settings_beside(path)
    write_text(path, text)


def format_measurements(
    data: Measurements, robot: Mechanism, remark: str = "", states_use: bool = False
) -> str:
    """Return the text of a measurement file; `states_use` also where no pose is held out."""
    from loopcal.measure.data_checks import check_kinds

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
    """Return a measurement file with poses, readings (n, a) [SI] and empty measured values.

    `instrument` states the poses, session and group of each kind. Without `is_held_out` (n,), the
    file has no column `use`. DataError : a pose that does not exist, or a wrong number of names.
    """
    from loopcal.measure.measurements import Measurements
    from loopcal.measure.observations import Observations

    sensors = instrument.with_tool(robot).sensors
    rows = []
    for sensor in (sensor.assign_rows(len(np.asarray(readings))) for sensor in sensors):
        if sensor.rows is None:
            continue
        empty = np.full((len(sensor.rows), len(sensor.kind.columns)), np.nan)
        empty[:, : sensor.kind.label_count] = sensor.kind.list_labels(len(empty))
        sigma = sensor.noise.sigma
        rows.append(
            Observations.from_sigma(
                sensor.kind, sensor.rows, empty, sigma, sensor.session, sensor.group
            )
        )
    data = Measurements(
        robot.name,
        np.asarray(readings),
        tuple(of_sensor for of_sensor in rows if not of_sensor.kind.is_of_base),
        labels=tuple(labels),
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
        raise DataError(f"the {what} {name!r} cannot be written: {reason}. Rename it")
    labels = [unicodedata.normalize("NFC", name) for name in data.labels]
    if len(set(labels)) < len(labels):
        name = next(name for name in labels if labels.count(name) > 1)
        raise DataError(f"two poses are named {name!r}, but names must differ. Rename one")


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
    N = kind.linearize_noise(rows.measured)
    half = np.linalg.solve(N, rows.covariance)
    covariance = np.linalg.solve(N, np.swapaxes(half, -1, -2))
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    is_common = np.all(np.abs(sigma - sigma[:1]) <= EQUAL * sigma[:1], axis=0)
    is_related = np.any(np.abs(covariance) > EQUAL * sigma[:, :, None] * sigma[:, None, :], axis=0)
    common = {}
    for i, column in enumerate(kind.noise_columns):
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
