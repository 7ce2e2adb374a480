# SPDX-License-Identifier: Apache-2.0
"""The commands that `loopcal app` runs: one after the other, until one refuses or people stop it.

A command is a process of its own, so that it can be stopped at once.
"""

from __future__ import annotations

import asyncio
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import psutil

from loopcal.errors import FileError
from loopcal.findings import report_finding


@dataclass(kw_only=True)
class Said:
    """What commands said. pages, codes : command -> what it printed, as HTML, and its exit code."""

    pages: dict[str, str] = field(default_factory=dict)
    messages: list[str] = field(default_factory=list)
    codes: dict[str, int] = field(default_factory=dict)


@dataclass(eq=False)
class Work:
    """The commands that run in a folder, and how far they are.

    changed : is called when `progress` or what they said changes. store : keeps what they said.
    word : the text of a command as people get it.
    """

    folder: Path
    changed: Callable[[], None]
    store: Callable[[], None]
    word: Callable[[str], str]
    progress: tuple[str, int, int] | None = None
    task: asyncio.Task[None] | None = None
    process: asyncio.subprocess.Process | None = None

    def begin(self, steps: Mapping[str, Sequence[str]], said: Said) -> None:
        """Run commands, title -> words, while others are answered."""
        self.task = asyncio.create_task(self._run(steps, said))

    async def _run(self, steps: Mapping[str, Sequence[str]], said: Said) -> None:
        pipe = asyncio.subprocess.PIPE
        environment = {**os.environ, "LOOPCAL_PAGE": "html", "PYTHONIOENCODING": "utf-8"}
        try:
            said.messages = []
            for title in steps:  # these pages go with the files that commands replace
                said.pages.pop(title, None)
                said.codes.pop(title, None)
            self.store()
            for title, words in steps.items():
                self.progress = (title, 0, 0)
                self.changed()
                command = (sys.executable, "-P", "-m", "loopcal", *words)
                self.process = await asyncio.create_subprocess_exec(
                    *command, cwd=self.folder, env=environment, stdout=pipe, stderr=pipe
                )
                assert self.process.stdout is not None
                out = asyncio.create_task(self.process.stdout.read())
                await self._listen(self.process.stderr, said)
                page, code = (await out).decode(), await self.process.wait()
                if code < 0:
                    said.messages.append(f"loopcal: {report_finding('app.killed')}")
                else:
                    said.pages[title], said.codes[title] = self.word(page), code
                if code not in (0, 2):
                    return
        finally:
            if self.process is not None:  # it was stopped
                await self.process.wait()
            self.task = self.process = self.progress = None
            with suppress(OSError, FileError):  # the folder may be gone
                self.store()

    async def _listen(self, stream: asyncio.StreamReader | None, said: Said) -> None:
        """Take progress and messages of a command."""
        assert stream is not None
        async for line in stream:
            text = line.decode().rstrip("\r\n")
            if text.startswith("\x1e"):  # see `loopcal.cli.terminal`
                done, total, what = text[1:].split("\t")
                self.progress = (what, int(done), int(total))
            elif text:
                said.messages.append(self.word(text))
            self.changed()

    def stop(self, said: Said) -> None:
        """End the command that runs, and what it has started."""
        if self.task is not None:
            self.task.cancel()
            said.messages.append(f"loopcal: note: {report_finding('app.stopped')}")
        if self.process is not None:
            with suppress(psutil.NoSuchProcess):
                process = psutil.Process(self.process.pid)
                for each in (*process.children(recursive=True), process):
                    each.kill()
