# SPDX-License-Identifier: Apache-2.0
"""The dialog of `loopcal measure`: what it shows, and the rows and commands that it takes.

Rows come from standard input, where they are typed, pasted or piped, and from an export that an
instrument writes meanwhile.
"""

from __future__ import annotations

import queue
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress

from loopcal.cli.hints import with_hint
from loopcal.cli.terminal import print_text, width
from loopcal.findings import Finding
from loopcal.io.exports.growing_export import POLL
from loopcal.measuring import COMMANDS, MeasuringSession, Row
from loopcal.results.tables import Block, render_text


def print_lines(*lines: Block | Finding) -> None:
    """Print lines or findings, wrapped."""
    if lines:
        words = [with_hint(line) if isinstance(line, Finding) else line for line in lines]
        print_text(render_text(words, width()) + "\n")


class Dialog(MeasuringSession):
    """The dialog of one session on a terminal."""

    def run(self) -> None:
        """Ask for rows until the work is done, or the input ends."""
        self.resume()
        inputs = self._list_inputs()
        while True:
            self.choose_pose()
            if self.pose is None and self.export is not None:
                return
            if self.pose is not None:
                asked = f"Measured {' '.join(self.list_headers())}, or help:"
                self.say(*self.describe_pose(self.pose), asked)
            if not self._take_inputs(inputs):
                return

    def _take_inputs(self, inputs: Iterator[str | Row]) -> bool:
        """Take rows and commands until the state has changed; return whether to go on."""
        for given in inputs:
            word = given.partition(" ")[0] if isinstance(given, str) else ""
            if word in ("quit", "exit", "q"):
                return False
            if word in ("help", "?", "h"):
                self.say(*(f"  {word:10} {what}" for word, what in COMMANDS.items()))
            elif self.take(given):
                return True
        return False

    def _list_inputs(self) -> Iterator[str | Row]:
        """Give typed lines, until they end, and rows of the export, if any, as they come."""
        lines: queue.Queue[str | None] = queue.Queue()

        def read() -> None:
            with suppress(OSError):  # of a terminal that is gone
                for line in iter(sys.stdin.readline, ""):
                    lines.put(line.strip())
            lines.put(None)

        threading.Thread(target=read, daemon=True).start()
        while True:
            yield from self.read_export()
            try:
                line = lines.get(timeout=POLL)
            except queue.Empty:
                continue
            if line is None and self.export is None:
                return
            if line:
                yield line
