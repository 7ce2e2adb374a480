# SPDX-License-Identifier: Apache-2.0
"""Phrases of statements on mechanisms, as those of `loopcal.findings.catalog.phrases`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from loopcal.findings.wording import list_names


def repeated_constraints(data: Mapping[str, Any]) -> str:
    """Return which limbs prevent which motions that other limbs prevent, too."""
    words = []
    for entry in data["repeated"]:
        prevented = [
            f"{'rotation about' if d['turns'] else 'translation along'} "
            + (d["name"] or "({:g}, {:g}, {:g})".format(*d["vector"]))
            for d in entry["directions"]
        ]
        others = list_names(list(entry["others"]))
        verb = "do together" if len(entry["others"]) > 1 else "does"
        words.append(f"limb {entry['limb']} prevents {list_names(prevented)}, as {others} {verb}")
    return "; ".join(words)


def joints_to_free(data: Mapping[str, Any]) -> str:
    """Return the lines to write behind joints, and the alternatives."""
    alternatives = []
    for chosen in data["proposals"]:
        places = dict.fromkeys(f"{added['limb']}.{added['joint']}" for added in chosen)
        instructions = []
        for place in places:
            lines = [a["line"] for a in chosen if f"{a['limb']}.{a['joint']}" == place]
            instructions.append(f"behind {place} write `{'` and `'.join(lines)}`")
        alternatives.append(list_names(instructions))
    return "; or ".join(alternatives)
