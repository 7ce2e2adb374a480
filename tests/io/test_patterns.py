# SPDX-License-Identifier: Apache-2.0
"""Patterns of profiles have limits: a hostile one is refused, and never hangs."""

import time
from contextlib import suppress
from pathlib import Path

import pytest
import regex

from loopcal.errors import FileError
from loopcal.io.core.yaml_file import read_yaml
from loopcal.io.exports.conversion import convert_export
from loopcal.io.exports.profile import PatternClock, read_profile, refuse_pattern

PROFILE = """delimiter: semicolon
ignore: '{ignore}'
columns:
  pose: {{from: Name, match: '{match}'}}
  x: {{from: X, unit: mm}}
  y: {{from: Y, unit: mm}}
  z: {{from: Z, unit: mm}}
settings: {{kind: position, noise: {{x: 1 um, y: 1 um, z: 1 um}}}}
"""


def write(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.write_text(text, "utf-8")
    return path


def make_clock(folder: Path, pattern: str, seconds: float = 0.05) -> PatternClock:
    return PatternClock(read_yaml(write(folder, "p.yaml", f"ignore: '{pattern}'\n"), "p"), seconds)


@pytest.mark.parametrize(
    ("pattern", "text"),
    [
        (r"(a|a)*$", "a" * 40 + "!"),
        (r"(a+)+$", "a" * 9000 + "!"),
        (r"(?:a?){30}a{30}$", "a" * 9000 + "!"),
        (r"(\w+\s?)*$", "a" * 9000 + "!"),
        (r"(x+x+)+y", "x" * 9000),
        (r"^(([a-z])+.)+[A-Z]([a-z])+$", "a" * 9000),
        (r"(.*)(.*)(.*)(.*)(.*)\1\2\3!$", "ab" * 4000),
    ],
)
def test_catastrophic_patterns_end_at_the_limit(pattern: str, text: str, tmp_path) -> None:
    clock = make_clock(tmp_path, pattern)
    start = time.process_time()
    with suppress(FileError):  # some of them are fast, because the module recognizes them
        clock.match(regex.compile(pattern).search, text, ("ignore",))
    assert time.process_time() - start < 2.0


def test_limit_is_for_all_lines_together(tmp_path) -> None:
    pattern = regex.compile(r"(a|a)*$")
    clock, text = make_clock(tmp_path, "(a|a)*$", 0.2), "a" * 16 + "!"

    def match_lines() -> None:
        for _ in range(100_000):
            clock.match(pattern.search, text, ("ignore",))

    with pytest.raises(FileError, match=r"p\.yaml:1: this pattern takes more than 0\.2 s") as slow:
        match_lines()
    assert slow.value.code == "files.pattern-too-slow"


def test_many_lines_with_a_simple_pattern_are_not_too_slow(tmp_path) -> None:
    pattern = regex.compile(r"P(?P<pose>\d+)_(?P<target>\w+)")
    clock = make_clock(tmp_path, "", 0.5)
    for _ in range(5_000):
        match = clock.match(pattern.fullmatch, "P12_a", ("ignore",))
        assert match is not None
        assert match.groupdict() == {"pose": "12", "target": "a"}
    assert clock.remaining > 0.0


@pytest.mark.parametrize(
    ("pattern", "reason"),
    [
        ("a{1000000000}", "has 1,000,000,000 repetitions, but the limit is 1,000"),
        ("((((a{100}){100}){100}){100})", "repetitions, but the limit"),
        ("a{2,100000}", "has 100,000 repetitions"),
        ("(?:" * 300 + "a" + ")" * 300, "has 1,201 characters, but the limit is 1,000"),
        ("(?:" * 240 + "a" + ")" * 240, "too deeply nested"),
        ("(a", "is not a regular expression"),
    ],
)
def test_patterns_that_take_memory_are_refused_before_they_are_compiled(
    pattern: str, reason: str, tmp_path
) -> None:
    file = read_yaml(write(tmp_path, "p.yaml", f"ignore: '{pattern}'\n"), "profile")
    with pytest.raises(FileError, match=reason):
        refuse_pattern(file, pattern, ("ignore",))


@pytest.mark.parametrize(
    ("pattern", "text", "occurs"),
    [
        (r"\d{4}-\d{2}-\d{2}", "at 2026-01-31, 10:00", True),
        (r"^(?!Total)\w{1,30}$", "pose_7", True),
        (r"^(?!Total)\w{1,30}$", "Total", False),
        (r"(?P<pose>[A-Z]{2,}\d*)", "x AB12", True),
        ("{}", "a {} b", True),
    ],
)
def test_usual_patterns_are_accepted_and_match(
    pattern: str, text: str, occurs: bool, tmp_path
) -> None:
    clock = make_clock(tmp_path, pattern)
    refuse_pattern(clock.file, pattern, ("ignore",))
    assert (clock.match(regex.compile(pattern).search, text, ("ignore",)) is not None) is occurs


def test_slow_profile_is_refused_at_the_line_of_its_pattern(tmp_path) -> None:
    export = write(tmp_path, "e.txt", f"Name;X;Y;Z\n{'a' * 5000}!;1;2;3\n")
    slow = PROFILE.format(ignore="(a|a)*$", match="(?P<pose>.*)")
    profile = read_profile(write(tmp_path, "slow.yaml", slow))
    with pytest.raises(FileError, match=r"slow\.yaml:2: this pattern takes more than 0\.1 s"):
        convert_export(export, profile, 0.1)
    slow = PROFILE.format(ignore="#", match="(?P<pose>(a|a)*)")
    profile = read_profile(write(tmp_path, "slow.yaml", slow))
    with pytest.raises(FileError, match=r"slow\.yaml:4: this pattern takes more than 0\.1 s"):
        convert_export(export, profile, 0.1)
