# SPDX-License-Identifier: Apache-2.0
"""Text of YAML: names in quotes where they need them, and one key added to or removed from a file.

A change of one key leaves the rest of the text as it is, in any style: block mappings at any
indentation, flow mappings, JSON. Several places for the new text are tried, and the first result
that reads back as the wanted content counts. Where none does, the content is written anew.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from typing import Any

from loopcal.errors import FileError
from loopcal.io.core.yaml_file import YamlFile, make_round_trip_yaml, parse_yaml

PLAIN = re.compile(r"(?!(?:true|false|null|yes|no|on|off)\Z)[a-z][\w.-]*", re.IGNORECASE)
"""Text that every version of YAML reads as the same text without quotes."""


def quote_scalar(text: str) -> str:
    """Return text as a YAML scalar in one line, in double quotes where it needs them."""
    return text if PLAIN.fullmatch(text) else _escape(json.dumps(text, ensure_ascii=False))


def format_flow_mapping(texts: Mapping[str, str]) -> str:
    """Return a mapping in one line, from names and the YAML texts of their values."""
    return f"{{{', '.join(f'{quote_scalar(name)}: {text}' for name, text in texts.items())}}}"


def add_key(file: YamlFile, entry: str, content: Mapping[str, Any] | None = None) -> YamlFile:
    """Return a file with one more key.

    Parameters
    ----------
    file : without the key. entry : the key and its value in block style at the left margin, in
        complete lines; a comment in them is lost where the file is in flow style.
    content : what the entry says, as far as the caller knows; otherwise it is parsed.
    """
    added = _parse(entry, file).content if content is None else dict(content)
    return _choose(file, _list_additions(file, entry, added), file.content | added)


def remove_key(file: YamlFile, key: str) -> YamlFile:
    """Return a file without one of its keys."""
    if key not in file.content:
        return file
    wanted = {name: value for name, value in file.content.items() if name != key}
    return _choose(file, _list_removals(file.text, key), wanted)


def _choose(file: YamlFile, candidates: Iterator[str], wanted: dict[str, Any]) -> YamlFile:
    """Return the first text that reads as the wanted content, or that content as JSON."""
    exact = json.dumps(wanted, sort_keys=True)
    for candidate in candidates:
        try:
            changed = _parse(candidate, file)
        except FileError:
            continue
        if json.dumps(changed.content, sort_keys=True) == exact:
            return changed
    rows = ",\n ".join(_format_inside({name: value}) for name, value in wanted.items())
    return _parse(f"{{{rows}}}\n", file)


def _parse(text: str, file: YamlFile) -> YamlFile:
    """Parse a changed text of a file, or a part of it, whose names were checked before."""
    return parse_yaml(text, file.path, "changed file", has_names=False)


def _list_additions(file: YamlFile, entry: str, added: dict[str, Any]) -> Iterator[str]:
    """Yield texts with a further key, first those that are quick to make."""
    text = file.text
    end = "\r\n" if "\r\n" in text else "\n"
    whole = text if text.endswith("\n") else text + end
    yield whole + entry.replace("\n", end)
    root = make_round_trip_yaml().compose(text)
    start, stop = root.start_mark.index, root.end_mark.index
    if root.flow_style:
        inside = _format_inside(added)
        for comma in (",", ""):
            yield f"{text[: stop - 1]}{comma}{end}{inside}{text[stop - 1 :]}"
        return
    start = root.value[0][0].start_mark.index
    column = start - _find_line(text, start)
    indented = "".join(" " * column + line + end for line in entry.splitlines())
    for place in (_find_line(whole, stop) if stop < len(text) else len(whole), start - column):
        yield whole[:place] + indented + whole[place:]


def _list_removals(text: str, key: str) -> Iterator[str]:
    """Yield texts without a key and its value."""
    root = make_round_trip_yaml().compose(text)
    for name, value in root.value:
        if name.value != key:
            continue
        start, stop = name.start_mark.index, max(_list_ends(value), default=0)
        if root.flow_style:
            behind = re.compile(r"\s*,").match(text, stop)
            if behind is not None:
                yield text[:start] + text[behind.end() :].lstrip(" ")
            yield re.sub(r",\s*\Z", "", text[:start]) + text[stop:]
        else:
            after = text.find("\n", stop - 1) + 1 or len(text)  # the value may end with a break
            yield text[: _find_line(text, start)] + text[after:]


def _list_ends(node: Any) -> Iterator[int]:
    """Yield where the scalars and flow collections of a node end; a block ends with its last."""
    if isinstance(node.value, str) or node.flow_style:
        yield node.end_mark.index
        return
    for child in node.value:
        for part in child if isinstance(child, tuple) else (child,):
            yield from _list_ends(part)


def _find_line(text: str, place: int) -> int:
    """Return where the line of a character begins."""
    return text.rfind("\n", 0, place) + 1


def _format_inside(content: dict[str, Any]) -> str:
    """Return a mapping as JSON in one line, without its braces."""
    return _escape(json.dumps(content, ensure_ascii=False)[1:-1])


def _escape(text: str) -> str:
    """Return JSON with escapes for all characters that YAML does not allow or breaks lines at."""
    return "".join(c if c.isprintable() else _escape_one(c) for c in text)


def _escape_one(character: str) -> str:
    code = ord(character)
    return f"\\u{code:04x}" if code < 1 << 16 else f"\\U{code:08x}"
