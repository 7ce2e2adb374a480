# SPDX-License-Identifier: Apache-2.0
"""YAML 1.2 with the line of every key and value, so that each complaint about a file can name its
line.

The round-trip reader of ruamel.yaml keeps comments and positions; `plain` gives the same content as
dicts, lists, text, numbers, booleans and None, checked: keys are text, numbers are finite.
"""

from __future__ import annotations

import datetime
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from loopcal.errors import FileError, suggest_names
from loopcal.io.core.text_file import read_text

Location = tuple[str | int, ...]


@dataclass(frozen=True)
class YamlFile:
    """A mapping read from a YAML file.

    Parameters
    ----------
    path : Path
        Where it was read; for messages.
    text : str
        The file's text without byte order mark.
    tree : Any
        ruamel.yaml's round-trip tree, which knows lines and comments.
    content : dict
        The same as plain Python values.
    first_line : int
        Line of the file at which the YAML text starts (front matter of another file starts later
        than 1).
    """

    path: Path
    text: str
    tree: Any
    content: dict[str, Any]
    first_line: int = 1

    def line(self, location: Location) -> int:
        """Return the line of the node at `location`; parts that do not exist in the file are
        ignored.
        """
        node, line = self.tree, 0
        for step in location:
            if has_child(node, step):
                line = _line_of(node, step, line)
                node = node[step]
        return line + self.first_line

    def error(self, sentence: str, location: Location = ()) -> FileError:
        """Return the error that puts `sentence` at the line of `location`; no line where the file
        has nothing there.
        """
        known = bool(location) and has_child(self.tree, location[0])
        return FileError(sentence, self.path, self.line(location) if known else None)


def read_yaml(path: str | Path, what: str) -> YamlFile:
    """Read one mapping from a YAML 1.2 file.

    Parameters
    ----------
    path : str or Path
        The file.
    what : str
        What it should be, for messages: "robot file".

    Raises
    ------
    FileError
        Unreadable file, YAML syntax, duplicate key, a key that is not text, a number that is not
        finite.
    """
    return parse_yaml(read_text(path, what), path, what)


def parse_yaml(text: str, path: str | Path, what: str, first_line: int = 1) -> YamlFile:
    """Parse YAML text that begins at line `first_line` of `path`; see `read_yaml`."""
    from ruamel.yaml.constructor import DuplicateKeyError
    from ruamel.yaml.error import MarkedYAMLError, YAMLError

    path = Path(path)
    try:
        tree = round_trip().load(text)
    except DuplicateKeyError as error:
        key = str(error.problem).split('"')[1] if '"' in str(error.problem) else "?"
        line = error.problem_mark.line + first_line if error.problem_mark else None
        raise FileError(
            f"key {key!r} stands here for the second time; keep one of the two", path, line
        ) from None
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        problem = " ".join(str(error.problem or error.context or "not YAML").split())
        line = mark.line + first_line if mark else None
        raise FileError(
            f"this is not valid YAML ({problem}); check indentation, brackets and colons",
            path,
            line,
        ) from None
    except (YAMLError, ValueError, RecursionError) as error:
        raise FileError(
            f"this is not valid YAML ({' '.join(str(error).split())}); check its form", path
        ) from None
    if not isinstance(tree, Mapping):
        raise FileError(
            f"this {what} holds no 'key: value' lines; see the examples that come with loopcal",
            path,
        )
    draft = YamlFile(path, text, tree, {}, first_line)
    return YamlFile(path, text, tree, _plain(tree, draft, ()), first_line)


def round_trip() -> Any:
    """Return ruamel.yaml's round-trip reader and writer with this project's settings."""
    from ruamel.yaml import YAML

    yaml = YAML(typ="rt", pure=True)
    yaml.preserve_quotes = True
    yaml.width = 120
    return yaml


def refuse_unknown_keys(
    file: YamlFile, keys: Sequence[str], allowed: Sequence[str], location: Location = ()
) -> None:
    """Raise for the first key that is not allowed, with the nearest allowed names.

    Raises
    ------
    FileError
        One key is unknown.
    """
    for key in keys:
        if key not in allowed:
            hint = suggest_names(key, allowed) or f"; allowed are {', '.join(sorted(allowed))}"
            raise file.error(
                f"unknown key {key!r}{_inside(location)}{hint}; correct or remove it",
                (*location, key),
            )


def has_child(node: Any, step: str | int) -> bool:
    """Tell whether a mapping has the key, or a list the index, `step`."""
    if isinstance(node, Mapping):
        return step in node
    return isinstance(node, list) and isinstance(step, int) and 0 <= step < len(node)


def words(location: Location) -> str:
    """Return a location in words that count from 1: `base entry 3` for ("base", 2)."""
    parts: list[str] = []
    for step in location:
        if isinstance(step, int):
            parts.append(f" entry {step + 1}")
        else:
            parts.append(f".{step}" if parts else step)
    return "".join(parts)


def _inside(location: Location) -> str:
    """Return ` in 'legs'`, or nothing at the top of the file."""
    return f" in {words(location)!r}" if location else ""


def _line_of(node: Any, step: str | int, line: int) -> int:
    """Return the line (from 0) of a child: of the key in a mapping, of the item in a sequence;
    `line` where unknown.
    """
    try:
        positions = node.lc
        return int(positions.key(step)[0] if isinstance(node, Mapping) else positions.item(step)[0])
    except (AttributeError, KeyError, TypeError, IndexError):
        return line


def _plain(node: Any, file: YamlFile, location: Location) -> Any:
    """Return `node` as plain Python values; see the module."""
    if isinstance(node, Mapping):
        for key in node:
            if not isinstance(key, str):
                raise file.error(
                    f"key {key!r}{_inside(location)} is not text; put it in quotes",
                    (*location, key),
                )
        return {str(key): _plain(value, file, (*location, key)) for key, value in node.items()}
    if isinstance(node, bool) or node is None:
        return node
    if isinstance(node, str):
        return str(node)
    if isinstance(node, int):
        return _finite(int(node), file, location)
    if isinstance(node, float):
        return _finite(float(node), file, location)
    if isinstance(node, Sequence):
        return [_plain(value, file, (*location, i)) for i, value in enumerate(node)]
    if isinstance(node, datetime.date):
        return node.isoformat()
    raise file.error(
        f"{words(location)!r} has a YAML tag, which robot and data files do not use; remove it",
        location,
    )


def _finite(value: float, file: YamlFile, location: Location) -> float:
    """Return a number that a double can hold."""
    try:
        finite = math.isfinite(float(value))
    except OverflowError:
        finite = False
    if not finite:
        raise file.error(
            f"{words(location)!r} is {value}; every number must be finite, so write its value",
            location,
        )
    return value
