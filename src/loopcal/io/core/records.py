# SPDX-License-Identifier: Apache-2.0
"""The one reader of records: from the content of a YAML file to a frozen dataclass in SI.

The annotations of the fields say everything. Numbers annotated `Length`, `Angle` or `Ratio` are
converted to SI: by the units of the file, or, where the file has none, from texts such as `5 um`.
Keys that are not fields are refused, except in records whose class says `OTHER_KEYS = True`; a
field `from_` has the key `from`. The rest is checked strictly (text is not a number). The first
value that does not fit is answered by one sentence with its line.

The reader is our own, because general ones name neither the key of a mapping nor the line, do not
choose between records by their keys, and take longer to import than to read a robot.
"""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

from loopcal.errors import DataError, FileError, UnitError, suggest_names
from loopcal.io.core.yaml_file import Location, YamlFile, name_location, refuse_unknown_keys
from loopcal.plain_text import quote
from loopcal.units import Dimension, DimensionOf, Unit, find_unit, list_symbols, to_si

T = TypeVar("T")
Units = Mapping[Dimension, Unit]


def read_record(
    file: YamlFile,
    content: Any,
    record: type[T],
    units: Units | None,
    location: Location = (),
    word: Callable[[Path, str], FileError] | None = None,
) -> T:
    """Return a record (a dataclass with annotated fields) from `content` at a location of a file.

    `units` are those of the numbers in the file; None where each number states its own, as in `5
    um`. `word` makes the error from the file and what does not fit, for files that nobody edits;
    by default it names the line and says what to write.

    FileError : the first value that does not fit, at its line.
    """
    try:
        value: T = _RecordReader(file, units).read(record, content, location)
    except _MisfitError as error:
        if word is not None:
            raise word(file.path, error.fact) from None
        raise file.error(f"{error.fact}{error.action}", error.location) from None
    return value


@cache
def _make_units_record() -> type:
    """Return the record of `units:`."""
    names = (Dimension.LENGTH, Dimension.ANGLE)
    fields = [(d.value, Literal[tuple(list_symbols(d))]) for d in names]
    return dataclasses.make_dataclass("StatedUnits", fields, frozen=True)


def read_units(file: YamlFile) -> dict[Dimension, Unit]:
    """Return the units that a file must state under `units:`; ratios have unit 1. FileError where
    they are missing, unknown, or of another dimension.
    """
    if "units" not in file.content:
        example = "write for example 'units: {length: mm, angle: deg}'"
        raise file.error(f"this file has no units, which every number needs; {example}")
    record = read_record(file, file.content["units"], _make_units_record(), None, ("units",))
    stated = {Dimension(name): find_unit(symbol) for name, symbol in vars(record).items()}
    return {Dimension.RATIO: find_unit("1"), **stated}


@cache
def get_field_types(record: type) -> Mapping[str, Any]:
    """Return key -> annotation of the fields that a record takes from a file."""
    hints = typing.get_type_hints(record, include_extras=True)
    own = (f.name for f in dataclasses.fields(record) if f.init)
    return {_key(name): _state_dimension(hints[name], record) for name in own}


def _state_dimension(annotation: Any, record: type) -> Any:
    """Return an annotation with the dimensions that the class of its record states."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        stated = isinstance(arguments[1], DimensionOf)
        return Annotated[float, getattr(record, arguments[1].name)] if stated else annotation
    if origin is None or origin is Literal:
        return annotation
    parts = tuple(_state_dimension(argument, record) for argument in arguments)
    return Union[parts] if origin is types.UnionType else origin[parts]  # noqa: UP007


def _key(name: str) -> str:
    """Return the key of a field: `from` for the field `from_`."""
    return name.removesuffix("_")


class _MisfitError(Exception):
    """A value does not fit its annotation: what is wrong, `; ` what to do, and where."""

    def __init__(self, fact: str, action: str, location: Location) -> None:
        super().__init__(fact)
        self.fact, self.action, self.location = fact, action, location


@dataclasses.dataclass(frozen=True)
class _RecordReader:
    """The reader of one file, with the units of its numbers."""

    file: YamlFile
    units: Units | None

    def read(self, annotation: Any, node: Any, at: Location, of: Dimension | None = None) -> Any:
        """Return the value of an annotation from a node `at` a location; `of` is its dimension."""
        origin, arguments = get_origin(annotation), get_args(annotation)
        if origin is Annotated:
            marks = [mark for mark in arguments[1:] if isinstance(mark, Dimension)]
            return self.read(arguments[0], node, at, marks[0] if marks else of)
        if origin in (Union, types.UnionType):
            # a constant that no record of the union has is refused with those of all
            tags = [_list_tags(branch) for branch in arguments if _is_record(branch)]
            for key in node if isinstance(node, dict) and tags else ():
                if all(key in tag for tag in tags):
                    allowed = dict.fromkeys(constant for tag in tags for constant in tag[key])
                    _read_literal(tuple(allowed), node[key], (*at, key))
            branch = max(arguments, key=lambda branch: _fit(branch, node))
            return self.read(branch, node, at, of)
        if origin is Literal:
            return _read_literal(arguments, node, at)
        if origin is list:
            arguments = (*arguments, ...)
        if origin in (tuple, list):
            return origin(self._read_items(arguments, node, at, of))
        if _is_record(annotation):
            keys = f" with {', '.join(get_field_types(annotation))}"
            return self._read_fields(annotation, _require(dict, node, at, keys), at)
        if _is_mapping(annotation):
            items = _require(dict, node, at).items()
            return {key: self.read(arguments[1], value, (*at, key), of) for key, value in items}
        if annotation is Any and isinstance(node, list):
            return [self.read(Any, item, (*at, i), of) for i, item in enumerate(node)]
        if of is not None:
            node = self._scale(node, of, at)
        return node if annotation is Any else _require(annotation, node, at)

    def _scale(self, node: Any, dimension: Dimension, at: Location) -> Any:
        """Return a number in SI; what is none as it is."""
        is_plain = node is None or (dimension is Dimension.RATIO and not isinstance(node, str))
        if self.units is None and not is_plain:
            return self.file.quantity(node, dimension, at)
        if not isinstance(node, int | float) or isinstance(node, bool):
            return node
        try:
            return to_si(node, find_unit("1") if self.units is None else self.units[dimension])
        except UnitError as error:
            raise self.file.error(f"{name_location(at)!r}: {error}", at) from None

    def _read_items(
        self, arguments: tuple[Any, ...], node: Any, at: Location, of: Dimension | None
    ) -> list[Any]:
        """Return the items of a list of any length, or of one with these members."""
        items = _require(list, node, at)
        members = arguments
        if arguments[1:] == (Ellipsis,):
            members = arguments[:1] * len(items)
        elif len(items) != len(members):
            fact = f"{_name(at)} has {len(items)} values, but must have {len(members)}"
            act = "Remove the others" if len(items) > len(members) else "Add the missing ones"
            raise _MisfitError(fact, f". {act}", at)
        pairs = enumerate(zip(members, items, strict=True))
        return [self.read(member, item, (*at, i), of) for i, (member, item) in pairs]

    def _read_fields(self, record: Any, node: dict[str, Any], at: Location) -> Any:
        """Return a record from a mapping of its keys."""
        hints = get_field_types(record)
        if getattr(record, "OTHER_KEYS", False):
            node = {key: value for key, value in node.items() if key in hints}
        others: Mapping[str, str] = getattr(record, "OTHER_NAMES", {})
        renamed = {f: key for key, f in others.items() if key in node and f not in node}
        known = [*hints, *renamed.values()]
        refuse_unknown_keys(self.file, list(node), known, at)
        absent, values = dataclasses.MISSING, {}
        for field in (field for field in dataclasses.fields(record) if field.init):
            key = _key(field.name)
            stated = renamed.get(key, key)
            if stated in node:
                values[field.name] = self.read(hints[key], node[stated], (*at, stated))
            elif field.default is absent and field.default_factory is absent:
                raise _MisfitError(f"{_name(at)} has no key {key!r}", ". Add it", at)
        try:
            return record(**values)
        except (ValueError, DataError) as error:  # what the record itself says of its values
            key, _, fact = str(error).partition(" ")
            if key in node:  # its text begins with the key that is wrong
                raise _MisfitError(f"{_name((*at, key))} {fact}", "", (*at, key)) from None
            raise _MisfitError(f"{_name(at)}: {error}", "", at) from None


def _is_record(annotation: Any) -> bool:
    return dataclasses.is_dataclass(annotation) and isinstance(annotation, type)


def _is_mapping(annotation: Any) -> bool:
    origin = get_origin(annotation)
    return isinstance(origin, type) and issubclass(origin, Mapping)


def _fit(annotation: Any, node: Any) -> float:
    """Return how well the form of `node` fits an annotation (negative: not at all).

    It chooses among the branches of a union: a mapping that a branch cannot have counts most, then
    a `Literal` key that agrees, then the number of known keys or the length of a list.
    """
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _fit(arguments[0], node)
    if origin in (Union, types.UnionType):
        return max(_fit(a, node) for a in arguments)
    if isinstance(node, dict):
        if not _is_record(annotation):
            return 0.05 if _is_mapping(annotation) else -math.inf
        hints = get_field_types(annotation)
        tags = _list_tags(annotation)
        score = sum(10.0 if node[key] in tags[key] else -10.0 for key in tags if key in node)
        score += sum(1.0 if key in hints else -0.5 for key in node) + 0.1
        inner = [key for key, value in node.items() if key in hints and isinstance(value, dict)]
        return score - 25.0 * sum(_fit(hints[key], {}) < 0.0 for key in inner)
    if isinstance(node, list):
        if origin not in (tuple, list):
            return -1.0
        inner = _fit(arguments[0], node[0]) if node and arguments else 0.0
        has_length = origin is list or arguments[-1] is Ellipsis or len(arguments) == len(node)
        return (2.0 if has_length else 0.5) + (0.5 if inner > 0 else -0.4)
    if node is None or annotation is types.NoneType:
        return 1.0 if node is None and annotation is types.NoneType else -1.0
    if isinstance(node, str):
        return 1.0 if annotation is str or (origin is Literal and node in arguments) else -1.0
    if isinstance(node, bool):
        return 1.0 if annotation is bool else -1.0
    return 1.0 if annotation is type(node) else 0.9 if annotation is float else -1.0


def _list_tags(record: Any) -> dict[str, tuple[Any, ...]]:
    """Return key -> constants of the fields that tell a record from others."""
    hints = get_field_types(record)
    return {key: get_args(h) for key, h in hints.items() if get_origin(h) is Literal}


def _read_literal(allowed: tuple[Any, ...], node: Any, at: Location) -> Any:
    """Return the allowed value that a node equals."""
    for value in allowed:
        if type(node) is type(value) and node == value:
            return value
    names = [str(value) for value in allowed]
    hint = "" if str(node) in names else suggest_names(str(node), names)
    shown = quote(node) if isinstance(node, str) else _describe(node)
    constants = ", ".join(map(repr, allowed))
    raise _MisfitError(f"{_name(at)} is {shown}{hint}. Allowed: {constants}", "", at)


# Type of a field -> types that a file may have there, in words, and what to do.
NEEDED: Mapping[type, tuple[tuple[type, ...], str, str]] = {
    float: ((int, float), "a number", "write a number"),
    int: ((int,), "a whole number", "write a number"),
    str: ((str,), "text", "put it in quotes"),
    bool: ((bool,), "true or false", "write one of the two"),
    list: ((list,), "a list", "write it as [.., ..]"),
    dict: ((dict,), "a mapping", "write 'key: value' lines"),
    types.NoneType: ((types.NoneType,), "nothing", "remove it"),
}


def _require(needed: Any, node: Any, at: Location, details: str = "") -> Any:
    """Return a node of the needed type; an integer as a needed float. `details` end what to do."""
    allowed, words, act = NEEDED[needed]
    if isinstance(node, allowed) and (needed is bool or not isinstance(node, bool)):
        return float(node) if needed is float else node
    if needed is int and isinstance(node, float):
        act = "Write it without decimal point or exponent"
    if needed in (float, int) and isinstance(node, str) and node.strip()[:1] in "+-.0123456789":
        act = "Write the number without quotes or unit"
        act = "Write a decimal point, not a comma" if "," in node else act
    fact = f"{_name(at)} is {_describe(node)}, but must be {words}"
    raise _MisfitError(fact, f". {act}{details}", at)


def _name(location: Location) -> str:
    return repr(name_location(location)) if location else "this file"


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
