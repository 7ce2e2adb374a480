# SPDX-License-Identifier: Apache-2.0
"""Values of a batch of trials: frozen dataclasses whose arrays begin with an axis of trials."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields, is_dataclass, replace
from functools import cache
from typing import Any, ClassVar, Self, TypeVar

import numpy as np

from loopcal.typing import IntArray

Value = TypeVar("Value")


def map_arrays(function: Callable[..., np.ndarray], *values: Value) -> Value:
    """Return the value each array of which is a function of the same array of all given values.

    Values are arrays, dataclasses and tuples of values, and anything else, which is taken from the
    first one. What is None in one of them is None. A dataclass keeps the fields that it names in
    `shared`.
    """
    first: Any = values[0]
    if first is None or (len(values) > 1 and any(value is None for value in values)):
        return None  # type: ignore[return-value]
    if isinstance(first, np.ndarray):
        return function(*values)  # type: ignore[return-value]
    if isinstance(first, tuple):
        elements: Any = zip(*values, strict=True)  # type: ignore[call-overload]
        return tuple(map_arrays(function, *part) for part in elements)  # type: ignore[return-value]
    if is_dataclass(first):
        names = _list_batched(type(first))
        made = {n: map_arrays(function, *[getattr(value, n) for value in values]) for n in names}
        return replace(first, **made)  # type: ignore[type-var]
    return first


def select_counts(count: IntArray, trials: IntArray) -> IntArray:
    """Return counts (T | 1,) of some trials (t,)."""
    return np.full(len(trials), count[0]) if len(count) == 1 else count[trials]


@cache
def _list_batched(kind: type[Any]) -> tuple[str, ...]:
    """Return the names of the fields of a dataclass that belong to trials."""
    shared = getattr(kind, "shared", ())
    return tuple(f.name for f in fields(kind) if f.name not in shared)


class TrialBatch:
    """Base of frozen dataclasses whose arrays begin with an axis of t trials.

    shared : names of the fields that belong to no trial.
    """

    shared: ClassVar[tuple[str, ...]] = ()

    def take(self, trials: IntArray) -> Self:
        """Return the trials at these indices, or of this mask; this object where it is all."""
        if self._are_all(trials):
            return self
        return map_arrays(lambda array: array[trials], self)

    def put(self, trials: IntArray, other: Self) -> Self:
        """Return this value with some trials taken from another one."""
        if self._are_all(trials):
            return other

        def replaced(old: np.ndarray, new: np.ndarray) -> np.ndarray:
            out = np.array(old)
            out[trials] = new
            return out

        return map_arrays(replaced, self, other)

    def _are_all(self, trials: IntArray) -> bool:
        """Return whether these indices, or this mask, are all trials in their order."""
        count = _count_trials(self)
        if len(trials) != count:
            return False
        is_in_place = trials if trials.dtype == np.bool_ else trials == np.arange(count)
        return bool(is_in_place.all())

    @staticmethod
    def join(batches: Sequence[Value]) -> Value:
        """Return the trials of all batches, one after the other."""
        if len(batches) == 1:
            return batches[0]
        return map_arrays(lambda *arrays: np.concatenate(arrays), *batches)


def _count_trials(value: Any) -> int:
    """Return the length of the first array of a dataclass."""
    while is_dataclass(value):
        value = getattr(value, _list_batched(type(value))[0])
    return len(value)
