# SPDX-License-Identifier: Apache-2.0
"""Which changes to a study keep its finished blocks valid, and which do not."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

from loopcal.studies.specification.levels import FACTORS

FREE = frozenset({"title", "order", "questions"})
"""Keys that change no number."""

LONGEST = 40
"""Characters of a value that is shown."""


def list_conflicts(old: str, new: str) -> tuple[str, ...]:
    """Return the changes by which finished blocks of a study would not belong to it any more.

    More replicates, further levels, and another title, order or question are none.

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
                    yield from _compare_values(f"{key}/{level}", before[level], after[level])
        else:
            yield from _compare_values(key, before, after)


def _compare_values(path: str, old: Any, new: Any) -> Iterator[str]:
    """Yield the differences of two values, with their places."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in dict.fromkeys((*old, *new)):
            yield from _compare_values(f"{path}/{key}", old.get(key), new.get(key))
    elif old != new:
        texts = [json.dumps(value, ensure_ascii=False) for value in (old, new)]
        is_short = all(len(text) <= LONGEST for text in texts)
        yield f"{path}: {texts[0]} -> {texts[1]}" if is_short else f"{path}: changed"
