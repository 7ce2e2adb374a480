# SPDX-License-Identifier: Apache-2.0
"""Run one input in this process, with limits of time, and record all that it does.

The process is a worker that `campaign.py` has forked: limits of memory and of processor time end it
where Python cannot stop a run.
"""

from __future__ import annotations

import contextlib
import io
import os
import platform
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

import click

from loopcal.cli import entry_point
from loopcal.errors import LoopcalError
from tools.fuzz.cases import Case
from tools.fuzz.surroundings import set_variables

CPU_LIMIT, WAIT_LIMIT = 10.0, 15.0
"""Seconds of processor time of a run, and seconds that it may do nothing but wait."""

MEMORY_LIMIT = 4 << 30
"""Bytes of address space of a worker."""

DEEPEST = 250_000
"""Bytes of a file of which a copy is kept to find changes."""


class TimeIsUp(BaseException):
    """A run took too long; no handler of exceptions may catch this."""


@dataclass
class Outcome:
    """What a run did.

    Attributes
    ----------
    code : exit code; None where an exception or a limit ended the run. cpu : seconds.
    failures : exceptions that are no message, and limits, each with its traceback.
    before, after : content of the files by name. warned : warnings. escapes : writes elsewhere.
    """

    code: int | None = None
    out: str = ""
    err: str = ""
    cpu: float = 0.0
    failures: list[tuple[str, str]] = field(default_factory=list)
    before: dict[str, bytes | str] = field(default_factory=dict)
    after: dict[str, bytes | str] = field(default_factory=dict)
    warned: list[str] = field(default_factory=list)
    escapes: list[str] = field(default_factory=list)


WATCHED: list[tuple[Path, Outcome]] = []
"""Folder and outcome of the run in progress, for the hook that cannot be removed again."""

WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND


def watch_writes(event: str, arguments: tuple[Any, ...]) -> None:
    """Refuse writes outside of the folder of the run, and the start of programs (audit hook)."""
    if not WATCHED or event not in EVENTS:
        return
    folder, outcome = WATCHED[-1]
    paths: list[Any] = []
    if event == "open":
        paths = [arguments[0]] if isinstance(arguments[2], int) and arguments[2] & WRITES else []
    elif event in ("os.rename", "os.link", "os.symlink"):
        paths = [arguments[1]] if event == "os.symlink" else list(arguments[:2])
    elif event in FILE_EVENTS:
        paths = [arguments[0]]
    else:
        outcome.escapes.append(f"{event} {arguments!r}"[:200])
        raise PermissionError(13, "refused by the fuzzer", event)
    for path in paths:
        if isinstance(path, str | bytes | os.PathLike):
            place = os.path.realpath(os.fsdecode(path))
            if not place.startswith(str(folder)) and place != os.devnull:
                outcome.escapes.append(f"{event} {place}")
                raise PermissionError(13, "refused by the fuzzer", place)


FILE_EVENTS = {"os.remove", "os.rmdir", "os.mkdir", "os.chmod", "os.truncate", "shutil.rmtree"}
EVENTS = {
    "open",
    "os.rename",
    "os.link",
    "os.symlink",
    "os.system",
    "subprocess.Popen",
    "socket.connect",
    "os.exec",
    *FILE_EVENTS,
}


def prepare_worker() -> None:
    """Set the limits of this process and the hooks that a run needs."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_LIMIT, MEMORY_LIMIT))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.signal(signal.SIGPROF, _stop)
    signal.signal(signal.SIGALRM, _stop_waiting)
    platform.uname().processor  # noqa: B018  # starts a program once, which is not the run's doing
    sys.dont_write_bytecode = True  # Python compiles a module where the first run imports it
    sys.addaudithook(watch_writes)
    os.environ["COLUMNS"] = "100"
    os.environ["PATH"] = ""  # a browser is a program of others, which the hooks cannot watch


def _stop(_number: int, _frame: FrameType | None) -> None:
    raise TimeIsUp("processor time")


def _stop_waiting(_number: int, _frame: FrameType | None) -> None:
    """End a run that has not computed since the last signal; a busy machine is no reason to."""
    now = read_busy_time()
    if now - LAST_SEEN[0] < 0.01 * WAIT_LIMIT:
        raise TimeIsUp("waiting")
    LAST_SEEN[0] = now


LAST_SEEN = [0.0]
"""Busy time of this process at the last signal."""


def read_busy_time() -> float:
    """Return the seconds that this process computed, or waited for a processor where Linux counts
    them.
    """
    try:
        return sum(map(int, Path("/proc/self/schedstat").read_text().split()[:2])) / 1e9
    except OSError:
        return time.process_time()


@contextlib.contextmanager
def limited_time() -> Iterator[None]:
    """Raise TimeIsUp after too much processor time, and end the process after twice as much."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    _, hard = resource.getrlimit(resource.RLIMIT_CPU)
    spent = int(used.ru_utime + used.ru_stime)
    resource.setrlimit(resource.RLIMIT_CPU, (spent + int(2 * CPU_LIMIT) + 1, hard))
    LAST_SEEN[0] = read_busy_time()
    signal.setitimer(signal.ITIMER_PROF, CPU_LIMIT, 1.0)
    signal.setitimer(signal.ITIMER_REAL, WAIT_LIMIT, WAIT_LIMIT)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.setitimer(signal.ITIMER_REAL, 0.0)


def write_case(case: Case, folder: Path) -> None:
    """Write the files of an input."""
    for name, content in (case.files | case.foreign).items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if isinstance(content, bytes):
            path.write_bytes(content)
        elif content == "folder":
            path.mkdir()
        elif content == "fifo":
            os.mkfifo(path)
        elif content == "loop":
            path.symlink_to(path.name)
        elif content == "link":
            path.symlink_to("missing.txt")
        elif content == "empty":
            path.touch()


def read_folder(folder: Path) -> dict[str, bytes | str]:
    """Return the files below a folder; of large ones their size, of others what they are."""
    files: dict[str, bytes | str] = {}
    for entry in _scan(folder):
        name = entry.path[len(str(folder)) + 1 :]
        if not entry.is_file(follow_symlinks=False):
            files[name] = "folder" if os.path.isdir(entry.path) else "other"  # noqa: PTH112  # loops
        elif entry.stat().st_size > DEEPEST:
            files[name] = f"{entry.stat().st_size} bytes"
        else:
            with open(entry.path, "rb") as stream:  # noqa: PTH123  # Path costs more than reading
                files[name] = stream.read()
    return files


def _scan(folder: Path | str) -> Iterator[os.DirEntry[str]]:
    """Yield every file and folder below a folder, a folder before its content."""
    for entry in sorted(os.scandir(folder), key=lambda entry: entry.name):
        yield entry
        if entry.is_dir(follow_symlinks=False):
            yield from _scan(entry.path)


def run_case(case: Case, folder: Path) -> Outcome:
    """Run an input in an empty folder and return what it did; the folder keeps its files."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    write_case(case, folder)
    outcome = Outcome(before=read_folder(folder))
    tempfile.tempdir = str(folder.parent)
    out, err = (
        io.TextIOWrapper(io.BytesIO(), "utf-8", mode) for mode in ("strict", "backslashreplace")
    )
    begin = time.process_time()
    with (
        contextlib.chdir(folder),
        set_variables(case.variables),
        warnings.catch_warnings(record=True) as warned,
        _watched(folder.parent, outcome),
    ):
        warnings.simplefilter("always")
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), _recorded(outcome):
            outcome.code = entry_point.main(case.words)
    outcome.cpu = time.process_time() - begin
    for stream in (out, err):
        stream.flush()
    outcome.out, outcome.err = (s.buffer.getvalue().decode("utf-8", "replace") for s in (out, err))  # type: ignore[attr-defined]
    outcome.warned = [
        f"{w.category.__name__}: {w.message} ({_shorten(w.filename)}:{w.lineno})" for w in warned
    ]
    outcome.after = read_folder(folder)
    return outcome


def _shorten(path: str) -> str:
    return path.partition("/src/")[2] or path.rpartition("site-packages/")[2]


@contextlib.contextmanager
def _watched(folder: Path, outcome: Outcome) -> Iterator[None]:
    WATCHED.append((folder.resolve(), outcome))
    try:
        yield
    finally:
        WATCHED.clear()


@contextlib.contextmanager
def _recorded(outcome: Outcome) -> Iterator[None]:
    """Record exceptions that the command line does not expect, whatever it makes of them."""
    original = entry_point.command_line.main

    def watched(*arguments: Any, **options: Any) -> Any:
        try:
            return original(*arguments, **options)
        except (
            click.ClickException,
            click.exceptions.Abort,
            LoopcalError,
            OSError,
            KeyboardInterrupt,
        ):
            raise
        except Exception as error:
            outcome.failures.append((type(error).__name__, _format(error)))
            raise

    entry_point.command_line.main = watched  # type: ignore[method-assign]
    try:
        with limited_time():
            yield
    except TimeIsUp as error:
        outcome.failures.append((f"TimeIsUp {error}", _format(error)))
    except BaseException as error:  # noqa: BLE001  # whatever leaves main is what is looked for
        if not outcome.failures:
            outcome.failures.append((type(error).__name__, _format(error)))
    finally:
        entry_point.command_line.main = original  # type: ignore[method-assign]


def _format(error: BaseException) -> str:
    lines = traceback.format_exception(error, limit=-60)
    return "".join(lines)[-6000:]
