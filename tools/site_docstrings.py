# SPDX-License-Identifier: Apache-2.0
"""Docstrings as Sphinx reads them.

Docstrings of loopcal are NumPy style with the description on the line of the name
(`name : description`), several entries on a line, and formulas such as |z|^2 as plain text.
"""

import re

FIELDS = {
    "Parameters": ":param {}:",
    "Raises": ":raises {}:",
    "Attributes": "``{}``",  # a list of definitions: a field would be linked by its name alone
}
"""From the heading of a section to what one of its entries begins with."""

ENTRY = re.compile(r"^([*\w][\w, *.]*?) : ?(.*)$")
NEXT_ENTRY = re.compile(r"(?<=[.;\]]) (?=\w[\w, ]*? : )")
NAME = re.compile(r"^\w+$")
UNDERLINE = re.compile(r"^-{3,}$")
CODE = re.compile(r"(``.*?``|`[^`]*`|^ *>>> .*$)", re.DOTALL | re.MULTILINE)


def convert_docstring(lines: list[str]) -> list[str]:
    """Return the lines of a docstring in the markup of docutils."""
    result: list[str] = []
    heading = ""
    for line, after in zip(lines, [*lines[1:], ""], strict=True):
        if UNDERLINE.match(after) and NAME.match(line):
            heading = line
            result += start_section(heading)
        elif UNDERLINE.match(line):
            continue
        elif heading in FIELDS:
            result += convert_entries(line, FIELDS[heading])
        elif heading == "Returns" and line:
            result.append(f"    {line.strip()}")
        else:
            result.append(line)
    return escape_markup("\n".join(result)).split("\n")


def start_section(heading: str) -> list[str]:
    """Return the lines with which a section begins."""
    if FIELDS.get(heading, "").startswith(":"):
        return []
    return [":returns:"] if heading == "Returns" else [f".. rubric:: {heading}", ""]


def convert_entries(line: str, field: str) -> list[str]:
    """Return the fields that a line of a section begins, or the line that continues one."""
    if not line or line.startswith(" "):
        return [line]
    result = []
    for part in NEXT_ENTRY.split(line):
        entry = ENTRY.match(part)
        if entry:
            names = entry[1].replace(", ", ",")  # else the first is read as the type of the second
            result += [field.format(names), f"    {entry[2]}"]
        elif NAME.match(part):
            result.append(field.format(part))
        else:
            result += ["", part, ""]
    return result


def escape_markup(text: str) -> str:
    """Return a text in which asterisks and bars outside of code are what they look like."""
    parts = CODE.split(text)
    parts[::2] = [re.sub(r"([|*])", r"\\\1", part) for part in parts[::2]]
    return "".join(parts)
