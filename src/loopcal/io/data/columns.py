# SPDX-License-Identifier: Apache-2.0
"""The registry of columns of measurement files: names, units, how cells are read and written.

Reader, writer, template, profiles of exports and the file reference loop over `RULES`. A new
column is one new entry there.
"""

from __future__ import annotations

import math
import re
import unicodedata
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from itertools import permutations
from typing import Any, NamedTuple

import numpy as np

from loopcal.errors import suggest_names
from loopcal.findings import Finding, report_finding
from loopcal.io.core import csv_table
from loopcal.measure.kinds.kind import Kind
from loopcal.mechanism.assembly import FORCES
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.platform_coordinates import get_dimension
from loopcal.typing import FloatArray, IntArray
from loopcal.units import ABSOLUTE_ZERO, DISPLAY_UNITS, ROUNDING, SI_SYMBOLS, Dimension, find_unit

LINK = ";"  # separates the names of poses that one row compares

COMMANDED, MEASURED, SIGMA, COVARIANCE = "commanded.", "measured.", "sigma.", "cov."
TIME, TEMPERATURE, NOTE = "time", "temperature", "note"
FIT, HELD_OUT = "fit", "held-out"
"""Cells of the column `use`."""


@dataclass(frozen=True)
class Column(ABC):
    """A column of a measurement file, by its name in the header."""

    name: str

    @property
    def header(self) -> str:
        """Name, and unit in brackets where there is one."""
        return self.name

    @abstractmethod
    def parse(self, table: csv_table.Table) -> Any:
        """Return the values of all rows (n,) of a table that has this column; raise FileError."""

    @abstractmethod
    def format(self, value: Any) -> str:
        """Return the cell of a value."""


@dataclass(frozen=True)
class TextColumn(Column):
    """A column of names; `choices` lists the allowed cells, none allow any text."""

    choices: tuple[str, ...] = ()

    def parse(self, table: csv_table.Table) -> tuple[str, ...]:
        """Return the cells in Unicode normal form C."""
        cells = table.text(self.name)
        for row, cell in enumerate(cells):
            if self.choices and cell and cell not in self.choices:
                allowed = " or ".join(self.choices)
                sentence = f"column {self.name!r} is {cell!r}. Write {allowed}, or leave it empty"
                raise table.row_error(row, sentence)
        return tuple(unicodedata.normalize("NFC", cell) for cell in cells)

    def format(self, value: Any) -> str:
        """Return the text."""
        return str(value)


@dataclass(frozen=True)
class NumberColumn(Column):
    """A column of numbers, written in the product of the units `symbols`: none for counts, such as
    corners of a board, and two for covariances, as `[mm*mrad]`; `inf` where it `allows_infinity`,
    for a reading that is not trusted.
    """

    symbols: tuple[str, ...]
    allows_infinity: bool = False

    @property
    def header(self) -> str:
        """Name, and unit where there is one."""
        return f"{self.name} [{'*'.join(self.symbols)}]" if self.symbols else self.name

    def parse(self, table: csv_table.Table) -> FloatArray:
        """Return the values [SI], NaN where a cell is empty, which that of a covariance is not."""
        dimensions, stated = [find_unit(s).dimension for s in self.symbols], table.units[self.name]
        if not dimensions and stated is not None:
            raise table.header_error(f"column {self.name!r} has a unit. Remove it: it only counts")
        if len(dimensions) == 1:
            return table.numbers(self.name, dimensions[0], infinite=self.allows_infinity)
        symbols = stated.split("*") if stated else []
        if len(symbols) != len(dimensions):
            sentence = f"column {self.name!r} needs two units, as in '{self.name} [mm*mrad]'"
            raise table.header_error(sentence)
        units = map(table.unit, [self.name] * len(symbols), dimensions, map(str.strip, symbols))
        factor = math.prod(unit.factor_to_si for unit in units)
        return table.scaled_numbers(self.name, factor, empty=not dimensions)

    def format(self, value: Any) -> str:
        """Return a number [SI] in the unit; nothing for NaN."""
        number = float(value)
        if math.isnan(number):
            return ""
        if math.isinf(number):
            return "inf"
        if not self.symbols:
            return f"{number:g}"
        factor = math.prod(find_unit(symbol).factor_to_si for symbol in self.symbols)
        return csv_table.format_exact(number, factor)


@dataclass(frozen=True)
class ContextColumn(Column):
    """Time or a temperature, which enter no equation: kept in seconds or degrees Celsius.

    Without a unit, `time` holds dates and times of ISO 8601 (UTC where no offset is written), kept
    as seconds since 1970-01-01 UTC.
    """

    @property
    def dimension(self) -> Dimension:
        """Time, or temperature."""
        return Dimension.TIME if self.name == TIME else Dimension.TEMPERATURE

    @property
    def header(self) -> str:
        """Name and unit."""
        return f"{self.name} [{SI_SYMBOLS[self.dimension]}]"

    def parse(self, table: csv_table.Table) -> FloatArray:
        """Return the values [s] or [degC], NaN where a cell is empty."""
        cells = table.text(self.name)
        if self.name == TIME and table.units[self.name] is None:
            return np.array([self._parse_date(table, row, cell) for row, cell in enumerate(cells)])
        unit = table.unit(self.name, self.dimension)
        values = table.scaled_numbers(self.name, unit.factor_to_si) + unit.offset
        lowest = -math.inf if self.name == TIME else ABSOLUTE_ZERO - ROUNDING
        for row in np.flatnonzero(values < lowest).tolist():
            sentence = f"column {self.name!r} is {cells[row]} {unit}, below absolute zero"
            raise table.row_error(row, f"{sentence}. Correct it, or leave the cell empty")
        return values

    @staticmethod
    def _parse_date(table: csv_table.Table, row: int, cell: str) -> float:
        """Return seconds since 1970-01-01 UTC of a date and time; NaN for an empty cell."""
        try:
            moment = datetime.fromisoformat(cell) if cell else None
        except ValueError:
            sentence = f"column 'time' is {cell!r}, but must be a date and time. Write"
            act = "2026-05-04T10:22:31, or give the column a unit, as 'time [s]'"
            raise table.row_error(row, f"{sentence} {act}") from None
        if moment is None:
            return math.nan
        return (moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)).timestamp()

    def format(self, value: Any) -> str:
        """Return the number [s] or [degC]; nothing for NaN."""
        return "" if math.isnan(float(value)) else csv_table.format_exact(float(value), 1.0)


@dataclass(frozen=True)
class PoseColumn(TextColumn):
    """A column of names that says something of poses: an attribute of `Measurements`.

    `encode` makes the attribute (n,) from the cells of the poses (n,), which are empty where no row
    states one; `decode` makes these cells from it, and `is_needed` says whether a file without the
    column would mean something else. `conflict` words two different cells of a pose.
    `is_required` where each pose that a file names must have a cell, in its first row.
    """

    attribute: str = field(kw_only=True)
    encode: Callable[[Sequence[str]], np.ndarray] = field(kw_only=True)
    decode: Callable[[np.ndarray], Sequence[str]] = field(kw_only=True)
    is_needed: Callable[[np.ndarray], bool] = field(kw_only=True)
    conflict: Callable[[str, str, str, str], str | Finding] = field(kw_only=True)
    is_required: bool = field(default=False, kw_only=True)


def _number_blocks(cells: Sequence[str]) -> IntArray:
    """Return the numbers of named blocks; a pose without one is a block of its own."""
    if not any(cells):
        return np.arange(len(cells))
    keys = [("block", cell) if cell else ("pose", str(i)) for i, cell in enumerate(cells)]
    numbers = {key: i for i, key in enumerate(dict.fromkeys(keys))}
    return np.array([numbers[key] for key in keys])


# What the poses of a row are for. A plan fills it in before anything is measured, so that the
# choice does not depend on the results.
USE_COLUMN = PoseColumn(
    "use",
    (FIT, HELD_OUT),
    attribute="is_held_out",
    encode=lambda cells: np.array(cells) == HELD_OUT,
    decode=lambda is_held_out: np.where(is_held_out, HELD_OUT, FIT).tolist(),
    is_needed=lambda is_held_out: bool(is_held_out.any()),
    conflict=lambda pose, use, other_use, place: report_finding(
        "data.use-contradicted", pose=pose, use=use, other_use=other_use, place=place
    ),
)
BLOCK_COLUMN = PoseColumn(
    "block",
    attribute="block",
    encode=_number_blocks,
    decode=lambda block: [str(number) for number in block],
    is_needed=lambda block: len(set(block.tolist())) < len(block),
    conflict=lambda pose, block, other, place: (
        f"pose {pose!r} is in block {block!r} here and {other!r} in {place}. Correct one"
    ),
    is_required=True,
)
POSE_COLUMNS = (USE_COLUMN, BLOCK_COLUMN)
# Columns, also settings, that name what rows share: fields of `Observations`.
ROW_COLUMNS = ("session", "group")


class ColumnRule(NamedTuple):
    """An entry of the registry: one sort of columns.

    `pattern`, `unit` and `meaning` are shown in the file reference. `list_columns` returns those
    that a file on a robot, with some kinds, may have; `match` an open-ended one by name, or None.
    """

    pattern: str
    unit: str
    meaning: str
    list_columns: Callable[[Mechanism, Sequence[Kind]], Iterable[Column]]
    match: Callable[[str], Column | None] = lambda _: None


def _number(name: str, *dimensions: Dimension) -> NumberColumn:
    of_unit = [dimension for dimension in dimensions if dimension is not Dimension.COUNT]
    return NumberColumn(name, tuple(DISPLAY_UNITS[dimension].symbol for dimension in of_unit))


def _text_rule(meaning: str, column: TextColumn) -> ColumnRule:
    return ColumnRule(column.name, "", meaning, lambda _robot, _kinds: (column,))


# All columns, in the order of the file reference.
RULES: tuple[ColumnRule, ...] = (
    _text_rule(
        f"name of the pose, or `a{LINK}b` in a row that compares two poses. Default: the number of "
        "the row",
        TextColumn("pose"),
    ),
    _text_rule(
        f"`{FIT}` or `{HELD_OUT}`: what the pose is for, in every file alike. Default: `{FIT}`",
        USE_COLUMN,
    ),
    _text_rule("poses of a block are never split between fit and validation", BLOCK_COLUMN),
    _text_rule("label of the kind, in files with several kinds", TextColumn("kind")),
    ColumnRule(
        "camera, board, picture",
        "",
        "of the kind image: its settings of these names, by which a row belongs to one of several "
        "kinds without the column `kind`. In a table of poses: station and file of each picture",
        lambda _, kinds: [
            TextColumn(name)
            for names in ([kind.row_settings for kind in kinds] or [("camera", "picture")])
            for name in names
        ],
    ),
    _text_rule("rows of a session share unknown frames and targets", TextColumn("session")),
    _text_rule("rows of a group share a surface or the constant of a lock", TextColumn("group")),
    ColumnRule(
        "ACTUATOR",
        "[mm] or [deg]",
        "reading of the actuator",
        lambda robot, _: [
            ContextColumn(a.name)
            if is_context(a.name)
            else NumberColumn(a.name, (robot.units[a.dimension],))
            for a in robot.actuators
        ],
    ),
    ColumnRule(
        "force.AXIS, moment.AXIS, load.ACTUATOR",
        "[N], [Nm]",
        "force and moment on the platform of an elastic robot, or the load of each elastic drive",
        lambda robot, _: [
            _number(name, Dimension(name.partition(".")[0]))
            for name in (FORCES if robot.is_elastic else ())
        ],
    ),
    ColumnRule(
        f"{COMMANDED}COORDINATE",
        "[mm] or [deg]",
        "commanded coordinate, in place of the readings",
        lambda robot, _: [_number(COMMANDED + c, get_dimension(c)) for c in robot.controlled],
    ),
    ColumnRule(
        "COLUMN",
        "of the kind",
        f"measured value, `{MEASURED}COLUMN` if a reading has an equal name",
        lambda robot, kinds: [
            _number(name_measured(c.name, robot), c.dimension)
            for kind in kinds
            for c in kind.columns
        ],
    ),
    ColumnRule(
        f"{SIGMA}NAME",
        "of NAME",
        "standard deviation of a measured value or reading in this row. `inf` marks an "
        "untrusted reading",
        lambda robot, kinds: [
            *(
                NumberColumn(SIGMA + a.name, (robot.units[a.dimension],), True)
                for a in robot.actuators
            ),
            *(
                _number(SIGMA + name_measured(column.name, robot), column.dimension)
                for kind in kinds
                for column in kind.noise_columns
            ),
        ],
    ),
    ColumnRule(
        f"{COVARIANCE}A.B",
        "[mm*mrad]",
        "covariance of two measured values in this row",
        lambda robot, kinds: [
            _number(name_covariance(a.name, b.name, robot), a.dimension, b.dimension)
            for kind in kinds
            for a, b in permutations(kind.noise_columns, 2)
        ],
    ),
    ColumnRule(
        TIME,
        "[s], [ms], [min], [h] or none",
        "time of the row. Without a unit: date and time of ISO 8601",
        lambda _robot, _kinds: (ContextColumn(TIME),),
    ),
    ColumnRule(
        f"{TEMPERATURE}, {TEMPERATURE}.PLACE",
        "[degC], [K] or [degF]",
        "temperature of the room, or of what PLACE names",
        lambda _robot, _kinds: (ContextColumn(TEMPERATURE),),
        lambda name: ContextColumn(name) if is_context(name) else None,
    ),
    ColumnRule(
        f"{NOTE}...",
        "any",
        "a remark, which loopcal ignores",
        lambda _robot, _kinds: (),
        lambda name: TextColumn(name) if name.startswith(NOTE) else None,
    ),
)

ROLES = (*csv_table.NAME_COLUMNS, TIME, TEMPERATURE)  # columns with the same meaning in every file


def list_columns(robot: Mechanism, kinds: Sequence[Kind]) -> dict[str, Column]:
    """Return name -> column of all columns with fixed names; open-ended ones: `find_column`."""
    return {column.name: column for rule in RULES for column in rule.list_columns(robot, kinds)}


def find_open_column(name: str) -> Column | None:
    """Return an open-ended column (a temperature, a remark) by its name; None for other names."""
    return next((column for rule in RULES if (column := rule.match(name)) is not None), None)


def is_context(name: str) -> bool:
    """Return whether a column holds a time or a temperature."""
    place = name.removeprefix(f"{TEMPERATURE}.")
    return name in (TIME, TEMPERATURE) or place not in ("", name)


def read_context(table: csv_table.Table) -> dict[str, FloatArray]:
    """Return name -> (rows,) of the times [s] and temperatures [degC] of a table."""
    return {name: ContextColumn(name).parse(table) for name in table.names if is_context(name)}


def refuse_unknown_columns(table: csv_table.Table, robot: Mechanism, kinds: Sequence[Kind]) -> None:
    """Raise FileError for the first column that has no meaning in this file."""
    known = list_columns(robot, kinds)
    for name in table.names:
        if name in known or find_open_column(name) is not None:
            continue
        hint = csv_table.suggest_header(name, table.units[name], known) or suggest_names(
            name, known
        )
        families = sorted({re.sub(r"\..*", ".*", known_name) for known_name in known})
        hint = hint or f". Allowed: {', '.join(families)}"
        act = f"correct it, or call it '{NOTE} {name}' to ignore it"
        why = "" if kinds else " (this file has no kind, so it only gives the readings of poses)"
        raise table.header_error(f"column {name!r} is unknown{hint}; {act}{why}")


def name_measured(column: str, robot: Mechanism) -> str:
    """Return the name of a measured column: `measured.q1` where a reading has the plain name."""
    taken = {*ROLES, *(actuator.name for actuator in robot.actuators)}
    return MEASURED + column if column in taken else column


def name_covariance(a: str, b: str, robot: Mechanism) -> str:
    """Return the name of the covariance of two noise columns."""
    return f"{COVARIANCE}{name_measured(a, robot)}.{name_measured(b, robot)}"


# Further columns of the operator's sheet of a plan.
SHEET_COLUMNS = ("step", "role", "hold", "tolerance")


def find_column_fault(name: str, what: str) -> Finding | None:
    """Return why no actuator or measured column may be named so; None where one may."""
    if "[" in name or "]" in name or name != name.strip():
        return report_finding("files.name-not-a-column", what=what, name=name)
    is_taken = name in (*ROLES, *SHEET_COLUMNS) or find_open_column(name) is not None
    if is_taken or name.startswith((COMMANDED, MEASURED, SIGMA, COVARIANCE)):
        return report_finding("files.name-of-a-column", what=what, name=name)
    return None
