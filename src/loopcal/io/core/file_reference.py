# SPDX-License-Identifier: Apache-2.0
"""Reference of file keys, taken from the records that read them: types, defaults, docstrings."""

from __future__ import annotations

import dataclasses
import inspect
import re
import types
from collections.abc import Mapping
from dataclasses import MISSING, dataclass
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from loopcal.io.core.records import get_field_types
from loopcal.units import Dimension

SECTION = re.compile(r"^(Attributes|Examples|Parameters|Raises|Returns)\n-{3,}\n", re.MULTILINE)
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
    name : as written. holds : its type, such as `length`, `[x, y]`, or the name of a record.
    default : value without the key, "needed" where the key is mandatory, "" where it is empty.
    meaning : phrase of the docstring, possibly empty.
    """

    name: str
    holds: str
    default: str
    meaning: str


def list_keys(record: type) -> tuple[Key, ...]:
    """Return the keys that a record takes, its own before inherited ones."""
    meanings = collect_meanings(record)
    hints = get_field_types(record)
    fields = {f.name.removesuffix("_"): f for f in dataclasses.fields(record) if f.init}
    bases = [base for base in record.__mro__[1:] if dataclasses.is_dataclass(base)]
    inherited = {name for base in bases for name in get_field_types(base)}
    order = sorted(fields, key=lambda name: name in inherited)
    return tuple(
        Key(n, describe_type(hints[n]), _describe_default(fields[n]), meanings.get(n, ""))
        for n in order
    )


def collect_meanings(record: type) -> dict[str, str]:
    """Return name -> phrase from the docstrings of a record and of its bases."""
    meanings: dict[str, str] = {}
    for base in reversed(record.__mro__):
        meanings |= _parse_entries(inspect.cleandoc(base.__doc__ or ""))
    return {name.removesuffix("_"): phrase for name, phrase in meanings.items()}


def name_record(record: type) -> str:
    """Return the name of a record in the file reference: `Pose` for `PoseRecord`."""
    return record.__name__.removesuffix("Record")


def describe_type(annotation: Any) -> str:
    """Return what an annotation allows, in terms of a file."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        marks = [mark for mark in arguments[1:] if isinstance(mark, Dimension)]
        names = {Dimension.LENGTH: "length", Dimension.ANGLE: "angle"}
        return names.get(marks[0], "number") if marks else describe_type(arguments[0])
    if origin in (Union, types.UnionType):
        branches = (describe_type(a) for a in arguments if a is not type(None))
        return " or ".join(dict.fromkeys(branches))
    if origin is Literal:
        return " or ".join(f"`{value}`" for value in arguments)
    if origin in (tuple, list):
        if arguments[-1:] == (Ellipsis,) or origin is list:
            return f"list of {describe_type(arguments[0])}"
        return f"[{', '.join(describe_type(a) for a in arguments)}]"
    if origin is not None and issubclass(origin, Mapping):
        return f"name: {describe_type(arguments[1])}"
    if isinstance(annotation, type) and dataclasses.is_dataclass(annotation):
        return name_record(annotation)
    names = {str: "text", float: "number", int: "whole number", bool: "true or false"}
    return "anything" if annotation is Any else names.get(annotation, str(annotation))


def _parse_entries(doc: str) -> dict[str, str]:
    """Return name -> phrase of the Attributes and Parameters sections of a docstring.

    An entry is `name : type` with an indented phrase below it, or `name : phrase`, of which
    several may share a line.
    """
    titles_and_bodies = SECTION.split(doc)
    sections = zip(titles_and_bodies[1::2], titles_and_bodies[2::2], strict=True)
    text = "".join(body for title, body in sections if title in ("Attributes", "Parameters"))
    entries: dict[str, str] = {}
    for match in LONG.finditer(text):
        entries |= _clean_phrase(match["names"], match["phrase"])
    text = LONG.sub("", text)
    matches = list(SHORT.finditer(text))
    ends = [*(match.start() for match in matches), len(text)][1:]
    for match, end in zip(matches, ends, strict=True):
        entries |= _clean_phrase(match[1], text[match.end() : end])
    return entries


def _clean_phrase(names: str, text: str) -> dict[str, str]:
    """Return name -> phrase of one entry; nothing for one that only points elsewhere."""
    phrase = ELSEWHERE.sub("", SI.sub("", " ".join(text.split()))).rstrip(". ")
    return dict.fromkeys(names.split(", "), phrase) if phrase else {}


def _describe_default(field: dataclasses.Field[Any]) -> str:
    """Return a default as a file would state it."""
    if field.default is MISSING and field.default_factory is MISSING:
        return "needed"
    if field.default_factory is not MISSING or field.default in (None, (), ""):
        return ""
    if isinstance(field.default, tuple):
        return f"[{', '.join(f'{v:g}' if isinstance(v, float) else str(v) for v in field.default)}]"
    return f"{field.default:g}" if isinstance(field.default, float) else str(field.default)
