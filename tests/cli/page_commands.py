# SPDX-License-Identifier: Apache-2.0
"""The commands of a page of the documentation."""

from __future__ import annotations

import re
import shlex


def list_commands(page: str) -> list[list[str]]:
    """Return the words of each command in the `sh` blocks of a page, without `loopcal`."""
    blocks = re.findall(r"^```sh\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    commands = [shlex.split(line, comments=True) for block in blocks for line in block.splitlines()]
    assert commands
    assert all(words[0] == "loopcal" for words in commands)
    return [words[1:] for words in commands]
