# SPDX-License-Identifier: Apache-2.0
"""The commands and the Python code of a page of the documentation.

`run_page` executes a page from top to bottom in the present folder. Its conventions:

* Each line of an `sh` block is a command of loopcal, with exit code 0 or with the one in its
  comment (`# exit code 2`). `< FILE` at its end is its standard input.
* All `python` blocks share their names; those that begin with `>>>` also show what they print.
* A `text` block below them has lines of what the commands and the code above it have printed, in
  this order; `...` stands for lines that are left out.
* `<!-- file: NAME -->` above a block makes it a file of this name. A block `none` is only read.
"""

from __future__ import annotations

import contextlib
import doctest
import io
import re
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from loopcal.cli.entry_point import main

_BLOCK = re.compile(
    r"(?:^<!-- file: (?P<file>\S+) -->\n)?^```(?P<language>\w+)\n(?P<text>.*?)^```",
    re.MULTILINE | re.DOTALL,
)


@dataclass(frozen=True)
class PageBlock:
    """A code block of a page: its language, its text, and the file that it shows, if it does."""

    language: str
    text: str
    file: str | None


def list_blocks(page: str) -> list[PageBlock]:
    """Return all code blocks of a page that state a language."""
    return [PageBlock(m["language"], m["text"], m["file"]) for m in _BLOCK.finditer(page)]


def list_commands(page: str) -> list[list[str]]:
    """Return the words of each command in the `sh` blocks of a page, without `loopcal`."""
    blocks = [block.text for block in list_blocks(page) if block.language == "sh"]
    commands = [shlex.split(line, comments=True) for block in blocks for line in block.splitlines()]
    assert commands
    assert all(words[0] == "loopcal" for words in commands)
    return [words[1:] for words in commands]


def run_page(page: str) -> dict[str, Any]:
    """Execute the blocks of a page; return the names that its Python code has defined."""
    names: dict[str, Any] = {}
    printed = ""
    for block in list_blocks(page):
        if block.file:
            Path(block.file).parent.mkdir(parents=True, exist_ok=True)
            Path(block.file).write_text(block.text, "utf-8")
        elif block.language == "sh":
            printed = "".join(run_command(line) for line in block.text.splitlines())
        elif block.language == "python" and block.text.startswith(">>> "):
            run_examples(block.text, names)
        elif block.language == "python":
            with contextlib.redirect_stdout(io.StringIO()) as out:
                exec(compile(block.text, "<page>", "exec"), names)  # noqa: S102
            printed = out.getvalue()
        elif block.language == "text":
            check_shown_lines(block.text, printed)
    return names


def run_examples(text: str, names: dict[str, Any]) -> None:
    """Run the examples of an interpreter's session, and compare what they print."""
    report: list[str] = []
    session = doctest.DocTestParser().get_doctest(text, names, "page", None, 0)
    failed, tried = doctest.DocTestRunner().run(session, out=report.append, clear_globs=False)
    assert tried
    assert not failed, "".join(report)


def run_command(line: str) -> str:
    """Run one command of a page; return what it printed, notes and errors included."""
    words, expected = shlex.split(line, comments=True), re.search(r"# exit code (\d)", line)
    assert words[0] == "loopcal", line
    typed = ""
    if "<" in words:
        typed, words = Path(words[-1]).read_text("utf-8"), words[:-2]
    with (
        contextlib.redirect_stdout(io.StringIO()) as out,
        contextlib.redirect_stderr(out),
        pytest.MonkeyPatch.context() as patch,
    ):
        patch.setattr("sys.stdin", io.StringIO(typed))
        code = main(words[1:])
    assert code == (int(expected[1]) if expected else 0), f"{line}\n{out.getvalue()}"
    return out.getvalue()


def check_shown_lines(shown: str, printed: str) -> None:
    """Check that the lines of a `text` block were printed, in this order, up to blanks."""
    remaining = iter([line.split() for line in printed.splitlines()])
    for line in shown.splitlines():
        if line.strip() != "...":
            assert line.split() in remaining, f"{line}\n\n{printed}"
