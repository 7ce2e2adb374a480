# SPDX-License-Identifier: Apache-2.0
"""The option --time-limit of every command: work that takes longer is stopped.

Where the operating system has timers, a signal stops the main thread between two instructions of
Python. Elsewhere, and in other threads, a timer of its own thread raises the exception in the
thread that works.
"""

from __future__ import annotations

import copy
import ctypes
import re
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import click

CODE = 4
"""Exit code where the time limit was reached."""

REPEAT = 5.0
"""Seconds until work that ignored the exception is stopped again."""

LONGEST = 30 * 86400.0
"""Largest limit [s]."""

SECONDS = {"s": 1.0, "min": 60.0, "h": 3600.0}
"""Seconds of a unit."""

_DURATION = re.compile(r"(\d{1,9}(?:\.\d{1,9})?)\s*([a-z]+)")


class TimeLimitError(BaseException):
    """The time limit is reached. It passes what catches errors, as KeyboardInterrupt does.

    `limit` [s]; `step` : what was being done, where progress named it.
    """

    def __init__(self, limit: float = 0.0) -> None:
        super().__init__(limit)
        self.limit = limit
        self.step = ""

    def __str__(self) -> str:
        step = f" during this step: {self.step}" if self.step else ""
        return f"the time limit of {format_duration(self.limit)} was reached{step}"


class Duration(click.ParamType):  # pyright: ignore[reportMissingTypeArgument]  # generic since 8.4
    """A number of seconds, minutes or hours, such as 30s, 10min or 2h; its value is in seconds."""

    name = "duration"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """Return the seconds, or fail with what is allowed."""
        match = _DURATION.fullmatch(str(value))
        if match is None or match[2] not in SECONDS:
            self.fail(f"{value!r} is not a duration; write 30s, 10min or 2h", param, ctx)
        seconds = float(match[1]) * SECONDS[match[2]]
        if not 0.0 < seconds <= LONGEST:
            self.fail(f"{value!r} is not above 0 and at most 720h", param, ctx)
        return seconds


def format_duration(seconds: float, digits: int = 6) -> str:
    """Return seconds in the largest unit in which they are at least one, to some digits."""
    unit = next((u for u in ("h", "min") if seconds >= SECONDS[u]), "s")
    rounded = float(f"{seconds / SECONDS[unit]:.{digits}g}")
    return f"{rounded:.6g} {unit}"


@contextmanager
def limit_time(seconds: float) -> Iterator[None]:
    """Raise TimeLimitError in the body, in the thread that enters it, after this time."""
    is_main = threading.current_thread() is threading.main_thread()
    start = _limit_by_signal if is_main and hasattr(signal, "setitimer") else _limit_by_thread
    with start(seconds):
        yield


@contextmanager
def _limit_by_signal(seconds: float) -> Iterator[None]:
    def stop(_number: int, _frame: object) -> None:
        raise TimeLimitError(seconds)

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds, REPEAT)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


@contextmanager
def _limit_by_thread(seconds: float) -> Iterator[None]:
    worker, is_done = threading.get_ident(), threading.Event()
    raise_in = ctypes.pythonapi.PyThreadState_SetAsyncExc

    def watch() -> None:
        wait = seconds
        while not is_done.wait(wait):
            raise_in(ctypes.c_ulong(worker), ctypes.py_object(TimeLimitError))
            wait = REPEAT

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield
    except TimeLimitError as error:
        error.limit = seconds
        raise
    finally:
        is_done.set()
        watcher.join()


def _start(ctx: click.Context, _param: click.Parameter, seconds: float | None) -> None:
    """Start the clock of a command; it is stopped when the command ends."""
    if seconds is not None and not ctx.resilient_parsing:
        ctx.with_resource(limit_time(seconds))


OPTION = click.Option(
    ["--time-limit"],
    type=Duration(),
    callback=_start,
    expose_value=False,
    is_eager=True,
    help="Stop after this time, such as 30s, 10min or 2h, with exit code 4 and no result.",
)


def add_time_limit(command: click.Command) -> click.Command:
    """Return a command that also has the option --time-limit."""
    limited = copy.copy(command)
    limited.params = [*command.params, OPTION]
    return limited
