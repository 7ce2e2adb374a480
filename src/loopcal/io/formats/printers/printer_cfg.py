# SPDX-License-Identifier: Apache-2.0
"""A Klipper configuration as lines in which single values are changed, and nothing else.

Options are `name: value` or `name = value` in `[sections]`. What `SAVE_CONFIG` stored follows a
header line, with `#*# ` in front of each line; an option of the main part hides a stored one.
Source: the documents "Configuration reference" and "G-Codes" (SAVE_CONFIG) of Klipper, and how its
configfile module reads the two parts.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from loopcal.errors import FileError
from loopcal.io.core.text_file import read_text
from loopcal.io.formats.program_format import parse_number

MARK = "#*#"
HEADER = "#*# <---------------------- SAVE_CONFIG ---------------------->"
NEW_BLOCK = (HEADER, "#*# DO NOT EDIT THIS BLOCK OR BELOW. The contents are auto-generated.", MARK)
SECTION = re.compile(r"\[([^]]+)\]")
OPTION = re.compile(r"([^:=\s][^:=]*?)(\s*[:=]\s*)(.*?)\s*$")
COMMENT = re.compile(r"#.*|(?:^|(?<=\s));.*")

Key = tuple[str, str]


@dataclass(frozen=True)
class Option:
    """A value, with its line (from 0) and column."""

    value: str
    line: int
    start: int


@dataclass(frozen=True)
class PrinterConfig:
    """A configuration file.

    Attributes
    ----------
    lines : with their ends. options : (section, option) -> the one that counts.
    saved : section -> line of its header in the saved part. header : first line of that part, None
        without one. includes : files that it includes.
    """

    path: Path
    lines: tuple[str, ...]
    options: Mapping[Key, Option]
    saved: Mapping[str, int]
    header: int | None
    includes: tuple[str, ...] = ()

    def has(self, section: str, option: str) -> bool:
        """Return whether an option exists."""
        return (section, option) in self.options

    def error(self, sentence: str, section: str, option: str) -> FileError:
        """Return an error at the line of an option, without a line where it does not exist."""
        entry = self.options.get((section, option))
        return FileError(sentence, self.path, None if entry is None else entry.line + 1)

    def text(self, section: str, option: str) -> str:
        """Return the text of an option; FileError where it does not exist."""
        entry = self.options.get((section, option))
        if entry is None:
            files = ", ".join(self.includes)
            hint = f" (if {files} contains it, move it into this file)" if files else ""
            sentence = f"option {option!r} of [{section}] is missing{hint}; add it"
            raise FileError(sentence, self.path)
        return entry.value

    def number(self, section: str, option: str, default: float | None = None) -> float:
        """Return the number of an option, or the default; FileError for other text."""
        if default is not None and not self.has(section, option):
            return default
        return self._parse(self.text(section, option), section, option)

    def positive(self, section: str, option: str, default: float | None = None) -> float:
        """Return a positive number of an option, or the default; FileError for another."""
        value = self.number(section, option, default)
        if not value > 0:
            sentence = f"{option!r} of [{section}] is {value:g}; write a positive number"
            raise self.error(sentence, section, option)
        return value

    def three(self, section: str, option: str) -> tuple[float, float, float]:
        """Return the three numbers of an option, separated by commas."""
        parts = self.text(section, option).split(",")
        if len(parts) != 3:
            sentence = f"{option!r} of [{section}] has {len(parts)} numbers, but three are needed"
            raise self.error(f"{sentence}, the steps of the towers; correct it", section, option)
        a, b, c = (self._parse(part.strip(), section, option) for part in parts)
        return a, b, c

    def replace(self, section: str, option: str, value: str) -> PrinterConfig:
        """Return the file with another value of an option; a new one goes to the saved part."""
        entry = self.options.get((section, option))
        if entry is None:
            return self._add(section, option, value)
        line = self.lines[entry.line]
        changed = line[: entry.start] + value + line[entry.start + len(entry.value) :]
        lines = (*self.lines[: entry.line], changed, *self.lines[entry.line + 1 :])
        options = {**self.options, (section, option): replace(entry, value=value)}
        return replace(self, lines=lines, options=options)

    def _parse(self, text: str, section: str, option: str) -> float:
        line = self.options[section, option].line + 1
        return parse_number(text, f"{option!r} of [{section}]", self.path, line)

    def _add(self, section: str, option: str, value: str) -> PrinterConfig:
        end = "\r\n" if self.lines and self.lines[0].endswith("\r\n") else "\n"
        lines = list(self.lines)
        if lines and not lines[-1].endswith("\n"):
            lines[-1] += end
        if self.header is None:
            lines += [end, *(line + end for line in NEW_BLOCK)]
        if section in self.saved:
            lines.insert(self.saved[section] + 1, f"{MARK} {option} = {value}{end}")
        else:
            while lines and not lines[-1].strip():
                lines.pop()
            first = [] if lines[-1].strip() == MARK else [MARK + end]
            lines += [*first, f"{MARK} [{section}]{end}", f"{MARK} {option} = {value}{end}"]
        return parse(lines, self.path)


def read(path: Path) -> PrinterConfig:
    """Read a configuration; FileError where it is unreadable, or its saved part was edited."""
    return parse(read_text(path, "printer.cfg").splitlines(keepends=True), path)


def parse(lines: Sequence[str], path: Path) -> PrinterConfig:
    """Find options and sections."""
    header = next((i for i, line in enumerate(lines) if line.rstrip() == HEADER), None)
    options: dict[Key, Option] = {}
    saved: dict[str, int] = {}
    includes: list[str] = []
    section, main_part = "", frozenset[Key]()
    last = max((i for i, line in enumerate(lines) if line.strip()), default=0)
    for i, line in enumerate(lines[: last + 1]):
        if i == header:
            section, main_part = "", frozenset(options)
        offset = 0
        if header is not None and i >= header:
            if not line.startswith(MARK) or line[3:4] not in ("", " ", "\n", "\r"):
                sentence = (
                    f"this line below SAVE_CONFIG has no {MARK!r}, so Klipper ignores the block"
                )
                raise FileError(f"{sentence}; move it up", path, i + 1)
            offset = 4
        content = COMMENT.sub("", line[offset:].rstrip("\r\n")).rstrip()
        if not content or content[0].isspace():
            continue
        if match := SECTION.match(content):
            section = match[1]
            if section.startswith("include "):
                includes.append(section.removeprefix("include ").strip())
            if offset:
                saved[section] = i
        elif (match := OPTION.match(content)) and section:
            key = (section, match[1].lower())
            if key not in main_part:
                options[key] = Option(match[3], i, offset + match.start(3))
    return PrinterConfig(path, tuple(lines), options, saved, header, tuple(includes))
