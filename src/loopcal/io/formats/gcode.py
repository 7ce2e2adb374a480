# SPDX-License-Identifier: Apache-2.0
"""G-code files whose words M665 L269 R130.25 can be read, and changed one by one while all else stays as it is.

Of several commands of the same number the last one that says a word counts, as when the firmware runs the file. What a
firmware reports (M503: `echo:  M665 L269 ...`) reads as well.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from loopcal.errors import FileError
from loopcal.io.formats.delta import same, written
from loopcal.io.formats.exchange import number
from loopcal.io.text_file import read_text

COMMAND = re.compile(r"\s*(?:echo:\s*)?([GM]\d+)(?![\d.])")
WORD = re.compile(r"([A-Z])\s*([-+\d.][-+\d.eE:]*)")
COMMENT = re.compile(r"[;(].*")

Key = tuple[str, str]


@dataclass(frozen=True)
class Word:
    """The text of a word's number, and where it stands: line (from 0) and column."""

    text: str
    line: int
    start: int


@dataclass(frozen=True)
class Gcode:
    """A file: its lines with their ends, the words that count by (command, letter), the last line of each command."""

    path: Path
    lines: tuple[str, ...]
    words: Mapping[Key, Word]
    commands: Mapping[str, int]

    def numbers(self, command: str, letter: str) -> tuple[float, ...] | None:
        """A word's number, or its several with colons between; None where it is not there."""
        word = self.words.get((command, letter))
        if word is None:
            return None
        return tuple(number(part, f"{letter} of {command}", self.path, word.line + 1) for part in word.text.split(":"))

    def number(self, command: str, letter: str, default: float | None = None) -> float:
        """A word's number; the default where it is not there; FileError without one, or for several numbers."""
        found = self.numbers(command, letter)
        if found is None:
            if default is not None:
                return default
            raise FileError(f"{command} states no {letter}, which is needed; write it as {command} {letter}..", self.path)
        if len(found) != 1:
            raise self.error(f"{letter} of {command} has {len(found)} numbers where one is needed; correct it", command, letter)
        return found[0]

    def error(self, sentence: str, command: str, letter: str) -> FileError:
        """The error for a word, with its line where there is one."""
        word = self.words.get((command, letter))
        return FileError(sentence, self.path, None if word is None else word.line + 1)

    def replaced(self, command: str, letter: str, text: str) -> Gcode:
        """The same with another number in a word; a word or command that is not there is added."""
        word, lines = self.words.get((command, letter)), list(self.lines)
        if word is not None:
            line = lines[word.line]
            lines[word.line] = line[: word.start] + text + line[word.start + len(word.text) :]
        elif command in self.commands:
            at = self.commands[command]
            line = lines[at]
            code = COMMENT.sub("", line.rstrip("\r\n")).rstrip()
            lines[at] = f"{code} {letter}{text}{line[len(code) :]}"
        else:
            end = "\r\n" if lines and lines[0].endswith("\r\n") else "\n"
            if lines and not lines[-1].endswith("\n"):
                lines[-1] += end
            lines.append(f"{command} {letter}{text}{end}")
        return parse(lines, self.path)


def read(path: Path) -> Gcode:
    """Read a file; FileError where it holds no M665, or counts in inches."""
    found = parse(read_text(path, "G-code file").splitlines(keepends=True), path)
    if "M665" not in found.commands:
        raise FileError("there is no M665 in this file, which holds the geometry of a delta; M503 prints it", path)
    if "G20" in found.commands:
        raise FileError("G20 asks for inches; write the geometry in millimetres", path, found.commands["G20"] + 1)
    return found


def parse(lines: Iterable[str], path: Path) -> Gcode:
    """Find the words."""
    kept = tuple(lines)
    words: dict[Key, Word] = {}
    commands: dict[str, int] = {}
    for i, line in enumerate(kept):
        code = COMMENT.sub("", line)
        if (command := COMMAND.match(code)) is None:
            continue
        commands[command.group(1)] = i
        if command.group(1) in ("M665", "M666", "M851"):
            for word in WORD.finditer(code, command.end()):
                words[command.group(1), word.group(1)] = Word(word.group(2), i, word.start(2))
    return Gcode(path, kept, words, commands)


def corrected(file: Gcode, wanted: Mapping[Key, float], defaults: Mapping[Key, float]) -> tuple[Gcode, list[str]]:
    """Put numbers in, and tell which were changed; a word that is not there is added where it differs from its default."""
    notes = []
    for (command, letter), value in wanted.items():
        present = file.words.get((command, letter))
        if present is None and (command, letter) in defaults and same(defaults[command, letter], value):
            continue
        if present is not None and same(file.number(command, letter), value):
            continue
        file = file.replaced(command, letter, written(value))
        line = file.words[command, letter].line + 1
        notes.append(
            f"line {line}: {command} {letter} {'added as' if present is None else f'{present.text} ->'} {written(value)}"
        )
    return file, notes
