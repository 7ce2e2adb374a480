# SPDX-License-Identifier: Apache-2.0
"""A Klipper configuration as lines in which single values can be changed, and nothing else.

Options stand as `name: value` or `name = value` in `[sections]`; what `SAVE_CONFIG` stored follows
a header line, with `#*# ` before each line. An option in the main part hides one of the same name
that was saved. Source: the documents "Configuration reference" and "G-Codes" (SAVE_CONFIG) of
Klipper, and how its configfile module reads the two parts.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from loopcal.errors import FileError
from loopcal.io.core.text_file import read_text
from loopcal.io.formats.program_format import number

MARK = "#*#"
HEADER = "#*# <---------------------- SAVE_CONFIG ---------------------->"
NEW_BLOCK = (HEADER, "#*# DO NOT EDIT THIS BLOCK OR BELOW. The contents are auto-generated.", MARK)
SECTION = re.compile(r"\[([^]]+)\]")
OPTION = re.compile(r"([^:=\s][^:=]*?)(\s*[:=]\s*)(.*?)\s*$")
COMMENT = re.compile(r"#.*|(?:^|(?<=\s));.*")

Key = tuple[str, str]


@dataclass(frozen=True)
class Option:
    """A value, and where it stands: line (from 0) and columns."""

    value: str
    line: int
    start: int


@dataclass(frozen=True)
class PrinterConfig:
    """A configuration file.

    Attributes
    ----------
    lines : with their ends. options : (section, option) -> the one that counts.
    saved : section -> line of its header in the saved part. header : line at which that part
        begins, None without one.
    """

    path: Path
    lines: tuple[str, ...]
    options: Mapping[Key, Option]
    saved: Mapping[str, int]
    header: int | None
    includes: tuple[str, ...] = ()

    def has(self, section: str, option: str) -> bool:
        """Whether an option is there."""
        return (section, option) in self.options

    def error(self, sentence: str, section: str, option: str) -> FileError:
        """The error for an option, with its line where there is one."""
        found = self.options.get((section, option))
        return FileError(sentence, self.path, None if found is None else found.line + 1)

    def text(self, section: str, option: str) -> str:
        """An option's text; FileError where it is not there."""
        found = self.options.get((section, option))
        if found is None:
            hint = (
                f" (it may stand in {', '.join(self.includes)}; put it into this file)"
                if self.includes
                else ""
            )
            raise FileError(
                f"option {option!r} of [{section}] is missing{hint}, and there is no default for "
                "it; add it",
                self.path,
            )
        return found.value

    def number(self, section: str, option: str, default: float | None = None) -> float:
        """An option's number, or the default where it is not there; FileError where it is no
        number.
        """
        if default is not None and not self.has(section, option):
            return default
        text = self.text(section, option)
        return number(
            text, f"{option!r} of [{section}]", self.path, self.options[section, option].line + 1
        )

    def three(self, section: str, option: str) -> tuple[float, float, float]:
        """An option's three numbers with commas between."""
        parts = self.text(section, option).split(",")
        if len(parts) != 3:
            raise self.error(
                f"{option!r} of [{section}] has {len(parts)} numbers where steps of three towers "
                "are needed; correct it",
                section,
                option,
            )
        line = self.options[section, option].line + 1
        a, b, c = (
            number(part.strip(), f"{option!r} of [{section}]", self.path, line) for part in parts
        )
        return a, b, c

    def replaced(self, section: str, option: str, value: str) -> PrinterConfig:
        """The same with another value of an option; one that is not there is added to the saved
        part.
        """
        found = self.options.get((section, option))
        if found is None:
            return self._added(section, option, value)
        line = self.lines[found.line]
        changed = line[: found.start] + value + line[found.start + len(found.value) :]
        lines = (*self.lines[: found.line], changed, *self.lines[found.line + 1 :])
        return replace(
            self,
            lines=lines,
            options={**self.options, (section, option): replace(found, value=value)},
        )

    def _added(self, section: str, option: str, value: str) -> PrinterConfig:
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
    """Read a configuration; FileError where it cannot be read, or its saved part was edited."""
    return parse(read_text(path, "printer.cfg").splitlines(keepends=True), path)


def parse(lines: Sequence[str], path: Path) -> PrinterConfig:
    """Find options and sections; see the module."""
    header = next((i for i, line in enumerate(lines) if line.rstrip() == HEADER), None)
    options: dict[Key, Option] = {}
    saved: dict[str, int] = {}
    includes: list[str] = []
    section, kept = "", frozenset[Key]()
    last = max((i for i, line in enumerate(lines) if line.strip()), default=0)
    for i, line in enumerate(lines[: last + 1]):
        if i == header:
            section, kept = "", frozenset(options)
        offset = 0
        if header is not None and i >= header:
            if not line.startswith(MARK) or line[3:4] not in ("", " ", "\n", "\r"):
                raise FileError(
                    f"this line stands below SAVE_CONFIG without {MARK!r}, so Klipper ignores the "
                    "block; move it up",
                    path,
                    i + 1,
                )
            offset = 4
        content = COMMENT.sub("", line[offset:].rstrip("\r\n")).rstrip()
        if not content or content[0].isspace():
            continue
        if found := SECTION.match(content):
            section = found.group(1)
            if section.startswith("include "):
                includes.append(section.removeprefix("include ").strip())
            if offset:
                saved[section] = i
        elif (found := OPTION.match(content)) and section:
            key = (section, found.group(1).lower())
            if key not in kept:
                options[key] = Option(found.group(3), i, offset + found.start(3))
    return PrinterConfig(path, tuple(lines), options, saved, header, tuple(includes))
