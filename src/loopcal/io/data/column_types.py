# SPDX-License-Identifier: Apache-2.0
"""Types of columns of measurement files: how their cells are parsed and formatted."""

from __future__ import annotations

import math
import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Protocol

import numpy as np

from loopcal.io.core.csv_table import Table, quote_cell
from loopcal.io.core.numbers import format_exact, format_scaled, parse_exact
from loopcal.typing import FloatArray
from loopcal.units import DISPLAY_UNITS, Dimension, find_unit

TIME = "time"
TIME_UNITS: Mapping[str, tuple[float, float]] = {
    "s": (1.0, 0.0),
    "ms": (1e-3, 0.0),
    "min": (60.0, 0.0),
    "h": (3600.0, 0.0),
}
TEMPERATURE_UNITS: Mapping[str, tuple[float, float]] = {
    "degC": (1.0, 0.0),
    "K": (1.0, -273.15),
    "degF": (5 / 9, -160 / 9),
}
"""Unit -> factor and offset to seconds, or degrees Celsius."""

ABSOLUTE_ZERO, ROUNDING = -273.15, 1e-9
"""Lowest temperature, and the rounding of a conversion that is accepted below it [degC]."""


class Column(Protocol):
    """A column of a measurement file."""

    @property
    def name(self) -> str:
        """Name in the header, without the unit."""
        ...

    @property
    def header(self) -> str:
        """Header as it is written."""
        ...

    def parse(self, table: Table) -> Any:
        """Return the values of all rows (n,) of a table that has this column; raise FileError."""
        ...

    def format(self, value: Any) -> str:
        """Return the cell of a value."""
        ...


@dataclass(frozen=True)
class TextColumn:
    """A column of names; `choices` lists the allowed cells, none allow any text."""

    name: str
    choices: tuple[str, ...] = ()

    @property
    def header(self) -> str:
        """The name; text has no unit."""
        return self.name

    def parse(self, table: Table) -> tuple[str, ...]:
        """Return the cells in Unicode normal form C."""
        cells = table.text(self.name)
        for row, cell in enumerate(cells):
            if self.choices and cell and cell not in self.choices:
                allowed = " or ".join(self.choices)
                sentence = f"column {self.name!r} is {cell!r}; write {allowed}, or leave it empty"
                raise table.row_error(row, sentence)
        return tuple(unicodedata.normalize("NFC", cell) for cell in cells)

    def format(self, value: Any) -> str:
        """Return the text, quoted where necessary."""
        return quote_cell(str(value))


@dataclass(frozen=True)
class NumberColumn:
    """A column of numbers of a dimension, written in the unit `symbol`.

    `allows_infinity` : the cell `inf` is allowed, for a reading that is not trusted.
    """

    name: str
    dimension: Dimension
    symbol: str
    allows_infinity: bool = False

    @property
    def header(self) -> str:
        """Name and unit."""
        return f"{self.name} [{self.symbol}]"

    def parse(self, table: Table) -> FloatArray:
        """Return the values [SI], NaN where a cell is empty."""
        if not self.allows_infinity:
            return table.numbers(self.name, self.dimension)
        cells = table.text(self.name)
        infinite = np.array([cell == "inf" for cell in cells])
        finite = ["" if cell == "inf" else cell for cell in cells]
        factor = table.factor(self.name, self.dimension)
        return np.where(infinite, np.inf, table.scaled(self.name, factor, finite))

    def format(self, value: Any) -> str:
        """Return a number [SI] in the unit; nothing for NaN."""
        number = float(value)
        if math.isnan(number):
            return ""
        return "inf" if math.isinf(number) else format_exact(number, _factor(self.symbol))


@dataclass(frozen=True)
class ProductColumn:
    """A column of covariances, whose unit is a product such as `[mm*mrad]`."""

    name: str
    dimensions: tuple[Dimension, Dimension]

    @property
    def symbols(self) -> tuple[str, ...]:
        """Units of the two factors as they are written."""
        return tuple(DISPLAY_UNITS[d].symbol for d in self.dimensions)

    @property
    def header(self) -> str:
        """Name and unit."""
        return f"{self.name} [{'*'.join(self.symbols)}]"

    def parse(self, table: Table) -> FloatArray:
        """Return the values [SI]; every row needs one."""
        symbols = (table.units[self.name] or "").split("*")
        if len(symbols) != 2:
            sentence = f"column {self.name!r} needs two units, as in '{self.name} [mm*mrad]'"
            raise table.header_error(sentence)
        factor = 1.0
        for symbol, dimension in zip(symbols, self.dimensions, strict=True):
            factor *= table.factor(self.name, dimension, symbol.strip())
        cells = enumerate(table.text(self.name))
        return (
            np.array([table.number(self.name, i, cell, empty=False) for i, cell in cells]) * factor
        )

    def format(self, value: Any) -> str:
        """Return a covariance [SI] in the unit."""
        return format_scaled(float(value), _factor(self.symbols[0]) * _factor(self.symbols[1]))


@dataclass(frozen=True)
class ContextColumn:
    """Time or a temperature, which enter no equation: kept in seconds or degrees Celsius.

    Without a unit, `time` holds dates and times of ISO 8601 (UTC where no offset is written), kept
    as seconds since 1970-01-01 UTC.
    """

    name: str

    @property
    def units(self) -> Mapping[str, tuple[float, float]]:
        """Unit -> factor and offset."""
        return TIME_UNITS if self.name == TIME else TEMPERATURE_UNITS

    @property
    def header(self) -> str:
        """Name and unit."""
        return f"{self.name} [{next(iter(self.units))}]"

    def parse(self, table: Table) -> FloatArray:
        """Return the values [s] or [degC], NaN where a cell is empty."""
        symbol, cells = table.units[self.name], table.text(self.name)
        if self.name == TIME and symbol is None:
            return np.array([_parse_date(table, row, cell) for row, cell in enumerate(cells)])
        if symbol is None or symbol not in self.units:
            stated = "no unit" if symbol is None else f"the unit {symbol!r}"
            allowed = ", ".join(f"[{s}]" for s in self.units)
            raise table.header_error(f"column {self.name!r} has {stated}; write one of {allowed}")
        factor, offset = self.units[symbol]
        values = np.full(len(cells), np.nan)
        for row, cell in enumerate(cells):
            if not math.isnan(table.number(self.name, row, cell, empty=True)):
                values[row] = parse_exact(cell, factor) + offset
            if self.name != TIME and values[row] < ABSOLUTE_ZERO - ROUNDING:
                sentence = f"column {self.name!r} is {cell} {symbol}, below absolute zero"
                raise table.row_error(row, f"{sentence}; correct it, or leave the cell empty")
        return values

    def format(self, value: Any) -> str:
        """Return the number [s] or [degC]; nothing for NaN."""
        return "" if math.isnan(float(value)) else format_exact(float(value), 1.0)


def _factor(symbol: str) -> float:
    return find_unit(symbol).factor_to_si


def _parse_date(table: Table, row: int, cell: str) -> float:
    """Return seconds since 1970-01-01 UTC of a date and time."""
    if not cell:
        return math.nan
    try:
        moment = datetime.fromisoformat(cell)
    except ValueError:
        sentence = f"column 'time' is {cell!r}, but a date and time is needed, such as"
        act = "or give the column a unit, as 'time [s]'"
        raise table.row_error(row, f"{sentence} 2026-05-04T10:22:31; {act}") from None
    return (moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)).timestamp()
