# SPDX-License-Identifier: Apache-2.0
"""Options of the commands of loopcal with random values, taken from the commands themselves, so
that a new command or option is included without a change here.
"""

from __future__ import annotations

from collections.abc import Container, Sequence
from random import Random
from typing import Any

import click

from loopcal.cli import entry_point
from loopcal.cli.entry_point import find_command
from tools.fuzz.values import NAMES, WINDOWS_PATHS

COUNTS = ("1", "2", "3", "4", "5", "8", "12", "20")
"""Counts that cost little."""

WRONG_COUNTS = (
    "0",
    "-1",
    "1e3",
    "nan",
    "",
    "1.5",
    "9223372036854775808",
    "1" + "0" * 30,
    "1000000001",
    "x",
    "٣",
    "0x3",
    "1_0",
)
SHARES = ("0", "0.1", "0.25", "0.5", "0.9", "0.95", "1e-6", "1e-11")
WRONG_SHARES = ("1", "-0.0", "-1", "nan", "inf", "1e160", "1e-320", "", "x", "50%", "0,5", "1e400")
AMOUNTS = ("0.1", "1", "20", "200", "0.001", "1.5")
WRONG_AMOUNTS = ("0", "-1", "nan", "inf", "1e308", "1e-320", "1e160", "", "1e400", "-0")
TIMES = ("0.001s", "0.2s", "30s", "10min", "2h")
WRONG_TIMES = ("", "0s", "-1s", "30", "nans", "1e9s", "1 day", "999999999h", "0.0000000001s", "٣s")
UNITS = ("mm", "um", "m", "deg", "urad", "rad", "in", "mrad")
WRONG_UNITS = ("", "kg", "mm2", " mm", "MM", "°", "mmm", "\x1b[31m")
PATHS = (
    "out", "out.csv", "new.yaml", ".", "..", "a/b/c", "", " ", "-", "x\ny", "\udcff.csv",
    "é.yaml", "out.svg", "out.png", "out.pdf", "n" * 300, "run", "data.csv", "robot.yaml", "~",
    "plan", "=1.csv", "\x1b[31m.yaml", "con.", "#1.yaml",
)  # fmt: skip
"""Names of files and folders. All are relative: an input writes nothing outside of its folder."""


def list_commands() -> dict[str, click.Command]:
    """Return every command by name, but for those of groups, which have a corpus of their own, and
    for `app`, which serves until it is stopped.
    """
    names = [name for members in entry_point.SECTIONS.values() for name in members]
    group, context = entry_point.command_line, click.Context(entry_point.command_line)
    commands = {name: group.get_command(context, name) for name in names}
    return {
        name: command
        for name, command in commands.items()
        if name != "app" and command is not None and not isinstance(command, click.Group)
    }


def find_group_command(words: Sequence[str]) -> click.Command | None:
    """Return the command of words such as `study run`; None where they name none of a group."""
    if not words or (group := find_command(words[0])) is None:
        return None
    if not isinstance(group, click.Group) or len(words) < 2:
        return None
    return group.get_command(click.Context(group), words[1])


def draw_options(
    command: click.Command,
    rng: Random,
    words: Sequence[str],
    files: Sequence[str],
    left_out: Container[str] = (),
) -> list[str]:
    """Return a few options of a command, with values.

    Parameters
    ----------
    words : that mean something to the machine. files : that exist. left_out : options not to draw.
    """
    options = [
        p for p in command.params if isinstance(p, click.Option) and p.opts[0] not in left_out
    ]
    if not options:
        return []
    drawn: list[str] = []
    for option in rng.choices(options, k=rng.choice([1, 1, 2, 3])):
        drawn.append(rng.choice(option.opts))
        if not option.is_flag:
            drawn.append(draw_value(option.type, rng, words, files))
    return drawn


def draw_value(
    kind: click.ParamType, rng: Random, words: Sequence[str], files: Sequence[str]
) -> str:
    """Return the text of a value for an option or argument of a type, seldom a wrong one."""
    is_wrong = rng.random() < 0.25
    if isinstance(kind, click.Choice):
        choices = [str(choice) for choice in kind.choices]
        return rng.choice(NAMES[:30]) if is_wrong else rng.choice(choices)
    if isinstance(kind, click.types.IntParamType):
        least = getattr(kind, "min", None) or 0
        return rng.choice(WRONG_COUNTS) if is_wrong else str(max(int(rng.choice(COUNTS)), least))
    if isinstance(kind, click.types.FloatParamType) or kind.name == "share":
        return rng.choice(WRONG_SHARES if is_wrong else SHARES)
    if isinstance(kind, click.Path):
        return (
            rng.choice([*PATHS, *WINDOWS_PATHS]) if is_wrong else rng.choice([*files, *PATHS[:3]])
        )
    if kind.name == "duration":
        return rng.choice(WRONG_TIMES if is_wrong else TIMES)
    if kind.name == "quantity":
        return _draw_quantity(rng, is_wrong)
    return _draw_text(rng, words, is_wrong)


def _draw_quantity(rng: Random, is_wrong: bool) -> str:
    if not is_wrong:
        return rng.choice(AMOUNTS) + rng.choice(UNITS)
    return rng.choice(
        [
            rng.choice(WRONG_AMOUNTS) + rng.choice(UNITS),
            rng.choice(AMOUNTS) + rng.choice(WRONG_UNITS),
        ]
    )


def _draw_text(rng: Random, words: Sequence[str], is_wrong: bool) -> str:
    if is_wrong:
        return rng.choice([n for n in NAMES if "\0" not in n])
    drawn = rng.choices([*words, *KNOWN], k=rng.choice([1, 1, 1, 2, 3]))
    return ",".join(drawn)


KNOWN = (
    "pose", "position", "component", "plane", "plane-line", "x", "z", "rx", "quaternion",
    "euler-ZYX", "tilt-torsion", "base", "tool", "base,tool", "0,0,1", "1.5m,-0.8m,0.6m",
    "0m,0m,0m", "fitted", "relative", "all", "5um", "*", "pose:1", "gough", "limbs",
    "linear-delta", "nan,0,0", "robot.yaml", "run", "truth.yaml",
)  # fmt: skip
"""Words of which text options expect some."""


def name_command(words: Sequence[str], commands: Container[str]) -> str:
    """Return the name of the command of a command line; "(none)" where there is none."""
    if words and words[0] in commands:
        return words[0]
    return "(none)" if find_group_command(words) is None else " ".join(words[:2])


def describe(words: Sequence[str], commands: dict[str, click.Command]) -> list[str]:
    """Return the options of a command line, as `command --option`."""
    command = (commands.get(words[0]) or find_group_command(words)) if words else None
    known = (
        {opt for p in command.params for opt in (*p.opts, *p.secondary_opts)}
        if command
        else set[Any]()
    )
    name = name_command(words, commands)
    return sorted({f"{name} {word}" for word in words[1:] if word in known and word[0] == "-"})
