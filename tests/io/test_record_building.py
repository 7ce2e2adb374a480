# SPDX-License-Identifier: Apache-2.0
"""Records are built without pydantic exactly where pydantic accepts them, and are the same."""

import copy
import functools
import json
import subprocess
import sys
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError

from loopcal.io.core import records
from loopcal.io.core.record_building import NoFitError, make_builder
from loopcal.io.robot.robot_file import list_shipped_robots, load_robot
from loopcal.io.runs.run_result import StoredResult

WRONG = (
    *(None, True, False, 0, -3, 1.5, 2.0, 10**400, float("inf"), float("nan")),
    *("", "1", "x", "\ud800", "ball", [], [1.0], [[]], [1.0, 2.0, 3.0], {}, {"x": 1.0}, {"": []}),
)
"""Values that take the place of others, of every form that a file can have."""


def build(record: type, node: Any) -> Any:
    """Return the record without pydantic; None where it is left to pydantic."""
    try:
        return make_builder(record)(node)
    except NoFitError:
        return None


make_adapter = functools.cache(TypeAdapter)


def ask_pydantic(record: type, node: Any) -> Any:
    """Return the record of pydantic, None where something does not fit."""
    try:
        return make_adapter(record).validate_json(json.dumps(node), strict=True)
    except ValidationError:
        return None


def list_places(node: Any) -> list[tuple[Any, Any]]:
    """Return every container within a node, with each of its keys."""
    keys = node if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else ()
    own = [(node, key) for key in keys]
    return own + [place for key in keys for place in list_places(node[key])]


def change(node: Any, rng: np.random.Generator) -> Any:
    """Return a copy with one value replaced, removed, repeated or added."""
    changed = copy.deepcopy(node)
    places = list_places(changed)
    container, key = places[rng.integers(len(places))]
    match rng.integers(4):
        case 0:
            del container[key]
        case 1 if isinstance(container, list):
            container.insert(key, copy.deepcopy(container[key]))
        case 1:
            container["further"] = 1.0
        case _:
            container[key] = copy.deepcopy(WRONG[rng.integers(len(WRONG))])
    return changed


@pytest.fixture(scope="module")
def shipped() -> list[tuple[type, Any]]:
    """The records of all shipped robots, with the contents from which they are built."""
    found: list[tuple[type, Any]] = []

    def keep(record: type) -> Any:
        def builder(node: Any) -> Any:
            found.append((record, node))
            return make_builder(record)(node)

        return builder

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(records, "make_builder", keep)
        for name in list_shipped_robots():
            load_robot(name)
    return found


def test_records_of_shipped_robots_need_no_pydantic(shipped) -> None:
    assert len(shipped) >= 10
    for record, node in shipped:
        assert repr(build(record, node)) == repr(ask_pydantic(record, node))


def test_changed_records_are_accepted_where_pydantic_accepts_them(shipped) -> None:
    rng, built, refused = np.random.default_rng(0), 0, 0
    for record, node in shipped:
        for _ in range(40):
            changed = change(node, rng)
            expected, own = ask_pydantic(record, changed), build(record, changed)
            assert own is None or repr(own) == repr(expected), changed
            built, refused = built + (own is not None), refused + (expected is None)
    assert built > 20
    assert refused > 100


@dataclass(frozen=True)
class Part:
    size: float
    kind: Literal["part"] = "part"

    def __post_init__(self) -> None:
        if self.size < 0.0:
            raise ValueError("size must not be negative")


@dataclass(frozen=True)
class Whole:
    number: int
    text: str | None
    first: Part | tuple[float, float]
    others: dict[str, Part]
    rest: Any = None
    flag: bool = False
    level: Literal[1, "high"] = 1


FITS = {"number": 1, "text": None, "first": {"size": 1}, "others": {}}


VALUES = (*WRONG, {"size": -1.0}, {"a": {"size": 1.0}}, [1, 2], "high", 1)


@pytest.mark.parametrize("key", [*FITS, "rest", "flag", "level", "unknown"])
def test_no_form_of_value_is_built_that_pydantic_refuses(key) -> None:
    accepted = 0
    for value in VALUES:
        node = FITS | {key: value}
        own = build(Whole, node)
        assert own is None or repr(own) == repr(ask_pydantic(Whole, node)), value
        accepted += own is not None
    assert accepted >= (key != "unknown")
    assert key == "rest" or accepted < len(VALUES)


def test_values_that_fit_two_branches_are_left_to_pydantic() -> None:
    @dataclass(frozen=True)
    class Other:
        size: float

    assert build(Part | Other, {"size": 1.0}) is None  # pyright: ignore
    assert build(Part | Other, {"size": 1.0, "kind": "part"}) == Part(1.0)  # pyright: ignore


def test_what_lacks_every_key_is_left_to_pydantic() -> None:
    assert build(StoredResult, {}) is None


def test_a_robot_is_read_without_importing_pydantic() -> None:
    code = (
        "import sys; from loopcal.io.robot.robot_file import load_robot; load_robot('hexapod-42'); "
        "print('pydantic' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
