# SPDX-License-Identifier: Apache-2.0
"""Results from stored content: from JSON by the types of their attributes, and from arrays."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from enum import Enum
from types import NoneType, UnionType
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from loopcal.results.description import Field
from loopcal.typing import find_array_type

Stored = TypeVar("Stored")


def restore(of_class: type[Stored], content: Mapping[str, Any], **given: Any) -> Stored:
    """Return an object from its content of JSON.

    Keys are those of `FIELDS` of its class, or the names of its attributes. Where there is no key,
    an attribute has its default. Null for a number is NaN.

    content : numbers that are not finite may be restored already, see `restore_numbers`.
    given : attributes that are not in `content`, or are to be taken instead.
    """
    hints, values = get_type_hints(of_class), dict(given)
    described: tuple[Field, ...] = getattr(of_class, "FIELDS", ())
    keys = {f.of or f.name: f.json_key for f in described if f.json_key is not None}
    for name in (field.name for field in dataclasses.fields(of_class)):  # type: ignore[arg-type]
        key = keys.get(name, name)
        if name not in given and key in content:
            values[name] = _restore_value(hints[name], content[key])
    return of_class(**values)


def _restore_value(hint: Any, value: Any) -> Any:
    """Return a value of JSON as one of a type."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        (other,) = (argument for argument in arguments if argument is not NoneType)
        return None if value is None else _restore_value(other, value)
    if hint is float:
        return math.nan if value is None else float(value)
    if entries := find_array_type(hint):
        return np.array(value, dtype=entries)
    if origin is tuple:
        entries = arguments[:1] * len(value) if arguments[-1] is ... else arguments
        return tuple(map(_restore_value, entries, value))
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return {key: _restore_value(arguments[1], entry) for key, entry in value.items()}
    if isinstance(hint, type) and issubclass(hint, Enum):
        return hint[value.upper()]
    if isinstance(hint, type) and dataclasses.is_dataclass(hint):
        of_class: type[Any] = hint
        return restore(of_class, value)
    return value


def _list_stored(of_class: type[Any]) -> list[Field]:
    """Return the fields that a class marks as stored; of one without fields, all its arrays."""
    if hasattr(of_class, "FIELDS"):
        return [field for field in of_class.FIELDS if field.is_stored]
    hints = get_type_hints(of_class)
    return [Field(name) for name, hint in hints.items() if find_array_type(hint)]


def store_arrays(result: Any, prefix: str, suffix: str = "") -> dict[str, np.ndarray]:
    """Return the stored fields of a result, by name between `prefix` and `suffix`."""
    stored = _list_stored(type(result))
    return {f"{prefix}{field.name}{suffix}": _to_array(field.get(result)) for field in stored}


def _to_array(value: Any) -> np.ndarray:
    """Return an array; members of an enumeration as their values."""
    if isinstance(value, tuple) and all(isinstance(entry, Enum) for entry in value):
        return np.array([entry.value for entry in value], str)
    return np.asarray(value)


def restore_arrays(
    of_class: type[Stored],
    arrays: Mapping[str, np.ndarray],
    prefix: str,
    suffix: str = "",
    **given: Any,
) -> Stored | None:
    """Return an object from what `store_arrays` returned; None where an array is missing.

    given : the attributes that are not stored.
    """
    stored = _list_stored(of_class)
    if any(f"{prefix}{field.name}{suffix}" not in arrays for field in stored):
        return None
    hints = get_type_hints(of_class)
    for field in stored:
        attribute, array = str(field.of or field.name), arrays[f"{prefix}{field.name}{suffix}"]
        is_array = find_array_type(hints[attribute])
        given[attribute] = array if is_array else _restore_value(hints[attribute], array.tolist())
    return of_class(**given)
