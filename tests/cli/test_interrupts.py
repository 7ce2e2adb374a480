# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C that arrives in a callback of a library still stops a command, in one sentence, and so
does the end that the system asks for.
"""

import signal
import subprocess
import sys
import time

import pytest

from loopcal.cli import entry_point
from loopcal.cli.entry_point import main, repeat_lost_interrupts


class _Callback:
    """Raises in `__del__`, where Python can only print an exception."""

    def __init__(self, error: BaseException | None = None) -> None:
        self.error = error

    def __del__(self) -> None:
        if self.error is not None:
            raise self.error
        signal.raise_signal(signal.SIGINT)
        time.sleep(0)


def _lose_interrupt(*_arguments: object, **_named: object) -> int:
    _Callback()
    for _ in range(1000):
        time.sleep(0.01)
    return 0


def test_command_stops_on_an_interrupt_that_a_callback_lost(monkeypatch, capfd) -> None:
    monkeypatch.setattr(entry_point.command_line, "main", _lose_interrupt)
    assert main(["check", "five-bar"]) == 1
    sentence = "loopcal: stopped before the end, and loopcal wrote no result.\n"
    assert capfd.readouterr().err == sentence


def test_lost_exceptions_of_other_kinds_are_reported(monkeypatch) -> None:
    reported: list[type[BaseException]] = []
    monkeypatch.setattr(sys, "unraisablehook", lambda lost: reported.append(lost.exc_type))
    with repeat_lost_interrupts():
        _Callback(ValueError("not an interrupt"))
    assert reported == [ValueError]
    with pytest.raises(KeyboardInterrupt), repeat_lost_interrupts():
        _lose_interrupt()
    assert reported == [ValueError]


STOPPED = """
import signal, sys
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # nohup ignores it, and so does what nohup runs
from loopcal.__main__ import run
from loopcal.cli import entry_point
entry_point.command_line.main = lambda *_, **__: signal.raise_signal(signal.{name})
sys.argv[1:] = ["check", "five-bar"]
sys.exit(run())
"""


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP", "SIGINT"])
def test_an_end_that_the_system_asks_for_is_answered_as_ctrl_c(name) -> None:
    words = [sys.executable, "-c", STOPPED.format(name=name)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.stderr == "loopcal: stopped before the end, and loopcal wrote no result.\n"
    assert done.returncode == 1
