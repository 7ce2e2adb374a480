# SPDX-License-Identifier: Apache-2.0
"""From checked file content to a frozen dataclass in SI: one walk over the annotations, then
pydantic, strictly.

A record's fields say everything: `Length`, `Angle` and `Ratio` numbers are multiplied by the factor
of the unit that the file states, keys that are not fields are refused, and pydantic's `TypeAdapter`
checks the rest (text is not a number, two numbers are not three). What pydantic finds is said in
one sentence with the line of the node.
"""

from __future__ import annotations

import dataclasses
import json
import types
import typing
from collections.abc import Mapping
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

from loopcal.errors import FileError, suggest_names
from loopcal.io.core.yaml_file import Location, YamlFile, has_child, refuse_unknown_keys, words
from loopcal.units import Dimension, Unit, find_unit, list_symbols

T = TypeVar("T")
Units = Mapping[Dimension, Unit]


def read_record(file: YamlFile, content: Mapping[str, Any], record: type[T], units: Units) -> T:
    """Build a record dataclass from the content of a file.

    Parameters
    ----------
    file : YamlFile
        Where the content comes from; for lines.
    content : mapping
        Plain values as written in the file, keys of the record at the top.
    record : type
        A dataclass with annotated fields.
    units : mapping Dimension -> Unit
        Units of the file.

    Returns
    -------
    T
        An instance in SI.

    Raises
    ------
    FileError
        The first thing that does not fit, at its line.
    """
    from pydantic import TypeAdapter, ValidationError

    scaled = to_si(record, dict(content), file, units, ())
    try:
        return TypeAdapter(record).validate_json(json.dumps(scaled), strict=True)
    except ValidationError as error:
        raise _translated(error, file, content) from None


def read_units(file: YamlFile) -> dict[Dimension, Unit]:
    """Return the units that the file states under `units:`, which is obligatory; ratios have the
    unit 1.

    Raises
    ------
    FileError
        No units, an unknown dimension or unit, or a unit of another dimension.
    """
    example = "write for example 'units: {length: mm, angle: deg}'"
    found = file.content.get("units")
    if "units" not in file.content:
        raise file.error(
            f"this file states no units, and a number without a unit is refused; {example}"
        )
    if not isinstance(found, dict):
        raise file.error(
            f"'units' must name a unit of length and one of angle; {example}", ("units",)
        )
    names = [d.value for d in (Dimension.LENGTH, Dimension.ANGLE)]
    refuse_unknown_keys(file, list(found), names, ("units",))
    units = {Dimension.RATIO: find_unit("1")}
    for name in names:
        dimension = Dimension(name)
        if name not in found:
            raise file.error(f"'units' states no unit of {name}; {example}", ("units",))
        symbol = found[name]
        if not isinstance(symbol, str) or symbol not in list_symbols(dimension):
            hint = suggest_names(str(symbol), list_symbols(dimension))
            allowed = ", ".join(list_symbols(dimension))
            raise file.error(
                f"{symbol!r} is not a unit of {name}{hint}; allowed are {allowed}", ("units", name)
            )
        units[dimension] = find_unit(symbol, dimension)
    return units


def to_si(annotation: Any, node: Any, file: YamlFile, units: Units, location: Location) -> Any:
    """Return `node` with each number annotated by a Dimension in SI; keys that no record knows are
    refused.

    What does not fit the annotation is left as it is, for pydantic to name.
    """
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        for mark in arguments[1:]:
            if isinstance(mark, Dimension):
                return _scaled(node, units[mark].factor_to_si)
        return to_si(arguments[0], node, file, units, location)
    if origin in (Union, types.UnionType):
        return to_si(_branch(arguments, node), node, file, units, location)
    if (
        isinstance(node, dict)
        and dataclasses.is_dataclass(annotation)
        and isinstance(annotation, type)
    ):
        hints = field_types(annotation)
        refuse_unknown_keys(file, list(node), list(hints), location)
        return {
            key: to_si(hints[key], value, file, units, (*location, key))
            for key, value in node.items()
        }
    if isinstance(node, dict) and origin is not None and issubclass(origin, Mapping):
        return {
            key: to_si(arguments[1], value, file, units, (*location, key))
            for key, value in node.items()
        }
    if isinstance(node, list) and origin in (tuple, list):
        repeated = origin is list or (len(arguments) == 2 and arguments[1] is Ellipsis)
        each = [arguments[0]] * len(node) if repeated else list(arguments) + [Any] * len(node)
        return [to_si(each[i], value, file, units, (*location, i)) for i, value in enumerate(node)]
    return node


def field_types(record: type) -> dict[str, Any]:
    """Return name -> annotation of the fields that a record takes."""
    hints = typing.get_type_hints(record, include_extras=True)
    return {field.name: hints[field.name] for field in dataclasses.fields(record) if field.init}


def _scaled(node: Any, factor: float) -> Any:
    """Return a number times `factor`, or lists of numbers times `factor`; anything else unchanged."""
    if isinstance(node, list):
        return [_scaled(value, factor) for value in node]
    if isinstance(node, (int, float)) and not isinstance(node, bool):
        return node * factor
    return node


def _branch(arguments: tuple[Any, ...], node: Any) -> Any:
    """Return the branch of a union that `node` was written for: the one whose form and keys fit
    best.
    """
    return max(arguments, key=lambda annotation: _fit(annotation, node))


def _fit(annotation: Any, node: Any) -> float:
    """Return how well the form of `node` fits an annotation (negative: not at all)."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _fit(arguments[0], node)
    if origin in (Union, types.UnionType):
        return max(_fit(a, node) for a in arguments)
    if annotation in (None, type(None)):
        return 1.0 if node is None else -1.0
    if isinstance(node, dict):
        if dataclasses.is_dataclass(annotation) and isinstance(annotation, type):
            hints = field_types(annotation)
            tags = [
                (key, get_args(h))
                for key, h in hints.items()
                if get_origin(h) is Literal and key in node
            ]
            tagged = sum(10.0 if node[key] in allowed else -10.0 for key, allowed in tags)
            return (
                tagged
                + sum(key in hints for key in node)
                - 0.5 * sum(key not in hints for key in node)
                + 0.1
            )
        return 0.05 if origin is not None and issubclass(origin, Mapping) else -1.0
    if isinstance(node, list):
        if origin not in (tuple, list):
            return -1.0
        fixed = origin is tuple and arguments[-1:] != (Ellipsis,)
        inner = _fit(arguments[0], node[0]) if node and arguments else 0.0
        return (2.0 if not fixed or len(arguments) == len(node) else 0.5) + (
            0.5 if inner > 0 else -0.4
        )
    if isinstance(node, str):
        return 1.0 if annotation is str or (origin is Literal and node in arguments) else -1.0
    if isinstance(node, bool):
        return 1.0 if annotation is bool else -1.0
    return 1.0 if annotation in (float, int) else -1.0


def _translated(error: Any, file: YamlFile, content: Mapping[str, Any]) -> FileError:
    """Return pydantic's first finding (by line) as our own sentence."""
    findings = error.errors(include_url=False, include_context=True)
    ranked = sorted(findings, key=lambda f: -len(_existing(f["loc"], content)[0]))
    finding = (
        ranked[0]
        if _has_union(findings, content)
        else min(findings, key=lambda f: _rank(f, file, content))
    )
    location, node = _existing(finding["loc"], content)
    needed = max(
        [
            f["loc"][-1] + 1
            for f in findings
            if f["loc"][:-1] == finding["loc"][:-1] and _is_index(f)
        ],
        default=0,
    )
    return file.error(_sentence(finding, location, node, needed), location)


def _rank(finding: Any, file: YamlFile, content: Mapping[str, Any]) -> int:
    """Return the line of a finding."""
    return file.line(_existing(finding["loc"], content)[0])


def _has_union(findings: list[Any], content: Mapping[str, Any]) -> bool:
    """Tell whether pydantic named branches of a union, of which the deepest is the one meant."""
    return any(len(_existing(f["loc"], content)[0]) < len(f["loc"]) - 1 for f in findings)


def _existing(loc: tuple[str | int, ...], content: Any) -> tuple[Location, Any]:
    """Return the part of pydantic's location that exists in the file, and the node there."""
    location: list[str | int] = []
    node = content
    for step in loc:
        if has_child(node, step):
            node = node[step]
            location.append(step)
    return tuple(location), node


def _is_index(finding: Any) -> bool:
    """Tell whether a finding is about an entry of a list."""
    return isinstance(finding["loc"][-1], int)


def _sentence(finding: Any, location: Location, node: Any, needed: int) -> str:
    """Return what was found, what is allowed and what to do, for one finding of pydantic.

    `needed` is the number of values of a fixed list some of which are missing.
    """
    kind, context = finding["type"], finding.get("ctx", {})
    name = repr(words(location)) if location else "this file"
    if kind == "missing" and isinstance(node, list):
        return f"{name} has {len(node)} values where {needed} are needed; add the missing ones"
    if kind in ("missing", "missing_argument"):
        return f"{name} has no key {finding['loc'][-1]!r}, which is needed; add it"
    if kind in ("too_long", "too_short"):
        bound = context.get("max_length", context.get("min_length"))
        act = "remove the others" if kind == "too_long" else "add the missing ones"
        return f"{name} has {len(node)} values where {bound} are needed; {act}"
    if kind in ("float_type", "float_parsing", "int_type", "int_parsing", "int_from_float"):
        number = "a whole number" if kind.startswith("int") else "a number"
        if isinstance(node, str):
            act = (
                "write the number without quotes and without a unit"
                if _numeric(node)
                else "write a number"
            )
            act = (
                "write a point in the number, not a comma"
                if _numeric(node) and "," in node
                else act
            )
            return f"{name} is the text {node!r} where {number} is needed; {act}"
        return f"{name} is {_shape(node)} where {number} is needed; write a number"
    if kind in ("tuple_type", "list_type"):
        return f"{name} is {_shape(node)} where a list is needed; write it as [.., ..]"
    if kind in ("dataclass_type", "dict_type", "dataclass_exact_type"):
        return (
            f"{name} is {_shape(node)} where 'key: value' lines are needed; write it as a mapping"
        )
    if kind == "literal_error":
        hint = suggest_names(
            str(node), [p.strip("' ") for p in context["expected"].replace(" or ", ",").split(",")]
        )
        return f"{name} is {node!r}{hint}; allowed: {context['expected'].replace(' or ', ', ')}"
    if kind == "string_type":
        return f"{name} is {_shape(node)} where text is needed; put it in quotes"
    if kind == "bool_type":
        return f"{name} is {_shape(node)} where true or false is needed; write one of the two"
    if kind == "value_error":
        return f"{name}: {context.get('error', finding['msg'])}"
    return f"{name} is {_shape(node)}, which does not fit: {finding['msg'][:1].lower()}{finding['msg'][1:]}; correct it"


def _numeric(text: str) -> bool:
    """Tell whether text begins like a number."""
    return text.strip()[:1].isdigit() or text.strip()[:1] in "+-."


def _shape(node: Any) -> str:
    """Return a node in words: `the number 4`, `a list of 3`, `empty`."""
    if node is None:
        return "empty"
    if isinstance(node, bool):
        return f"the value {str(node).lower()}"
    if isinstance(node, (int, float)):
        return f"the number {node:g}"
    if isinstance(node, str):
        return f"the text {node!r}"
    return f"a list of {len(node)}" if isinstance(node, list) else "a mapping"
