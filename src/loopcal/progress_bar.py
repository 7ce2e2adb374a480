# SPDX-License-Identifier: Apache-2.0
"""A progress callback that draws: a bar below the cell of a notebook, a line in a terminal."""

from __future__ import annotations

import html
import sys
import time
from typing import Any

from loopcal.plain_text import escape

INTERVAL = 0.2
"""Seconds between two updates of a bar."""


class ProgressBar:
    """Draws how far long work is: `lc.bootstrap(fit, data, progress=lc.ProgressBar())`.

    In a notebook it is a bar below the cell, in a terminal a line on standard error; where there is
    neither, it does nothing. One bar may serve several functions, one after the other.
    """

    def __init__(self) -> None:
        self._handle: Any = None
        self._what, self._total, self._drawn, self._width = "", 0, float("-inf"), 0

    def __call__(self, done: int, total: int, what: str, /) -> None:
        """Draw `done` of `total` steps of `what`."""
        now, is_new = time.monotonic(), total != self._total
        if not is_new and done < total and now - self._drawn < INTERVAL:
            return
        self._what, self._total, self._drawn = what, total, now
        if (display := _find_display()) is not None:
            self._draw_html(display, done, is_new)
        elif sys.stderr is not None and sys.stderr.isatty():
            self._draw_line(done)

    def _draw_html(self, display: Any, done: int, is_new: bool) -> None:
        """Draw a bar, or update the one of this work."""
        steps = html.escape(escape(f"{self._what}: {done} of {self._total}"))
        bar = f'<progress value="{done}" max="{max(self._total, 1)}"></progress> {steps}'
        content = display.HTML(f'<div class="loopcal">{bar}</div>')
        if is_new or self._handle is None:
            self._handle = display.display(content, display_id=True)
        else:
            self._handle.update(content)

    def _draw_line(self, done: int) -> None:
        """Write over the line; the last step ends it."""
        line = escape(f"{self._what}: {done} of {self._total}")
        ending = "\n" if done >= self._total else ""
        sys.stderr.write(f"\r{line:<{self._width}}{ending}")
        sys.stderr.flush()
        self._width = len(line)


def _find_display() -> Any:
    """Return the module that displays in the notebook in which this program runs; else None."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    if getattr(shell, "kernel", None) is None:
        return None
    from importlib import import_module

    return import_module("IPython.display")
