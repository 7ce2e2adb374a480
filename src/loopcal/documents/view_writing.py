# SPDX-License-Identifier: Apache-2.0
"""Write the 3-D view of a robot or of a calibration as one HTML file, and open it."""

from __future__ import annotations

import os
import sys
import webbrowser
from pathlib import Path

from loopcal.documents.sources import load_record
from loopcal.documents.writing import check_ending
from loopcal.io import Run
from loopcal.io.core.outputs import refuse_outputs
from loopcal.io.core.text_file import as_path, write_text
from loopcal.mechanism import Mechanism
from loopcal.report.document.page import render_html
from loopcal.report.document.view_document import build_calibration_view, build_robot_view
from loopcal.workflow import CalibrationReport


def write_view(path: str | Path, source: Mechanism | CalibrationReport | Run) -> Path:
    """Write the interactive 3-D view of a robot or of a calibration as one HTML file.

    The page shows the robot at home. Of a calibration it also shows the robot at the measured
    poses, the position errors of the geometry before calibration, and the uncertainty over the
    workspace. It loads nothing; without WebGL or JavaScript it shows a picture. An older file of
    this name is replaced. Commands: see `loopcal view`.

    Parameters
    ----------
    path : of the HTML file, whose name ends in .html.
    source : a robot, the result of `loopcal.calibrate`, or a run from `loopcal.load_run`.

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
    >>> lc.write_view("view.html", lc.load_robot("hexapod-42"))  # doctest: +SKIP
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
