# SPDX-License-Identifier: Apache-2.0
"""YAML 1.2 files that know the line of every key and value, so that errors can name it."""

from __future__ import annotations

import datetime
import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

from loopcal.errors import FileError, UnitError, suggest_names
from loopcal.findings import Finding, report_finding
from loopcal.io.core.limits import YAML_DEPTH, YAML_NODES, YAML_SIZE, FileLimit, find_fault_below
from loopcal.io.core.text_file import as_path, read_text
from loopcal.plain_text import escape, quote
from loopcal.units import Dimension, parse_quantity

Location = tuple[str | int, ...]

KEPT_TEXTS, KEPT_LENGTH = 32, 100_000
"""Texts whose nodes are kept, and their largest length. A command reads the same text several times
(it is looked at before it is used), which takes as long as a fit.
"""

# A line by which a file is recognized as one of loopcal; messages only quote such files.
_KNOWN_KEY = re.compile(
    r"""^[\s{]*["']?(format|units|family|identified|kinds?|noise|controller|instrument|robot|poses"""
    r"""|unknowns|reading_noise|columns|delimiter|settings|closed_loop|name_mot)["']?\s*:""",
    re.MULTILINE,
)

# A text that begins with a directive other than `%YAML 1.2`, after empty lines and comments.
_DIRECTIVE = re.compile(r"(?:\s*(?:#.*)?\n)*%(?!YAML 1\.2\s)")


@dataclass(frozen=True)
class YamlFile:
    """A mapping read from a YAML file.

    `content` is plain: dicts, lists, text, finite numbers, booleans and None; `lines` are those of
    its keys and items, from 0.
    """

    path: Path
    text: str
    content: dict[str, Any]
    lines: Mapping[Location, int] = field(default_factory=dict)

    def line(self, location: Location) -> int:
        """Return the line of the node at `location`; steps that do not exist are ignored."""
        known = (location[:n] for n in range(len(location), 0, -1) if location[:n] in self.lines)
        return self.lines.get(next(known, ()), 0) + 1

    def error(self, sentence: Any, location: Location = ()) -> FileError:
        """Return an error at the line of `location`, or without a line where it does not exist."""
        exists = location[:1] in self.lines
        return FileError(sentence, self.path, self.line(location) if exists else None)

    def quantity(
        self, node: Any, dimension: Dimension, location: Location, is_difference: bool = False
    ) -> float:
        """Return the SI value of a number with its unit, such as `5 um`; else FileError."""
        try:
            return parse_quantity(str(node), dimension, is_difference)
        except UnitError as error:
            raise self.error(f"{name_location(location)!r}: {error}", location) from None


def read_yaml(path: str | Path, what: str, has_names: bool = True) -> YamlFile:
    """Read one mapping from a YAML 1.2 file; its keys and texts are names, if it `has_names`.

    FileError : unreadable file, YAML syntax, duplicate key, a key that is not text, a number that
    is not finite, a name that a file must not contain, a YAML tag, or more than the limits allow.
    """
    return parse_yaml(read_text(path, what, limit=YAML_SIZE), path, what, has_names=has_names)


def parse_yaml(text: str, path: str | Path, what: str, has_names: bool = True) -> YamlFile:
    """Parse YAML text of `path`; raise as `read_yaml`."""
    path = as_path(path, what)
    YAML_SIZE.check(len(text), what, path)
    try:
        content, lines = _load_content(text, path, what, has_names)
    except FileError as error:
        is_ours = not has_names or _KNOWN_KEY.search(text) is not None
        if is_ours or error.code == "files.limit-exceeded":  # which only has numbers
            raise
        # the sentence shows nothing of the text
        raise FileError.of("files.not-recognized", path, error.line, what=what) from None
    if not isinstance(content, dict):
        sentence = f"this {what} contains no 'key: value' lines. See the examples of loopcal"
        raise FileError(sentence, path)
    return YamlFile(path, text, content, lines)


def _load_content(
    text: str, path: Path, what: str, has_names: bool
) -> tuple[Any, Mapping[Location, int]]:
    """Return the content of a text, and the lines in it; raise FileError for bad syntax."""
    from ruamel.yaml.error import MarkedYAMLError, YAMLError

    if (directive := _DIRECTIVE.match(text)) is not None:
        sentence = "this file must not have YAML directives, which begin with %. Remove the line"
        raise FileError(sentence, path, directive[0].count("\n") + 1)
    try:
        compose = _compose if len(text) <= KEPT_LENGTH else _compose.__wrapped__
        reader = _NodeReader(has_names)
        return reader.read(compose(text), (), 0), reader.lines
    except _RefusedError as error:
        line = error.line + 1
        if isinstance(error.refusal, FileLimit):
            raise error.refusal.make_error(what, path, line=line) from None
        raise FileError(error.refusal, path, line) from None
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = mark.line + 1 if mark else None
        if "max_depth" in str(error.problem):
            raise YAML_DEPTH.make_error(what, path, line=line) from None
        problem = _shorten(error.problem or error.context or "not YAML")
        sentence = f"not valid YAML ({problem}). Check indentation, brackets and colons"
        raise FileError(sentence, path, line) from None
    except (YAMLError, ValueError, LookupError, AssertionError) as error:
        if "integer string conversion" in str(error):  # Python reads no more than 4300 digits
            raise FileError("a number has thousands of digits. Write a shorter one", path) from None
        sentence = f"not valid YAML ({_shorten(error)}). Correct the syntax"
        raise FileError(sentence, path) from None


@lru_cache(KEPT_TEXTS)
def _compose(text: str) -> Any:
    """Return the nodes of a YAML text as ruamel.yaml composes them, with places; None for none."""
    yaml = make_yaml()
    yaml.composer.warn_double_anchors = False  # YAML allows an anchor again, for another value
    yaml.max_depth = YAML_DEPTH.count  # deep text takes the square of its depth to read
    return yaml.compose(text)


def make_yaml() -> Any:
    """Return ruamel.yaml's reader of YAML 1.2 in Python, for plain values."""
    from ruamel.yaml import YAML

    return YAML(typ="safe", pure=True)


def refuse_unknown_keys(
    file: YamlFile, keys: Sequence[str], allowed: Sequence[str], location: Location = ()
) -> None:
    """Raise FileError for the first key that is not allowed, with the nearest allowed names."""
    if set(keys).isdisjoint(allowed) and keys and not _KNOWN_KEY.search(file.text):
        raise FileError.of("files.no-known-key", file.path, keys=tuple(sorted(allowed)))
    for key in keys:
        if key not in allowed:
            hint = suggest_names(key, allowed) or f". Allowed: {', '.join(sorted(allowed))}"
            sentence = f"unknown key {key!r}{_inside(location)}{hint}. Correct or remove it"
            raise file.error(sentence, (*location, key))


def name_location(location: Location) -> str:
    """Return a location for messages, counting from 1: `base entry 3` for ("base", 2)."""
    text = "".join(f" entry {s + 1}" if isinstance(s, int) else f".{s}" for s in location)
    return text.removeprefix(".")


def _shorten(problem: object) -> str:
    """Return a parser's sentence, which may quote the file, in one line of 100 characters."""
    text = " ".join(str(problem).split())
    return escape(text if len(text) <= 100 else f"{text[:100]}…")


def _inside(location: Location) -> str:
    """Return ` in 'legs'`, or nothing at the top of the file."""
    return f" in {name_location(location)!r}" if location else ""


class _RefusedError(Exception):
    """A document beyond a limit, or another refusal as a sentence; the line is counted from 0."""

    def __init__(self, refusal: FileLimit | Finding | str, line: int) -> None:
        super().__init__(refusal, line)
        self.refusal, self.line = refusal, line


@dataclass
class _NodeReader:
    """Reads nodes as plain values, see `YamlFile.content`, and their lines.

    It refuses tags, deep documents, those whose aliases stand for too much, and keys that are no
    text; where the file `has_names`, keys and texts that are no names.
    """

    has_names: bool
    yaml: Any = field(default_factory=make_yaml)
    lines: dict[Location, int] = field(default_factory=dict)
    count: int = 0
    sizes: dict[int, int] = field(default_factory=dict)  # values in a node that was read before
    within: list[Any] = field(default_factory=list)

    def read(self, node: Any, at: Location, line: int) -> Any:
        """Return the value of a node at a location, whose key or item is in a line."""
        if node is None:
            return None
        is_text, before = isinstance(node.value, str), self.count
        self.count += 1
        counts = self.count + self.sizes.get(id(node), 0), len(self.within) + 1
        for limit, count in zip((YAML_NODES, YAML_DEPTH), counts, strict=True):
            if count > limit.count:
                raise _RefusedError(limit, line)
        # a tag that the file states is not the one of the form of the value
        form = (node.style is None, node.style is not None) if is_text else True
        if node.tag != str(self.yaml.resolver.resolve(type(node), node.value, form)):
            raise _RefusedError("this file must not have YAML tags. Remove the tag", line)
        if is_text:
            return self._read_scalar(node, at, line)
        if any(node is outer for outer in self.within):
            problem = f"alias {node.anchor!r} stands for a value that contains the alias"
            sentence = f"not valid YAML ({problem}). Check indentation, brackets and colons"
            raise _RefusedError(sentence, line)
        self.within.append(node)
        if node.id == "mapping":
            value: Any = self._read_keys(node.value, at)
        else:  # an alias in a list has the line of the list
            lines = [max(line, item.start_mark.line) for item in node.value]
            self.lines |= {(*at, i): of_item for i, of_item in enumerate(lines)}
            value = [self.read(item, (*at, i), lines[i]) for i, item in enumerate(node.value)]
        self.within.pop()
        self.sizes[id(node)] = self.count - before
        return value

    def _read_keys(self, nodes: Sequence[tuple[Any, Any]], at: Location) -> dict[str, Any]:
        """Return the keys and values of a mapping, those that it merges behind its own."""
        content: dict[str, Any] = {}
        merged: list[dict[str, Any]] = []
        for name, node in nodes:
            # an alias has no place of its own, but its value has
            line = (node if id(name) in self.sizes else name).start_mark.line
            if not isinstance(name.value, str):
                raise _RefusedError("a key is a list or a mapping. Write text there", line)
            if name.tag.endswith(":merge"):
                value = self.read(node, at, line)
                merged += value if isinstance(value, list) else [value]
                if not all(isinstance(other, dict) for other in merged):
                    raise _RefusedError("<< merges no mapping. Write a mapping or its alias", line)
                continue
            key = self.read(name, at, line)
            if not isinstance(key, str):
                sentence = f"key {quote(key)}{_inside(at)} is not text. Put it in quotes"
                raise _RefusedError(sentence, line)
            if key in content:
                raise _RefusedError(f"duplicate key {quote(key)}. Remove one", line)
            self.lines[*at, key] = line
            content[key] = self.read(node, (*at, key), line)
        for other in merged:
            content = {**other, **content}
        return content

    def _read_scalar(self, node: Any, at: Location, line: int) -> Any:
        """Return the value of a scalar."""
        from ruamel.yaml.error import YAMLError

        value: Any = ...
        with suppress(YAMLError):  # such as of a single =
            value = self.yaml.constructor.construct_object(node)
        if isinstance(value, datetime.date):
            return value.isoformat()
        if isinstance(value, str):
            if self.has_names and (fault := find_fault_below(at, value)) is not None:
                raise _RefusedError(fault, line)
            return value
        if value is None or isinstance(value, bool):
            return value
        if isinstance(value, int | float):
            with suppress(OverflowError):
                if math.isfinite(float(value)):
                    return value
            shown = "too large" if isinstance(value, int) else value  # perhaps thousands of digits
            sentence = f"{name_location(at)!r} is {shown}. Write a finite number"
            raise _RefusedError(sentence, line)
        sentence = f"{name_location(at)!r} has no value that loopcal reads. Put it in quotes"
        raise _RefusedError(sentence, line)


# Text of YAML: names in quotes where they need them, and one key added to or removed from a
# file.

# Text, or a number with its unit, that YAML 1.2, and the readers of YAML 1.1 in use, read as the
# same text without quotes. To them y and n are no truth values, and y is the name of a column.
PLAIN = re.compile(
    r"(?!(?:true|false|null|yes|no|on|off)\Z)[a-z][\w.-]*"
    r"|-?[0-9]+(?:\.[0-9]+)?(?:e[-+]?[0-9]+)? [a-z1]+",
    re.IGNORECASE,
)


def quote_scalar(text: str) -> str:
    """Return text as a YAML scalar in one line, in double quotes where it needs them."""
    return text if PLAIN.fullmatch(text) else _escape(json.dumps(text, ensure_ascii=False))


def format_flow(value: Any) -> str:
    """Return plain content as YAML in one line; numbers read back the same, -0 as 0."""
    if isinstance(value, str):
        return quote_scalar(value)
    if isinstance(value, Mapping):
        items: Mapping[str, Any] = value
        return f"{{{', '.join(f'{quote_scalar(k)}: {format_flow(v)}' for k, v in items.items())}}}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(format_flow, value))}]"
    return repr(float(value) + 0.0) if isinstance(value, float) else json.dumps(value)


WIDTH = 110  # characters that a value in one line may fill


def format_yaml(content: Mapping[str, Any], comments: Mapping[str, str] | None = None) -> str:
    """Return a mapping as YAML, each key in lines of its own, some with a comment behind them;
    below them, what fits into a line is in one line.
    """
    lines: list[str] = []
    for key, value in content.items():
        first, *others = _list_lines(key, value, WIDTH)
        comment = f"     # {comments[key]}" if comments and key in comments else ""
        lines += [first + comment, *others]
    return "".join(f"{line}\n" for line in lines)


def _list_lines(key: str | None, value: Any, width: int) -> list[str]:
    """Return the lines of a value behind its key, or (None) behind the dash of a list."""
    head, flow = "-" if key is None else f"{quote_scalar(key)}:", format_flow(value)
    if not isinstance(value, dict | list | tuple) or len(head) + len(flow) < width:
        return [f"{head} {flow}"]
    items: Any = value.items() if isinstance(value, dict) else ((None, item) for item in value)
    lines = [line for name, item in items for line in _list_lines(name, item, width - 2)]
    if key is None:
        return [f"- {lines[0]}", *(f"  {line}" for line in lines[1:])]
    return [head, *(f"  {line}" for line in lines)]


def add_key(file: YamlFile, entry: str, content: Mapping[str, Any] | None = None) -> YamlFile:
    """Return a file with one more key.

    `entry` is the key and its value in block style at the left margin, in complete lines; a
    comment in them is lost where the file is in flow style. `content` is what it says, if known.
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
    root = make_yaml().compose(text)
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
    root = make_yaml().compose(text)
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
    codes = ((c, ord(c)) for c in text)
    return "".join(
        c if c.isprintable() else f"\\u{n:04x}" if n < 1 << 16 else f"\\U{n:08x}" for c, n in codes
    )


# Names of other files in a file: they stay in the folder of the file that names them.

KEYS = ("poses", "controller")  # settings of measurement files that name another file


def find_reference(
    file: YamlFile, key: str, known: Mapping[str, Path] | None = None
) -> Path | None:
    """Return the file that the setting `key` names, beside `file` or as one of those `known` by
    name; None without the setting. FileError : there is none, or see `find_file_beside`.
    """
    if (stated := file.content.get(key)) is None:
        return None
    path = find_file_beside(file, str(stated), (key,)) or (known or {}).get(str(stated))
    if path is None:
        finding = report_finding("files.reference-missing", key=key, path=str(stated))
        raise file.error(finding, (key,))
    return path


def find_file_beside(file: YamlFile, name: str, location: Location) -> Path | None:
    """Return a file that `file` names, or None; FileError where its path leaves the folder."""
    path, is_inside = file.path.parent / name, False
    with suppress(OSError, RuntimeError):  # a loop of links
        is_inside = path.resolve().is_relative_to(file.path.parent.resolve())
    if not Path(name).is_absolute() and not is_inside:
        key = name_location(location)
        finding = report_finding("files.reference-outside", key=key, path=escape(name))
        raise file.error(finding, location)
    return path if path.is_file() else None


def list_absolute_references(file: YamlFile) -> tuple[Finding, ...]:
    """Return a finding for each absolute path in the settings of a file."""
    stated = ((key, str(file.content[key])) for key in KEYS if key in file.content)
    return tuple(
        report_finding("files.reference-absolute", file=str(file.path), path=path, key=key)
        for key, path in stated
        if Path(path).is_absolute()
    )
