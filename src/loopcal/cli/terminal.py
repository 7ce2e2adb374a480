# SPDX-License-Identifier: Apache-2.0
"""Output to the terminal: wrapped pages, JSON, notes, quality gates and progress."""

from __future__ import annotations

import codecs
import json
import os
import shutil
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from io import TextIOWrapper
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self, TextIO

import click

from loopcal.errors import FileError
from loopcal.findings import Finding, report_finding
from loopcal.plain_text import escape

if TYPE_CHECKING:
    from loopcal.results.tables import Block

FORMAT = 1  # of the documents that --json prints and no file holds: output.schema.json
WIDEST = 120  # characters of the longest line of prose, on wide terminals
LONGEST_MESSAGE = 4000  # characters of a message; a longer one lists more than anybody reads
DELAY = 2.0  # seconds of work before progress is shown
PAGE = "LOOPCAL_PAGE"
"""Variable with which `loopcal app` runs commands: their pages are HTML, and they write progress on
standard error as lines that begin with `MARK`.
"""
MARK, INTERVAL = "\x1e", 0.1  # seconds between two lines of progress


def width() -> int:
    """Return the characters of a line: those of the terminal, or 80 where there is none."""
    return min(shutil.get_terminal_size((80, 24)).columns, WIDEST)


@dataclass(frozen=True)
class Output:
    """What a command has found out.

    document : for --json. page : makes the paragraphs and tables for people, or text as it is;
        nothing is printed where they are empty.
    failures : quality gates that are not met. shown : whether the page contains them; then a
        terminal does not repeat them. exit_code : 2 where there are failures, unless it is stated.
    """

    document: Any
    page: Callable[[], Sequence[Block] | str]
    failures: Iterable[Finding | str] = ()
    shown: bool = False
    exit_code: int | None = None


def print_output(output: Output, as_json: bool) -> int:
    """Print what a command has found out, and return its exit code."""
    page = None if as_json else output.page()
    if as_json:
        from loopcal.io.core.text_file import convert_document, to_json

        content = convert_document(output.document)
        number = {} if "$schema" in content else {"format": FORMAT}
        print_text(to_json(add_findings(number | content)))
    elif isinstance(page, str):
        print_text(page)
    elif page and PAGE in os.environ:
        from loopcal.results.notebook import render_html
        from loopcal.results.tables import COMMAND

        own = ("Written to ", COMMAND)  # files that the page lists, and what it has buttons for
        print_text(render_html([b for b in page if not str(b).startswith(own)], style=""))
    elif page:
        from loopcal.results.tables import render_text

        print_text(render_text(page, width()) + "\n")
    failures = list(output.failures)
    if as_json or not (output.shown and sys.stdout.isatty()):
        for failure in failures:
            print_message(f"loopcal: quality gate not met: {failure}")
    return (2 if failures else 0) if output.exit_code is None else output.exit_code


def read_output_schema() -> dict[str, Any]:
    """Return the JSON Schema of the documents of all commands, which tools.output_schema makes."""
    return json.loads(Path(__file__).with_name("output.schema.json").read_text("utf-8"))


def print_text(text: str) -> None:
    """Print text on standard output, plain and otherwise as it is.

    FileError : standard output cannot be written, such as a file on a full disk.
    BrokenPipeError : its reader has stopped.
    """
    with _report_output_errors():
        click.echo(escape(text, "\n"), nl=False)


def flush_output() -> None:
    """Write what is left of standard output; raise as `print_text`."""
    with _report_output_errors():
        sys.stdout.flush()


@contextmanager
def _report_output_errors() -> Iterator[None]:
    """Raise FileError where standard output cannot be written; Python does not try again."""
    try:
        yield
    except OSError as error:
        silence(sys.stdout)
        if isinstance(error, BrokenPipeError):
            raise
        reason = (error.strerror or str(error)).lower()
        raise FileError(f"cannot be written ({reason})", "standard output") from error


def silence(stream: TextIO) -> None:
    """Discard what is left of a standard stream, which Python would try to write when it exits."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def prepare_streams() -> None:
    """Replace standard streams that are closed, so that no output file takes their place, and let
    other signs and escapes stand for characters that they cannot express or read.
    """
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # the lowest free descriptor, which is this one
    codecs.register_error("loopcal", _express)
    for name in ("stdin", "stdout", "stderr"):
        mode, errors = ("r", "backslashreplace") if name == "stdin" else ("w", "loopcal")
        if getattr(sys, name) is None:
            stream = Path(os.devnull).open(mode, encoding="utf-8")  # noqa: SIM115 until the end
            setattr(sys, name, stream)
        stream = getattr(sys, name)
        if isinstance(stream, TextIOWrapper) and stream.errors in ("strict", "backslashreplace"):
            stream.reconfigure(errors=errors)


def _express(error: UnicodeError) -> tuple[str | bytes, int]:
    """Return what stands for the first character that an encoding lacks, and where to go on."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    sign, error.end = SIGNS.get(error.object[error.start]), error.start + 1
    return (sign, error.end) if sign else codecs.backslashreplace_errors(error)


# Signs of our own texts, where the encoding of a terminal lacks them.
SIGNS = {"\u2500": "-", "\u2026": "..."}


def print_message(text: str) -> None:
    """Print a message on standard error: one line of plain text, which a terminal shows wrapped."""
    text = escape(text if len(text) <= LONGEST_MESSAGE else f"{text[:LONGEST_MESSAGE]} …")
    if sys.stderr.isatty():
        text = textwrap.fill(text, width(), break_long_words=False, break_on_hyphens=False)
    try:
        click.echo(text, err=True)
    except OSError:  # a message that cannot be shown must not end the work
        silence(sys.stderr)


def print_note(text: object) -> None:
    """Print a text or finding as a note on standard error."""
    print_message(f"loopcal: note: {text}")


def print_finding(code: str, **facts: Any) -> None:
    """Print the finding of a code as a note on standard error, once; --json contains it, too."""
    finding, printed = report_finding(code, **facts), list_printed()
    if finding not in printed:
        printed.append(finding)
        print_note(finding)


def list_printed() -> list[Finding]:
    """Return the findings that the running command has printed as notes, to read or to extend."""
    context = click.get_current_context(silent=True)
    return [] if context is None else context.meta.setdefault("loopcal.printed", [])


def add_findings(document: Any) -> Any:
    """Return the document of the running command with the findings that were printed as notes."""
    printed = list_printed()
    return {**document, "input_findings": printed} if printed else document


class TerminalProgress:
    """The progress callback of the command line: a bar on standard error.

    It is drawn only where standard error is a terminal, and only after two seconds of work. A timer
    draws it, so that a long step without further reports shows, too; `step` is the first one.
    """

    def __init__(self, step: str = "") -> None:
        self._lock = threading.Lock()
        self._timer = threading.Timer(DELAY, self._start)
        self._timer.daemon = True
        self._bar: Any = None
        self._task: Any = None
        self._state: tuple[int, int, str] | None = (0, 1, step) if step else None
        self._total: int | None = None
        self._written = -INTERVAL

    def __enter__(self) -> Self:
        if PAGE in os.environ and self._state is not None:
            self._write(*self._state)
        elif sys.stderr.isatty():
            self._timer.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._timer.cancel()
        with self._lock:
            self._state = None
            if self._bar is not None:
                self._bar.stop()
                self._bar = None

    def __call__(self, done: int, total: int, what: str, /) -> None:
        """Draw `done` of `total` steps of `what`."""
        with self._lock:
            self._state = (done, total, what)
            if self._bar is not None:
                self._draw(*self._state)
        if PAGE in os.environ and time.monotonic() > self._written + INTERVAL:
            self._write(done, total, what)

    def _write(self, done: int, total: int, what: str) -> None:
        """Write progress as a line."""
        self._written = time.monotonic()
        click.echo(f"{MARK}{done}\t{total}\t{escape(what)}", err=True)

    def _start(self) -> None:
        """Begin to draw, after the delay."""
        with self._lock:
            if self._state is None:
                return
            self._bar = _make_bar()
            self._bar.start()
            self._draw(*self._state)

    def _draw(self, done: int, total: int, what: str) -> None:
        """Update the bar; work with another number of steps begins a bar of its own."""
        if total != self._total:
            if self._task is not None:
                self._bar.remove_task(self._task)
            self._task, self._total = self._bar.add_task(what, total=total, completed=done), total
        self._bar.update(self._task, completed=done, description=what)


def _make_bar() -> Any:
    """Return a bar with percentage and remaining time that disappears at the end."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress,
        TaskProgressColumn,
        TextColumn,
        TimeRemainingColumn,
    )

    return Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TaskProgressColumn(),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        transient=True,
    )
