# SPDX-License-Identifier: Apache-2.0
"""A robot file with some parameters fixed: the same file, comments kept, with a longer `fixed:`."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping

from loopcal.io.robot.identified_table import format_table
from loopcal.io.robot.robot_file import get_source
from loopcal.mechanism import Mechanism

FIXED = re.compile(r"^fixed:.*\n(?:(?:[ \t]+.*|-.*)\n)*", re.MULTILINE)
"""The list in a file, in one line or in several."""

PLAIN = re.compile(r"[A-Za-z][\w.-]*$")
"""Names that YAML reads as text without quotes."""


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
        return source.text + format_table(robot)
    names = {name: name if PLAIN.match(name) else json.dumps(name) for name in entries}
    width = max(len(text) for text in names.values())
    lines = [
        f"  - {names[name]:<{width}}  # {comment}" if comment else f"  - {names[name]}"
        for name, comment in entries.items()
    ]
    text = FIXED.sub("", source.text)
    text = text if text.endswith("\n") else text + "\n"
    return text + "\n".join(["fixed:", *lines]) + "\n" + format_table(robot)
