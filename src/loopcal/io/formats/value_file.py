# SPDX-License-Identifier: Apache-2.0
"""Text files of controllers whose values are read and replaced by name, and nothing else in them.

A name has two parts: command and letter, section and option, component and pin. A format parses its
lines to values, and says where a value that does not exist is added.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Self

from loopcal.errors import FileError
from loopcal.findings import Finding, report_finding
from loopcal.io.formats.program_format import (
    Exported,
    get_byte_order_mark,
    parse_number,
    report_changes,
)

DECIMALS = 6
"""Decimals of written numbers [mm, deg]: those that Klipper itself saves, a nanometer."""

Name = tuple[str, str]


@dataclass(frozen=True)
class Value:
    """The text of a value, with its line and column (both from 0)."""

    text: str
    line: int
    column: int


@dataclass(frozen=True)
class ValueFile(ABC):
    """A file: its lines with their ends, and the values that count.

    `title` and `phrase` word a name in a list of changes and in sentences.
    """

    path: Path
    lines: tuple[str, ...]
    values: Mapping[Name, Value]

    title: ClassVar[str] = "{0} {1}"
    phrase: ClassVar[str] = "{1} of {0}"

    @abstractmethod
    def describe_missing(self, group: str, name: str) -> str:
        """Return the sentence about a value that does not exist."""

    @abstractmethod
    def with_lines(self, lines: Sequence[str]) -> Self:
        """Return the file with other lines."""

    @abstractmethod
    def insert(self, lines: list[str], name: Name, text: str) -> None:
        """Insert a new value into complete lines."""

    def finish_line(self, line: str) -> str:
        """Return a line after a change of a value."""
        return line

    def format(self, number: float) -> str:
        """Return a number as it is written."""
        return format_number(number)

    def is_same(self, a: float, b: float) -> bool:
        """Return whether two numbers count as the same."""
        return is_same((a, b))

    @property
    def line_end(self) -> str:
        """The end of lines in this file."""
        return "\r\n" if self.lines and self.lines[0].endswith("\r\n") else "\n"

    def has(self, *name: str) -> bool:
        """Return whether a value exists."""
        return name in self.values

    def error(self, sentence: str | Finding, *name: str) -> FileError:
        """Return an error at the line of a value, without a line where it does not exist."""
        line = self.values[name[0], name[1]].line + 1 if name in self.values else None
        return FileError(sentence, self.path, line)

    def text(self, group: str, name: str) -> str:
        """Return the text of a value; FileError where it does not exist."""
        if not self.has(group, name):
            raise FileError(self.describe_missing(group, name), self.path)
        return self.values[group, name].text

    def number(self, group: str, name: str, default: float | None = None) -> float:
        """Return a number, or the default where there is none; FileError for other text."""
        if default is not None and not self.has(group, name):
            return default
        return self.numbers(group, name)[0]

    def numbers(self, group: str, name: str, separator: str | None = None) -> tuple[float, ...]:
        """Return the numbers of a value; FileError for other text."""
        text = self.text(group, name)
        what, line = self.phrase.format(group, name), self.values[group, name].line + 1
        number_texts = [text] if separator is None else text.split(separator)
        return tuple(parse_number(part.strip(), what, self.path, line) for part in number_texts)

    def replace(self, name: Name, text: str) -> Self:
        """Return the file with another text of a value, which is added where it does not exist."""
        lines = list(self.lines)
        if name in self.values:
            value = self.values[name]
            line, end = lines[value.line], value.column + len(value.text)
            lines[value.line] = self.finish_line(line[: value.column] + text + line[end:])
        else:
            if lines and not lines[-1].endswith("\n"):
                lines[-1] += self.line_end
            self.insert(lines, name, text)
        return self.with_lines(lines)

    def correct(
        self, wanted: Mapping[Name, float | str], defaults: Mapping[Name, float]
    ) -> tuple[Self, tuple[Finding, ...]]:
        """Return the file with other numbers (or texts), and the changes.

        A value that does not exist is added only where it differs from its default.
        """
        file, changes = self, []
        for name, number in wanted.items():
            before = file.values.get(name)
            if not isinstance(number, str):
                present = defaults.get(name) if before is None else file.number(*name)
                if present is not None and self.is_same(present, number):
                    continue
            text = number if isinstance(number, str) else self.format(number)
            file = file.replace(name, text)
            changes.append(
                report_finding(
                    "files.value-changed",
                    line=file.values[name].line + 1,
                    name=self.title.format(*name),
                    before=None if before is None else before.text,
                    after=text,
                )
            )
        return file, tuple(changes)

    def export(
        self,
        into: Path | None,
        wanted: Mapping[Name, float | str],
        defaults: Mapping[Name, float],
        findings: Sequence[Finding] = (),
    ) -> Exported:
        """Return the text with other numbers; with all of them, where `into` names no file."""
        if into is None:
            file, mark = self.correct(wanted, {})[0], ""
        else:
            file, changes = self.correct(wanted, defaults)
            findings, mark = (*report_changes(changes), *findings), get_byte_order_mark(into)
        return Exported(mark + "".join(file.lines), tuple(findings))


def format_number(value: float) -> str:
    """Return a number with the decimals that firmware of printers uses."""
    return f"{value:.{DECIMALS}f}"


def shorten_numbers(wanted: Mapping[Name, float | str], decimals: int) -> dict[Name, float | str]:
    """Return numbers as texts for people, without zeros at their ends; lists are `a:b:c`."""
    return {
        name: ":".join(
            format_short(float(number), decimals)
            for number in (value.split(":") if isinstance(value, str) else (value,))
        )
        for name, value in wanted.items()
    }


def format_short(number: float, decimals: int) -> str:
    """Return a number with at most so many decimals, without zeros at its end and without -0."""
    text = f"{number:.{decimals}f}"
    text = text.rstrip("0").rstrip(".") if "." in text else text
    return "0" if text == "-0" else text


def is_same(*pairs: tuple[float, float]) -> bool:
    """Return whether the two numbers of each pair are written alike."""
    return all(format_number(a) == format_number(b) for a, b in pairs)
