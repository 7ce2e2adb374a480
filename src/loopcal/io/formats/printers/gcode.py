# SPDX-License-Identifier: Apache-2.0
"""G-code files whose words, such as M665 L269 R130.25, are read and changed one by one.

Of several commands with the same number, the last one that has a word counts, as in the firmware.
Reports of a firmware (M503: `echo:  M665 L269 ...`) are read as well, and so are small letters,
line numbers and checksums (`N10 M665 L269*87`), remarks behind `;` or in parentheses, and, where
the firmware supports it, several commands in a line. Text behind a command that is not words is
refused, because half a number is another number.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import reduce
from operator import xor
from pathlib import Path

from loopcal.errors import FileError
from loopcal.findings import Finding
from loopcal.io.core.text_file import read_text
from loopcal.io.formats.printers.delta_geometry import format_number, is_same
from loopcal.io.formats.program_format import parse_number, report_change

COMMAND = re.compile(r"\s*([GM]\d+)(?![\d.])")
FRONT = re.compile(r"\s*(?:ECHO:)?\s*(?:N\s*\d+)?")
WORD = re.compile(r"\s*([A-Z])[ \t]*(\{[^}]*\}|[^A-Z\s{]*)")
ASIDE = re.compile(r'"[^"]*"?|;.*|\([^)]*\)?')
CHECKSUM = re.compile(r"\*\s*\d*\s*$")
UPPER = {ord(small): small.upper() for small in "abcdefghijklmnopqrstuvwxyz"}

READ = ("M665", "M666", "M851")
"""Commands whose words are read."""

WITH_TEXT = ("M16", "M23", "M28", "M30", "M32", "M117", "M118")
"""Commands that are followed by text."""

Key = tuple[str, str]


@dataclass(frozen=True)
class Word:
    """The text of a word's number, with its line (from 0) and column."""

    text: str
    line: int
    start: int


@dataclass(frozen=True)
class Gcode:
    """A file: its lines with their ends, and the words that count by (command, letter).

    `commands` has the line (from 0) and the column behind the last word of each command.
    """

    path: Path
    lines: tuple[str, ...]
    words: Mapping[Key, Word]
    commands: Mapping[str, tuple[int, int]]

    def numbers(self, command: str, letter: str) -> tuple[float, ...] | None:
        """Return the number of a word, or several separated by colons; None without the word."""
        word = self.words.get((command, letter))
        if word is None:
            return None
        what = f"{letter} of {command}"
        parts = word.text.split(":")
        return tuple(parse_number(part, what, self.path, word.line + 1) for part in parts)

    def number(self, command: str, letter: str, default: float | None = None) -> float:
        """Return the number of a word, or the default; FileError without one, or for several."""
        numbers = self.numbers(command, letter)
        if numbers is None:
            if default is not None:
                return default
            sentence = f"{command} has no {letter}; write it as {command} {letter}.."
            raise FileError(sentence, self.path)
        if len(numbers) != 1:
            sentence = f"{letter} of {command} has {len(numbers)} numbers, but one is needed"
            raise self.error(f"{sentence}; correct it", command, letter)
        return numbers[0]

    def error(self, sentence: str, command: str, letter: str) -> FileError:
        """Return an error at the line of a word, without a line where it does not exist."""
        word = self.words.get((command, letter))
        return FileError(sentence, self.path, None if word is None else word.line + 1)

    def replace(self, command: str, letter: str, text: str) -> Gcode:
        """Return the file with another number in a word; a missing word or command is added."""
        word, lines = self.words.get((command, letter)), list(self.lines)
        if word is not None:
            line = lines[word.line]
            changed = line[: word.start] + text + line[word.start + len(word.text) :]
            lines[word.line] = _update_checksum(changed)
        elif command in self.commands:
            number, end = self.commands[command]
            line = lines[number]
            lines[number] = _update_checksum(f"{line[:end]} {letter}{text}{line[end:]}")
        else:
            line_end = "\r\n" if lines and lines[0].endswith("\r\n") else "\n"
            if lines and not lines[-1].endswith("\n"):
                lines[-1] += line_end
            lines.append(f"{command} {letter}{text}{line_end}")
        return parse(lines, self.path)


def read(path: Path, one_in_a_line: bool = False) -> Gcode:
    """Read a file.

    Raises
    ------
    FileError : no M665, inches, or several commands in a line where the firmware runs only one.
    """
    file = parse(read_text(path, "G-code file").splitlines(keepends=True), path, one_in_a_line)
    if "M665" not in file.commands:
        raise FileError("no M665, the geometry of a delta, in this file; print it by M503", path)
    if "G20" in file.commands:
        sentence = "G20 selects inches; write the geometry in millimetres"
        raise FileError(sentence, path, file.commands["G20"][0] + 1)
    return file


def parse(lines: Iterable[str], path: Path, one_in_a_line: bool = False) -> Gcode:
    """Find the words; FileError for text that is not words, and for a letter that occurs twice."""
    kept = tuple(lines)
    words: dict[Key, Word] = {}
    commands: dict[str, tuple[int, int]] = {}
    for i, line in enumerate(kept):
        for position, (command, found, end, rest) in enumerate(_split_commands(line)):
            commands[command] = (i, end)
            if command not in READ:
                continue
            if position and one_in_a_line:
                sentence = (
                    f"{command} is not the first command of this line; move it to its own line"
                )
                raise FileError(sentence, path, i + 1)
            if rest:
                sentence = f"{command} has {rest!r}, but a letter and its number are needed"
                raise FileError(f"{sentence}; correct it", path, i + 1)
            letters = [letter for letter, _, _ in found]
            for letter, start, length in found:
                if letters.count(letter) > 1:
                    raise FileError(f"{command} has {letter} twice; remove one", path, i + 1)
                words[command, letter] = Word(line[start : start + length], i, start)
    return Gcode(path, kept, words, commands)


def format_commands(words: Mapping[Key, str]) -> str:
    """Return one line for each command with its words."""
    lines: dict[str, list[str]] = {}
    for (command, letter), text in words.items():
        lines.setdefault(command, [command]).append(f"{letter}{text}")
    return "".join(f"{' '.join(parts)}\n" for parts in lines.values())


def correct(
    file: Gcode, wanted: Mapping[Key, float], defaults: Mapping[Key, float]
) -> tuple[Gcode, list[Finding]]:
    """Return the file with other numbers, and the changes.

    A missing word is added only where its number differs from its default.
    """
    changes = []
    for (command, letter), value in wanted.items():
        word = file.words.get((command, letter))
        present = defaults.get((command, letter))
        if word is not None:
            present = file.number(command, letter)
        if present is not None and is_same((present, value)):
            continue
        text = format_number(value)
        file = file.replace(command, letter, text)
        line = file.words[command, letter].line + 1
        before = None if word is None else word.text
        changes.append(report_change(line, f"{command} {letter}", before, text))
    return file, changes


def _split_commands(line: str) -> Iterator[tuple[str, list[tuple[str, int, int]], int, str]]:
    """Yield the commands of a line: name, words (letter, column, length), end, other text."""
    code = CHECKSUM.sub("", _blank_asides(line).rstrip()).translate(UPPER)
    front = FRONT.match(code)
    at = front.end() if front is not None else 0
    while (command := COMMAND.match(code, at)) is not None:
        at, words = command.end(), []
        while COMMAND.match(code, at) is None and (word := WORD.match(code, at)) is not None:
            words.append((word[1], word.start(2), len(word[2])))
            at = word.end()
        rest = "" if COMMAND.match(code, at) is not None else code[at:].strip()
        yield command[1], words, len(code[:at].rstrip()), rest
        if command[1] in WITH_TEXT:
            return


def _blank_asides(line: str) -> str:
    """Return a line of the same length, with blanks for remarks and no letters in quotes."""

    def blank(match: re.Match[str]) -> str:
        return ("\0" if match[0].startswith('"') else " ") * len(match[0])

    return ASIDE.sub(blank, line)


def _update_checksum(line: str) -> str:
    """Return a line with the checksum of its text, where it has one: all bytes before the star."""
    code = _blank_asides(line).rstrip()
    match = CHECKSUM.search(code)
    if match is None:
        return line
    text = line[: match.start()]
    return f"{text}*{reduce(xor, text.encode(), 0)}{line[len(code) :]}"
