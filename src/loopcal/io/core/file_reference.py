# SPDX-License-Identifier: Apache-2.0
"""What files may say, read off the records that read them: keys, what they hold, defaults, and the
words of docstrings.
"""

from __future__ import annotations

import dataclasses
import inspect
import re
import types
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from loopcal.io.core.records import field_types
from loopcal.units import Dimension

SECTION = re.compile(r"^(Attributes|Parameters|Raises|Returns)\n-{3,}\n", re.MULTILINE)
SHORT = re.compile(r"(?:^ *|(?<=[.;] ))((?:\w+, )*\w+) :\s", re.MULTILINE)
LONG = re.compile(
    r"^(?P<names>(?:\w+, )*\w+)(?: : [^\n]{0,48})?\n(?P<phrase>(?: {4}[^\n]*(?:\n|$))+)",
    re.MULTILINE,
)
SI = re.compile(r" \[(?:m|rad|m per turn|m, rad|m or rad)\]")
ELSEWHERE = re.compile(r"(?:Others: )?[Ss]ee (?:`\w+`|the module)(?:, |; |\. ?|$)")


@dataclass(frozen=True)
class Key:
    """A key of a file.

    Parameters
    ----------
    name : str
        As written.
    holds : str
        What stands there: `length`, `[x, y]`, `a` or `b`, or the name of a record in capitals.
    default : str
        What is taken where the key is missing; empty where nothing sensible is.
    meaning : str
        A phrase from the docstring; may be empty.
    """

    name: str
    holds: str
    default: str
    meaning: str


def keys(record: type) -> tuple[Key, ...]:
    """Return the keys that a record takes, its own before those that it inherits."""
    meanings = meanings_of(record)
    hints = field_types(record)
    fields = {field.name: field for field in dataclasses.fields(record) if field.init}
    inherited = [
        name
        for base in record.__mro__[1:]
        if dataclasses.is_dataclass(base)
        for name in field_types(base)
    ]
    order = [n for n in fields if n not in inherited] + [n for n in fields if n in inherited]
    return tuple(Key(n, holds(hints[n]), _default(fields[n]), meanings.get(n, "")) for n in order)


def meanings_of(record: type) -> dict[str, str]:
    """Return name -> phrase from the docstrings of a record and what it inherits from."""
    found: dict[str, str] = {}
    for base in reversed(record.__mro__):
        found |= _entries(inspect.cleandoc(base.__doc__ or ""))
    return found


def summary(record: type) -> str:
    """Return the first sentences of a record's docstring, up to its sections."""
    text = SECTION.split(inspect.cleandoc(record.__doc__ or ""))[0]
    return SI.sub("", " ".join(text.split()))


def holds(annotation: Any) -> str:
    """Return what an annotation allows, in words of a file."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        marks = [mark for mark in arguments[1:] if isinstance(mark, Dimension)]
        return (
            {Dimension.LENGTH: "length", Dimension.ANGLE: "angle"}.get(marks[0], "number")
            if marks
            else holds(arguments[0])
        )
    if origin in (Union, types.UnionType):
        return " or ".join(dict.fromkeys(holds(a) for a in arguments if a is not type(None)))
    if origin is Literal:
        return " or ".join(f"`{value}`" for value in arguments)
    if origin in (tuple, list):
        if arguments[-1:] == (Ellipsis,) or origin is list:
            return f"list of {holds(arguments[0])}"
        return f"[{', '.join(holds(a) for a in arguments)}]"
    if origin is not None and issubclass(origin, Mapping):
        return f"name: {holds(arguments[1])}"
    if isinstance(annotation, type) and dataclasses.is_dataclass(annotation):
        return annotation.__name__
    return {str: "text", float: "number", int: "whole number", bool: "true or false"}.get(
        annotation, str(annotation)
    )


def nested(record: type) -> tuple[type, ...]:
    """Return the records that a record's keys hold, in order, each once."""
    found: dict[type, None] = {}

    def walk(annotation: Any) -> Iterator[type]:
        if isinstance(annotation, type) and dataclasses.is_dataclass(annotation):
            yield annotation
        for argument in get_args(annotation):
            yield from walk(argument)

    queue = [record]
    while queue:
        for hint in field_types(queue.pop(0)).values():
            for inner in walk(hint):
                if inner not in found and inner is not record:
                    found[inner] = None
                    queue.append(inner)
    return tuple(found)


def _entries(doc: str) -> dict[str, str]:
    """Return name -> phrase of the Attributes or Parameters section of a docstring."""
    parts = SECTION.split(doc)
    text = "".join(
        body
        for title, body in zip(parts[1::2], parts[2::2], strict=True)
        if title in ("Attributes", "Parameters")
    )
    found: dict[str, str] = {}
    for place in LONG.finditer(
        text
    ):  # a type behind the name, or nothing, and the phrase indented below it
        found |= _phrase(place["names"], place["phrase"])
    text = LONG.sub("", text)
    places = list(SHORT.finditer(text))
    for i, place in enumerate(places):  # all on a line, and several entries on one
        end = places[i + 1].start() if i + 1 < len(places) else len(text)
        found |= _phrase(place[1], text[place.end() : end])
    return found


def _phrase(names: str, text: str) -> dict[str, str]:
    """Return name -> phrase of one entry; nothing for one that only points elsewhere."""
    phrase = ELSEWHERE.sub("", SI.sub("", " ".join(text.split()))).rstrip(". ")
    return dict.fromkeys(names.split(", "), phrase) if phrase else {}


def _default(field: dataclasses.Field[Any]) -> str:
    """Return a default as a file would say it."""
    if field.default_factory is not dataclasses.MISSING or field.default in (
        dataclasses.MISSING,
        None,
        (),
        "",
    ):
        return (
            "needed"
            if field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
            else ""
        )
    if isinstance(field.default, tuple):
        return f"[{', '.join(f'{value:g}' if isinstance(value, float) else str(value) for value in field.default)}]"
    return f"{field.default:g}" if isinstance(field.default, float) else str(field.default)
