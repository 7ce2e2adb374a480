# SPDX-License-Identifier: Apache-2.0
"""Values that files and options should not contain, and values at the edge of what they may."""

from __future__ import annotations

from dataclasses import dataclass
from random import Random
from typing import Any

NUMBERS: tuple[float, ...] = (
    0, -0.0, 1, -1, 0.5, 1e-320, 1e-9, 1e9, 1e160, -1e160, 1e308, -1e308, 10**9, 10**30,
    -(10**30), float("nan"), float("inf"), float("-inf"), 90, 180, 1e-3, 7, 2**63,
)  # fmt: skip
"""Numbers at the ends of what a double holds, and those that formulas divide by."""

CELLS = (
    "", " ", "nan", "-inf", "inf", "1e400", "1e160", "-1e308", "0", "-0.0", "1e-320", "1,5",
    "1_0", "0x1F", "٣", "1.2.3", "--5", "5 mm", "5mm", "true", "None", '"', "'1", "=1+1", "1e5",
    "99999999999999999999", "#", "a;b", ";", "held-out", "fit", "1 000", "+1", ".5", "1.", "1e",
    "\u22121",
)  # fmt: skip
"""Text in place of the number of a cell."""

NAMES = (
    "", " ", "a, b", "x: y", '"q"', "'q", "*w", "%w", "leg #1", "q [", "q [mm]",
    "=cmd|' /C calc'!A0", "use", "time", "temperature", "pose", "block", "kind", "session",
    "group", "note", "\x1b[31mred", "\u202eabc", "é", "名前", "a" * 300, "nan", "inf", "null",
    "yes", "1", "-", "?", "a/b", "../a", "a\nb", "a\tb", "a\rb", "{{x}}", "<b>", "&amp;", "a;b",
    "-->", "*/", ")", "(", "\u2028", "\ufeff", ".", "a.b", "sigma.x", "commanded.x", "measured.x",
    "cov.x.y", "[a", "!!python/object:os.system", "&a", "~", "`", "@a", "|", ">", "\\", "\x7f",
    "\x85", "fixed", "*", "*.x", "[", "**", "\U0001f916", "a\u0301", "CON", "0x10", "1e5",
    "12:30:00", "2020-01-01",
)  # fmt: skip
"""Text in place of a name: signs of YAML, CSV, HTML and terminals, and words with a meaning."""

WINDOWS_PATHS = (
    "C:\\data\\x.csv", "C:data.csv", "C:/data.csv", "\\\\server\\share\\x.csv", "..\\x.csv",
    ".\\data.csv", "sub\\data.csv", "\\data.csv", "NUL", "con.csv", "COM1.yaml", "aux", "data.csv.",
    "data.csv ", "data.csv:stream", "\\\\?\\C:\\x.csv", "DATA.CSV", "Robot.yaml",
)  # fmt: skip
"""Paths as Windows writes them, and names that it does not allow."""

LONE_SURROGATE = "\ud800"
"""Half of a character: JSON and YAML can write it (as an escape), UTF-8 cannot."""

DEPTHS = (2, 3, 40, 400, 5000)
"""Levels of lists around a value."""


@dataclass(frozen=True)
class Raw:
    """Text that is written into a YAML or JSON file as it is."""

    text: str


SNIPPETS = (
    "&a [*a]", "*nothing", "!!python/object/apply:os.getcwd []", "!!float 1", "!!binary aGVsbG8=",
    "&b {x: *b}", "[1, 2", "{", "<<", "? x", "|", "|\n   text", "'open", "2001-01-01",
    "!!set {a}", "0o17", "1_000", "~", "=", "!x 1", "&c", "- -", "{a: 1, a: 2}", "1e400", ".inf",
    "-.inf", ".NaN", "0b1", "190:20:30", '"\\ud800"', '"\\x1b[31m"', '"\\0"',
)  # fmt: skip
"""Pieces of YAML that no reader of settings expects."""


def draw_number(rng: Random) -> float:
    """Return a number to write in place of another."""
    return rng.choice(NUMBERS)


def draw_name(rng: Random) -> str:
    """Return text to write in place of a name."""
    return LONE_SURROGATE if rng.random() < 0.03 else rng.choice(NAMES)


def draw_value(rng: Random) -> Any:
    """Return a value of any type for a YAML or JSON file."""
    kind = rng.randrange(6)
    if kind <= 1:
        return draw_number(rng)
    if kind == 2:
        return draw_name(rng)
    if kind == 3:
        return Raw(rng.choice(SNIPPETS))
    return rng.choice(
        [None, True, False, [], {}, "", [1], ["x"], {"x": 1}, [[]], [None], {"": 1}, [{}]]
    )


def change_number(number: float, rng: Random) -> float:
    """Return a number near another one, or of another sign or size."""
    changed = rng.choice(
        [
            -number,
            number * 1e3,
            number * 1e-3,
            number * 2.5,
            number + 1e-3,
            number * (1 + 1e-9),
            0.5 * number,
        ]
    )
    return int(changed) if isinstance(number, int) and rng.random() < 0.7 else changed
