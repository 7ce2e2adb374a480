# SPDX-License-Identifier: Apache-2.0
"""What the command line does with an exception that is no mistake of the user: a defect report.

The screen shows one sentence. The traceback, the command and the versions are written to a file
that the user can read and send.
"""

from __future__ import annotations

import os
import platform
import shlex
import tempfile
import traceback
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

PACKAGES = ("loopcal", "numpy", "scipy", "ruamel.yaml", "pydantic", "click")
"""Packages whose versions a report states."""

PREFIX, SUFFIX = "loopcal-defect-", ".txt"
"""Beginning and end of the name of a report; the rest is drawn by the operating system."""

DEFECT_CODE = 3
"""Exit code of a command that ended by a defect of loopcal."""


def describe_defect(error: BaseException, words: Sequence[str]) -> str:
    """Save a report of an unexpected exception, and return the sentence for the screen.

    Parameters
    ----------
    error : the exception. words : of the command line after `loopcal`.
    """
    sentence = f"this is a defect of loopcal, not of your input ({_name_place(error)})"
    path = save_report(format_report(error, words))
    if path is None:
        return (
            f"{sentence}; no report could be saved: send the developers this message, the command "
            f"and the version {_find_version('loopcal')}"
        )
    return (
        f"{sentence}; please read {path}, which contains the command, versions and the Python "
        "traceback, and send it to the developers together with the input files"
    )


def format_report(error: BaseException, words: Sequence[str]) -> str:
    """Return the text of a report: command, versions and traceback."""
    versions = [f"{name} {_find_version(name)}" for name in PACKAGES]
    trace = "".join(traceback.format_exception(error, limit=-100))
    machine = platform.uname()
    lines = (
        "loopcal stopped because of a defect. This report and the input files make it repeatable.",
        f"command: {shlex.join(['loopcal', *words])}",
        f"versions: {', '.join(versions)}, Python {platform.python_version()}",
        f"system: {machine.system} {machine.release} {machine.machine}",
        "",
        trace,
    )
    return "\n".join(lines)


def save_report(text: str) -> Path | None:
    """Write a report to a new file in the temporary folder, or where that fails in the current one.

    The name is unpredictable, and the file is made exclusively: nothing is replaced and no symbolic
    link is followed. None where no file can be written.
    """
    for folder in (None, "."):
        try:
            number, name = tempfile.mkstemp(SUFFIX, PREFIX, folder)
        except OSError:
            continue
        path = Path(name)
        try:
            with os.fdopen(number, "w", encoding="utf-8", errors="backslashreplace") as stream:
                stream.write(text)
        except OSError:
            path.unlink(missing_ok=True)
            continue
        return path
    return None


def _name_place(error: BaseException) -> str:
    """Return the kind of an exception and the innermost line of loopcal that it passed."""
    package = Path(__file__).resolve().parent.parent
    frames = traceback.extract_tb(error.__traceback__, limit=-100)
    own = [frame for frame in frames if Path(frame.filename).is_relative_to(package)]
    if not own:
        return type(error).__name__
    place = Path(own[-1].filename).relative_to(package.parent).as_posix()
    return f"{type(error).__name__} at {place}:{own[-1].lineno}"


def _find_version(package: str) -> str:
    """Return the version of a package; `unknown` where it is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "unknown"
