# SPDX-License-Identifier: Apache-2.0
"""Write the report of a calibration: `NAME.html` to read, and `NAME.json` with the same content."""

from __future__ import annotations

from pathlib import Path

from loopcal.documents.sources import load_record
from loopcal.errors import FileError
from loopcal.findings import report_finding
from loopcal.io import Run
from loopcal.io.core.json_text import to_json
from loopcal.io.core.outputs import refuse_outputs, restore_on_failure
from loopcal.io.core.text_file import as_path, write_text
from loopcal.plain_text import quote
from loopcal.report.document.calibration_document import build_document
from loopcal.report.document.page import render_html
from loopcal.workflow import CalibrationReport

SHORT_HTML = ".htm"
HTML = (".html", SHORT_HTML)
"""Endings of a page's name."""


def write_report(path: str | Path, report: CalibrationReport | Run) -> Path:
    """Write the report of a calibration as one HTML file for people, and as JSON beside it.

    The HTML file loads nothing and can be printed, sent and archived. It contains one script, the
    3-D view, in place of which a browser without WebGL or JavaScript shows a picture. An older
    report of this name is replaced. Commands: see `loopcal report`.

    Parameters
    ----------
    path : of the HTML file, whose name ends in .html; the JSON file has the same name otherwise.
    report : of `loopcal.calibrate`, or a run from `loopcal.load_run`.

    Returns
    -------
    path of the HTML file.

    Raises
    ------
    FileError : the name has another ending, or a file cannot be written.

    Examples
    --------
    >>> import loopcal as lc
    >>> robot = lc.load_robot("hexapod-42")
    >>> data = lc.load_measurements("examples/hexapod-42/measurements.csv", robot)
    >>> report = lc.calibrate(robot, data, lc.CalibrationOptions(hold_out=0.25))
    >>> lc.write_report("report.html", report)  # doctest: +SKIP
    """
    path = as_path(path, "report")
    _, data = name_files(path)
    refuse_outputs((path, data), (), force=True)
    document = build_document(load_record(report))
    html, json_text = render_html(document), to_json({"format": 1, **document.to_dict()})
    with restore_on_failure((path, data)):
        write_text(path, html)
        write_text(data, json_text)
    return path


def name_files(path: Path) -> tuple[Path, Path]:
    """Return the HTML and the JSON file of a report.

    Raises
    ------
    FileError : the name does not end in .html.
    """
    check_ending(path, "report")
    return path, path.with_suffix(".json")


def check_ending(path: Path, what: str, endings: tuple[str, ...] = HTML) -> str:
    """Return the ending of a file's name; FileError where it is none of `endings`.

    `what` is in the file, such as "report".
    """
    ending = path.suffix.lower()
    if ending not in endings:
        allowed = tuple(name for name in endings if name != SHORT_HTML)
        shown = quote(path.suffix) if path.suffix else ""
        finding = report_finding("files.document-ending", what=what, allowed=allowed, ending=shown)
        raise FileError(finding, path)
    return ending
