# SPDX-License-Identifier: Apache-2.0
"""YAML files and records: values in SI units, and errors in one sentence with their line."""

import copy
import math
import subprocess
import sys
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pytest

from loopcal.errors import FileError
from loopcal.io.core.records import read_record, read_units
from loopcal.io.core.yaml_file import parse_yaml, read_yaml
from loopcal.io.robot.robot_file import HEADER, list_shipped_robots
from loopcal.mechanism.families import FAMILIES
from loopcal.mechanism.families.stages import Stages
from loopcal.units import Angle, Length, Ratio
from tests.zoo import ROBOTS

FILES = list_shipped_robots()
OF_A_FAMILY = [
    robot for robot in ROBOTS if "\nfamily:" in FILES[str(robot.values[0])].read_text("utf-8")
]
Vector = tuple[Length, Length, Length]


@dataclass(frozen=True)
class Tolerance:
    sd: Length | None = None
    limits: Length | None = None


@dataclass(frozen=True)
class RodLegs:
    legs: Literal["rod"]
    base: tuple[Vector, ...]
    gain: Ratio = 1.0
    clearance: Length = 1e-6
    home: tuple[Length, Length, Length, Angle] | None = None


@dataclass(frozen=True)
class ChainLegs:
    legs: Literal["ups"]
    joints: tuple[Vector, ...]


@dataclass(frozen=True)
class Robot:
    name: str
    leg: RodLegs | ChainLegs
    tolerances: dict[str, Tolerance]
    count: int = 3
    mode: Literal["up", "down"] = "up"


GOOD = """format: 1
units: {length: mm, angle: deg}
name: h
leg:
  legs: rod
  base:
    - [1, 2, 3]
    - [1e-3, 2, 3]
  home: [0, 0, 400, 90]
tolerances:
  base: {sd: 0.5}
"""


def read(text: str) -> Robot:
    file = parse_yaml(text, "robot.yaml", "robot file")
    content = {key: value for key, value in file.content.items() if key not in ("format", "units")}
    return read_record(file, content, Robot, read_units(file))


def test_numbers_are_converted_to_si_units_and_defaults_are_not() -> None:
    robot = read(GOOD)
    assert isinstance(robot.leg, RodLegs)
    assert robot.leg.base == ((0.001, 0.002, 0.003), (1e-6, 0.002, 0.003))
    assert robot.leg.home == pytest.approx((0, 0, 0.4, math.pi / 2), rel=4e-16)
    assert (robot.leg.gain, robot.leg.clearance) == (1.0, 1e-6)
    assert robot.tolerances["base"].sd == 0.0005


@pytest.mark.parametrize(
    ("old", "new", "line", "message"),
    [
        ("name: h\n", "", None, "no key 'name'"),
        ("- [1, 2, 3]", "- [1, 2]", 7, "'leg.base entry 1' has 2 values, but must have 3"),
        ("- [1, 2, 3]", "- [1]", 7, "'leg.base entry 1' has 1 values, but must have 3"),
        ("- [1, 2, 3]", "- [1, 2, 3, 4]", 7, "has 4 values, but must have 3. Remove"),
        ("- [1, 2, 3]", "- 5", 7, "is the number 5, but must be a list"),
        (
            "[1, 2, 3]",
            "[1, '2', 3]",
            7,
            "is the text '2', but must be a number. Write the number without quotes",
        ),
        ("[1, 2, 3]", "[1, 2mm, 3]", 7, "is the text '2mm', but must be a number"),
        ("[1, 2, 3]", "[1, nan, 3]", 7, "is the text 'nan', but must be a number"),
        ("[1, 2, 3]", "[1, .nan, 3]", 7, "is nan. Write a finite number"),
        ("[1, 2, 3]", "[1, -.inf, 3]", 7, "is -inf. Write a finite number"),
        ("[1, 2, 3]", "[1, 1e999, 3]", 7, "Write a finite number"),
        ("[1, 2, 3]", "[1, true, 3]", 7, "is the value true, but must be a number"),
        ("[1, 2, 3]", "[1, , 3]", 7, "not valid YAML"),
        ("[1, 2, 3]", "!foo 5", 7, "must not have YAML tags"),
        ("[1, 2, 3]", "!!int ''", 7, "must not have YAML tags"),
        ("[1, 2, 3]", "!!omap x", 7, "must not have YAML tags"),
        ("[1, 2, 3]", "=", 7, "Put it in quotes"),
        ("legs: rod", "legs: rood", 5, "'leg.legs' is 'rood' .did you mean 'rod'"),
        ("legs: rod", "legs: ups", 6, "unknown key 'base' in 'leg'. Allowed: joints, legs"),
        ("  base:", "  bse:", 6, "unknown key 'bse' in 'leg' .did you mean 'base'"),
        ("units: {length: mm, angle: deg}\n", "", None, "has no units"),
        ("length: mm, ", "", 2, "'units' has no key 'length'. Add it"),
        ("length: mm", "length: mmm", 2, "'units.length' is 'mmm' .did you mean 'mm'"),
        ("length: mm", "length: deg", 2, "'units.length' is 'deg'. Allowed: 'm', 'mm'"),
        ("name: h", "name: 3", 3, "is the number 3, but must be text"),
        ("name: h", "name: h\ncount: 3.5", 4, "is the number 3.5, but must be a whole number"),
        ("name: h", "name: h\nmode: u", 4, "'mode' is 'u'.*. Allowed: 'up', 'down'"),
        ("name: h", "name: h\nname: g", 4, "duplicate key 'name'"),
        ("name: h", "name: h\n3: g", 4, "key 3 is not text"),
        ("name: h", "name: [h", 4, "not valid YAML"),
        ("{sd: 0.5}", "0.5", 11, "is the number 0.5, but must be a mapping"),
        ("name: h", "name: +_", None, "not valid YAML"),
        (GOOD, "%YAML 1.1\n---\n" + GOOD, 1, "YAML directives"),
        (GOOD, "- 1\n- 2\n", None, "contains no 'key: value' lines"),
    ],
)
def test_invalid_record_is_refused_in_one_sentence_with_its_line(
    old: str, new: str, line: int | None, message: str
) -> None:
    with pytest.raises(FileError, match=message) as caught:
        read(GOOD.replace(old, new, 1))
    assert caught.value.line == line
    assert "\n" not in str(caught.value)


def test_byte_order_mark_is_accepted_and_does_not_shift_lines(tmp_path) -> None:
    path = tmp_path / "robot.yaml"
    path.write_bytes(b"\xef\xbb\xbf" + GOOD.encode())
    assert read_yaml(path, "robot file").content["name"] == "h"
    assert read_yaml(path, "robot file").line(("name",)) == 3


@pytest.mark.parametrize(
    ("content", "line", "message"),
    [
        (b"", None, "is empty"),
        (b"  \n\n", None, "is empty"),
        (b"\xef\xbb\xbf", None, "is empty"),
        (b"a: 1\nb: \xe4\n", 2, "not UTF-8 text .byte 0xe4."),
        (b"a: 1\nb: \0\n", 2, "zero byte"),
    ],
)
def test_file_that_is_not_text_is_refused(
    tmp_path, content: bytes, line: int | None, message: str
) -> None:
    path = tmp_path / "robot.yaml"
    path.write_bytes(content)
    with pytest.raises(FileError, match=message) as caught:
        read_yaml(path, "robot file")
    assert caught.value.line == line


def test_folder_and_missing_file_are_refused(tmp_path) -> None:
    with pytest.raises(FileError, match=r"this is a folder\. Name the robot file in it"):
        read_yaml(tmp_path, "robot file")
    with pytest.raises(FileError, match="this robot file does not exist"):
        read_yaml(tmp_path / "absent.yaml", "robot file")


WRONG = (
    *(None, True, False, 0, -3, 1.5, 2.0, "", "1", "x", "2 mm", "ball"),
    *([], [1.0], [[]], [1.0, 2.0, 3.0], {}, {"x": 1.0}, {"": []}),
)
"""Values that take the place of others, of every form that a file can have."""


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


@pytest.mark.parametrize("name", OF_A_FAMILY)
def test_changed_robot_is_read_or_refused_in_one_sentence(name: str) -> None:
    file, rng, refused = read_yaml(FILES[name], "robot file"), np.random.default_rng(0), 0
    content = {key: value for key, value in file.content.items() if key not in HEADER}
    family = FAMILIES[file.content["family"]]
    for _ in range(30):
        try:
            record = read_record(file, change(content, rng), family, read_units(file))
        except FileError as error:
            refused += "\n" not in str(error)
        else:
            assert isinstance(record, family)
    assert refused > (0 if family is Stages else 5)  # the keys of a stage are read by its family


@dataclass(frozen=True)
class Part:
    size: float
    kind: Literal["part"] = "part"

    def __post_init__(self) -> None:
        if self.size < 0.0:
            raise ValueError("size is negative, but must be above 0")


@dataclass(frozen=True)
class Box:
    size: float
    lid: bool
    kind: Literal["box"] = "box"


@dataclass(frozen=True)
class Whole:
    number: int
    text: str | None
    first: Part | Box | tuple[float, float]
    others: dict[str, Part]
    rest: Any = None
    flag: bool = False
    level: Literal[1, "high"] = 1


FITS: dict[str, Any] = {"number": 1, "text": None, "first": {"size": 1}, "others": {}}
ACCEPTED: dict[str, tuple[Any, ...]] = {
    "number": (0, 1, -3),
    "text": (None, "", "1", "x", "2 mm", "ball", "high"),
    "first": ({"size": 1.0}, {"size": 1, "lid": True}, [1, 2.0]),
    "others": ({}, {"a": {"size": 1.0}}),
    "flag": (True, False),
    "level": (1, "high"),
}


@pytest.mark.parametrize("key", ACCEPTED)
def test_only_values_of_the_annotated_form_are_read(key: str) -> None:
    file = parse_yaml("format: 1\n", "whole.yaml", "file")
    values = [*WRONG, *(v for allowed in ACCEPTED.values() for v in allowed), {"size": -1.0}]
    for value in values:
        is_allowed = any(same(value, allowed) for allowed in ACCEPTED[key])
        with nullcontext() if is_allowed else pytest.raises(FileError, match=repr(key)[:-1]):
            read_record(file, FITS | {key: value}, Whole, None)


def same(first: Any, second: Any) -> bool:
    return type(first) is type(second) and first == second


def test_records_of_a_union_are_told_apart_by_their_keys_and_constants() -> None:
    file = parse_yaml("format: 1\n", "whole.yaml", "file")
    for node, expected in (
        ({"size": 1, "kind": "part"}, Part(1.0)),
        ({"size": 1, "lid": False}, Box(1.0, lid=False)),
        ([1, 2], (1.0, 2.0)),
    ):
        assert read_record(file, FITS | {"first": node}, Whole, None).first == expected
    with pytest.raises(FileError, match=r"'first.kind' is 'bax' .did you mean 'box'"):
        read_record(file, FITS | {"first": {"size": 1, "kind": "bax"}}, Whole, None)
    with pytest.raises(FileError, match=r"'others.a.size' is negative, but must be above 0"):
        read_record(file, FITS | {"others": {"a": {"size": -1}}}, Whole, None)


def test_a_robot_is_read_without_importing_msgspec() -> None:
    code = (
        "import sys; from loopcal.io.robot.robot_file import load_robot; load_robot('hexapod-42'); "
        "print('msgspec' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
