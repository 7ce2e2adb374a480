# SPDX-License-Identifier: Apache-2.0
"""YAML files and records: values in SI units, and errors in one sentence with their line."""

import math
from dataclasses import dataclass
from typing import Literal

import pytest

from loopcal.errors import FileError
from loopcal.io.core.records import read_record, read_units
from loopcal.io.core.yaml_file import parse_yaml, read_yaml
from loopcal.units import Angle, Length, Ratio

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
        ("- [1, 2, 3]", "- [1, 2]", 7, "'leg.base entry 1' has 2 values, but 3"),
        ("- [1, 2, 3]", "- [1]", 7, "'leg.base entry 1' has 1 values, but 3"),
        ("- [1, 2, 3]", "- [1, 2, 3, 4]", 7, "has 4 values, but 3 are needed; remove"),
        ("- [1, 2, 3]", "- 5", 7, "is the number 5, but a list"),
        (
            "[1, 2, 3]",
            "[1, '2', 3]",
            7,
            "is the text '2', but a number is needed; write the number without quotes",
        ),
        ("[1, 2, 3]", "[1, 2mm, 3]", 7, "is the text '2mm', but a number"),
        ("[1, 2, 3]", "[1, nan, 3]", 7, "is the text 'nan', but a number"),
        ("[1, 2, 3]", "[1, .nan, 3]", 7, "is nan; write a finite number"),
        ("[1, 2, 3]", "[1, -.inf, 3]", 7, "is -inf; write a finite number"),
        ("[1, 2, 3]", "[1, 1e999, 3]", 7, "write a finite number"),
        ("[1, 2, 3]", "[1, true, 3]", 7, "is the value true, but a number"),
        ("[1, 2, 3]", "[1, , 3]", 7, "not valid YAML"),
        ("[1, 2, 3]", "!foo 5", 7, "has a YAML tag"),
        ("legs: rod", "legs: rood", 5, "'leg.legs' is 'rood' .did you mean 'rod'"),
        ("legs: rod", "legs: ups", 6, "unknown key 'base' in 'leg'; allowed: joints, legs"),
        ("  base:", "  bse:", 6, "unknown key 'bse' in 'leg' .did you mean 'base'"),
        ("units: {length: mm, angle: deg}\n", "", None, "states no units"),
        ("length: mm, ", "", 2, "states no unit of length"),
        ("length: mm", "length: mmm", 2, "'mmm' is not a unit of length .did you mean 'mm'"),
        ("length: mm", "length: deg", 2, "'deg' is not a unit of length; allowed: m, mm"),
        ("name: h", "name: 3", 3, "is the number 3, but text"),
        ("name: h", "name: h\ncount: 3.5", 4, "is the number 3.5, but a whole number"),
        ("name: h", "name: h\nmode: u", 4, "'mode' is 'u'.*; allowed: 'up', 'down'"),
        ("name: h", "name: h\nname: g", 4, "duplicate key 'name'"),
        ("name: h", "name: h\n3: g", 4, "key 3 is not text"),
        ("name: h", "name: [h", 4, "not valid YAML"),
        ("{sd: 0.5}", "0.5", 11, "is the number 0.5, but a mapping is needed"),
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
    with pytest.raises(FileError, match="this is a folder, but a robot file is needed"):
        read_yaml(tmp_path, "robot file")
    with pytest.raises(FileError, match="this robot file does not exist"):
        read_yaml(tmp_path / "absent.yaml", "robot file")
