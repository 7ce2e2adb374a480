# SPDX-License-Identifier: Apache-2.0
"""Measurement files that are made from exports: written, and compared with what is read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from loopcal.io.core.csv_table import format_header, read_table, refuse_settings_beside
from loopcal.io.core.read_back import require_same
from loopcal.io.core.text_file import write_text


def save_table(
    path: str | Path, text: str, table: Sequence[tuple[str, ...]], settings: Mapping[str, object]
) -> None:
    """Write a measurement file whose text has this header, these rows and these settings.

    Raises
    ------
    FileError : the file cannot be written, or reads otherwise.
    """

    def check(written: Path) -> None:
        read = read_table(written)
        header, *rows = table
        require_same("columns", header, format_header(read.units))
        for before, after in zip(rows, read.rows, strict=True):
            require_same("row", before, after)
        require_same("settings", settings, read.settings.content)

    refuse_settings_beside(Path(path))
    write_text(path, text, check)
