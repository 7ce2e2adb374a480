# SPDX-License-Identifier: Apache-2.0
"""Paragraphs and tables as HTML for notebooks."""

from __future__ import annotations

import html
from collections.abc import Iterable
from dataclasses import replace
from itertools import groupby

from loopcal.plain_text import escape
from loopcal.report.tables import Table
from loopcal.report.text_page import Block

MOST_ROWS = 30
"""Rows of a table that a notebook shows."""

STYLE = (
    "<style>.loopcal pre{white-space:pre-wrap;margin:0.3em 0}"
    ".loopcal caption{text-align:left;font-weight:bold}"
    ".loopcal th,.loopcal td{padding:0 0.5em}"
    ".loopcal .words{text-align:left}.loopcal .numbers{text-align:right}</style>"
)
"""Left for words, right for numbers; colors are those of the notebook."""


def render_html(blocks: Iterable[Block]) -> str:
    """Return a page as one `<div>`; of tables the first `MOST_ROWS` rows.

    Names are shown as they are written: markup and control characters have no effect.
    """
    sections = []
    for is_table, group in groupby(blocks, lambda block: isinstance(block, Table)):
        if is_table:
            sections += [_render_table(table) for table in group if isinstance(table, Table)]
        elif text := "\n".join(str(block) for block in group).strip("\n"):
            sections.append(f"<pre>{html.escape(text)}</pre>")
    return escape(f'<div class="loopcal">{STYLE}{"".join(sections)}</div>', "\n")


def _render_table(table: Table) -> str:
    """Return the first rows of a table, and how many more there are."""
    more = len(table.rows) - MOST_ROWS
    if more <= 0:
        return table.to_html()
    shown = replace(table, rows=table.rows[:MOST_ROWS]).to_html()
    return f"{shown}<pre>and {more} more {'row' if more == 1 else 'rows'}</pre>"
