# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C where Python cannot raise it.

Python raises an interrupt between two instructions. In a callback of a library, such as the one
with which pydantic reads the name of a class, or in `__del__`, it can only print the exception and
go on. The user would see a traceback, and the command would not stop.
"""

from __future__ import annotations

import _thread
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

DELAY = 0.01
"""From a lost interrupt to its repetition [s]; by then the callback has ended."""


@contextmanager
def repeat_lost_interrupts() -> Iterator[None]:
    """Raise an interrupt that a callback lost again, a moment after the callback."""
    report = sys.unraisablehook

    def repeat_or_report(lost: sys.UnraisableHookArgs) -> None:
        if issubclass(lost.exc_type, KeyboardInterrupt):
            _thread.start_new_thread(_interrupt, ())  # raised here, it is lost again
        else:
            report(lost)

    sys.unraisablehook = repeat_or_report
    try:
        yield
    finally:
        sys.unraisablehook = report


def _interrupt() -> None:
    """Interrupt the main thread, also while it waits where the operating system has signals."""
    time.sleep(DELAY)
    main = threading.main_thread().ident
    if main is not None and hasattr(signal, "pthread_kill"):
        signal.pthread_kill(main, signal.SIGINT)
    else:
        _thread.interrupt_main()
