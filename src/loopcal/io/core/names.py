# SPDX-License-Identifier: Apache-2.0
"""The rule for names in files: of robots, limbs, actuators, poses, sessions, targets, columns.

A name is written into tables, comments, pictures and controllers' files, and shown on terminals. It
is therefore one line of plain text, of limited length, that no spreadsheet computes.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

from loopcal.findings import Finding, report_finding
from loopcal.io.core.limits import COMPOSED_LENGTH, NAME_LENGTH, TEXT_LENGTH
from loopcal.plain_text import escape, find_not_plain, name_character, quote

LONGEST_NAME, LONGEST_COMPOSED = NAME_LENGTH.count, COMPOSED_LENGTH.count
"""Characters of a name, and of one that is composed of others, such as `monday.tracker.x`."""

COMPOSED_KEYS = frozenset(
    {"identified", "unknowns", "fixed", "stored_parameters", "of", "noise", "columns"}
)
"""Keys of YAML files with composed names in or below them."""

TEXT_KEYS = frozenset({"source", "comment", "format", "from", "ignore", "match", "missing"})
"""Keys of YAML files whose values are texts or patterns, not names."""

_EQUALS, _SIGNS = r"=@\uff1d\uff20", r"+\-\uff0b\uff0d"
"""Characters that begin a formula, also as wide ones, which spreadsheets of East Asia accept."""

_FORMULA = re.compile(rf'(?:^|[,;])[\s"]*(?:[{_EQUALS}]\s*[^\s,;]|[{_SIGNS}][^,;]*[(|!])')
"""A cell, or a part of a name that becomes one where a line is split, that is computed: it begins
with `=` or `@`, or with a sign and calls a function or another program. Signs and numbers, such as
the labels `+x` and `-1`, are none.
"""


def find_fault(name: str, longest: int = LONGEST_NAME) -> Finding | None:
    """Return why a file must not contain a name of at most `longest` characters, or None."""
    if (fault := _find_fault(name, "name", "", longest)) is not None:
        return fault
    return report_finding("files.name-computed", name=quote(name)) if is_formula(name) else None


def find_fault_below(keys: Iterable[str | int], text: str) -> Finding | None:
    """Return why a YAML file must not contain a text below some keys, or as the last of them."""
    if not TEXT_KEYS.isdisjoint(keys):
        return find_text_fault(text)
    is_composed = not COMPOSED_KEYS.isdisjoint(keys)
    return find_fault(text, LONGEST_COMPOSED if is_composed else LONGEST_NAME)


def find_text_fault(text: str) -> Finding | None:
    """Return why a file must not contain a text that is no name; it may have several lines."""
    return _find_fault(text, "text", "\n\t", TEXT_LENGTH.count)


def is_formula(cell: str) -> bool:
    """Return whether a spreadsheet would compute a cell."""
    return _FORMULA.search(cell) is not None


def make_name(text: str) -> str:
    """Return a text of another origin, such as the name of a file, as a name."""
    name = escape(text)[:LONGEST_NAME].strip()
    return re.sub(rf"[{_EQUALS}(|!]", "_", name) if is_formula(name) else name


def format_comment(text: str) -> str:
    """Return a text, which may contain names of files, as one line behind the `#` of a comment.

    Measurement files have comments, too, and spreadsheets split these at commas.
    """
    line = escape(" ".join(text.split()))
    return re.sub("[,;]", " ", line) if is_formula(line) else line


def _find_fault(text: str, what: str, allowed: str, longest: int) -> Finding | None:
    """Return what is wrong with the characters or the length of a text."""
    character = find_not_plain(text, allowed)
    if character is not None:
        named = name_character(character)
        return report_finding("files.name-not-plain", what=what, name=quote(text), character=named)
    if len(text) > longest:
        n = len(text)
        return report_finding(
            "files.name-too-long", what=what, name=quote(text), length=n, longest=longest
        )
    return None
