# SPDX-License-Identifier: Apache-2.0
"""A page of paragraphs and tables, rendered as text of a given width."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Sequence

from loopcal.plain_text import escape
from loopcal.report.tables import Table

COMMAND = "Next: loopcal "
"""Start of a line that contains a command."""

Block = str | Table
"""A paragraph or a table. A paragraph may have several lines; each is wrapped on its own."""


def render_text(blocks: Iterable[Block], width: int) -> str:
    """Return blocks as plain text, with an empty line around tables.

    Parameters
    ----------
    blocks : paragraphs and tables. An empty paragraph is an empty line.
    width : characters of a line. Paragraphs are wrapped; numbers in tables are never cut.
    """
    lines: list[str] = []
    after_table = False
    for block in blocks:
        is_table = isinstance(block, Table)
        if (is_table or (after_table and block)) and lines and lines[-1]:
            lines.append("")
        lines += (block.to_text(width) if is_table else wrap_text(block, width)).split("\n")
        after_table = is_table
    return escape("\n".join(lines), "\n")


def wrap_text(text: str, width: int) -> str:
    """Return text with each line wrapped; continuation lines keep the indentation of theirs."""
    return "\n".join(_wrap_line(line, width) for line in text.split("\n"))


def format_list(labels_and_texts: Sequence[tuple[str, str]]) -> list[str]:
    """Return lines `  label  text`, with the texts in one column."""
    widest = max((len(label) for label, _ in labels_and_texts), default=0)
    return [f"  {label:<{widest}}  {text}" for label, text in labels_and_texts]


def _wrap_line(line: str, width: int) -> str:
    """Return one line wrapped; the indentation ends where a second column begins.

    A command to copy is not wrapped.
    """
    if len(line) <= width or line.startswith(COMMAND):
        return line
    stripped = line.lstrip()
    indent = len(line) - len(stripped)
    column = stripped.find("  ")
    if indent and 0 < column < 20:
        indent += column + len(stripped[column:]) - len(stripped[column:].lstrip())
    return textwrap.fill(
        line,
        width,
        subsequent_indent=" " * indent,
        break_long_words=False,
        break_on_hyphens=False,
        drop_whitespace=True,
        replace_whitespace=False,
    )
