# SPDX-License-Identifier: Apache-2.0
"""Words of G-code commands in a file: read with their places, replaced, and added.

Of several commands with the same number, the last one that has a word counts, as in firmware.
Reports of a firmware (M503: `echo:  M665 L269 ...`) are read as well, and so are small letters,
line numbers and checksums (`N10 M665 L269*87`), remarks behind `;` or in parentheses, and, where
the firmware supports it, several commands in a line. Text behind a command that is not words is
refused, because half a number is another number.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import xor
from pathlib import Path

from loopcal.errors import FileError
from loopcal.io.core.text_file import read_text
from loopcal.io.formats.value_file import Name, Value, ValueFile
from loopcal.plain_text import quote

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


@dataclass(frozen=True)
class GcodeFile(ValueFile):
    """A file whose values are words, by command and letter.

    `commands` has the line (from 0) and the column behind the last word of each command.
    """

    commands: Mapping[str, tuple[int, int]]

    def describe_missing(self, group: str, name: str) -> str:
        """Return the sentence about a word that does not exist."""
        return f"{group} has no {name}; write it as {group} {name}.."

    def with_lines(self, lines: Sequence[str]) -> GcodeFile:
        """Return the file with other lines."""
        return parse_gcode(lines, self.path)

    def insert(self, lines: list[str], name: Name, text: str) -> None:
        """Insert a new word behind the others of its command, or a new command at the end."""
        command, letter = name
        if command in self.commands:
            number, end = self.commands[command]
            line = lines[number]
            lines[number] = self.finish_line(f"{line[:end]} {letter}{text}{line[end:]}")
        else:
            lines.append(f"{command} {letter}{text}{self.line_end}")

    def finish_line(self, line: str) -> str:
        """Return a line with the checksum of its text, where it has one: all bytes before `*`."""
        code = _blank_asides(line).rstrip()
        match = CHECKSUM.search(code)
        if match is None:
            return line
        text = line[: match.start()]
        return f"{text}*{reduce(xor, text.encode(), 0)}{line[len(code) :]}"


def read_gcode(path: Path, one_in_a_line: bool = False) -> GcodeFile:
    """Read a file.

    Raises
    ------
    FileError : no M665, inches, or several commands in a line where the firmware runs only one.
    """
    file = parse_gcode(
        read_text(path, "G-code file").splitlines(keepends=True), path, one_in_a_line
    )
    if "M665" not in file.commands:
        raise FileError("no M665, the geometry of a delta, in this file; print it by M503", path)
    if "G20" in file.commands:
        sentence = "G20 selects inches; write the geometry in millimeters"
        raise FileError(sentence, path, file.commands["G20"][0] + 1)
    return file


def parse_gcode(lines: Iterable[str], path: Path, one_in_a_line: bool = False) -> GcodeFile:
    """Find the words; FileError for text that is not words, and for a letter that occurs twice."""
    complete = tuple(lines)
    words: dict[Name, Value] = {}
    commands: dict[str, tuple[int, int]] = {}
    for i, line in enumerate(complete):
        for position, (command, letters, end, rest) in enumerate(_split_commands(line)):
            commands[command] = (i, end)
            if command not in READ:
                continue
            if position and one_in_a_line:
                sentence = (
                    f"{command} is not the first command of this line; move it to its own line"
                )
                raise FileError(sentence, path, i + 1)
            if rest:
                sentence = f"{command} has {quote(rest)}, but a letter and its number are needed"
                raise FileError(f"{sentence}; correct it", path, i + 1)
            for k, (letter, start, length) in enumerate(letters):
                if any(letter == other for other, *_ in letters[:k]):
                    raise FileError(f"{command} has {letter} twice; remove one", path, i + 1)
                words[command, letter] = Value(line[start : start + length], i, start)
    return GcodeFile(path, complete, words, commands)


def _split_commands(line: str) -> Iterator[tuple[str, list[tuple[str, int, int]], int, str]]:
    """Yield the commands of a line: name, words (letter, column, length), end, other text."""
    code = CHECKSUM.sub("", _blank_asides(line).rstrip()).translate(UPPER)
    front = FRONT.match(code)
    column = front.end() if front is not None else 0
    while (command := COMMAND.match(code, column)) is not None:
        column, words = command.end(), []
        while not COMMAND.match(code, column) and (word := WORD.match(code, column)):
            words.append((word[1], word.start(2), len(word[2])))
            column = word.end()
        rest = "" if COMMAND.match(code, column) else code[column:].strip()
        yield command[1], words, len(code[:column].rstrip()), rest
        if command[1] in WITH_TEXT:
            return


def _blank_asides(line: str) -> str:
    """Return a line of the same length, with blanks for remarks and no letters in quotes."""

    def blank(match: re.Match[str]) -> str:
        return ("\0" if match[0].startswith('"') else " ") * len(match[0])

    return ASIDE.sub(blank, line)
