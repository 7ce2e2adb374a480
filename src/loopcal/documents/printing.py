# SPDX-License-Identifier: Apache-2.0
"""Print an HTML file to PDF with an installed Chromium."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path
from tempfile import TemporaryDirectory

from loopcal.errors import FileError
from loopcal.io.core.text_file import write_bytes

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
"""Names of programs that print, in the order in which they are tried."""

OPTIONS = ("headless", "disable-gpu", "no-pdf-header-footer", "no-first-run")
OPTIONS += ("disable-background-networking", "disable-extensions")
SANDBOX = ("no-sandbox",)
"""Options of the browser; the last for root, for whom it has no sandbox."""

SECONDS = 120
"""Time that a browser gets to print a report."""

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
            "a PDF file needs Chromium or Google Chrome, and neither is installed; install one, or "
            "open the HTML file in a browser and print it",
            output,
        )
    return browser


def print_pdf(page: Path, output: Path) -> None:
    """Print an HTML file to a PDF file, on A4 as its style sheet says.

    Raises
    ------
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
                f"{browser} did not print within {SECONDS} s; open the HTML file and print it",
                output,
            ) from None
        if ended.returncode or not printed.is_file():
            raise FileError(
                f"{browser} could not print (exit code {ended.returncode}); open the HTML file in "
                "a browser and print it",
                output,
            )
        _check_pdf(printed)
        write_bytes(output, printed.read_bytes())


def _check_pdf(file: Path) -> None:
    """Raise FileError where a file is not a complete PDF file."""
    content = file.read_bytes()
    if not content.startswith(b"%PDF-") or _END.search(content) is None:
        raise FileError("this is not a complete PDF file", file)
