# SPDX-License-Identifier: Apache-2.0
"""Fields of frozen results that are computed when they are first asked for, and kept."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from typing import Any, NamedTuple, Self


class _Later(NamedTuple):
    compute: Callable[[], Any]


def later(compute: Callable[[], Any]) -> Any:
    """Return what a constructor takes in place of the value of a deferred field: a function without
    arguments, which has no effect but its result.
    """
    return _Later(compute)


class _Deferred:
    """A required field of a dataclass."""

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __get__(self, record: Any, owner: type) -> Any:
        if record is None:  # the dataclass looks for a default
            raise AttributeError(self.name)
        value = record.__dict__[self.name]
        if isinstance(value, _Later):
            value = record.__dict__[self.name] = value.compute()
        return value

    def __set__(self, record: Any, value: Any) -> None:  # by the constructor of a frozen record
        record.__dict__[self.name] = value


def deferred() -> Any:
    """Return the descriptor of a field whose constructor takes a value, or `later` the value."""
    return _Deferred()


class DeferredFields:
    """Base of frozen dataclasses with deferred fields: a copy or a pickle has their values."""

    def with_fields(self, **values: Any) -> Self:
        """Return a copy with other values of some fields; the others stay deferred."""
        copied = object.__new__(type(self))
        kept = {field.name: self.__dict__[field.name] for field in fields(self)}  # type: ignore[arg-type]
        copied.__dict__.update(kept | values)
        return copied

    def __getstate__(self) -> dict[str, Any]:
        """Return the content of the record, all of it computed."""
        for field in fields(self):  # type: ignore[arg-type]
            getattr(self, field.name)
        return self.__dict__
