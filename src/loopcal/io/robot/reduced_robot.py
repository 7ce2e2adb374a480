# SPDX-License-Identifier: Apache-2.0
"""A robot file with some parameters fixed: the file as it was, comments kept, and a longer `fixed:`
list.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import TYPE_CHECKING

from loopcal.errors import MechanismError
from loopcal.io.robot.identified_table import table_text
from loopcal.io.robot.robot_file import RobotSource

if TYPE_CHECKING:
    from loopcal.mechanism import Mechanism

FIXED = re.compile(r"^fixed:.*\n(?:(?:[ \t]+.*|-.*)\n)*", re.MULTILINE)
"""The list as it stands in a file, in one line or in several."""

PLAIN = re.compile(r"[A-Za-z][\w.-]*$")
"""Names that YAML reads as text without quotes."""


def format_reduced_robot(robot: Mechanism, dropped: Mapping[str, str]) -> str:
    """Return the text of a robot's file with further parameters fixed.

    Parameters
    ----------
    robot : Mechanism
        A robot that came from `load_robot`, with any values.
    dropped : name -> what to say of it
        Parameters to fix, each with a comment behind it.

    Raises
    ------
    MechanismError
        The robot did not come from a file.
    """
    source = robot.record
    if not isinstance(source, RobotSource):
        raise MechanismError(
            f"{robot.name} was not read from a robot file, so there is none to shorten; use "
            "load_robot"
        )
    entries = dict.fromkeys(source.record.fixed, "") | dict(dropped)
    if not entries:
        return source.text + table_text(robot)
    written = {name: name if PLAIN.match(name) else json.dumps(name) for name in entries}
    width = max(len(text) for text in written.values())
    lines = [
        f"  - {written[name]:<{width}}  # {words}" if words else f"  - {written[name]}"
        for name, words in entries.items()
    ]
    text = FIXED.sub("", source.text)
    text = text if text.endswith("\n") else text + "\n"
    return text + "\n".join(["fixed:", *lines]) + "\n" + table_text(robot)
