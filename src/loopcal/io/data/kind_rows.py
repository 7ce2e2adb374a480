# SPDX-License-Identifier: Apache-2.0
"""The rows of each kind in a measurement file: settings, measured values and their noise."""

from __future__ import annotations

import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from loopcal.errors import DataError, suggest_names
from loopcal.findings import report_finding
from loopcal.io.core.csv_table import Table, require_columns
from loopcal.io.core.text_file import name_files
from loopcal.io.core.yaml_file import Location, YamlFile, refuse_unknown_keys
from loopcal.io.data.columns import (
    SIGMA,
    list_columns,
    name_covariance,
    name_measured,
    refuse_unknown_columns,
)
from loopcal.io.data.kind_settings import SETTINGS as SHARED_ERRORS
from loopcal.io.data.kind_settings import (
    list_kind_settings,
    read_instrument,
    read_kind,
    read_noise,
    read_noise_source,
    read_shared_errors,
)
from loopcal.mechanism.model import Mechanism
from loopcal.typing import BoolArray, FloatArray, IntArray
from loopcal.units import EXAMPLES, SMALLEST_SD

if TYPE_CHECKING:
    from loopcal.measure.kinds.kind import Kind
    from loopcal.measure.observations import InstrumentRecord, Observations

SETTINGS: Mapping[str, str] = {
    "format": "1",
    "robot": "name of the robot; a different name than that of the robot in use is reported",
    "instrument": "name of the instrument, or its facts for traceability; see "
    "[instruments](#instruments-and-their-traceability)",
    "controller": "robot file of the geometry that converts commanded coordinates to readings; "
    "the nominal robot by default",
    "kind": "the kind of all rows, followed by its own settings and noise",
    "kinds": "label -> kind, settings and noise, in files with several kinds",
    "noise": "standard deviation of each noise column, with its unit; by name or pattern, such as "
    '`"*.x": 5 um`',
    "noise_source": "`assumed` where nobody stated the noise, as in imported files; by default "
    "`stated`. Assumed noise decides no quality gate",
    **SHARED_ERRORS,
    "unknowns": "name or pattern -> prior knowledge of a setup parameter (frame, target, surface, "
    "offset), or `fixed`",
    "session": "session of all rows whose column states none",
    "group": "group of all rows whose column states none",
    "reading_noise": "standard deviation of the readings: one for all, or actuator -> one; that of "
    "the robot file by default",
    "poses": "another file, in the same folder, with the readings of the poses",
}
KIND_SETTINGS = ("noise", "noise_source", "instrument", *SHARED_ERRORS)
"""Settings beside those of the kind itself."""

POSE_SETTINGS = ("format", "robot", "controller", "reading_noise")
"""Settings of a file without measured values."""


@dataclass(frozen=True, eq=False)
class KindRows:
    """A kind in a file: its noise [SI] by column, its rows, and the place of its settings.

    `is_noise_assumed` where nobody stated the noise; `shared_errors` as of `read_shared_errors`.
    """

    kind: Kind
    noise: dict[str, float]
    rows: IntArray
    location: Location
    is_noise_assumed: bool = False
    shared_errors: Mapping[str, float] = field(default_factory=dict)
    instrument: InstrumentRecord | None = None


def has_measured_values(table: Table) -> bool:
    """Return whether a file states a kind; one that does not only holds readings of poses."""
    return any(key in table.settings.content for key in ("kind", "kinds"))


def read_kinds(table: Table, robot: Mechanism, several: bool = False) -> tuple[KindRows, ...]:
    """Return the kinds of a file, mounted on the robot's tool, with the indices of their rows.

    One of `several` files may have none, and then only holds readings of poses. FileError :
    settings or columns without a meaning.
    """
    if several and not has_measured_values(table):
        refuse_unknown_keys(table.settings, list(table.settings.content), POSE_SETTINGS)
        kinds: tuple[KindRows, ...] = ()
    else:
        kinds = _read_kinds(table, robot)
    refuse_unknown_columns(table, robot, [entry.kind for entry in kinds])
    return kinds


def read_observations(
    table: Table,
    robot: Mechanism,
    entry: KindRows,
    members: Sequence[tuple[int, ...]],
    context: Mapping[str, FloatArray],
    pose_context: Mapping[str, FloatArray],
) -> tuple[Observations, tuple[str, ...]]:
    """Read the rows of one kind; return them with file and line of each.

    `members` are the poses of each row of the file; `context` and `pose_context` times and
    temperatures of its rows (rows,) and of the poses (n,), for rows that state none.

    FileError : a cell that does not fit. DataError : noise that is not a covariance.
    """
    from loopcal.measure.observations import Observations

    entry = _select_rows(table, entry, members)
    links, rows = entry.kind.poses_per_row, entry.rows
    measured, covariance = _read_values(table, robot, entry)
    if entry.kind.is_of_base:
        poses, pose_context = np.zeros((len(rows), 1), dtype=np.intp), {}
    else:
        poses = np.array([members[row] for row in rows], dtype=np.intp).reshape(-1, links)
    beside = {}
    for name in dict.fromkeys([*context, *pose_context]):
        values = context[name][rows] if name in context else np.full(len(rows), np.nan)
        if name in pose_context:
            values = np.where(np.isnan(values), pose_context[name][poses].mean(axis=1), values)
        if not np.isnan(values).all():
            beside[name] = values
    with name_files(table.path):
        observations = Observations(
            entry.kind,
            poses[:, 0] if links == 1 else poses,
            measured,
            covariance,
            session=_read_names(table, "session", rows),
            group=_read_names(table, "group", rows),
            context=beside,
            source=str(table.path),
            is_noise_assumed=entry.is_noise_assumed,
            instrument=entry.instrument,
        )
    return observations, table.places(rows.tolist())


def _read_kinds(table: Table, robot: Mechanism) -> tuple[KindRows, ...]:
    """Read the settings `kind` or `kinds`, and the column `kind`."""
    file, content = table.settings, table.settings.content
    several = content.get("kinds")
    instrument = read_instrument(file, content, ())
    if several is None:
        kind = _read_robot_kind(file, content, robot, ())
        refuse_unknown_keys(file, list(content), [*SETTINGS, *list_kind_settings(type(kind))])
        rows = np.arange(len(table))
        noise, is_assumed = (
            read_noise(file, content, kind, ()),
            read_noise_source(file, content, ()),
        )
        kind, shared = read_shared_errors(file, content, kind, ())
        return (KindRows(kind, noise, rows, (), is_assumed, shared, instrument),)
    allowed = [
        key for key in SETTINGS if key == "instrument" or key not in ("kind", *KIND_SETTINGS)
    ]
    refuse_unknown_keys(file, list(content), allowed)
    if not isinstance(several, dict) or not all(isinstance(n, dict) for n in several.values()):
        sentence = "'kinds' must map labels to kinds, as 'kinds: {height: {kind: component, ..}}'"
        raise file.error(sentence, ("kinds",))
    require_columns(table, ["kind"], "which assigns each row to one of the kinds")
    cells, kinds = np.array(table.text("kind")), []
    for row, cell in enumerate(cells):
        if cell and cell not in several:  # without a kind, a row only holds readings
            sentence = f"column 'kind' is {cell!r}; allowed: {', '.join(several)}"
            raise table.row_error(row, sentence)
    for label, node in several.items():
        place = ("kinds", label)
        kind = _read_robot_kind(file, node, robot, place)
        allowed = ["kind", *KIND_SETTINGS, *list_kind_settings(type(kind))]
        refuse_unknown_keys(file, list(node), allowed, place)
        noise, rows = read_noise(file, node, kind, place), np.flatnonzero(cells == label)
        is_assumed = read_noise_source(file, node, place)
        kind, shared = read_shared_errors(file, node, kind, place)
        own = read_instrument(file, node, place) or instrument
        kinds.append(KindRows(kind, noise, rows, place, is_assumed, shared, own))
    return tuple(kinds)


def _read_robot_kind(
    file: YamlFile, node: Mapping[str, Any], robot: Mechanism, place: Location
) -> Kind:
    """Return a kind of the settings, mounted on the robot's tool; refuse what it cannot measure."""
    from loopcal.measure.data_checks import check_redundancy
    from loopcal.measure.kinds.kind import BASE

    kind = read_kind(file, node, place).with_tool(robot.tool)
    stages = [stage.name for stage in robot.stages]
    if kind.of and not kind.is_of_base and kind.of not in stages:
        known = f"a stage ({', '.join(stages)}), or base" if stages else "base"
        sentence = (
            f"{robot.name!r} has no stage {kind.of!r}{suggest_names(kind.of, [*stages, BASE])}"
        )
        raise file.error(f"{sentence}; `of` is {known}", (*place, "of"))
    try:
        check_redundancy(robot, (kind,))
    except DataError as error:
        raise file.error(error.finding, (*place, "kind")) from None
    return kind


def _select_rows(table: Table, entry: KindRows, members: Sequence[tuple[int, ...]]) -> KindRows:
    """Return only the rows that measure: those of two poses, for a kind that compares poses."""
    links = 0 if entry.kind.is_of_base else entry.kind.poses_per_row
    if links > 1 and "kind" not in table.units:
        entry = replace(entry, rows=entry.rows[[len(members[row]) > 1 for row in entry.rows]])
    for row in entry.rows:
        if (count := len(members[row])) != links:
            sentence = (
                f"this row names {count} poses, but the kind {entry.kind.name!r} needs {links}"
            )
            raise table.row_error(int(row), f"{sentence}; correct the column 'pose'")
    return entry


def _read_values(table: Table, robot: Mechanism, entry: KindRows) -> tuple[FloatArray, FloatArray]:
    """Return measured values (r, c) and the covariance (r, m, m) of their residuals [SI]."""
    kind, rows = entry.kind, entry.rows
    known = list_columns(robot, [kind])
    names = [name_measured(column.name, robot) for column in kind.columns]
    require_columns(table, names, f"which the kind {kind.name!r} measures")
    measured = np.zeros((len(rows), len(names)))
    for i, name in enumerate(names):
        measured[:, i] = known[name].parse(table)[rows]
    for i, doubt in kind.find_invalid_rows(measured):
        raise table.row_error(int(rows[i]), f"this row {doubt}")
    absent = np.zeros((len(rows), len(kind.noise_columns)), bool)
    if kind.noise_columns == kind.columns:  # then a value that was not measured needs no sigma
        absent = np.isnan(measured)
    sigma = np.zeros(absent.shape)
    for i in range(absent.shape[1]):
        sigma[:, i] = _read_sigma(table, robot, entry, i, absent[:, i])
    covariance = sigma[:, :, None] * np.eye(sigma.shape[1]) * sigma[:, None, :]
    for i, a in enumerate(kind.noise_columns):
        for j, b in enumerate(kind.noise_columns):
            name = name_covariance(a.name, b.name, robot)
            if i != j and name in table.units:
                covariance[:, i, j] = covariance[:, j, i] = known[name].parse(table)[rows]
    N = kind.linearize_noise(measured)
    return measured, N @ covariance @ np.swapaxes(N, -1, -2)


def _read_names(table: Table, name: str, rows: IntArray) -> NDArray[np.str_]:
    """Return the sessions or groups (r,) of rows: of their cells, else of the setting, else ''."""
    stated = table.settings.content.get(name, "")
    if isinstance(stated, dict | list):
        sentence = f"{name!r} names the {name} of all rows; write a name or a number"
        raise table.settings.error(sentence, (name,))
    usual = str(stated if stated is not None else "").strip()
    if name not in table.units:
        return np.full(len(rows), unicodedata.normalize("NFC", usual))
    cells = table.text(name)
    texts = (unicodedata.normalize("NFC", cells[row] or usual) for row in rows.tolist())
    return np.array(list(texts), dtype=np.str_)


def _read_sigma(
    table: Table, robot: Mechanism, entry: KindRows, place: int, absent: BoolArray
) -> FloatArray:
    """Return the standard deviations (r,) [SI] of one noise column, from its column or settings.

    An empty cell of a value that is `absent` (r,) gets the sigma of another row, without effect.
    """
    column = entry.kind.noise_columns[place]
    name = SIGMA + name_measured(column.name, robot)
    if name not in table.units:
        if column.name not in entry.noise:
            raise table.settings.error(
                report_finding(
                    "files.noise-missing",
                    column=column.name,
                    example=f"noise: {{{column.name}: {EXAMPLES[column.dimension]}}}",
                    sigma=name,
                ),
                (*entry.location, "noise"),
            )
        return np.full(len(entry.rows), entry.noise[column.name])
    cells = table.numbers(name, column.dimension)[entry.rows]
    sigma = np.where(np.isnan(cells), entry.noise.get(column.name, np.nan), cells)
    if (positive := sigma[sigma > 0]).size:
        sigma = np.where(absent & np.isnan(sigma), positive[0], sigma)
    for i in np.flatnonzero(~(sigma >= SMALLEST_SD)):
        size = "too small" if sigma[i] > 0.0 else "not positive"
        sentence = f"column {name!r} is {size}; write a standard deviation"
        raise table.row_error(int(entry.rows[i]), sentence)
    return sigma
