# SPDX-License-Identifier: Apache-2.0
"""Write a comparison of calibrations: HTML for people, JSON and CSV for programs."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path

from loopcal.apply import RunComparison
from loopcal.documents.writing import HTML, check_ending
from loopcal.io.core.json_text import to_json
from loopcal.io.core.text_file import as_path, write_text
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
    ending = check_ending(path, "comparison", ENDINGS)
    if ending in HTML:
        document = build_comparison_document(comparison, f"loopcal {version('loopcal')}")
        write_text(path, render_html(document))
    elif ending == ".json":
        write_text(path, to_json(comparison.to_dict()))
    else:
        table = tabulate_comparison(comparison)
        save_comparison(path, [column.title for column in table.columns], table.rows)
    return path
