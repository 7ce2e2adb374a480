# SPDX-License-Identifier: Apache-2.0
"""A reproduction as a folder: a page to read, every table as CSV and JSON, every figure as PNG.

page.md        what agrees, what does not and why, with all tables and figures
result.json    the same for programs, and under `made_by` where it comes from
tables/        NAME.csv and NAME.json, one row for each number
figures/       NAME.png

"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from loopcal import serialization
from loopcal.io.core.json_text import to_json
from loopcal.io.core.result_folder import FolderKind, refuse_folder, write_result_folder

if TYPE_CHECKING:
    from loopcal.papers.printed import Table
    from loopcal.papers.reproduction import Reproduction

TEMPLATE = "page.md.j2"
STUDY = FolderKind(
    "study",
    "result.json",
    ("made_by", "paper"),
    ("page.md", "tables/*.csv", "tables/*.json", "figures/*.png"),
)


def refuse_study_folder(path: Path, force: bool) -> None:
    """Raise FileError where a study must not be written; see `refuse_folder`."""
    refuse_folder(path, STUDY, force)


def page(reproduction: Reproduction, made_by: Mapping[str, Any]) -> str:
    """Return the page as Markdown.

    Parameters
    ----------
    reproduction : what to show. made_by : see `loopcal.io.runs.run_folder.collect_provenance`.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(TEMPLATE).render(reproduction=reproduction, made_by=made_by)


def write_folder(
    path: str | Path, reproduction: Reproduction, made_by: Mapping[str, Any], force: bool = False
) -> Path:
    """Write a reproduction whole or not at all; return the folder.

    Parameters
    ----------
    path : folder to make. reproduction : what to write. made_by : where it comes from.
    force : replace an earlier one.

    Raises
    ------
    FileError : see `write_result_folder`.
    """
    from loopcal.papers.drawing import choose_styles, png

    path = Path(path)
    files = {"page.md": page(reproduction, made_by).encode("utf-8", "backslashreplace")}
    for table in (
        reproduction.summary(),
        *(c.table() for c in reproduction.comparisons),
        *reproduction.tables,
    ):
        files[f"tables/{table.name}.csv"] = csv_text(table).encode()
        files[f"tables/{table.name}.json"] = to_json(table.to_dict()).encode()
    style = choose_styles(reproduction.figures)
    for figure in reproduction.figures:
        files[f"figures/{figure.name}.png"] = png(figure, style)
    document = {"made_by": made_by, **reproduction.to_dict()}
    write_result_folder(path, STUDY, document, files, force)
    return path


def csv_text(table: Table) -> str:
    """Return a table as CSV with a header; numbers in full, and no cell where one is not finite."""
    stream = StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(table.columns)
    rows = serialization.to_json(table.rows)
    writer.writerows(["" if cell is None else cell for cell in row] for row in rows)
    return stream.getvalue()
