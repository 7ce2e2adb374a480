# SPDX-License-Identifier: Apache-2.0
"""Checks of options: words with choices, and numbers with limits."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import cache
from types import UnionType
from typing import Any, ClassVar, Literal, NamedTuple, Union, get_args, get_origin, get_type_hints

from loopcal.errors import EstimationError, suggest_names


def check_choice(
    name: str, value: object, allowed: Iterable[str], error: type[Exception] = EstimationError
) -> None:
    """Raise `error` for an option `name` whose value is none of the allowed words."""
    words = tuple(allowed)
    if not isinstance(value, str) or value not in words:
        raise error(
            f"{name} is {value!r}{suggest_names(str(value), words)}, but must be one of "
            f"{', '.join(map(repr, words))}"
        )


class Limit(NamedTuple):
    """Which values of a setting are allowed.

    is_allowed : whether a value is. words : which values are. show : text of a wrong one.
    """

    is_allowed: Callable[[Any], bool]
    words: str
    show: Callable[[Any], str] = lambda value: f"{value:g}" if isinstance(value, float) else value


POSITIVE = Limit(lambda value: value > 0, "above 0")
NOT_NEGATIVE = Limit(lambda value: value >= 0, "0 or more")


def whole_numbers(least: int, most: int) -> Limit:
    """Return the limit of a number from `least` to `most`."""
    return Limit(lambda value: least <= value <= most, f"from {least} to {most}")


class Limited:
    """Base of dataclasses of settings: those in LIMITS have a limit, those of a `Literal` type a
    choice of words; None has no limit. A wrong one raises ERROR.
    """

    LIMITS: ClassVar[Mapping[str, Limit]] = {}
    ERROR: ClassVar[type[Exception]] = ValueError

    def __post_init__(self) -> None:
        """Check all settings."""
        for name, allowed in _list_choices(type(self)).items():
            if (value := getattr(self, name)) is not None:
                check_choice(name, value, allowed, self.ERROR)
        for name, limit in self.LIMITS.items():
            value = getattr(self, name)
            if value is not None and not limit.is_allowed(value):
                raise self.ERROR(f"{name} is {limit.show(value)}, but must be {limit.words}")


@cache
def _list_choices(record: type) -> dict[str, tuple[str, ...]]:
    """Return the words of each setting of a `Literal` type."""
    choices = {}
    for name, hint in get_type_hints(record).items():
        parts = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
        for part in parts:
            if get_origin(part) is Literal:
                choices[name] = get_args(part)
    return choices
