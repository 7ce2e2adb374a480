# SPDX-License-Identifier: Apache-2.0
"""A robot file to begin with: a shipped robot of the family under a new name, with the keys that
the family takes above it.
"""

from __future__ import annotations

import json
import re
import textwrap

from loopcal.errors import MechanismError, suggest_names
from loopcal.io.core import file_reference
from loopcal.io.core.yaml_file import read_yaml
from loopcal.io.robot.robot_file import list_shipped_robots

EXAMPLES = {"gough": "hexapod-42", "limbs": "five-bar"}
"""The shipped robot that shows a family, where it is not called like the family."""

WIDTH = 120

PLAIN = re.compile(r"(?!(?:true|false|null)$)[A-Za-z][\w.-]*$")
"""Names that YAML reads as text without quotes."""


def format_new_robot(family: str, name: str) -> str:
    """Return the text of a robot file with a robot that closes, to put one's own numbers into.

    Parameters
    ----------
    family : str
        A family, or the name of a shipped robot to begin with.
    name : str
        Of the new robot.

    Raises
    ------
    MechanismError
        Neither a family nor a shipped robot.
    """
    from loopcal.mechanism import FAMILIES

    shipped = list_shipped_robots()
    example = EXAMPLES.get(family, family)
    if example not in shipped:
        known = [*FAMILIES, *(robot for robot in shipped if robot not in FAMILIES)]
        hint = suggest_names(family, known)
        raise MechanismError(
            f"{family!r} is neither a family nor a shipped robot{hint}; known are "
            f"{', '.join(known)}"
        )
    text = shipped[example].read_text("utf-8")
    found = str(read_yaml(shipped[example], "robot file").content["family"])
    written = name if PLAIN.match(name) else json.dumps(name)
    text = re.sub(r"^name: .*$", lambda _: f"name: {written}", text, count=1, flags=re.MULTILINE)
    text = re.sub(
        r"^source: .*$", "source: where these numbers come from", text, count=1, flags=re.MULTILINE
    )
    head = [
        (
            f"A new robot of the family {found}, with the numbers of the shipped robot {example}: "
            "put "
            "in your own."
        ),
        "",
    ]
    head += [
        (
            f"Keys of this family (`loopcal check {name}.yaml` shows what was understood; "
            "docs/files.md tells more):"
        )
    ]
    lines = [f"# {line}".rstrip() for line in head]
    for key in file_reference.keys(FAMILIES[found]):
        told = f"{key.name}: {key.holds}" + (
            f", {key.default} if left out" if key.default not in ("", "needed") else ""
        )
        told += f"; {key.meaning}" if key.meaning else ""
        lines += textwrap.wrap(told, WIDTH, initial_indent="#   ", subsequent_indent="#     ")
    body = text.split("\n")
    first = next(i for i, line in enumerate(body) if not line.startswith("#"))
    return "\n".join([*lines, "", *body[first:]])
