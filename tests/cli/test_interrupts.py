# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C that arrives in a callback of a library still stops a command, in one sentence."""

import signal
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
