# SPDX-License-Identifier: Apache-2.0
"""Robot files made from others: a new robot of a family, and a robot with more parameters fixed."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Mapping
from pathlib import Path

from loopcal.errors import MechanismError, suggest_names
from loopcal.io.core import file_reference
from loopcal.io.core.text_file import write_text
from loopcal.io.core.yaml_file import read_yaml
from loopcal.io.core.yaml_text import add_key, quote_scalar, remove_key
from loopcal.io.robot.identified_table import add_table
from loopcal.io.robot.robot_file import format_robot, get_source, list_shipped_robots
from loopcal.mechanism import FAMILIES, Mechanism

EXAMPLES = {"gough": "hexapod-42", "limbs": "five-bar", "stages": "arm-6r"}
"""The shipped robot of a family that does not have the name of the family."""

WIDTH = 120


def format_new_robot(family: str, name: str) -> str:
    """Return the text of a robot file of a valid robot, in which the user replaces the numbers.

    Parameters
    ----------
    family : a family, or the name of a shipped robot to start from. name : of the new robot.

    Raises
    ------
    MechanismError : neither a family nor a shipped robot.
    """
    shipped = list_shipped_robots()
    example = EXAMPLES.get(family, family)
    if example not in shipped:
        known = list(dict.fromkeys([*FAMILIES, *shipped]))
        sentence = (
            f"{family!r} is neither a family nor a shipped robot{suggest_names(family, known)}"
        )
        raise MechanismError(f"{sentence}; allowed: {', '.join(known)}")
    text = shipped[example].read_text("utf-8")
    record = str(read_yaml(shipped[example], "robot file").content["family"])
    new = {"name": quote_scalar(name)}
    new["source"] = "where these numbers come from"
    for key, value in new.items():
        line = f"{key}: {value}"
        text = re.sub(rf"^{key}: .*$", lambda _, line=line: line, text, count=1, flags=re.MULTILINE)
    lines = [
        f"# A new robot of the family {record}, with the numbers of the shipped robot {example}.",
        "# Replace them by your own.",
        "#",
        f"# Keys of this family (docs/files.md; `loopcal check {name}.yaml` shows how it is read):",
    ]
    for key in file_reference.list_keys(FAMILIES[record]):
        default = f", default {key.default}" if key.default not in ("", "needed") else ""
        meaning = f"; {key.meaning}" if key.meaning else ""
        entry = f"{key.name}: {key.holds}{default}{meaning}"
        lines += textwrap.wrap(entry, WIDTH, initial_indent="#   ", subsequent_indent="#     ")
    body = text.split("\n")
    first = next(i for i, line in enumerate(body) if not line.startswith("#"))
    return "\n".join([*lines, "", *body[first:]])


def save_reduced_robot(robot: Mechanism, dropped: Mapping[str, str], path: str | Path) -> None:
    """Write a robot's file with further parameters fixed; arguments as `format_reduced_robot`.

    Raises
    ------
    FileError : the file cannot be written. MechanismError : as `format_reduced_robot`.
    """
    write_text(path, format_reduced_robot(robot, dropped))


def format_reduced_robot(robot: Mechanism, dropped: Mapping[str, str]) -> str:
    """Return the text of a robot's file with further parameters fixed.

    Parameters
    ----------
    robot : from `load_robot`, with any values.
    dropped : parameter to fix -> comment that is written after it.

    Raises
    ------
    MechanismError : the robot was not loaded from a file.
    """
    source = get_source(robot)
    entries = dict.fromkeys(source.record.fixed, "") | dict(dropped)
    if not entries:
        return format_robot(robot)
    names = {name: quote_scalar(name) for name in entries}
    width = max(len(text) for text in names.values())
    lines = [
        f"  - {names[name]:<{width}}  # {comment}" if comment else f"  - {names[name]}"
        for name, comment in entries.items()
    ]
    file = add_key(remove_key(source.nominal_file, "fixed"), "\n".join(["fixed:", *lines]) + "\n")
    return add_table(file, robot).text
