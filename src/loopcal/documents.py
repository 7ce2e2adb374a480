# SPDX-License-Identifier: Apache-2.0
"""Write the report of a calibration: `NAME.html` to read, and `NAME.json` with the same content."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import webbrowser
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from loopcal.apply.base_motion import choose_base
from loopcal.apply.calibration_report import CalibrationReport
from loopcal.apply.height_errors import restore_heights
from loopcal.apply.run_comparison import RunComparison
from loopcal.apply.validation import restore_validation
from loopcal.apply.volume_accuracy import VolumeAccuracy, VolumeLike, bound_errors
from loopcal.errors import FileError, LoopcalError
from loopcal.estimate.posterior import posterior_from_arrays
from loopcal.estimate.result import residuals_from_arrays
from loopcal.io.core.outputs import refuse_outputs, write_files
from loopcal.io.core.text_file import as_path, to_json, write_bytes, write_text
from loopcal.io.formats import FORMATS
from loopcal.io.formats.import_export import build_source, export_robot
from loopcal.io.formats.program_format import ExportSource
from loopcal.io.runs.certificate import Administration, load_administration
from loopcal.io.runs.result_files import format_comparison
from loopcal.io.runs.run_folder import Run, build_document, refuse_changed_run
from loopcal.mechanism.model import Mechanism
from loopcal.plain_text import quote
from loopcal.report.document.elements import CalibrationRecord, ControllerValues, render_html
from loopcal.report.document.sections import (
    build_calibration_document,
    build_calibration_view,
    build_comparison_document,
    build_robot_view,
)
from loopcal.report.validation_view import tabulate_comparison
from loopcal.results.serialization import json_fields, restore_numbers
from loopcal.version import __version__

# Records of calibrations from reports in memory and from run folders, with controllers'
# values.

# Formats that take every robot and belong to no controller, and programs, which nobody types.
GENERAL = ("json", "csv", "c", "linuxcnc-kinematics")


def load_record(
    source: CalibrationReport | Run, facts: str | Path | None = None
) -> CalibrationRecord:
    """Return what a report shows, of a calibration in memory or a run folder.

    facts : file with what people state beside the results.

    FileError : a file of the run folder is not the one that the calibration wrote.
    """
    if isinstance(source, Run):
        refuse_changed_run(source)
        run = source
    else:  # as its run folder would be
        fit, result = source.identification, json.loads(to_json(build_document(source)))
        run = Run(Path(), result, fit.robot, fit.initial, arrays=source.arrays())
    stated = Administration() if facts is None else load_administration(facts, is_complete=False)
    robot, arrays, content = run.identified_robot, run.arrays, restore_numbers(run.result)
    stored = content.get("validation")
    moved = choose_base(content, run.initial_robot, run.robot, keep_frame=False)[1]
    return CalibrationRecord(
        result=content,
        arrays=arrays,
        robot=robot,
        initial=run.initial_robot,
        posterior=posterior_from_arrays(robot, arrays),
        validation=None if stored is None else restore_validation(stored, arrays, robot),
        heights=restore_heights(arrays, robot),
        residuals=residuals_from_arrays(arrays),
        controllers=list_controllers(
            replace(build_source(run), is_for_people=True, findings=moved)
        ),
        facts=stated.list_rows(),
    )


def state_volume(run: Run, volume: VolumeLike, limit: float | None) -> tuple[Run, VolumeAccuracy]:
    """Return a run whose documents state the largest position error in a volume, as if its
    calibration had been asked for it, and this statement; see `loopcal.bound_errors`.
    """
    posterior, frame = run.load_stated_errors(), run.result["options"]["frame"]
    stated = bound_errors(posterior, volume, frame, limit=limit)
    content = json.loads(to_json(json_fields(stated)))
    replaced = (run.result.get("volume") or {}).get("findings", ())
    findings = [f for f in run.result["findings"] if f not in replaced]
    findings += content["findings"][-1:] if limit is not None else []
    return replace(run, result=run.result | {"volume": content, "findings": findings}), stated


def list_controllers(source: ExportSource) -> tuple[ControllerValues, ...]:
    """Return the values as text of every controller's format that can express the robot."""
    controllers = []
    for target in FORMATS.values():
        if target.write is None or target.name in GENERAL:
            continue
        try:
            exported = export_robot(source, target, None)
        except LoopcalError:  # of another family, or a format that only corrects a file
            continue
        notes = tuple(str(finding) for finding in exported.findings)
        controllers.append(ControllerValues(target.name, target.what, exported.text, notes))
    return tuple(controllers)


SHORT_HTML = ".htm"
HTML = (".html", SHORT_HTML)  # endings of a page's name


def save_report(
    report: CalibrationReport | Run, path: str | Path, facts: str | Path | None = None
) -> Path:
    """Write the report of a calibration as one HTML file for people, and as JSON beside it.

    The HTML file loads nothing and can be printed, sent and archived. It contains one script, the
    3-D view, in place of which a browser without WebGL or JavaScript shows a picture. An older
    report of this name is replaced. Commands: see `loopcal report`.

    Parameters
    ----------
    report : of `loopcal.calibrate`, or a run from `loopcal.load_run`.
    path : of the HTML file, whose name ends in .html; the JSON file has the same name otherwise.
    facts : file with what people state beside the results, such as customer and serial number, see
        docs/report.md; a missing one is a line to fill in on paper.

    Returns
    -------
    path of the HTML file.

    Raises
    ------
    FileError : the name has another ending, a file cannot be written, or a fact is wrong.

    Examples
    --------
    >>> import loopcal as lc
    >>> robot = lc.load_robot("hexapod-42")
    >>> data = lc.load_measurements("examples/hexapod-42/measurements.csv", robot)
    >>> report = lc.calibrate(robot, data, lc.CalibrationOptions(hold_out=0.25))
    >>> lc.save_report(report, "report.html")  # doctest: +SKIP
    """
    path = as_path(path, "report")
    data = name_data(path)
    refuse_outputs((path, data), (), force=True)
    document = build_calibration_document(load_record(report, facts))
    html, json_text = render_html(document), to_json({"format": 1, **json_fields(document)})
    write_files({path: html, data: json_text})
    return path


def name_data(path: Path) -> Path:
    """Return the JSON file beside the HTML file of a report.

    FileError : the name does not end in .html.
    """
    check_ending(path, "report")
    return path.with_suffix(".json")


def check_ending(path: Path, what: str, endings: tuple[str, ...] = HTML) -> str:
    """Return the ending of a file's name; FileError where it is none of `endings`.

    `what` is in the file, such as "report".
    """
    ending = path.suffix.lower()
    if ending not in endings:
        allowed = tuple(name for name in endings if name != SHORT_HTML)
        shown = quote(path.suffix) if path.suffix else ""
        raise FileError.of("files.document-ending", path, what=what, allowed=allowed, ending=shown)
    return ending


# Write a comparison of calibrations: HTML for people, JSON and CSV for programs.

ENDINGS = (*HTML, ".json", ".csv")  # endings of the files of a comparison


def save_comparison(comparison: RunComparison, path: str | Path) -> Path:
    """Write a comparison of calibrations to a file; the ending of its name is the format.

    `.html` is a page for people, which loads nothing and runs no program. `.json` has all numbers
    (SI). `.csv` has one row for each run and parameter. Command: see `loopcal compare`.

    Parameters
    ----------
    comparison : of `loopcal.compare_runs`. path : of the file; an older one is replaced.

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
    >>> lc.save_comparison(lc.compare_runs(runs), "sessions.html")  # doctest: +SKIP
    """
    path = as_path(path, "comparison")
    ending = check_ending(path, "comparison", ENDINGS)
    if ending in HTML:
        document = build_comparison_document(comparison, f"loopcal {__version__}")
        write_text(path, render_html(document))
    elif ending == ".json":
        write_text(path, to_json({"format": 1, **comparison.to_dict()}))
    else:
        table = tabulate_comparison(comparison)
        titles = [column.title for column in table.columns]
        write_text(path, format_comparison(titles, table.rows))
    return path


# Print an HTML file to PDF with an installed Chromium.

# Names of programs that print, in the order in which they are tried.
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
OPTIONS = ("headless", "disable-gpu", "no-pdf-header-footer", "no-first-run")
OPTIONS += ("disable-background-networking", "disable-extensions")
SANDBOX = ("no-sandbox",)  # options of the browser; the last for root, for whom it has no sandbox
SECONDS = 120  # time that a browser gets to print a report
_END = re.compile(rb"%%EOF\s*\Z")


def find_browser() -> str | None:
    """Return the path of an installed Chromium; None without one."""
    return next((path for name in BROWSERS if (path := shutil.which(name))), None)


def is_root() -> bool:
    """Return whether the program runs as root, for whom Chromium has no sandbox."""
    return getattr(os, "geteuid", lambda: 1)() == 0


def check_browser(output: Path) -> str:
    """Return the path of an installed Chromium; FileError on `output` without one."""
    browser = find_browser()
    if browser is None:
        raise FileError(
            "a PDF file needs Chromium or Google Chrome, and this computer has neither. Install "
            "one, or open the HTML file in a browser and print it",
            output,
        )
    return browser


def print_pdf(page: Path, output: Path) -> None:
    """Print an HTML file to a PDF file, on A4 as its style sheet says.

    FileError : no browser is installed, it fails, or the file cannot be written.
    """
    browser = check_browser(output)
    with TemporaryDirectory(prefix="loopcal-") as folder:
        printed = Path(folder) / "report.pdf"
        values = {"user-data-dir": f"{folder}/profile", "print-to-pdf": str(printed)}
        options = [f"--{name}" for name in (*OPTIONS, *SANDBOX * is_root())]
        options += [f"--{name}={value}" for name, value in values.items()]
        try:
            ended = subprocess.run(
                [browser, *options, page.resolve().as_uri()],
                capture_output=True,
                timeout=SECONDS,
                check=False,
            )
        except subprocess.TimeoutExpired:
            raise FileError(
                f"{browser} did not print within {SECONDS} s. Open the HTML file and print it",
                output,
            ) from None
        if ended.returncode or not printed.is_file():
            raise FileError(
                f"{browser} could not print (exit code {ended.returncode}). Open the HTML file in "
                "a browser and print it",
                output,
            )
        content = printed.read_bytes()
        if not content.startswith(b"%PDF-") or _END.search(content) is None:
            raise FileError("this is not a complete PDF file", printed)
        write_bytes(output, content)


# Write the 3-D view of a robot or of a calibration as one HTML file, and open it.


def save_view(source: Mechanism | CalibrationReport | Run, path: str | Path) -> Path:
    """Write the interactive 3-D view of a robot or of a calibration as one HTML file.

    The page shows the robot at home. Of a calibration it also shows the robot at the measured
    poses, the position errors of the geometry before calibration, and the uncertainty over the
    workspace. It loads nothing; without WebGL or JavaScript it shows a picture. An older file of
    this name is replaced. Commands: see `loopcal view`.

    Parameters
    ----------
    source : a robot, the result of `loopcal.calibrate`, or a run from `loopcal.load_run`.
    path : of the HTML file, whose name ends in .html.

    Returns
    -------
    path of the HTML file.

    Raises
    ------
    FileError : the name has another ending, a file of the run was changed, or the file cannot be
        written.

    Examples
    --------
    >>> import loopcal as lc
    >>> lc.save_view(lc.load_robot("hexapod-42"), "view.html")  # doctest: +SKIP
    """
    path = as_path(path, "page")
    check_ending(path, "view")
    refuse_outputs((path,), (), force=True)
    is_robot = isinstance(source, Mechanism)
    document = build_robot_view(source) if is_robot else build_calibration_view(load_record(source))
    write_text(path, render_html(document))
    return path


def open_page(address: str) -> bool:
    """Open an address in the user's browser; return whether a browser was started.

    Without a display none is: a browser for terminals would take the terminal of the command.
    """
    has_display = any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))
    if sys.platform not in ("win32", "darwin") and not has_display:
        return False
    try:
        return webbrowser.open(address)
    except webbrowser.Error:
        return False
