# SPDX-License-Identifier: Apache-2.0
r"""Profiles: how to read the text that an instrument's software exports.

delimiter: semicolon                    comma, semicolon, tab or spaces
columns:
  pose: {from: Name, match: 'P(?P<pose>\d+)_(?P<target>\w+)'}
  x: {from: X, unit: mm}                by the name in the export's header, or its place from 1
settings: {kind: position, ...}         settings of the measurement file

A profile without a kind reads a table of readings, which is joined with measured values by the
names of the poses. `profile_reader` reads and checks profiles.
"""

from __future__ import annotations

import codecs
import unicodedata
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

from loopcal.io.core.numbers import format_scaled, parse_finite
from loopcal.io.core.yaml_file import YamlFile
from loopcal.io.data.columns import MEASURED
from loopcal.io.exports.patterns import Pattern, compile_pattern
from loopcal.units import find_unit, parse_quantity

if TYPE_CHECKING:
    from loopcal.measure import Column, Kind

DELIMITERS: Mapping[str, str | None] = {"comma": ",", "semicolon": ";", "tab": "\t", "spaces": None}
DECIMALS: Mapping[str, str] = {"point": ".", "comma": ","}
Place = int | str


def normalize_name(text: str) -> str:
    """Return a name in a header, or in `from`, without blanks around it and with single ones in it.

    Blanks include those that do not break a line; a byte order mark within the text counts, too.
    """
    return " ".join(unicodedata.normalize("NFC", text.replace("\ufeff", " ")).split())


def normalize_places(places: Iterable[Place]) -> tuple[Place, ...]:
    """Return places with their names as `normalize_name` does."""
    return tuple(normalize_name(p) if isinstance(p, str) else p for p in places)


@dataclass(frozen=True)
class ColumnSource:
    """The source of one column of the measurement file.

    Parameters
    ----------
    from_ : name in the export's header, or place counted from 1; several are joined by blanks.
    unit : unit of a number.
    factor : of a sigma: number by which it is multiplied, such as 0.5 for an expanded uncertainty
        U(95) with k = 2.
    floor : of a sigma: least standard deviation with its unit, which replaces zeros.
    match : of `pose`: pattern that finds (?P<pose>..), and (?P<target>..) where each target has a
        line of its own.
    format : of `time`: format of Python's strptime, such as '%d.%m.%Y %H:%M:%S'.
    """

    from_: Place | tuple[Place, ...]
    unit: str | int | None = None
    factor: float = 1.0
    floor: str | int | float | None = None
    match: str | None = None
    format: str | None = None

    @property
    def places(self) -> tuple[Place, ...]:
        """Names in the export's header, or places counted from 1."""
        return normalize_places(self.from_ if isinstance(self.from_, tuple) else (self.from_,))

    @property
    def symbol(self) -> str | None:
        """Unit of a number; None for text."""
        return None if self.unit is None else str(self.unit)

    @cached_property
    def least(self) -> str:
        """The floor in the unit of the column; 0 where there is none."""
        if self.floor is None or self.symbol is None:
            return "0"
        unit = find_unit(self.symbol)
        return format_scaled(parse_quantity(str(self.floor), unit.dimension), unit.factor_to_si)

    @cached_property
    def pattern(self) -> Pattern | None:
        """The compiled `match`."""
        return None if self.match is None else compile_pattern(self.match)


@dataclass(frozen=True)
class ProfileRecord:
    """The keys of a profile.

    Parameters
    ----------
    delimiter : separator of columns; `spaces` is any number of blanks and tabs.
    columns : column of the measurement file -> its source.
    settings : settings of the measurement file, see docs/files.md; `poses` names the file with the
        readings of the poses. Without `kind`, the table holds readings alone.
    format : version of the format, 1.
    decimal : the decimal mark.
    comment : start of lines without data.
    skip : number of lines at the top without data.
    ignore : pattern of further lines without data, such as totals.
    encoding : of the text; UTF-8 with or without byte order mark by default.
    missing : cells that mean not measured, besides empty ones; numbers count by value, so that -999
        includes -999.000.
    readings : actuator -> source of its reading, where the export contains readings.
    matrix : nine columns of a rotation matrix, row by row, in place of the columns of an
        orientation.
    """

    delimiter: Literal["comma", "semicolon", "tab", "spaces"]
    columns: Mapping[str, ColumnSource]
    settings: Mapping[str, Any] = field(default_factory=dict)
    format: int = 1
    decimal: Literal["point", "comma"] = "point"
    comment: str | None = None
    skip: int = 0
    ignore: str | None = None
    encoding: str = "utf-8"
    missing: str | int | float | tuple[str | int | float, ...] = ()
    readings: Mapping[str, ColumnSource] = field(default_factory=dict)
    matrix: tuple[Place, ...] = ()

    @property
    def matrix_places(self) -> tuple[Place, ...]:
        """Names in the export's header, or places counted from 1, of the rotation matrix."""
        return normalize_places(self.matrix)


@dataclass(frozen=True)
class Profile:
    """A checked profile; `kind` is the kind that its settings describe, None for readings alone."""

    file: YamlFile
    record: ProfileRecord
    kind: Kind | None

    @property
    def delimiter(self) -> str | None:
        """The separator; None for blanks and tabs."""
        return DELIMITERS[self.record.delimiter]

    @property
    def encoding(self) -> str:
        """Name of the codec; that of UTF-8 skips a byte order mark."""
        name = codecs.lookup(self.record.encoding).name
        return "utf-8-sig" if name == "utf-8" else name

    @cached_property
    def ignored(self) -> Pattern | None:
        """The compiled `ignore`."""
        return None if self.record.ignore is None else compile_pattern(self.record.ignore)

    @cached_property
    def columns(self) -> Mapping[str, ColumnSource]:
        """Sources of all columns, readings included."""
        return {**self.record.columns, **self.record.readings}

    @cached_property
    def missing(self) -> tuple[str, ...]:
        """Cells that mean not measured."""
        cells = self.record.missing
        return tuple(str(c) for c in (cells if isinstance(cells, tuple) else (cells,)))

    @cached_property
    def missing_numbers(self) -> tuple[float, ...]:
        """Numbers that mean not measured."""
        numbers = (self.parse(text) for text in self.missing)
        return tuple(number for number in numbers if number is not None)

    @property
    def measured(self) -> tuple[Column, ...]:
        """The columns of the kind; none for readings alone."""
        return () if self.kind is None else self.kind.columns

    @property
    def targets(self) -> tuple[str, ...]:
        """Targets of the kind; empty for a kind without targets."""
        return getattr(self.kind, "targets", ())

    def with_point(self, text: str) -> str:
        """Return a number with a decimal point; a misplaced point becomes an invalid number."""
        mark = DECIMALS[self.record.decimal]
        return text if mark == "." else text.replace(".", "?").replace(mark, ".")

    def parse(self, text: str) -> float | None:
        """Return the finite number of a cell; None for other text."""
        return parse_finite(self.with_point(text))

    def name_measured(self, name: str) -> str:
        """Return the profile's name of a measured column: `measured.NAME` where it is stated so."""
        return MEASURED + name if MEASURED + name in self.columns else name


def strip_target(column: str) -> str:
    """Return the name of a column of several targets without its target: `x` for `a.x`."""
    return column.partition(".")[2]
