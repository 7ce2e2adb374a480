# SPDX-License-Identifier: Apache-2.0
"""The registry of columns of measurement files: names, units, how cells are read and written.

Reader, writer, template, profiles of exports and the file reference loop over `RULES`. A new
column is one new entry there.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from loopcal.errors import suggest_names
from loopcal.io.core.csv_table import Table, suggest_header
from loopcal.io.data.column_types import (
    TIME,
    Column,
    ContextColumn,
    NumberColumn,
    ProductColumn,
    TextColumn,
)
from loopcal.mechanism import Mechanism
from loopcal.typing import FloatArray
from loopcal.units import DISPLAY_UNITS, Dimension

if TYPE_CHECKING:
    from loopcal.measure import Kind

LINK = ";"
"""Separates the names of poses that one row compares."""

COMMANDED, MEASURED, SIGMA, COVARIANCE = "commanded.", "measured.", "sigma.", "cov."
TEMPERATURE, NOTE = "temperature", "note"
FIT, HELD_OUT = "fit", "held-out"
USE_COLUMN = TextColumn("use", (FIT, HELD_OUT))
"""What a pose is for; a plan fills it in before anything is measured, so that the choice does not
depend on the results. A row that compares poses is held out with any of its poses.
"""


@dataclass(frozen=True)
class ColumnRule:
    """An entry of the registry: one sort of columns.

    Parameters
    ----------
    pattern : how the file reference names it. unit : as shown there. meaning : as shown there.
    list_columns : the columns of this sort that a file on a robot, with some kinds, may have.
    match : an open-ended column by its name, None where the name is of another sort.
    """

    pattern: str
    unit: str
    meaning: str
    list_columns: Callable[[Mechanism, Sequence[Kind]], Iterable[Column]]
    match: Callable[[str], Column | None] = lambda _: None


def _readings(robot: Mechanism, kinds: Sequence[Kind]) -> Iterable[Column]:
    del kinds
    for a in robot.actuators:
        yield NumberColumn(a.name, a.dimension, robot.units[a.dimension])


def _commanded(robot: Mechanism, kinds: Sequence[Kind]) -> Iterable[Column]:
    del kinds
    for name in robot.controlled:
        dimension = get_dimension(name)
        yield NumberColumn(COMMANDED + name, dimension, DISPLAY_UNITS[dimension].symbol)


def _measured(robot: Mechanism, kinds: Sequence[Kind]) -> Iterable[Column]:
    for kind in kinds:
        for column in kind.columns:
            symbol = DISPLAY_UNITS[column.dimension].symbol
            yield NumberColumn(name_measured(column.name, robot), column.dimension, symbol)


def _sigmas(robot: Mechanism, kinds: Sequence[Kind]) -> Iterable[Column]:
    for reading in _readings(robot, kinds):
        assert isinstance(reading, NumberColumn)
        name = SIGMA + reading.name
        yield NumberColumn(name, reading.dimension, reading.symbol, allows_infinity=True)
    for kind in kinds:
        for column in kind.noise_columns:
            name = SIGMA + name_measured(column.name, robot)
            yield NumberColumn(name, column.dimension, DISPLAY_UNITS[column.dimension].symbol)


def _covariances(robot: Mechanism, kinds: Sequence[Kind]) -> Iterable[Column]:
    for kind in kinds:
        for a in kind.noise_columns:
            for b in kind.noise_columns:
                if a is not b:
                    name = name_covariance(a.name, b.name, robot)
                    yield ProductColumn(name, (a.dimension, b.dimension))


def _match_temperature(name: str) -> Column | None:
    place = name.removeprefix(f"{TEMPERATURE}.")
    return ContextColumn(name) if place not in ("", name) else None


def _always(*columns: Column) -> Callable[[Mechanism, Sequence[Kind]], Iterable[Column]]:
    return lambda _robot, _kinds: columns


RULES: tuple[ColumnRule, ...] = (
    ColumnRule(
        "pose",
        "",
        f"name of the pose; `a{LINK}b` in a row that compares two poses; rows are numbered "
        "without it",
        _always(TextColumn("pose")),
    ),
    ColumnRule(
        "use",
        "",
        f"`{FIT}` or `{HELD_OUT}`: what the pose is for; an empty cell means `{FIT}`",
        _always(USE_COLUMN),
    ),
    ColumnRule(
        "block",
        "",
        "poses of a block are never split between fit and validation",
        _always(TextColumn("block")),
    ),
    ColumnRule(
        "kind", "", "label of the kind, in files with several kinds", _always(TextColumn("kind"))
    ),
    ColumnRule(
        "session",
        "",
        "rows of a session share unknown frames and targets",
        _always(TextColumn("session")),
    ),
    ColumnRule(
        "group",
        "",
        "rows of a group share a surface or the constant of a lock",
        _always(TextColumn("group")),
    ),
    ColumnRule("ACTUATOR", "[mm] or [deg]", "reading of the actuator", _readings),
    ColumnRule(
        f"{COMMANDED}COORDINATE",
        "[mm] or [deg]",
        "commanded coordinate, in place of the readings",
        _commanded,
    ),
    ColumnRule(
        "COLUMN",
        "of the kind",
        f"measured value; `{MEASURED}COLUMN` where a reading has the same name",
        _measured,
    ),
    ColumnRule(
        f"{SIGMA}NAME",
        "of NAME",
        "standard deviation of a measured value or reading in this row; `inf` marks a reading "
        "that is not trusted",
        _sigmas,
    ),
    ColumnRule(
        f"{COVARIANCE}A.B",
        "[mm*mrad]",
        "covariance of two measured values in this row",
        _covariances,
    ),
    ColumnRule(
        TIME,
        "[s], [ms], [min], [h] or none",
        "time of the row; date and time of ISO 8601 without a unit",
        _always(ContextColumn(TIME)),
    ),
    ColumnRule(
        f"{TEMPERATURE}, {TEMPERATURE}.PLACE",
        "[degC], [K] or [degF]",
        "temperature of the room, or of what PLACE names",
        _always(ContextColumn(TEMPERATURE)),
        _match_temperature,
    ),
    ColumnRule(
        f"{NOTE}...",
        "any",
        "a remark; ignored",
        lambda _robot, _kinds: (),
        lambda name: TextColumn(name) if name.startswith(NOTE) else None,
    ),
)
"""All columns, in the order of the file reference."""

ROLES = ("pose", "use", "block", "kind", "session", "group", TIME, TEMPERATURE)
"""Columns with the same meaning in every file."""


def list_columns(robot: Mechanism, kinds: Sequence[Kind]) -> dict[str, Column]:
    """Return name -> column of all columns with fixed names; open-ended ones: `find_column`."""
    return {column.name: column for rule in RULES for column in rule.list_columns(robot, kinds)}


def find_open_column(name: str) -> Column | None:
    """Return an open-ended column (a temperature, a remark) by its name; None for other names."""
    return next((found for rule in RULES if (found := rule.match(name)) is not None), None)


def is_context(name: str) -> bool:
    """Return whether a column holds a time or a temperature."""
    return name in (TIME, TEMPERATURE) or _match_temperature(name) is not None


def read_context(table: Table) -> dict[str, FloatArray]:
    """Return name -> (rows,) of the times [s] and temperatures [degC] of a table."""
    return {name: ContextColumn(name).parse(table) for name in table.names if is_context(name)}


def refuse_unknown_columns(table: Table, robot: Mechanism, kinds: Sequence[Kind]) -> None:
    """Raise FileError for the first column that has no meaning in this file."""
    known = list_columns(robot, kinds)
    for name in table.names:
        if name in known or find_open_column(name) is not None:
            continue
        hint = suggest_header(name, table.units[name], known) or suggest_names(name, known)
        families = sorted({re.sub(r"\..*", ".*", known_name) for known_name in known})
        hint = hint or f"; allowed: {', '.join(families)}"
        act = f"correct it, or call it '{NOTE} {name}' to ignore it"
        why = "" if kinds else " (this file states no kind, so it only gives the readings of poses)"
        raise table.header_error(f"column {name!r} is unknown{hint}; {act}{why}")


def name_measured(column: str, robot: Mechanism) -> str:
    """Return the name of a measured column: `measured.q1` where a reading has the plain name."""
    taken = {*ROLES, *(actuator.name for actuator in robot.actuators)}
    return MEASURED + column if column in taken else column


def name_covariance(a: str, b: str, robot: Mechanism) -> str:
    """Return the name of the covariance of two noise columns."""
    return f"{COVARIANCE}{name_measured(a, robot)}.{name_measured(b, robot)}"


def get_dimension(coordinate: str) -> Dimension:
    """Return the dimension of a controlled coordinate: x, y, z are lengths, others angles."""
    return Dimension.LENGTH if coordinate in ("x", "y", "z") else Dimension.ANGLE
