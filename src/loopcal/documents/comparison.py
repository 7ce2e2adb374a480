# SPDX-License-Identifier: Apache-2.0
"""Write a comparison of calibrations: HTML for people, JSON and CSV for programs."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path

from loopcal.apply import RunComparison
from loopcal.documents.writing import HTML, write_html
from loopcal.errors import ArgumentTypeError, FileError
from loopcal.io.core.json_text import to_json
from loopcal.io.core.limits import TABLE_SIZE
from loopcal.io.core.read_back import require_same
from loopcal.io.core.text_file import as_path, read_text, write_text
from loopcal.io.runs.comparison_file import save_comparison
from loopcal.report.document.comparison_document import build_comparison_document
from loopcal.report.document.page import render_html
from loopcal.report.run_comparison_view import tabulate_comparison

ENDINGS = (*HTML, ".json", ".csv")
"""Endings of the files of a comparison."""


def write_comparison(path: str | Path, comparison: RunComparison) -> Path:
    """Write a comparison of calibrations to a file; the ending of its name is the format.

    `.html` is a page for people, which loads nothing and runs no program. `.json` has all numbers
    (SI). `.csv` has one row for each run and parameter. Command: see `loopcal compare`.

    Parameters
    ----------
    path : of the file; an older one is replaced. comparison : of `loopcal.compare_runs`.

    Returns
    -------
    path of the file.

    Raises
    ------
    FileError : the name has another ending, or the file cannot be written.

    Examples
    --------
    >>> import loopcal as lc
    >>> runs = [lc.load_run("may"), lc.load_run("june")]  # doctest: +SKIP
    >>> lc.write_comparison("sessions.html", lc.compare_runs(runs))  # doctest: +SKIP
    """
    path = as_path(path, "comparison")
    if not isinstance(comparison, RunComparison):
        raise ArgumentTypeError(
            f"comparison is {type(comparison).__name__}; pass the result of loopcal.compare_runs"
        )
    ending = check_ending(path)
    if ending in HTML:
        document = build_comparison_document(comparison, f"loopcal {version('loopcal')}")
        write_html(path, render_html(document))
    elif ending == ".json":
        text = to_json(comparison.to_dict())
        write_text(path, text, lambda file: _check_json(file, text))
    else:
        table = tabulate_comparison(comparison)
        save_comparison(path, [column.title for column in table.columns], table.rows)
    return path


def _check_json(file: Path, text: str) -> None:
    """Read a written file; raise LoopcalError where it is not the one that was made."""
    require_same("comparison", text, read_text(file, "comparison", limit=TABLE_SIZE))


def check_ending(path: Path) -> str:
    """Return the ending of a file's name; FileError where it is none of a comparison."""
    ending = path.suffix.lower()
    if ending not in ENDINGS:
        shown = repr(path.suffix) if path.suffix else "no ending"
        sentence = (
            f"the name of a comparison ends in .html, .json or .csv, but this one has {shown}"
        )
        raise FileError(f"{sentence}; choose another name, such as comparison.html", path)
    return ending
