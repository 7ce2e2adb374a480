# SPDX-License-Identifier: Apache-2.0
"""The CSV file of a comparison of runs: one row for each run and parameter."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from loopcal.io.core.csv_table import format_row
from loopcal.io.core.text_file import write_text
from loopcal.plain_text import escape_formula


def save_comparison(path: Path, titles: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Write the table of a comparison.

    Parameters
    ----------
    titles : of the columns. rows : their cells as text.

    Raises
    ------
    FileError : the file cannot be written.
    """
    lines = [titles, *rows]
    text = "".join(format_row(map(escape_formula, line)) + "\n" for line in lines)

    write_text(path, text)
