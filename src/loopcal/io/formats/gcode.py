# SPDX-License-Identifier: Apache-2.0
"""G-code files whose words M665 L269 R130.25 can be read, and changed one by one while all else
stays as it is.

Of several commands of the same number the last one that says a word counts, as when the firmware
runs the file. What a firmware reports (M503: `echo:  M665 L269 ...`) reads as well, and so do small
letters, line numbers and checksums (`N10 M665 L269*87`), remarks behind `;` or in parentheses, and,
where the firmware knows them, several commands in a line. What follows a command whose words are
read is words to its end, or it is refused: half a number is another number.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import reduce
from operator import xor
from pathlib import Path

from loopcal.errors import FileError
from loopcal.io.core.text_file import read_text
from loopcal.io.formats.delta_geometry import same, written
from loopcal.io.formats.program_format import number

COMMAND = re.compile(r"\s*([GM]\d+)(?![\d.])")
FRONT = re.compile(r"\s*(?:ECHO:)?\s*(?:N\s*\d+)?")
WORD = re.compile(r"\s*([A-Z])[ \t]*(\{[^}]*\}|[^A-Z\s{]*)")
ASIDE = re.compile(r'"[^"]*"?|;.*|\([^)]*\)?')
CHECKSUM = re.compile(r"\*\s*\d*\s*$")
SMALL = {ord(small): small.upper() for small in "abcdefghijklmnopqrstuvwxyz"}

READ = ("M665", "M666", "M851")
"""Commands whose words are read."""

SPEAKING = ("M16", "M23", "M28", "M30", "M32", "M117", "M118")
"""Commands that are followed by text."""

Key = tuple[str, str]


@dataclass(frozen=True)
class Word:
    """The text of a word's number, and where it stands: line (from 0) and column."""

    text: str
    line: int
    start: int


@dataclass(frozen=True)
class Gcode:
    """A file: its lines with their ends, the words that count by (command, letter), where each
    command ends last.

    An end is a line (from 0) and the column behind the last word.
    """

    path: Path
    lines: tuple[str, ...]
    words: Mapping[Key, Word]
    commands: Mapping[str, tuple[int, int]]

    def numbers(self, command: str, letter: str) -> tuple[float, ...] | None:
        """A word's number, or its several with colons between; None where it is not there."""
        word = self.words.get((command, letter))
        if word is None:
            return None
        return tuple(
            number(part, f"{letter} of {command}", self.path, word.line + 1)
            for part in word.text.split(":")
        )

    def number(self, command: str, letter: str, default: float | None = None) -> float:
        """A word's number; the default where it is not there; FileError without one, or for several
        numbers.
        """
        found = self.numbers(command, letter)
        if found is None:
            if default is not None:
                return default
            raise FileError(
                f"{command} states no {letter}, which is needed; write it as {command} {letter}..",
                self.path,
            )
        if len(found) != 1:
            raise self.error(
                f"{letter} of {command} has {len(found)} numbers where one is needed; correct it",
                command,
                letter,
            )
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
            lines[word.line] = _summed(
                line[: word.start] + text + line[word.start + len(word.text) :]
            )
        elif command in self.commands:
            at, end = self.commands[command]
            lines[at] = _summed(f"{lines[at][:end]} {letter}{text}{lines[at][end:]}")
        else:
            end = "\r\n" if lines and lines[0].endswith("\r\n") else "\n"
            if lines and not lines[-1].endswith("\n"):
                lines[-1] += end
            lines.append(f"{command} {letter}{text}{end}")
        return parse(lines, self.path)


def read(path: Path, one_in_a_line: bool = False) -> Gcode:
    """Read a file; FileError where it holds no M665, counts in inches, or has several commands
    where one is run.
    """
    found = parse(read_text(path, "G-code file").splitlines(keepends=True), path, one_in_a_line)
    if "M665" not in found.commands:
        raise FileError(
            "there is no M665 in this file, which holds the geometry of a delta; M503 prints it",
            path,
        )
    if "G20" in found.commands:
        raise FileError(
            "G20 asks for inches; write the geometry in millimetres",
            path,
            found.commands["G20"][0] + 1,
        )
    return found


def parse(lines: Iterable[str], path: Path, one_in_a_line: bool = False) -> Gcode:
    """Find the words; FileError for what is no word behind a command that is read, and for a letter
    that it has twice.
    """
    kept = tuple(lines)
    words: dict[Key, Word] = {}
    commands: dict[str, tuple[int, int]] = {}
    for i, line in enumerate(kept):
        for count, (command, found, end, rest) in enumerate(_commands(line)):
            if command in READ and count and one_in_a_line:
                raise FileError(
                    f"{command} is not the first command of this line; write it in a line of its "
                    "own",
                    path,
                    i + 1,
                )
            commands[command] = (i, end)
            if command not in READ:
                continue
            if rest:
                raise FileError(
                    f"{command} has {rest!r} where a letter and its number are needed; correct it",
                    path,
                    i + 1,
                )
            letters = [letter for letter, _, _ in found]
            for letter, start, length in found:
                if letters.count(letter) > 1:
                    raise FileError(f"{command} has {letter} twice; keep one of them", path, i + 1)
                words[command, letter] = Word(line[start : start + length], i, start)
    return Gcode(path, kept, words, commands)


def _commands(line: str) -> Iterator[tuple[str, list[tuple[str, int, int]], int, str]]:
    """Yield the commands of a line: name, words as (letter, column, length), the column of the end,
    what is no word.
    """
    code = CHECKSUM.sub("", _without_asides(line).rstrip()).translate(SMALL)
    front = FRONT.match(code)
    at = front.end() if front is not None else 0
    while (command := COMMAND.match(code, at)) is not None:
        at, found = command.end(), []
        while COMMAND.match(code, at) is None and (word := WORD.match(code, at)) is not None:
            found.append((word[1], word.start(2), len(word[2])))
            at = word.end()
        following = COMMAND.match(code, at)
        rest = "" if following is not None else code[at:].strip()
        yield command[1], found, len(code[:at].rstrip()), rest
        if command[1] in SPEAKING:
            return


def _without_asides(line: str) -> str:
    """Return a line of the same length, blank where it has remarks, and without letters where it
    has text in quotes.
    """
    return ASIDE.sub(
        lambda found: ("\0" if found[0].startswith('"') else " ") * len(found[0]), line
    )


def _summed(line: str) -> str:
    """Return a line with the checksum of its new text, where it has one: all bytes in front of the
    star, exclusive or.
    """
    found = CHECKSUM.search(code := _without_asides(line).rstrip())
    if found is None:
        return line
    return f"{line[: found.start()]}*{reduce(xor, line[: found.start()].encode(), 0)}{line[len(code) :]}"


def corrected(
    file: Gcode, wanted: Mapping[Key, float], defaults: Mapping[Key, float]
) -> tuple[Gcode, list[str]]:
    """Put numbers in, and tell which were changed; a word that is not there is added where it
    differs from its default.
    """
    notes = []
    for (command, letter), value in wanted.items():
        present = file.words.get((command, letter))
        if (
            present is None
            and (command, letter) in defaults
            and same(defaults[command, letter], value)
        ):
            continue
        if present is not None and same(file.number(command, letter), value):
            continue
        file = file.replaced(command, letter, written(value))
        line = file.words[command, letter].line + 1
        notes.append(
            f"line {line}: {command} {letter} "
            f"{'added as' if present is None else f'{present.text} ->'} {written(value)}"
        )
    return file, notes
