# SPDX-License-Identifier: Apache-2.0
"""Records built from plain values by the annotations of their fields, where everything fits.

Nearly every record fits, and importing and preparing pydantic takes longer than the calibration of
a hexapod. So records that fit are built here. What does not fit, or fits in two ways, is refused
without a reason; pydantic then decides, and names what is wrong (`loopcal.io.core.records`). Both
accept the same values and build the same records: tests compare them on every robot file and on
thousands of wrong ones.
"""

from __future__ import annotations

import dataclasses
import json
import types
import typing
from collections.abc import Callable, Mapping
from functools import cache
from typing import Annotated, Any, Literal, Union, get_args, get_origin

Build = Callable[[Any], Any]


class NoFitError(Exception):
    """A value does not fit its annotation, or not in exactly one way."""


@cache
def make_builder(annotation: Any) -> Build:
    """Return the function from a plain value, as JSON has it, to a value of an annotation.

    It raises NoFitError.
    """
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return make_builder(arguments[0])
    if origin is Literal:
        return lambda node: _choose(arguments, node)
    if origin in (Union, types.UnionType):
        return _make_union(tuple(make_builder(branch) for branch in arguments))
    if origin is tuple:
        return _make_tuple(arguments)
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return _make_mapping(make_builder(arguments[1]))
    if isinstance(annotation, type) and dataclasses.is_dataclass(annotation):
        return _make_record(annotation)
    return _PLAIN.get(annotation, _refuse)


def _refuse(node: Any) -> Any:
    """Leave a value to pydantic."""
    raise NoFitError


def _build_float(node: Any) -> float:
    if not isinstance(node, int | float) or isinstance(node, bool):
        raise NoFitError
    try:
        return float(node)
    except OverflowError:
        raise NoFitError from None


def _build_int(node: Any) -> int:
    if not isinstance(node, int) or isinstance(node, bool):
        raise NoFitError
    return int(node)


def _build_text(node: Any) -> str:
    if not isinstance(node, str):
        raise NoFitError
    try:
        node.encode()
    except UnicodeEncodeError:  # half a character
        raise NoFitError from None
    return str(node)


def _build_flag(node: Any) -> bool:
    if not isinstance(node, bool):
        raise NoFitError
    return node


def _build_none(node: Any) -> None:
    if node is not None:
        raise NoFitError


def _build_any(node: Any) -> Any:
    try:
        return json.loads(json.dumps(node, ensure_ascii=False).encode())
    except (TypeError, ValueError):  # no JSON, or half a character
        raise NoFitError from None


_PLAIN: dict[Any, Build] = {
    float: _build_float,
    int: _build_int,
    str: _build_text,
    bool: _build_flag,
    types.NoneType: _build_none,
    Any: _build_any,
}


def _choose(allowed: tuple[Any, ...], node: Any) -> Any:
    """Return the allowed value that a node equals."""
    for value in allowed:
        if type(node) is type(value) and node == value:
            return value
    raise NoFitError


def _make_union(branches: tuple[Build, ...]) -> Build:
    """Return the builder of the only branch that a node fits."""

    def build(node: Any) -> Any:
        built = []
        for branch in branches:
            try:
                built.append(branch(node))
            except NoFitError:
                continue
        if len(built) != 1:
            raise NoFitError
        return built[0]

    return build


def _make_tuple(arguments: tuple[Any, ...]) -> Build:
    """Return the builder of a tuple of any length, or of one with these members."""
    if arguments[1:] == (Ellipsis,):
        each = make_builder(arguments[0])
        return lambda node: tuple(each(item) for item in _require(list, node))
    members = tuple(make_builder(argument) for argument in arguments)

    def build(node: Any) -> tuple[Any, ...]:
        if len(_require(list, node)) != len(members):
            raise NoFitError
        return tuple(member(item) for member, item in zip(members, node, strict=True))

    return build


def _make_mapping(of_value: Build) -> Build:
    """Return the builder of a mapping from texts."""

    def build(node: Any) -> dict[str, Any]:
        return {_build_text(k): of_value(value) for k, value in _require(dict, node).items()}

    return build


def _make_record(record: type) -> Build:
    """Return the builder of a dataclass from a mapping of its fields."""
    hints = typing.get_type_hints(record, include_extras=True)
    fields = [field for field in dataclasses.fields(record) if field.init]
    builders = {field.name: make_builder(hints[field.name]) for field in fields}
    absent = dataclasses.MISSING
    needed = {f.name for f in fields if f.default is absent and f.default_factory is absent}

    def build(node: Any) -> Any:
        if not needed <= _require(dict, node).keys() <= builders.keys():
            raise NoFitError
        values = {name: builders[name](value) for name, value in node.items()}
        try:
            return record(**values)
        except ValueError:  # what the record itself says of its values
            raise NoFitError from None

    return build


def _require(kind: type, node: Any) -> Any:
    """Return a node of a kind."""
    if not isinstance(node, kind):
        raise NoFitError
    return node
