# SPDX-License-Identifier: Apache-2.0
"""Frozen dataclasses with shared methods behave as those of the standard library."""

import copy
import dataclasses
import inspect
import pickle
from collections.abc import Callable
from dataclasses import FrozenInstanceError, asdict, field, replace
from typing import Any

import numpy as np
import pytest

from loopcal.value_classes import dataclass

Decorator = Callable[..., Callable[[type[Any]], type[Any]]]


def define(dataclass: Decorator) -> tuple[type[Any], type[Any], type[Any]]:
    """Define three classes with a decorator."""

    @dataclass(frozen=True)
    class Leg:
        """A leg."""

        length: float
        state: str = "new"  # names that code of `__init__` could use for itself
        value: tuple[int, ...] = ()
        joints: tuple[int, ...] = field(default_factory=tuple)
        note: str = field(default="", compare=False, repr=False)

        def __post_init__(self) -> None:
            object.__setattr__(self, "length", float(self.length))

    @dataclass(frozen=True)
    class Strut(Leg):
        """A leg with more fields, by name only."""

        mass: float = field(default=1.0, kw_only=True)
        count: int = field(init=False)
        kept: tuple[int, ...] = field(init=False, default_factory=tuple)

        def __post_init__(self) -> None:
            super().__post_init__()
            object.__setattr__(self, "count", len(self.joints))

        def __repr__(self) -> str:
            return "a strut"

    @dataclass(frozen=True, eq=False, repr=False, kw_only=True)
    class Frame:
        """A value without comparison."""

        origin: int
        size: int = 2

    return Leg, Strut, Frame


OURS, THEIRS = define(dataclass), define(dataclasses.dataclass)


@dataclass(frozen=True)
class Point:
    """A value with one field."""

    x: Any


@pytest.mark.parametrize("index", range(3))
def test_classes_have_the_signature_fields_and_patterns_of_the_standard_library(index) -> None:
    ours, theirs = OURS[index], THEIRS[index]
    assert str(inspect.signature(ours)) == str(inspect.signature(theirs))
    assert [f.name for f in dataclasses.fields(ours)] == [
        f.name for f in dataclasses.fields(theirs)
    ]
    assert ours.__match_args__ == theirs.__match_args__
    assert ours.__init__.__annotations__ == theirs.__init__.__annotations__


@pytest.mark.parametrize(
    "make",
    [
        lambda leg, strut, frame: leg(1),
        lambda leg, strut, frame: leg(1, "old", (1, 2), (3,), note="seen"),
        lambda leg, strut, frame: replace(leg(1), length=2, state="worn"),
        lambda leg, strut, frame: strut(1, joints=(1, 2), mass=3.0),
        lambda leg, strut, frame: copy.copy(leg(1, joints=(4,))),
    ],
)
def test_values_are_those_of_the_standard_library(make) -> None:
    ours, theirs = make(*OURS), make(*THEIRS)
    assert vars(ours) == vars(theirs)
    assert asdict(ours) == asdict(theirs)
    assert repr(ours) == repr(theirs)
    assert hash(ours) == hash(theirs)
    assert ours == make(*OURS)
    assert ours != replace(ours, length=7.0)


def test_fields_that_are_not_compared_make_no_difference_and_other_classes_do() -> None:
    leg, strut, frame = OURS
    assert leg(1, note="a") == leg(1, note="b")
    assert leg(1) != strut(1)
    assert leg(1) != 1
    assert frame(origin=1) != frame(origin=1)
    assert len({leg(1, note="a"), leg(1.0), leg(2)}) == 2


def test_nothing_can_be_assigned_or_deleted() -> None:
    leg = OURS[0](1)
    for name in ("length", "unknown"):
        with pytest.raises(FrozenInstanceError, match=f"cannot assign to field '{name}'"):
            setattr(leg, name, 2.0)
    with pytest.raises(FrozenInstanceError, match="cannot delete field 'length'"):
        del leg.length


def test_one_array_as_the_only_field_is_compared_as_by_the_standard_library() -> None:
    array = np.zeros(2)
    assert Point(array) == Point(array)
    with pytest.raises(ValueError, match="truth value"):
        assert Point(np.zeros(2)) == Point(np.zeros(2))


def test_values_pass_to_other_processes() -> None:
    assert pickle.loads(pickle.dumps(Point((1, 2)))) == Point((1, 2))  # noqa: S301 our own bytes


def test_a_value_in_itself_is_shown() -> None:
    inside: list[Any] = []
    inside.append(Point(inside))
    assert repr(inside[0]) == "Point(x=[...])"


def test_own_methods_and_their_hash_are_kept() -> None:
    @dataclass(frozen=True)
    class Odd:  # noqa: PLW1641 the decorator adds its hash
        """A value with its own equality."""

        x: int

        def __eq__(self, other: object) -> bool:
            return isinstance(other, Odd) and self.x % 2 == other.x % 2

    assert Odd(1) == Odd(3)
    assert hash(Odd(1)) == hash(Odd(1))


@pytest.mark.parametrize("default", [[], {}, set()])
def test_shared_defaults_are_refused(default) -> None:
    with pytest.raises(ValueError, match="default_factory"):
        dataclass(frozen=True)(type("Bad", (), {"__annotations__": {"x": "list"}, "x": default}))


def test_a_frozen_class_cannot_define_how_it_is_assigned_to() -> None:
    with pytest.raises(TypeError, match="frozen"):

        @dataclass(frozen=True)
        class Bad:
            """A contradiction."""

            x: int

            def __setattr__(self, name: str, value: object) -> None: ...


def test_missing_and_unknown_arguments_are_refused_as_by_python() -> None:
    for words in ({}, {"length": 1, "wrong": 2}):
        with pytest.raises(TypeError, match=r"__init__\(\)"):
            OURS[0](**words)
