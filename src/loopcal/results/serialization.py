# SPDX-License-Identifier: Apache-2.0
"""Turn results into JSON: one function for dataclasses, arrays, enums, findings and mappings.

A class whose JSON is not simply its fields states `FIELDS`, see `loopcal.results.description`, or
has a method `to_dict`, where keys depend on its content.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from enum import Enum
from pathlib import Path
from typing import Any

from loopcal.results.description import describe_json

INFINITE = "infinite: undetermined by these data, or a division by zero"
UNDEFINED = "undefined: there is nothing to compute it from"
_PLAIN = frozenset({type(None), bool, int, str})


def to_json(value: Any, nulls: dict[str, str] | None = None, path: tuple[str, ...] = ()) -> Any:
    """Return a value as dictionaries, lists, strings, numbers, booleans and None.

    value : dataclasses, findings, arrays, enums (written by their names in lower case), paths,
        named tuples, and lists and mappings of these. A number that is not finite becomes None.
    nulls : where given, receives the path of every such number, such as
        `parameters/3/plus_minus`, and the reason: `INFINITE` or `UNDEFINED`.
    path : keys that lead to `value`, for `nulls` and for the error.

    TypeError : a value of another type; the text names its path.

    Examples
    --------
    >>> to_json({"sd": float("inf"), "names": ("a", "b")})
    {'sd': None, 'names': ['a', 'b']}
    """
    if type(value) in _PLAIN:  # most values: no other question is asked about them
        return value
    if isinstance(value, Enum):
        return value.name.lower()
    if isinstance(value, int | str):  # of a class of its own, as from YAML
        return value
    if isinstance(value, float):
        if math.isfinite(value):
            return float(value)
        if nulls is not None:
            nulls["/".join(path)] = UNDEFINED if math.isnan(value) else INFINITE
        return None
    if (to_list := getattr(value, "tolist", None)) is not None:  # arrays and numbers of numpy
        return to_json(to_list(), nulls, path)
    if isinstance(value, Path):
        return str(value)
    content = _content(value)
    if isinstance(content, Mapping):
        return {_key(k): to_json(v, nulls, (*path, _key(k))) for k, v in content.items()}
    if isinstance(content, list | tuple):
        return [to_json(v, nulls, (*path, str(i))) for i, v in enumerate(content)]
    raise TypeError(f"{'/'.join(path)}: {type(value).__name__} has no JSON form")


def restore_numbers(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return a JSON document with the numbers that are not finite, from its reasons `nulls`.

    An infinite number becomes positive, because JSON does not state its sign.

    Examples
    --------
    >>> restore_numbers({"sd": None, "nulls": {"sd": INFINITE}})
    {'sd': inf}
    """
    nulls = document.get("nulls") or {}
    return {k: _restore(v, nulls, k) for k, v in document.items() if k != "nulls"}


def _restore(value: Any, nulls: Mapping[str, str], path: str) -> Any:
    """Return a JSON value with its numbers that are not finite."""
    if value is None and path in nulls:
        return math.inf if nulls[path] == INFINITE else math.nan
    if isinstance(value, dict):
        return {key: _restore(v, nulls, f"{path}/{key}") for key, v in value.items()}
    if isinstance(value, list):
        return [_restore(v, nulls, f"{path}/{i}") for i, v in enumerate(value)]
    return value


def json_fields(value: Any) -> dict[str, Any]:
    """Return what a class states for JSON, by key, as objects; of a dataclass that states nothing
    its fields.

    For methods `to_dict` that add keys to the fields: `{**json_fields(self), "rms": self.rms}`.
    """
    described = getattr(value, "FIELDS", ())
    if any(field.json_key is not None for field in described):
        return describe_json(value, described)
    names = (field.name for field in dataclasses.fields(value) if field.name[0] != "_")
    return {name: getattr(value, name) for name in names}


def _content(value: Any) -> Any:
    """Return the mapping or sequence behind a value; the value itself where there is none."""
    if isinstance(value, type):
        return value
    if hasattr(value, "to_dict"):
        return value.to_dict()
    if dataclasses.is_dataclass(value):
        return json_fields(value)
    return value._asdict() if hasattr(value, "_asdict") else value


def _key(key: Any) -> str:
    """Return a key of a mapping as text; an enum by its name."""
    return key.name.lower() if isinstance(key, Enum) else str(key)
