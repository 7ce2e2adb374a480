# SPDX-License-Identifier: Apache-2.0
"""A robot file to start from: a shipped robot of a family, with the keys of the family above it."""

from __future__ import annotations

import json
import re
import textwrap

from loopcal.errors import MechanismError, suggest_names
from loopcal.io.core import file_reference
from loopcal.io.core.yaml_file import read_yaml
from loopcal.io.robot.robot_file import list_shipped_robots
from loopcal.mechanism import FAMILIES

EXAMPLES = {"gough": "hexapod-42", "limbs": "five-bar"}
"""The shipped robot of a family that does not have the name of the family."""

WIDTH = 120

PLAIN = re.compile(r"(?!(?:true|false|null)$)[A-Za-z][\w.-]*$")
"""Names that YAML reads as text without quotes."""


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
    new = {"name": name if PLAIN.match(name) else json.dumps(name)}
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
