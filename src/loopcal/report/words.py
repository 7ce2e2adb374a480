# SPDX-License-Identifier: Apache-2.0
"""The sentences of pages, documents and figures: templates of `words.toml`."""

from __future__ import annotations

import tomllib
from functools import cache
from pathlib import Path
from typing import Any

from loopcal.findings.wording import fill_template


@cache
def _load() -> dict[str, dict[str, str]]:
    return tomllib.loads(Path(__file__).with_name("words.toml").read_text("utf-8"))


def say(name: str, /, **data: Any) -> str:
    """Return a sentence, such as `say("summary.rule", rule=...)`, filled with data."""
    table, _, key = name.rpartition(".")
    return fill_template(_load()[table][key].strip().replace("\n", " "), **data)
