# SPDX-License-Identifier: Apache-2.0
"""Results in notebooks: pages as HTML, and arrays as tables of pandas and xarray."""

from __future__ import annotations

import html
import math
from collections.abc import Iterable
from dataclasses import replace
from itertools import groupby
from typing import Any

from loopcal.environment import import_optional
from loopcal.plain_text import escape
from loopcal.results.description import Records
from loopcal.results.tables import Block, Column, Table, format_number

MOST_ROWS = 30  # rows of a table that a notebook shows
MOST_COLUMNS = 16  # columns of a table on a page
# Left for words, right for numbers; colors are those of the notebook.
STYLE = (
    "<style>.loopcal pre{white-space:pre-wrap;margin:0.3em 0}"
    ".loopcal caption{text-align:left;font-weight:bold}"
    ".loopcal th,.loopcal td{padding:0 0.5em}"
    ".loopcal .words{text-align:left}.loopcal .numbers{text-align:right}</style>"
)


def render_html(blocks: Iterable[Block], style: str = STYLE) -> str:
    """Return a page as one `<div>` with a style; of tables the first `MOST_ROWS` rows.

    Names are shown as they are written: markup and control characters have no effect.
    """
    sections = []
    for is_table, group in groupby(blocks, lambda block: isinstance(block, Table)):
        if is_table:
            for table in (block for block in group if isinstance(block, Table)):
                sections.append(replace(table, rows=table.rows[:MOST_ROWS]).to_html())
                if (more := len(table.rows) - MOST_ROWS) > 0:
                    sections.append(f"<pre>and {more} more {'row' if more == 1 else 'rows'}</pre>")
        elif text := "\n".join(str(block) for block in group).strip("\n"):
            sections.append(f"<pre>{html.escape(text)}</pre>")
    return escape(f'<div class="loopcal">{style}{"".join(sections)}</div>', "\n")


def build_main_table(records: Records, caption: str = "") -> Table:
    """Return the main table for a page; of many columns the first."""
    columns = list(records.list_columns().items())[:MOST_COLUMNS]
    formatted = [[_format(value) for value in values.tolist()] for _, values in columns]
    headings = (
        Column(heading, align="right" if values.dtype.kind in "iuf" else "left")
        for heading, values in columns
    )
    return Table(caption, tuple(headings), tuple(zip(*formatted, strict=True)))


def _format(value: Any) -> str:
    """Return a cell."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return "unknown" if math.isinf(value) else format_number(value)
    return str(value)


def build_dataset(records: Records) -> Any:
    """Return the arrays of a result as an xarray Dataset."""
    xarray = import_optional("xarray", "tables")
    arrays, units = {}, {}
    for variable in records.variables:
        axis, unit = variable.dimensions[-1], variable.unit
        if not isinstance(unit, str):
            units[f"{axis}_unit"] = (axis, list(unit))
            unit = f"see {axis}_unit"
        attributes = {"units": unit} if unit else {}
        arrays[variable.name] = (variable.dimensions, variable.values, attributes)
    return xarray.Dataset(arrays, coords={**records.labels, **units})
