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
from dataclasses import dataclass
from pathlib import Path

from loopcal.errors import FileError
from loopcal.io.core.text_file import read_text
from loopcal.io.formats.value_file import Name, Value, ValueFile

MARK = "#*#"
HEADER = "#*# <---------------------- SAVE_CONFIG ---------------------->"
NEW_BLOCK = (HEADER, "#*# DO NOT EDIT THIS BLOCK OR BELOW. The contents are auto-generated.", MARK)
SECTION = re.compile(r"\[([^]]+)\]")
OPTION = re.compile(r"([^:=\s][^:=]*?)(\s*[:=]\s*)(.*?)\s*$")
COMMENT = re.compile(r"#.*|(?:^|(?<=\s));.*")


@dataclass(frozen=True)
class KlipperConfig(ValueFile):
    """A configuration file, whose values are options by section and name.

    Attributes
    ----------
    saved : section -> line of its header in the saved part. header : first line of that part, None
        without one. includes : files that it includes.
    """

    saved: Mapping[str, int]
    header: int | None
    includes: tuple[str, ...]

    title = "[{0}] {1}"
    phrase = "{1!r} of [{0}]"

    def describe_missing(self, group: str, name: str) -> str:
        """Return the sentence about an option that does not exist."""
        files = ", ".join(self.includes)
        hint = f" (if {files} contains it, move it into this file)" if files else ""
        return f"option {name!r} of [{group}] is missing{hint}; add it"

    def positive(self, section: str, option: str, default: float | None = None) -> float:
        """Return a positive number of an option, or the default; FileError for another."""
        value = self.number(section, option, default)
        if not value > 0:
            sentence = f"{option!r} of [{section}] is {value:g}; write a positive number"
            raise self.error(sentence, section, option)
        return value

    def with_lines(self, lines: Sequence[str]) -> KlipperConfig:
        """Return the file with other lines."""
        return parse_config(lines, self.path)

    def insert(self, lines: list[str], name: Name, text: str) -> None:
        """Insert a new option into the saved part, which is added where there is none."""
        (section, option), end = name, self.line_end
        line = f"{MARK} {option} = {text}{end}"
        if self.header is None:
            lines += [end, *(line + end for line in NEW_BLOCK)]
        if section in self.saved:
            lines.insert(self.saved[section] + 1, line)
            return
        while not lines[-1].strip():
            lines.pop()
        first = [] if lines[-1].strip() == MARK else [MARK + end]
        lines += [*first, f"{MARK} [{section}]{end}", line]


def read_config(path: Path) -> KlipperConfig:
    """Read a configuration; FileError where it is unreadable, or its saved part was edited."""
    return parse_config(read_text(path, "printer.cfg").splitlines(keepends=True), path)


def parse_config(lines: Sequence[str], path: Path) -> KlipperConfig:
    """Find options and sections."""
    header = next((i for i, line in enumerate(lines) if line.rstrip() == HEADER), None)
    options: dict[Name, Value] = {}
    saved: dict[str, int] = {}
    includes: list[str] = []
    section, main_part = "", frozenset[Name]()
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
                options[key] = Value(match[3], i, offset + match.start(3))
    return KlipperConfig(path, tuple(lines), options, saved, header, tuple(includes))
