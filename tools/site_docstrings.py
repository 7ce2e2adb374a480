# SPDX-License-Identifier: Apache-2.0
"""Docstrings as Sphinx reads them.

Docstrings of loopcal are NumPy style with the description on the line of the name
(`name : description`), several entries on a line, and formulas such as |z|^2 as plain text.
"""

import re
from collections.abc import Sequence

TERMS = {"Parameters": "``{}``", "Attributes": "``{}``", "Raises": ":py:exc:`{}`"}
"""From the heading of a section of entries to the markup of the name of an entry."""

ENTRY = re.compile(r"^([*\w][\w, *.]*?) : ?(.*)$")
NEXT_ENTRY = re.compile(r"(?<=[.;\]]) (?=\w[\w, ]*? : )")
NAME = re.compile(r"^\w+$")
UNDERLINE = re.compile(r"^-{3,}$")
CODE = re.compile(r"(``.*?``|`[^`]*`|^ *>>> .*$)", re.DOTALL | re.MULTILINE)


def convert_docstring(lines: Sequence[str]) -> list[str]:
    """Return the lines of a docstring in the markup of docutils: a heading, then definitions."""
    result: list[str] = []
    heading = ""
    for line, after in zip(lines, [*lines[1:], ""], strict=True):
        if UNDERLINE.match(after) and NAME.match(line):
            heading = line
            result += [f".. rubric:: {heading}", ""]
        elif UNDERLINE.match(line):
            continue
        elif heading in TERMS:
            result += convert_entries(line, TERMS[heading])
        else:
            result.append(line)
    return escape_markup("\n".join(result)).split("\n")


def convert_entries(line: str, term: str) -> list[str]:
    """Return the definitions that a line of a section begins, or the line that continues one."""
    first, *others = NEXT_ENTRY.split(line)
    if not first or first.startswith(" "):
        return [first, *(text for part in others for text in convert_entries(part, term))]
    result = []
    for part in (first, *others):
        entry = ENTRY.match(part)
        if entry:
            result += [term.format(entry[1]), f"    {entry[2]}"]
        elif NAME.match(part):
            result.append(term.format(part))
        else:
            result += ["", part, ""]
    return result


def escape_markup(text: str) -> str:
    """Return a text in which asterisks and bars outside of code are what they look like."""
    parts = CODE.split(text)
    parts[::2] = [re.sub(r"([|*])", r"\\\1", part) for part in parts[::2]]
    return "".join(parts)
