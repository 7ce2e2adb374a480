# SPDX-License-Identifier: Apache-2.0
"""One description of a table, rendered as text, CSV and HTML."""

from __future__ import annotations

import csv
import io
import textwrap
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, TypeVar

from loopcal.plain_text import escape

GAP = 2
"""Blanks between two columns of text."""

NARROWEST = 12
"""Characters that a column of words keeps when a table is narrowed."""

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

        Parameters
        ----------
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
        height = max(len(lines) for lines in broken)
        padded = [lines + [""] * (height - len(lines)) for lines in broken]
        return [(" " * GAP).join(self._aligned(row, widths)) for row in zip(*padded, strict=True)]

    def _aligned(self, cells: Sequence[str], widths: Sequence[int]) -> list[str]:
        """Return cells padded to the widths of their columns."""
        return [
            cell.ljust(width) if column.align == "left" else cell.rjust(width)
            for cell, width, column in zip(cells, widths, self.columns, strict=True)
        ]


def build_table(
    caption: str, rows: Iterable[Row], *columns: tuple[Column, Callable[[Row], str]]
) -> Table:
    """Return a table from objects: each column with the function that gives its cell of a row."""
    cells = tuple(tuple(cell_of(row) for _, cell_of in columns) for row in rows)
    return Table(caption, tuple(column for column, _ in columns), cells)


def _total(widths: Sequence[int]) -> int:
    """Return the characters of a line of columns."""
    return sum(widths) + GAP * (len(widths) - 1)
