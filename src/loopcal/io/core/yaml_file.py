# SPDX-License-Identifier: Apache-2.0
"""YAML 1.2 files that know the line of every key and value, so that errors can name it."""

from __future__ import annotations

import datetime
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from loopcal.errors import FileError, UnitError, suggest_names
from loopcal.findings import report_finding
from loopcal.io.core.limits import YAML_SIZE
from loopcal.io.core.names import find_fault_below
from loopcal.io.core.text_file import as_path, read_text
from loopcal.plain_text import escape, quote
from loopcal.units import Dimension, parse_quantity

Location = tuple[str | int, ...]

LONGEST_PROBLEM = 100
"""Characters of a parser's sentence that a message repeats."""

KEPT_TEXTS, KEPT_LENGTH = 32, 100_000
"""Texts whose trees are kept, and their largest length. A command reads the same text several times
(it is looked at before it is used, and read back after it was written), which takes as long as a
fit.
"""

_KNOWN_KEY = re.compile(
    r"""^[\s{]*["']?(format|units|family|identified|kinds?|noise|controller|instrument|robot|poses"""
    r"""|unknowns|reading_noise|columns|delimiter|settings|closed_loop|name_mot)["']?\s*:""",
    re.MULTILINE,
)
"""A line by which a file is recognized as one of loopcal; messages only quote such files."""


@dataclass(frozen=True)
class YamlFile:
    """A mapping read from a YAML file.

    Parameters
    ----------
    path : the file, for messages. text : its text without a byte order mark.
    tree : ruamel.yaml's round-trip tree, which keeps lines and comments.
    content : the same as plain dicts, lists, text, finite numbers, booleans and None.
    first_line : line of the file at which the YAML text begins; front matter begins later than 1.
    """

    path: Path
    text: str
    tree: Any
    content: dict[str, Any]
    first_line: int = 1

    def line(self, location: Location) -> int:
        """Return the line of the node at `location`; steps that do not exist are ignored."""
        node, line = self.tree, 0
        for step in location:
            if has_child(node, step):
                line = _line_of(node, step, line)
                node = node[step]
        return line + self.first_line

    def error(self, sentence: Any, location: Location = ()) -> FileError:
        """Return an error at the line of `location`, or without a line where it does not exist."""
        exists = bool(location) and has_child(self.tree, location[0])
        return FileError(sentence, self.path, self.line(location) if exists else None)

    def quantity(self, node: Any, dimension: Dimension, location: Location) -> float:
        """Return the SI value of a number with its unit, such as `5 um`.

        Raises
        ------
        FileError : not a number with a unit of this dimension; at its line.
        """
        try:
            return parse_quantity(str(node), dimension)
        except UnitError as error:
            raise self.error(f"{name_location(location)!r}: {error}", location) from None


def read_yaml(path: str | Path, what: str, has_names: bool = True) -> YamlFile:
    """Read one mapping from a YAML 1.2 file.

    Parameters
    ----------
    path : the file. what : what it should be, for messages.
    has_names : whether its keys and texts are names (`loopcal.io.core.names`), not prose.

    Raises
    ------
    FileError
        Unreadable file, YAML syntax, duplicate key, a key that is not text, a number that is not
        finite, a name that a file must not contain, a YAML tag, or more than the limits of
        `loopcal.io.core.limits` allow.
    """
    return parse_yaml(read_text(path, what, limit=YAML_SIZE), path, what, has_names=has_names)


def parse_yaml(
    text: str, path: str | Path, what: str, first_line: int = 1, has_names: bool = True
) -> YamlFile:
    """Parse YAML text that begins at line `first_line` of `path`; raise as `read_yaml`."""
    path = as_path(path, what)
    YAML_SIZE.check(len(text), what, path)
    is_ours = not has_names or _KNOWN_KEY.search(text) is not None
    with _hide_content(path, what) if not is_ours else nullcontext():
        tree = _load_tree(text, path, what, first_line)
    if not isinstance(tree, Mapping):
        sentence = f"this {what} contains no 'key: value' lines; see the examples of loopcal"
        raise FileError(sentence, path)
    file = YamlFile(path, text, tree, {}, first_line)
    with _hide_content(path, what) if not is_ours else nullcontext():
        content = _to_plain(tree, file, ())
        if has_names:
            _refuse_names(content, file, ())
    return replace(file, content=content)


@contextmanager
def _hide_content(path: Path, what: str) -> Iterator[None]:
    """Replace the text of a FileError of the body: nothing of a file of somebody else is shown."""
    try:
        yield
    except FileError as error:
        if error.code == "files.limit-exceeded":
            raise  # it only has numbers
        finding = report_finding("files.not-recognized", what=what)
        raise FileError(finding, path, error.line) from None


def _load_tree(text: str, path: Path, what: str, first_line: int) -> Any:
    """Return ruamel.yaml's tree of a text; raise FileError for bad syntax."""
    from ruamel.yaml.constructor import DuplicateKeyError
    from ruamel.yaml.error import MarkedYAMLError, YAMLError

    from loopcal.io.core.bounded_yaml import KeyTypeError, LimitError

    try:
        return _parse_text(text) if len(text) <= KEPT_LENGTH else _parse_text.__wrapped__(text)
    except DuplicateKeyError as error:
        key = str(error.problem).split('"')[1] if '"' in str(error.problem) else "?"
        line = error.problem_mark.line + first_line if error.problem_mark else None
        raise FileError(f"duplicate key {quote(key)}; remove one", path, line) from None
    except LimitError as error:
        raise error.limit.make_error(what, path, line=error.line + first_line) from None
    except KeyTypeError as error:
        raise FileError(f"{error}; write text there", path, error.line + first_line) from None
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        problem = _shorten(error.problem or error.context or "not YAML")
        sentence = f"not valid YAML ({problem}); check indentation, brackets and colons"
        raise FileError(sentence, path, mark.line + first_line if mark else None) from None
    except (YAMLError, ValueError, RecursionError) as error:
        if "integer string conversion" in str(error):  # Python reads no more than 4300 digits
            raise FileError("a number has thousands of digits; write a shorter one", path) from None
        sentence = f"not valid YAML ({_shorten(error)}); correct the syntax"
        raise FileError(sentence, path) from None


@lru_cache(KEPT_TEXTS)
def _parse_text(text: str) -> Any:
    """Return ruamel.yaml's tree of a text, which nothing changes: it is only asked for lines."""
    return make_round_trip_yaml().load(text)


def make_round_trip_yaml() -> Any:
    """Return ruamel.yaml's round-trip reader and writer with the settings of this project."""
    from ruamel.yaml import YAML

    from loopcal.io.core.bounded_yaml import make_bounded_composer

    yaml = YAML(typ="rt", pure=True)
    yaml.Composer = make_bounded_composer
    yaml.preserve_quotes = True
    yaml.width = 120
    return yaml


def refuse_unknown_keys(
    file: YamlFile, keys: Sequence[str], allowed: Sequence[str], location: Location = ()
) -> None:
    """Raise FileError for the first key that is not allowed, with the nearest allowed names."""
    if set(keys).isdisjoint(allowed) and keys and not _KNOWN_KEY.search(file.text):
        finding = report_finding("files.no-known-key", keys=tuple(sorted(allowed)))
        raise FileError(finding, file.path)
    for key in keys:
        if key not in allowed:
            hint = suggest_names(key, allowed) or f"; allowed: {', '.join(sorted(allowed))}"
            sentence = f"unknown key {key!r}{_inside(location)}{hint}; correct or remove it"
            raise file.error(sentence, (*location, key))


def has_child(node: Any, step: str | int) -> bool:
    """Return whether a mapping has the key, or a list the index, `step`."""
    if isinstance(node, Mapping):
        return step in node
    return isinstance(node, list) and isinstance(step, int) and 0 <= step < len(node)


def name_location(location: Location) -> str:
    """Return a location for messages, counting from 1: `base entry 3` for ("base", 2)."""
    text = "".join(f" entry {s + 1}" if isinstance(s, int) else f".{s}" for s in location)
    return text.removeprefix(".")


def _shorten(problem: object) -> str:
    """Return a parser's sentence in one line, which may quote the file, without its end."""
    text = " ".join(str(problem).split())
    return escape(text if len(text) <= LONGEST_PROBLEM else f"{text[:LONGEST_PROBLEM]}…")


def _inside(location: Location) -> str:
    """Return ` in 'legs'`, or nothing at the top of the file."""
    return f" in {name_location(location)!r}" if location else ""


def _line_of(node: Any, step: str | int, line: int) -> int:
    """Return the line (from 0) of a key or an item; `line` where it is unknown."""
    try:
        positions = node.lc
        return int(positions.key(step)[0] if isinstance(node, Mapping) else positions.item(step)[0])
    except (AttributeError, KeyError, TypeError, IndexError):
        return line


def _to_plain(node: Any, file: YamlFile, location: Location) -> Any:
    """Return `node` as plain Python values; see `YamlFile.content`."""
    if isinstance(node, Mapping):
        for key in node:
            if not isinstance(key, str):
                sentence = f"key {quote(key)}{_inside(location)} is not text; put it in quotes"
                raise file.error(sentence, (*location, key))
        return {str(key): _to_plain(value, file, (*location, key)) for key, value in node.items()}
    if isinstance(node, bool) or node is None:
        return node
    if isinstance(node, str):
        return str(node)
    if isinstance(node, int | float):
        return _finite(int(node) if isinstance(node, int) else float(node), file, location)
    if isinstance(node, Sequence):
        return [_to_plain(value, file, (*location, i)) for i, value in enumerate(node)]
    if isinstance(node, datetime.date):
        return node.isoformat()
    sentence = f"{name_location(location)!r} has a YAML tag, which is not allowed here; remove it"
    raise file.error(sentence, location)


def _refuse_names(node: Any, file: YamlFile, location: Location) -> None:
    """Raise FileError for the first key or text that is not a name, or no text where one may be."""
    if isinstance(node, dict):
        for key, value in node.items():
            if (fault := find_fault_below(location, key)) is not None:
                raise file.error(fault, (*location, key))
            _refuse_names(value, file, (*location, key))
    elif isinstance(node, list):
        for i, value in enumerate(node):
            _refuse_names(value, file, (*location, i))
    elif isinstance(node, str) and (fault := find_fault_below(location, node)) is not None:
        raise file.error(fault, location)


def _finite(value: float, file: YamlFile, location: Location) -> float:
    """Return a number that fits a double."""
    try:
        is_finite = math.isfinite(float(value))
    except OverflowError:
        is_finite = False
    if not is_finite:
        shown = "too large" if isinstance(value, int) else value  # it may have thousands of digits
        raise file.error(f"{name_location(location)!r} is {shown}; write a finite number", location)
    return value
