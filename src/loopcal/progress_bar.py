# SPDX-License-Identifier: Apache-2.0
"""A progress callback that draws: a bar below the cell of a notebook, a line in a terminal."""

from __future__ import annotations

import html
import sys
import time
from importlib import import_module
from typing import Any

from loopcal.plain_text import escape

INTERVAL = 0.2  # seconds between two updates of a bar


class ProgressBar:
    """Draws how far long work is: `lc.bootstrap(fit, data, progress=lc.ProgressBar())`.

    In a notebook it is a bar below the cell, in a terminal a line on standard error; where there is
    neither, it does nothing. One bar may serve several functions, one after the other.
    """

    def __init__(self) -> None:
        self._handle: Any = None
        self._done, self._total, self._drawn, self._width = 0, 0, float("-inf"), 0

    def __call__(self, done: int, total: int, what: str, /) -> None:
        """Draw `done` of `total` steps of `what`."""
        now, is_new = time.monotonic(), total != self._total or done < self._done
        self._done = done
        if not is_new and done < total and now - self._drawn < INTERVAL:
            return
        self._total, self._drawn = total, now
        line = escape(f"{what}: {done} of {total}")
        shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
        if getattr(shell, "kernel", None) is not None:
            display = import_module("IPython.display")
            bar = f'<progress value="{done}" max="{max(total, 1)}"></progress> {html.escape(line)}'
            content = display.HTML(f'<div class="loopcal">{bar}</div>')
            if is_new or self._handle is None:
                self._handle = display.display(content, display_id=True)
            else:
                self._handle.update(content)
        elif sys.stderr is not None and sys.stderr.isatty():
            ending = "\n" if done >= total else ""  # the last step ends the line
            sys.stderr.write(f"\r{line:<{self._width}}{ending}")
            sys.stderr.flush()
            self._width = len(line)
