# SPDX-License-Identifier: Apache-2.0
"""Which changes to a study keep its finished blocks valid, and which do not."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

from loopcal.studies.specification.levels import FACTORS

FREE = frozenset({"title", "order", "questions"})
"""Keys that change no number."""

NAMES_OF_FILES = {"robots": "source", "poses": "file"}
"""Factor -> setting that says where a level was read; its content counts, not its name."""

LONGEST = 40
"""Characters of a value that is shown."""


def list_conflicts(old: str, new: str) -> tuple[str, ...]:
    """Return the changes by which finished blocks of a study would not belong to it any more.

    More replicates, further levels, other names of files with the same content, and another title,
    order or question are none.

    Parameters
    ----------
    old, new : studies as JSON (`Study.to_json`).

    Returns
    -------
    Texts such as `errors/wide/error_factor: 2 -> 3`; empty where the study may be continued.
    """
    return tuple(_compare(json.loads(old), json.loads(new)))


def _compare(old: dict[str, Any], new: dict[str, Any]) -> Iterator[str]:
    for key in dict.fromkeys((*old, *new)):
        before: Any = old.get(key)
        after: Any = new.get(key)
        if key in FREE:
            continue
        if key == "replicates":
            if after < before:
                yield f"replicates: {before} -> {after} (more are allowed, but not fewer)"
        elif key in FACTORS:
            for level in before:
                if level not in after:
                    yield f"{key}/{level}: removed"
                else:
                    values = (_drop_file_name(key, levels[level]) for levels in (before, after))
                    yield from _compare_values(f"{key}/{level}", *values)
        else:
            yield from _compare_values(key, before, after)


def _drop_file_name(factor: str, level: dict[str, Any]) -> dict[str, Any]:
    """Return the settings of a level without the name of the file in which they were read."""
    return {key: value for key, value in level.items() if key != NAMES_OF_FILES.get(factor)}


def _compare_values(path: str, old: Any, new: Any) -> Iterator[str]:
    """Yield the differences of two values, with their places."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in dict.fromkeys((*old, *new)):
            yield from _compare_values(f"{path}/{key}", old.get(key), new.get(key))
    elif old != new:
        texts = [json.dumps(value, ensure_ascii=False) for value in (old, new)]
        is_short = all(len(text) <= LONGEST for text in texts)
        yield f"{path}: {texts[0]} -> {texts[1]}" if is_short else f"{path}: changed"
