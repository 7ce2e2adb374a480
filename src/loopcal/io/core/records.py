# SPDX-License-Identifier: Apache-2.0
"""The one reader of records: from the content of a YAML file to a frozen dataclass in SI.

The annotations of the fields say everything. Numbers annotated `Length`, `Angle` or `Ratio` are
converted to SI: by the units of the file, or, where the file has none, from texts such as `5 um`.
Keys that are not fields are refused, except in records whose class says `OTHER_KEYS = True`; a
field `from_` has the key `from`. The rest is checked strictly (text is not a number). pydantic is
imported only where something does not fit: its first complaint becomes one sentence with a line.
"""

from __future__ import annotations

import dataclasses
import json
import types
import typing
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

from loopcal.errors import FileError, UnitError, suggest_names
from loopcal.io.core.record_building import NoFitError, make_builder
from loopcal.io.core.yaml_file import (
    Location,
    YamlFile,
    has_child,
    name_location,
    refuse_unknown_keys,
)
from loopcal.plain_text import quote
from loopcal.units import Dimension, Unit, find_unit, list_symbols, to_si

T = TypeVar("T")
Units = Mapping[Dimension, Unit]


def read_record(
    file: YamlFile,
    content: Mapping[str, Any],
    record: type[T],
    units: Units | None,
    location: Location = (),
    word: Callable[[Path, str], FileError] | None = None,
) -> T:
    """Return a record built from the content of a file.

    Parameters
    ----------
    file : source of `content`, for lines.
    content : plain values as written in the file.
    record : a dataclass with annotated fields.
    units : of the numbers in the file; None where each number states its own, as in `5 um`.
    location : of `content` in the file.
    word : makes the error from the file and what does not fit, for files that nobody edits; by
        default it names the line and says what to write.

    Raises
    ------
    FileError : the first value that does not fit, at its line.
    """
    scaled = _to_si(record, dict(content), file, units, location)
    with suppress(NoFitError):
        return make_builder(record)(scaled)
    from pydantic import ValidationError

    try:
        return _make_adapter(record).validate_json(json.dumps(scaled), strict=True)
    except ValidationError as error:
        (fact, act), place = _translate(error, file, content, location)
        if word is not None:
            raise word(file.path, fact) from None
        raise file.error(f"{fact}{act}", place) from None


def read_units(file: YamlFile) -> dict[Dimension, Unit]:
    """Return the units that a file states under `units:`, which is mandatory; ratios have unit 1.

    Raises
    ------
    FileError : no units, or an unknown dimension or unit, or a unit of another dimension.
    """
    example = "write for example 'units: {length: mm, angle: deg}'"
    stated = file.content.get("units")
    if "units" not in file.content:
        raise file.error(f"this file states no units, which every number needs; {example}")
    if not isinstance(stated, dict):
        raise file.error(f"'units' must state a unit of length and of angle; {example}", ("units",))
    names = [d.value for d in (Dimension.LENGTH, Dimension.ANGLE)]
    refuse_unknown_keys(file, list(stated), names, ("units",))
    units = {Dimension.RATIO: find_unit("1")}
    for name in names:
        dimension = Dimension(name)
        if name not in stated:
            raise file.error(f"'units' states no unit of {name}; {example}", ("units",))
        symbol, allowed = stated[name], list_symbols(dimension)
        if not isinstance(symbol, str) or symbol not in allowed:
            hint = suggest_names(str(symbol), allowed)
            sentence = f"{symbol!r} is not a unit of {name}{hint}; allowed: {', '.join(allowed)}"
            raise file.error(sentence, ("units", name))
        units[dimension] = find_unit(symbol, dimension)
    return units


@cache
def get_field_types(record: type) -> Mapping[str, Any]:
    """Return key -> annotation of the fields that a record takes from a file."""
    hints = typing.get_type_hints(record, include_extras=True)
    return {_key(f.name): hints[f.name] for f in dataclasses.fields(record) if f.init}


@cache
def _make_adapter(record: type) -> Any:
    """Return pydantic's reader of a record; cached, because making it takes as long as reading."""
    from pydantic import TypeAdapter

    return TypeAdapter(record)


def _key(name: str) -> str:
    """Return the key of a field: `from` for the field `from_`."""
    return name.removesuffix("_")


def _to_si(
    annotation: Any, node: Any, file: YamlFile, units: Units | None, location: Location
) -> Any:
    """Return `node` with numbers in SI and field names as keys; refuse unknown keys.

    Values that do not fit the annotation stay as they are; pydantic names them.
    """
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        for mark in arguments[1:]:
            if isinstance(mark, Dimension):
                return _scale(node, mark, file, units, location)
        return _to_si(arguments[0], node, file, units, location)
    if origin in (Union, types.UnionType):
        branch = max(arguments, key=lambda branch: _fit(branch, node))
        return _to_si(branch, node, file, units, location)
    if isinstance(node, dict) and _is_record(annotation):
        hints = get_field_types(annotation)
        if getattr(annotation, "OTHER_KEYS", False):
            node = {key: value for key, value in node.items() if key in hints}
        refuse_unknown_keys(file, list(node), list(hints), location)
        names = {_key(field.name): field.name for field in dataclasses.fields(annotation)}
        return {
            names[key]: _to_si(hints[key], value, file, units, (*location, key))
            for key, value in node.items()
        }
    if isinstance(node, dict) and _is_mapping(annotation):
        return {
            key: _to_si(arguments[1], value, file, units, (*location, key))
            for key, value in node.items()
        }
    if isinstance(node, list) and origin in (tuple, list):
        repeated = origin is list or (len(arguments) == 2 and arguments[1] is Ellipsis)
        each = [arguments[0]] * len(node) if repeated else list(arguments) + [Any] * len(node)
        return [_to_si(each[i], item, file, units, (*location, i)) for i, item in enumerate(node)]
    return node


def _scale(
    node: Any, dimension: Dimension, file: YamlFile, units: Units | None, location: Location
) -> Any:
    """Return a number, or nested lists of numbers, in SI."""
    if isinstance(node, list):
        return [_scale(item, dimension, file, units, (*location, i)) for i, item in enumerate(node)]
    if units is None and dimension is not Dimension.RATIO and node is not None:
        return file.quantity(node, dimension, location)
    if isinstance(node, int | float) and not isinstance(node, bool):
        try:
            return to_si(node, find_unit("1") if units is None else units[dimension])
        except UnitError as error:
            raise file.error(f"{name_location(location)!r}: {error}", location) from None
    return node


def _is_record(annotation: Any) -> bool:
    return dataclasses.is_dataclass(annotation) and isinstance(annotation, type)


def _is_mapping(annotation: Any) -> bool:
    origin = get_origin(annotation)
    return isinstance(origin, type) and issubclass(origin, Mapping)


def _fit(annotation: Any, node: Any) -> float:
    """Return how well the form of `node` fits an annotation (negative: not at all).

    It chooses among the branches of a union: a `Literal` key that agrees counts most, then the
    number of known keys or the length of a list.
    """
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _fit(arguments[0], node)
    if origin in (Union, types.UnionType):
        return max(_fit(a, node) for a in arguments)
    if annotation in (None, type(None)):
        return 1.0 if node is None else -1.0
    if isinstance(node, dict):
        if not _is_record(annotation):
            return 0.05 if _is_mapping(annotation) else -1.0
        hints = get_field_types(annotation)
        tags = {key: get_args(h) for key, h in hints.items() if get_origin(h) is Literal}
        score = sum(10.0 if node[key] in tags[key] else -10.0 for key in tags if key in node)
        return score + sum(1.0 if key in hints else -0.5 for key in node) + 0.1
    if isinstance(node, list):
        if origin not in (tuple, list):
            return -1.0
        fixed = origin is tuple and arguments[-1:] != (Ellipsis,)
        inner = _fit(arguments[0], node[0]) if node and arguments else 0.0
        length = 2.0 if not fixed or len(arguments) == len(node) else 0.5
        return length + (0.5 if inner > 0 else -0.4)
    if isinstance(node, str):
        return 1.0 if annotation is str or (origin is Literal and node in arguments) else -1.0
    if isinstance(node, bool):
        return 1.0 if annotation is bool else -1.0
    return 1.0 if annotation in (float, int) else -1.0


def _translate(
    error: Any, file: YamlFile, content: Mapping[str, Any], location: Location
) -> tuple[tuple[str, str], Location]:
    """Return the first complaint of pydantic (by line) in our own words, and its location.

    Where pydantic names branches of a union, the deepest complaint is the relevant one; a constant
    that another branch has comes last.
    """
    complaints = error.errors(include_url=False, include_context=True)
    places = [_resolve(c["loc"], content) for c in complaints]
    if any(len(path) < len(c["loc"]) - 1 for (path, _), c in zip(places, complaints, strict=True)):
        chosen = max(
            range(len(places)),
            key=lambda i: (len(places[i][0]), complaints[i]["type"] != "literal_error"),
        )
    else:
        chosen = min(range(len(places)), key=lambda i: file.line((*location, *places[i][0])))
    complaint, (path, node) = complaints[chosen], places[chosen]
    if complaint["type"] == "literal_error":  # every branch names its own constants
        expected = {
            c["ctx"]["expected"]: None
            for c, place in zip(complaints, places, strict=True)
            if c["type"] == "literal_error" and place[0] == path
        }
        complaint = {**complaint, "ctx": {"expected": ", ".join(expected)}}
    parent = complaint["loc"][:-1]
    missing = [c["loc"][-1] for c in complaints if c["loc"] and c["loc"][:-1] == parent]
    needed = max((step + 1 for step in missing if isinstance(step, int)), default=0)
    path = (*location, *path)
    if complaint["type"] == "value_error":  # its text begins with the key that is wrong
        key, _, fact = str(complaint["ctx"]["error"]).partition(" ")
        if has_child(node, key):
            path = (*path, key)
            return (f"{name_location(path)!r} {fact}", ""), path
    return _word(complaint, path, node, needed), path


def _resolve(loc: tuple[str | int, ...], content: Any) -> tuple[Location, Any]:
    """Return the part of pydantic's location that exists in the file, and the node there."""
    location: list[str | int] = []
    node = content
    for part in loc:
        step = part if has_child(node, part) else _key(part) if isinstance(part, str) else part
        if has_child(node, step):
            node = node[step]
            location.append(step)
    return tuple(location), node


NUMBERS: Mapping[str, str] = {
    **dict.fromkeys(("float_type", "float_parsing"), "a number"),
    **dict.fromkeys(("int_type", "int_parsing", "int_from_float"), "a whole number"),
}
SHAPES: Mapping[str, tuple[str, str]] = {
    **dict.fromkeys(("tuple_type", "list_type"), ("a list", "write it as [.., ..]")),
    **dict.fromkeys(
        ("dataclass_type", "dict_type", "mapping_type", "dataclass_exact_type"),
        ("a mapping", "write 'key: value' lines"),
    ),
    "string_type": ("text", "put it in quotes"),
    "bool_type": ("true or false", "write one of the two"),
}
"""Complaint of pydantic -> what is needed, and what to do."""
ADD = "; add the missing ones"


def _word(complaint: Any, location: Location, node: Any, needed: int) -> tuple[str, str]:
    """Return what is wrong by a complaint of pydantic (found, allowed), and `; ` what to do.

    `needed` is the number of values of a fixed list of which some are missing.
    """
    kind, context = complaint["type"], complaint.get("ctx", {})
    name = repr(name_location(location)) if location else "this file"
    if kind in ("missing", "missing_argument"):
        if isinstance(node, list):
            return f"{name} has {len(node)} values, but {needed} are needed", ADD
        return f"{name} has no key {_key(str(complaint['loc'][-1]))!r}", "; add it"
    if kind in ("too_long", "too_short"):
        bound = context.get("max_length", context.get("min_length"))
        act = "; remove the others" if kind == "too_long" else ADD
        return f"{name} has {len(node)} values, but {bound} are needed", act
    if kind in NUMBERS:
        act = "; write a number"
        if kind.startswith("int") and isinstance(node, float):
            act = "; write it without a decimal point and without an exponent"
        if isinstance(node, str) and node.strip()[:1] in "+-.0123456789":
            act = "; write the number without quotes and without a unit"
            act = "; write a decimal point, not a comma" if "," in node else act
        return f"{name} is {_describe(node)}, but {NUMBERS[kind]} is needed", act
    if kind in SHAPES:
        shape, act = SHAPES[kind]
        return f"{name} is {_describe(node)}, but {shape} is needed", f"; {act}"
    if kind == "literal_error":
        expected = context["expected"].replace(" or ", ", ")
        names = [part.strip("' ") for part in expected.split(",")]
        hint = "" if str(node) in names else suggest_names(str(node), names)
        return f"{name} is {quote(node)}{hint}; allowed: {expected}", ""
    if kind == "value_error":
        return f"{name}: {context.get('error', complaint['msg'])}", ""
    reason = complaint["msg"][:1].lower() + complaint["msg"][1:]
    return f"{name} is {_describe(node)}, which does not fit ({reason})", "; correct it"


def _describe(node: Any) -> str:
    """Return a node for messages: `the number 4`, `a list of 3`, `empty`."""
    if node is None:
        return "empty"
    if isinstance(node, bool):
        return f"the value {str(node).lower()}"
    if isinstance(node, int | float):
        return f"the number {node:g}"
    if isinstance(node, str):
        return f"the text {node!r}"
    return f"a list of {len(node)}" if isinstance(node, list) else "a mapping"
