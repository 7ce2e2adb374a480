# SPDX-License-Identifier: Apache-2.0
"""One description of a table, rendered as text, CSV and HTML."""

from __future__ import annotations

import csv
import io
import math
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from types import MappingProxyType
from typing import Any, Literal, TypeVar

from loopcal.findings.wording import SMALL, Quantity, choose_symbol, count_decimals, write_small
from loopcal.plain_text import escape
from loopcal.results.description import Field, look_up
from loopcal.units import UNITS, Dimension, Unit

GAP = 2  # blanks between two columns of text
NARROWEST = 12  # characters that a column of words keeps when a table is narrowed
RULE = "─"

Row = TypeVar("Row")


@dataclass(frozen=True)
class Column:
    """One column of a table.

    Parameters
    ----------
    title : its heading. unit : symbol of the unit of its numbers, empty where there is none or
        where another column states it.
    align : "left" for words, "right" for numbers. wraps : whether cells of words may be broken
        where the table is wider than the page; numbers are never broken.
    """

    title: str
    unit: str = ""
    align: Literal["left", "right"] = "right"
    wraps: bool = False

    @property
    def heading(self) -> str:
        """Title and unit, such as `before [mm]`."""
        return f"{self.title} [{self.unit}]" if self.unit else self.title


def word_column(title: str, wraps: bool = False) -> Column:
    """Return a column of words, on the left."""
    return Column(title, align="left", wraps=wraps)


@dataclass(frozen=True)
class Table:
    """Columns, rows of formatted cells, and a caption."""

    caption: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[str, ...], ...]

    def __post_init__(self) -> None:
        for row in self.rows:
            assert len(row) == len(self.columns), f"{self.caption}: {row}"

    def to_text(self, width: int | None = None) -> str:
        """Return the table as lines of text without trailing blanks.

        width : characters of a line. Headings and columns that wrap are broken to keep to it; where
            that is not enough the table is wider. Default: no limit.
        """
        headings = [column.heading for column in self.columns]
        widths = self._natural_widths(headings)
        if width is not None and _total(widths) > width:
            headings = [heading.replace(" [", "\n[") for heading in headings]
            widths = self._narrowed(self._natural_widths(headings), width)
        page = width or len(self.caption) or 1
        lines = textwrap.wrap(self.caption, page, break_long_words=False)
        lines += self._lines(headings, widths)
        lines.append(RULE * _total(widths))
        for row in self.rows:
            lines += self._lines(row, widths)
        return "\n".join(line.rstrip() for line in lines)

    def to_csv(self) -> str:
        """Return the headings and rows as CSV text."""
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow([column.heading for column in self.columns])
        writer.writerows(self.rows)
        return stream.getvalue()

    def to_html(self) -> str:
        """Return a `<table>` element; classes `words` and `numbers` mark the alignment, and `wraps`
        a column whose long words may be broken.

        Headings have a scope. So have the cells of the first column where it contains words.
        """
        from html import escape as escape_html

        classes = [
            ("words" if column.align == "left" else "numbers") + " wraps" * column.wraps
            for column in self.columns
        ]

        def cell(i: int, text: str, scope: str) -> str:
            tag = f'th scope="{scope}"' if scope else "td"
            shown = escape_html(escape(text, "\n"))
            return f'<{tag} class="{classes[i]}">{shown}</{tag[:2]}>'

        def row(cells: Sequence[str], scopes: Sequence[str]) -> str:
            inner = (cell(i, *pair) for i, pair in enumerate(zip(cells, scopes, strict=True)))
            return f"<tr>{''.join(inner)}</tr>"

        n = len(self.columns)
        scopes = ["row" if i == 0 and self.columns[0].align == "left" else "" for i in range(n)]
        caption = f"<caption>{escape_html(escape(self.caption))}</caption>" if self.caption else ""
        head = row([column.heading for column in self.columns], ["col"] * n)
        body = "\n".join(row(cells, scopes) for cells in self.rows)
        return f"<table>{caption}\n<thead>{head}</thead>\n<tbody>\n{body}\n</tbody>\n</table>"

    def _natural_widths(self, headings: Sequence[str]) -> list[int]:
        """Return the characters of each column without wrapping."""
        cells = [headings, *self.rows]
        return [
            max(len(line) for row in cells for line in row[i].split("\n"))
            for i in range(len(headings))
        ]

    def _narrowed(self, widths: list[int], width: int) -> list[int]:
        """Return the widths with columns narrowed, the widest first: wrapping columns to
        NARROWEST, all others to their widest cell or the longest word of their heading.
        """
        least = [
            NARROWEST if column.wraps else self._widest_unbroken(i)
            for i, column in enumerate(self.columns)
        ]
        while _total(widths) > width:
            spare = [i for i in range(len(widths)) if widths[i] > least[i]]
            if not spare:
                break
            widths[max(spare, key=widths.__getitem__)] -= 1
        return widths

    def _widest_unbroken(self, i: int) -> int:
        """Return the characters that a column needs if only its heading may be broken."""
        cells = [line for row in self.rows for line in row[i].split("\n")]
        return max(map(len, [*cells, *self.columns[i].heading.split()]))

    def _lines(self, cells: Sequence[str], widths: Sequence[int]) -> list[str]:
        """Return the lines of one row."""
        broken = [
            [
                part
                for line in cell.split("\n")
                for part in textwrap.wrap(line, width, break_long_words=False) or [""]
            ]
            for cell, width in zip(cells, widths, strict=True)
        ]
        shown = tuple(zip(self.columns, widths, strict=True))
        return [
            (" " * GAP).join(
                cell.ljust(width) if column.align == "left" else cell.rjust(width)
                for cell, (column, width) in zip(row, shown, strict=True)
            )
            for row in zip_longest(*broken, fillvalue="")
        ]


def make_table(
    caption: str, columns: Iterable[str | Column], rows: Iterable[Iterable[str]]
) -> Table:
    """Return a table of formatted cells; a title alone is a column of words."""
    shown = (word_column(c) if isinstance(c, str) else c for c in columns)
    return Table(caption, tuple(shown), tuple(map(tuple, rows)))


def build_table(
    caption: str,
    rows: Iterable[Row],
    *columns: Field | tuple[str | Column, Callable[[Row], str]],
    units: Mapping[Dimension, Unit] = MappingProxyType({}),
) -> Table:
    """Return a table from objects: fields of theirs, or columns with functions that give the cell
    of a row. A title alone is a column of words.

    units : in which fields with dimensions are shown.
    """
    rows, shown, cells = list(rows), [], []
    for column in columns:
        if isinstance(column, Field):
            is_words = all(isinstance(column.get(row), str | Dimension) for row in rows)
            heading = Column(column.title or column.name, align="left" if is_words else "right")
            shown.append(heading)
            cells.append([_format_field(column, row, units) for row in rows])
        else:
            shown.append(column[0])
            cells.append([column[1](row) for row in rows])
    return make_table(caption, shown, zip(*cells, strict=True))


def _format_field(field: Field, row: Any, units: Mapping[Dimension, Unit]) -> str:
    """Return the cell of a field."""
    value = field.get(row)
    if field.show is not None:
        return field.show(value)
    if isinstance(value, str | int | Dimension):
        return units[value].symbol if isinstance(value, Dimension) else str(value)
    if field.units:
        return format_in(units[look_up(row, field.units)], value, field.digits)
    return format_number(value, field.digits)


def _total(widths: Sequence[int]) -> int:
    """Return the characters of a line of columns."""
    return sum(widths) + GAP * (len(widths) - 1)


# Numbers for people: digits that the uncertainty leaves.

# A number smaller than this, in whatever unit is shown, is rounding and printed as 0.
ROUNDING = 1e-12
INSIGNIFICANT = 0.01  # share of its uncertainty below which a value is printed as 0
ABSENT = "-"  # stands for a number that does not exist


def format_number(value: float, digits: int = 6) -> str:
    """Return a number with `digits` significant digits, below a million all before the decimal
    point; a dash where it is not finite.
    """
    if not math.isfinite(value):
        return ABSENT
    if 10.0**digits <= abs(value) + 0.5 < 1e6:
        return f"{value:.0f}"
    return f"{0.0 if abs(value) < ROUNDING else value:.{digits}g}"


def format_in(unit: Unit, value: float | None, digits: int = 6) -> str:
    """Return a number in SI as one in a unit, without its symbol; a dash for None."""
    number = math.nan if value is None else float(value) / unit.factor_to_si
    return write_small(format_number(number, digits))


def to_quantity(number: float, unit: Unit) -> Quantity:
    """Return a number [SI] in a unit."""
    return Quantity(float(number) / unit.factor_to_si, unit.symbol)


def choose_unit(unit: Unit, values: Iterable[float | None], small: float = SMALL) -> Unit:
    """Return the unit of a column of numbers [SI]: `unit`, or a finer one for the largest, if it is
    below `small`.
    """
    sizes = [abs(x) / unit.factor_to_si for x in values if x is not None and math.isfinite(x)]
    largest = max(sizes, default=0.0)
    return UNITS[choose_symbol(largest, unit.symbol, small)[0]] if largest >= ROUNDING else unit


COARSER = {"nm": "um", "um": "mm", "urad": "mrad"}


def choose_coarser(unit: Unit, value: float) -> Unit:
    """Return the unit of a number that a user stated: a coarser one from 100 on."""
    while unit.symbol in COARSER and abs(value) >= 100.0:
        coarser = UNITS[COARSER[unit.symbol]]
        value *= unit.factor_to_si / coarser.factor_to_si
        unit = coarser
    return unit


def format_with_uncertainty(value: float, uncertainty: float, digits: int = 9) -> str:
    """Return a value to the second significant digit of its uncertainty.

    A value below a hundredth of its uncertainty is 0. Without a finite uncertainty above 0 the
    value has `digits` significant digits.
    """
    if not math.isfinite(value) or not math.isfinite(uncertainty) or uncertainty <= 0.0:
        return format_number(value, digits)
    if abs(value) < INSIGNIFICANT * uncertainty:
        value = 0.0
    return f"{value:z.{count_decimals(uncertainty)}f}"  # z: 0.00 in place of -0.00


def format_exact_beside(value: float, uncertainty: float) -> str:
    """Return a value that is exact, such as a nominal one, with the decimals of the uncertainty
    beside it; with its own digits where these would show it as 0.
    """
    if ROUNDING <= abs(value) < INSIGNIFICANT * uncertainty < math.inf:
        return format_number(value)
    return format_with_uncertainty(value, uncertainty)


def format_uncertainty(uncertainty: float) -> str:
    """Return an uncertainty with two significant digits, or a word where it has no number."""
    if math.isnan(uncertainty):
        return "not given"
    if math.isinf(uncertainty):
        return "unknown"
    return f"{uncertainty:.{count_decimals(uncertainty)}f}" if uncertainty > 0.0 else "0"


# A page of paragraphs and tables, rendered as text of a given width.

COMMAND = "Next: loopcal "  # start of a line that contains a command

Block = str | Table
"""A paragraph or a table. A paragraph may have several lines; each is wrapped on its own."""


def render_text(blocks: Iterable[Block], width: int) -> str:
    """Return blocks as plain text, with an empty line around tables.

    blocks : paragraphs and tables. An empty paragraph is an empty line.
    width : characters of a line. Paragraphs are wrapped; numbers in tables are never cut.
    """
    lines: list[str] = []
    after_table = False
    for block in blocks:
        is_table = isinstance(block, Table)
        if (is_table or (after_table and block)) and lines and lines[-1]:
            lines.append("")
        shown = (block.to_text(width) if is_table else block).split("\n")
        lines += shown if is_table else (part for line in shown for part in wrap_line(line, width))
        after_table = is_table
    return escape("\n".join(lines), "\n")


def format_list(labels_and_texts: Sequence[tuple[str, str]]) -> list[str]:
    """Return lines `  label  text`, with the texts in one column."""
    widest = max((len(label) for label, _ in labels_and_texts), default=0)
    return [f"  {label:<{widest}}  {text}" for label, text in labels_and_texts]


def wrap_line(line: str, width: int) -> list[str]:
    """Return one line wrapped; the indentation ends where a second column begins.

    A command to copy is not wrapped.
    """
    if len(line) <= width or line.startswith(COMMAND):
        return [line]
    stripped = line.lstrip()
    indent = len(line) - len(stripped)
    column = stripped.find("  ")
    if indent and 0 < column < 20:
        indent += column + len(stripped[column:]) - len(stripped[column:].lstrip())
    return textwrap.wrap(
        line,
        width,
        subsequent_indent=" " * indent,
        break_long_words=False,
        break_on_hyphens=False,
        replace_whitespace=False,
    ) or [""]
