# SPDX-License-Identifier: Apache-2.0
"""Frozen dataclasses that Python creates in a fifth of the time.

`dataclasses.dataclass(frozen=True)` writes and compiles six methods of each class. A calibration by
the command line needs 270 classes, and spent a fifth of its time on that. Here the classes share
five of the methods, and `__init__` alone is compiled. Their behavior is that of the standard
library, whose functions take them, and three of which can be imported from here. A class of one
sort cannot inherit from a class of the other.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import FrozenInstanceError, field, fields, replace
from functools import cache
from operator import attrgetter
from reprlib import recursive_repr
from typing import Any, Literal, NoReturn, TypeVar, dataclass_transform

__all__ = ["dataclass", "field", "fields", "replace"]

T = TypeVar("T")


@dataclass_transform(field_specifiers=(field,))
def dataclass(
    *,
    frozen: Literal[True],  # for readers and type checkers, which know it from the standard library
    eq: bool = True,
    repr: bool = True,  # noqa: A002 the name of the standard library
    kw_only: bool = False,
) -> Callable[[type[T]], type[T]]:
    """Return what gives a class the methods of a frozen dataclass.

    Parameters are those of `dataclasses.dataclass`. Methods that the class defines itself are kept.
    The fields that are compared are those that are hashed.
    """

    def make(cls: type[T]) -> type[T]:
        own = set(vars(cls))
        if not own.isdisjoint(("__setattr__", "__delattr__")):
            raise TypeError(f"{cls.__name__} is frozen and cannot define how fields are set")
        dataclasses.dataclass(repr=False, eq=False, kw_only=kw_only)(cls)  # noqa: TID251 here
        shared: dict[str, Any] = {"__setattr__": _set_once, "__delattr__": _refuse_to_delete}
        if repr:
            shared["__repr__"] = _represent
        if eq:
            shared |= {"__eq__": _are_equal, "__hash__": _hash}
            if "__eq__" in own and vars(cls)["__hash__"] is None:  # Python put None there
                own.remove("__hash__")
        for name, method in shared.items():
            if name not in own:
                setattr(cls, name, method)
        return cls

    return make


def _set_once(self: Any, name: str, value: object) -> None:
    """Set a field, as `__init__` does; raise FrozenInstanceError where it has a value."""
    state = self.__dict__
    if name in state or name not in self.__dataclass_fields__:
        raise FrozenInstanceError(f"cannot assign to field {name!r}")
    state[name] = value


def _refuse_to_delete(self: object, name: str) -> NoReturn:
    """Raise FrozenInstanceError."""
    raise FrozenInstanceError(f"cannot delete field {name!r}")


@recursive_repr()
def _represent(self: Any) -> str:
    """Return the name of the class with its fields."""
    shown = ", ".join(f"{f.name}={getattr(self, f.name)!r}" for f in fields(self) if f.repr)
    return f"{type(self).__qualname__}({shown})"


def _are_equal(self: object, other: object) -> bool:
    """Return whether two values of one class have equal fields."""
    if other.__class__ is not self.__class__:
        return NotImplemented
    compare = _find_compared(type(self))
    return compare(self) == compare(other)


def _hash(self: object) -> int:
    """Return the hash of the compared fields."""
    return hash(_find_compared(type(self))(self))


@cache
def _find_compared(cls: type[Any]) -> Callable[[object], tuple[Any, ...]]:
    """Return what takes the compared fields of a value of a class, as a tuple."""
    names = [f.name for f in fields(cls) if f.compare]
    if len(names) < 2:  # attrgetter returns no tuple of one
        return lambda value: tuple(getattr(value, name) for name in names)
    return attrgetter(*names)
