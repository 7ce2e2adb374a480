# SPDX-License-Identifier: Apache-2.0
r"""Plain text: characters that every program shows where they stand.

Names of files, cells of tables and values of settings are written by others. Control characters
drive a terminal, end a comment, or begin a command in a controller's file; characters that reverse
the direction of text, or that nobody sees, make a name look like another one. `escape` shows them
as a Python string would, such as `\x1b`.
"""

from __future__ import annotations

import dataclasses
import json
import re
import unicodedata
from typing import Any

SHOWN = 40  # characters of another's text that a message quotes
SHOWN_FIELD = 60  # characters of a field that a representation shows

_NOT_PLAIN = re.compile(
    "["
    "\x00-\x1f\x7f-\x9f"  # control characters
    "\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069"  # direction of text
    "\u2028\u2029"  # separators of lines and of paragraphs
    "\u00ad\u200b\u2060\ufeff\U000e0000-\U000e007f"  # invisible
    "\ud800-\udfff"  # halves of characters: no UTF-8; bytes of names of files that are not UTF-8
    "\ufdd0-\ufdef\ufff9-\ufffb\ufffe\uffff"  # no characters of any text
    "]"
)
_NOT_PLAIN_JSON = re.compile(f"(?!\n){_NOT_PLAIN.pattern}")


def find_not_plain(text: str, allowed: str = "") -> str | None:
    """Return the first character of a text that is not plain, except for those `allowed`."""
    if _NOT_PLAIN.search(text) is None:  # as nearly all names, of which a table has many
        return None
    return next((m[0] for m in _NOT_PLAIN.finditer(text) if m[0] not in allowed), None)


def escape(text: str, allowed: str = "") -> str:
    r"""Return a text with every character that is not plain as its escape.

    Examples
    --------
    >>> escape("leg 1\x1b[31m")
    'leg 1\\x1b[31m'
    """
    return _NOT_PLAIN.sub(
        lambda m: m[0] if m[0] in allowed else m[0].encode("unicode_escape").decode("ascii"), text
    )


def escape_formula(text: str) -> str:
    """Return an escaped cell that no spreadsheet takes for a formula; numbers stay numbers.

    Examples
    --------
    >>> escape_formula("=1+1"), escape_formula("-0.5")
    ("'=1+1", '-0.5')
    """
    try:
        float(text)
    except ValueError:
        return ("'" if text[:1] in tuple("=+-@\t\r") else "") + escape(text)
    return text


def escape_json(text: str) -> str:
    r"""Return JSON text with the same content, in which strings are plain, by JSON's escapes.

    Between the strings of JSON, line breaks are the only characters that are not plain.
    """
    return _NOT_PLAIN_JSON.sub(lambda m: json.dumps(m[0])[1:-1], text)


def quote(value: Any) -> str:
    """Return a text in quotes and escaped, or another value; of long ones the first characters."""
    is_text = isinstance(value, str)
    text = value if is_text else repr(value)
    text = text if len(text) <= SHOWN else text[:SHOWN] + "…"
    return escape(repr(text) if is_text else text)


def list_changes(value: Any) -> dict[str, Any]:
    """Return the fields of a dataclass, by name, that are not as they are by default."""
    changes = {}
    for entry in dataclasses.fields(value):
        if entry.init:
            content, factory = getattr(value, entry.name), entry.default_factory
            usual = entry.default if factory is dataclasses.MISSING else factory()
            if content is not usual and repr(content) != repr(usual):
                changes[entry.name] = content
    return changes


def represent(self: Any) -> str:
    """Return the name of a dataclass and its `list_changes` on one line, such as
    `Prior(names=<42 entries>, rows=<42 x 42 array>)`: only the size of what is long. This is the
    `__repr__` of values with arrays.
    """
    shown = []
    for name, content in list_changes(self).items():
        text = repr(content)
        if len(text) > SHOWN_FIELD or "\n" in text:
            size = " x ".join(map(str, getattr(content, "shape", ())))
            count = f"{len(content)} entries" if isinstance(content, tuple | list | dict) else ""
            text = f"<{f'{size} array' if size else count or type(content).__name__}>"
        shown.append(f"{name}={text}")
    return f"{type(self).__name__}({', '.join(shown)})"


def name_character(character: str) -> str:
    """Return a character for messages, such as `U+202E (right-to-left override)`."""
    name = unicodedata.name(character, "").lower()
    kind = {"Cc": "a control character", "Cs": "half of a character"}
    name = name or kind.get(unicodedata.category(character), "no character")
    return f"U+{ord(character):04X} ({name})"
