# SPDX-License-Identifier: Apache-2.0
"""Numbers as printed, digit by digit, and tables that put computed ones beside them.

The last printed digit is the yardstick: a computed number agrees when it is within one unit of it.
So printed numbers are read as text ("0.0352" has the unit 1e-4, "-9E-05" the unit 1e-5).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from decimal import Decimal
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from loopcal.typing import BoolArray, FloatArray

Cell = str | float | int | bool | None
ROUNDING = 1e-9
"""Of a unit, by which a difference may exceed it: decimal numbers are no binary ones."""


@dataclass(frozen=True)
class Table:
    """Rows of text and numbers.

    Attributes
    ----------
    name : of its file. title, note : what it shows. columns : their names, with units.
    formats : format specification of each column on a page ("" for text). shown : rows on a page,
        None for all.
    """

    name: str
    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    formats: tuple[str, ...]
    note: str = ""
    shown: int | None = None

    def text(self) -> list[tuple[str, ...]]:
        """Rows as a page shows them; a dash for what is not there."""
        return [
            tuple(_text(cell, spec) for cell, spec in zip(row, self.formats, strict=True))
            for row in self.rows[: self.shown]
        ]

    def to_dict(self) -> dict[str, Any]:
        """Return name, title, note, columns and all rows, for JSON."""
        return {name: getattr(self, name) for name in ("name", "title", "note", "columns", "rows")}


@dataclass(frozen=True)
class Printed:
    """A block of printed numbers: a row of texts under each label."""

    rows: Mapping[str, tuple[str, ...]]

    @classmethod
    def parse(cls, lines: Mapping[str, str]) -> Printed:
        """Read lines of numbers separated by blanks."""
        return cls({label: tuple(line.split()) for label, line in lines.items()})

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of the rows."""
        return tuple(self.rows)

    @cached_property
    def values(self) -> FloatArray:
        """(r, c) the numbers, in the units they are printed in."""
        return np.array([[float(cell) for cell in row] for row in self.rows.values()])

    @cached_property
    def unit(self) -> FloatArray:
        """(r, c) one unit of the last digit."""
        return np.array([[last_digit(cell) for cell in row] for row in self.rows.values()])

    def only(self, *labels: str) -> Printed:
        """Some of the rows."""
        return Printed({label: self.rows[label] for label in labels})


@dataclass(frozen=True, eq=False)
class Comparison:
    """Published beside computed.

    Attributes
    ----------
    name : of its file. title, note : what is compared. columns : of the printed block, with units.
    published : as printed. computed : (r, c). yardstick : (r, c) difference within which they
    agree; default: a unit of the
    last printed digit.
    """

    name: str
    title: str
    columns: tuple[str, ...]
    published: Printed
    computed: FloatArray
    note: str = ""
    yardstick: FloatArray | None = None

    @cached_property
    def difference(self) -> FloatArray:
        """(r, c) computed - published."""
        return self.computed - self.published.values

    @cached_property
    def step(self) -> FloatArray:
        """(r, c) within which they agree."""
        return self.published.unit if self.yardstick is None else self.yardstick

    @cached_property
    def within(self) -> BoolArray:
        """(r, c) which numbers agree."""
        return self.agrees_with(self.computed)

    def agrees_with(self, numbers: FloatArray) -> BoolArray:
        """Return which of other computed numbers (r, c) agree with the published ones."""
        return np.abs(numbers - self.published.values) <= self.step * (1.0 + ROUNDING)

    @property
    def count(self) -> int:
        """Number of numbers."""
        return self.within.size

    @property
    def agreeing(self) -> int:
        """How many agree."""
        return int(self.within.sum())

    @property
    def differing(self) -> int:
        """How many differ."""
        return self.count - self.agreeing

    @property
    def largest(self) -> float:
        """Largest difference, in the units of the table (which must have one)."""
        return float(np.abs(self.difference).max())

    def table(self) -> Table:
        """One row for each number."""
        rows = [
            (
                label,
                column,
                printed,
                float(self.computed[i, j]),
                float(self.difference[i, j]),
                float(self.step[i, j]),
                bool(self.within[i, j]),
            )
            for i, (label, texts) in enumerate(self.published.rows.items())
            for j, (column, printed) in enumerate(zip(self.columns, texts, strict=True))
        ]
        columns = (
            "row",
            "column",
            "published",
            "computed",
            "difference",
            "unit of the last digit",
            "within one unit",
        )
        return Table(
            self.name,
            self.title,
            columns,
            tuple(rows),
            ("", "", "", ".9g", ".2g", ".0e", ""),
            self.note,
        )

    def side_by_side(self) -> Table:
        """In the layout of the paper, three lines a row: published, computed, difference (in bold
        where too large).
        """
        lines: list[tuple[Cell, ...]] = []
        for i, (label, texts) in enumerate(self.published.rows.items()):
            lines.append((label, "published", *texts))
            lines.append(
                (
                    "",
                    "computed",
                    *(_like(*pair) for pair in zip(self.computed[i], texts, strict=True)),
                )
            )
            shown = [f"{d:.1e}" if d else "0" for d in self.difference[i]]
            marked = (d if ok else f"**{d}**" for d, ok in zip(shown, self.within[i], strict=True))
            lines.append(("", "difference", *marked))
        columns = ("", "", *self.columns)
        return Table(self.name, self.title, columns, tuple(lines), ("",) * len(columns), self.note)


def read_content(module: str) -> dict[str, Any]:
    """Return the content of the published.yaml beside a module (its `__file__`)."""
    from loopcal.io.core.yaml_file import read_yaml

    return read_yaml(
        Path(module).with_name("published.yaml"), "file of published numbers", has_names=False
    ).content


def last_digit(text: str) -> float:
    """Return one unit of the last digit of a printed number.

    Examples
    --------
    >>> last_digit("-0.0352"), last_digit("-9E-05"), last_digit("200"), last_digit("1.20E-09")
    (0.0001, 1e-05, 1.0, 1e-11)
    """
    return float(Decimal(1).scaleb(int(Decimal(text).as_tuple().exponent)))


def _like(value: float, printed: str) -> str:
    """Write a number as the printed one is, with one digit more."""
    if "E" in printed.upper():
        return f"{value:.3e}"
    return f"{value:.{max(1 - round(float(np.log10(last_digit(printed)))), 1)}f}"


def _text(cell: Cell, spec: str) -> str:
    if cell is None:
        return "-"
    if isinstance(cell, bool):
        return "yes" if cell else "no"
    return cell if isinstance(cell, str) else format(cell, spec)
