# SPDX-License-Identifier: Apache-2.0
"""XML as a tree of elements that know their place in the text, so that parts can be replaced."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.parsers import expat

import numpy as np

from loopcal.errors import FileError
from loopcal.io.core.limits import XML_DEPTH, XML_ELEMENTS
from loopcal.io.formats.program_format import parse_number
from loopcal.typing import FloatArray

ROUNDED = 4
"""Decimals from which a number counts as rounded, such as 1.5708 for a right angle."""

Edit = tuple[int, int, str]
"""First byte and end of a part of a text, and what replaces it."""


@dataclass
class Element:
    """An element: `line` from 1, bytes `start` to `end` of its start tag, and of its content to
    `close`. `text` is the content before its first child.
    """

    name: str
    attributes: Mapping[str, str]
    path: Path
    line: int
    start: int
    end: int = 0
    close: int = 0
    text: str = ""
    children: list[Element] = field(default_factory=list)

    def find_all(self, *names: str) -> Iterator[Element]:
        """Yield the children with these names."""
        return (child for child in self.children if child.name in names)

    def find(self, *path: str) -> Element | None:
        """Return the first child at a path of names, None without."""
        found: Element | None = self
        for name in path:
            found = None if found is None else next(found.find_all(name), None)
        return found

    def get(self, *path: str) -> str:
        """Return the text of the first child at a path of names, empty without."""
        found = self.find(*path)
        return "" if found is None else found.text.strip()

    def walk(self) -> Iterator[Element]:
        """Yield the element and all elements in it."""
        yield self
        for child in self.children:
            yield from child.walk()

    def error(self, sentence: Any) -> FileError:
        """Return an error at the line of the element."""
        return FileError(sentence, self.path, self.line)

    def parse_numbers(self, text: str, count: int, what: str) -> FloatArray:
        """Return the numbers of a text of this element; FileError unless there are `count`."""
        numbers = text.split()
        if len(numbers) != count:
            words = {1: "one number is", 3: "three numbers are"}.get(count, f"{count} numbers are")
            raise self.error(f"{what} is {text!r}, but {words} needed. Correct it")
        return np.array([parse_number(number, what, self.path, self.line) for number in numbers])

    def replace_attribute(self, raw: bytes, name: str, values: FloatArray) -> Edit | None:
        """Return the edit of an attribute with other numbers; None where it has no such one."""
        tag = raw[self.start : self.end].decode()
        match = re.search(rf"""\s{name}\s*=\s*(["'])(.*?)\1""", tag, re.DOTALL)
        if match is None:
            return None
        first = self.start + len(tag[: match.start(2)].encode())
        return first, first + len(match[2].encode()), format_numbers(values)


SAME = 1e-13
"""Difference of places that count as the same, so that their text stays [m, 1]."""


def format_numbers(values: Iterable[float]) -> str:
    """Return numbers that read back as the same doubles."""
    return " ".join(repr(float(v)) for v in values)


def apply_edits(text: str, edits: Sequence[Edit]) -> str:
    """Return a text with parts replaced."""
    raw = text.encode()
    for first, end, new in sorted(edits, reverse=True):
        raw = raw[:first] + new.encode() + raw[end:]
    return raw.decode()


def measure_rounding(lengths: Iterable[str], angles: Iterable[str]) -> tuple[float, float]:
    """Return the units of the last digits of lengths and angles, as roots of sums of squares.

    Rounding errors are uniform in half a unit, so that this is 3.5 times the standard deviation of
    their sum. A number with fewer than ROUNDED decimals is a dimension that somebody chose, and is
    exact.
    """

    def measure(texts: Iterable[str]) -> float:
        units = []
        for number in " ".join(texts).lower().split():
            mantissa, _, exponent = number.partition("e")
            decimals = len(mantissa.partition(".")[2]) - float(exponent or 0)
            units.append(10.0**-decimals if decimals >= ROUNDED else 0.0)
        return math.hypot(*units)

    return measure(lengths), measure(angles)


def parse_xml(text: str, path: Path, what: str) -> Element:
    """Return the root of a text; FileError where it is not XML, or larger than the limits."""
    raw = text.encode()
    parser = expat.ParserCreate()
    stack: list[Element] = []
    found: list[Element] = []

    def start(name: str, attributes: dict[str, str]) -> None:
        line, first = parser.CurrentLineNumber, parser.CurrentByteIndex
        end = _find_tag_end(raw, first)
        element = Element(name, attributes, path, line, first, end, end)
        found.append(element)
        if len(found) > XML_ELEMENTS.count:
            raise XML_ELEMENTS.make_error(what, path, line=line)
        if len(stack) >= XML_DEPTH.count:
            raise XML_DEPTH.make_error(what, path, line=line)
        if stack:
            stack[-1].children.append(element)
        stack.append(element)

    def end(_: str) -> None:
        element = stack.pop()
        element.close = max(element.end, parser.CurrentByteIndex)

    def read_characters(characters: str) -> None:
        if stack and not stack[-1].children:
            stack[-1].text += characters

    def refuse_doctype(*_: Any) -> None:
        sentence = f"a {what.removesuffix(' file')} has no document type. Remove <!DOCTYPE ..>"
        raise FileError(sentence, path, parser.CurrentLineNumber)

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.CharacterDataHandler = read_characters
    parser.StartDoctypeDeclHandler = refuse_doctype
    try:
        parser.Parse(raw, True)
    except expat.ExpatError as error:
        sentence = f"not valid XML ({expat.ErrorString(error.code)}). Correct it"
        raise FileError(sentence, path, error.lineno) from None
    return found[0]


def _find_tag_end(raw: bytes, start: int) -> int:
    """Return the byte after a start tag: after the first > outside of quotes."""
    match = re.compile(rb"""<(?:[^>"']|"[^"]*"|'[^']*')*>""").match(raw, start)
    return match.end() if match is not None else raw.index(b">", start) + 1
