# SPDX-License-Identifier: Apache-2.0
"""Random inputs: damaged files of every kind and options of every command (tools/fuzz).

The seeds begin at SEED, beyond those of `make test` and of the longest run of `make fuzz`.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from tools.fuzz.campaign import Summary, run_campaign
from tools.fuzz.cases import Maker
from tools.fuzz.corpus import build_corpus
from tools.fuzz.study_corpus import build_study_corpus

INPUTS, SEED = 5000, 1_000_001
LONG_RUN = Path(__file__).with_name("random_inputs_longest.json")
"""Counts of the longest run of `make fuzz`, with the seeds."""


QUICK = {"INPUTS": 60}


def check(tables: dict[str, Any]) -> None:
    """Assert what holds at the quick size."""
    assert all(row[1] == 0 for row in tables["counts"]["rows"][4:-1])


def collect() -> dict[str, Any]:
    """Return the counts of this run, and the tables of these and of the longest one."""
    summary = Summary()
    maker = Maker([*build_corpus(), *build_study_corpus()])
    run_campaign(maker, iter(range(SEED, SEED + INPUTS)), 1, summary, _ignore)
    counts = summary.to_json()
    return {"counts": counts, "finds": counts["finds"], "tables": make_tables(counts)}


def make_tables(counts: dict[str, Any]) -> dict[str, Any]:
    """Return the tables of the counts of a run beside those of the longest run."""
    long = json.loads(LONG_RUN.read_text("utf-8"))
    damage, long_damage = (_by_file(c["damage"]) for c in (counts, long))
    return {
        "counts": _table_counts(counts, long),
        "commands": _table(counts["commands"], long["commands"], "command"),
        "damage": _table(damage, long_damage, "what is damaged"),
    }


def _ignore(_answer: dict[str, Any], _new: list[dict[str, str]]) -> None:
    """Take no notice of single answers."""


def _by_file(damage: dict[str, int]) -> dict[str, int]:
    """Return the counts of damages by kind of file."""
    counts: dict[str, int] = {}
    for name, count in damage.items():
        kind = name.partition(": ")[0]
        counts[kind] = counts.get(kind, 0) + count
    return counts


def _table(counts: dict[str, int], long: dict[str, int], first: str) -> dict[str, Any]:
    """Return a table of two counts, the most frequent in the long run on top."""
    names = sorted({*counts, *long}, key=lambda name: (-long.get(name, 0), name))
    return {
        "columns": [first, "inputs in `make evidence`", "inputs in the longest run"],
        "formats": ["", "d", "d"],
        "rows": [[name, counts.get(name, 0), long.get(name, 0)] for name in names],
    }


def _table_counts(counts: dict[str, Any], long: dict[str, Any]) -> dict[str, Any]:
    """Return what came of the inputs, in numbers."""
    codes = ("0", "1", "2")
    rules = {
        "inputs": lambda c: c["inputs"],
        "answered (exit code 0)": lambda c: c["exit_codes"].get("0", 0),
        "refused in a sentence (1)": lambda c: c["exit_codes"].get("1", 0),
        "quality gate not met (2)": lambda c: c["exit_codes"].get("2", 0),
        "any other end": lambda c: c["inputs"] - sum(c["exit_codes"].get(k, 0) for k in codes),
        "tracebacks": lambda c: _count(c, ("traceback", "defect-message", "died")),
        "more than ten seconds of processor time": lambda c: _count(c, ("slow",), "TimeIsUp"),
        "success with a number that is not finite": lambda c: _count(c, ("non-finite",)),
        "output that loopcal cannot read": lambda c: _count(c, ("unreadable", "missing-output")),
        "file left, changed or deleted by a command that failed": lambda c: _count(
            c, ("left-output", "changed-file", "deleted-file")
        ),
        "write outside of the folder": lambda c: _count(c, ("escape",)),
        "warning of Python, or message of another form": lambda c: _count(
            c, ("warning", "message-form", "no-message", "control-character", "internal-words")
        ),
        "refused without the name of a file, an option or a word of the input": lambda c: _count(
            c, ("no-name",)
        ),
        "changed by files or variables of other programs": lambda c: _count(c, ("surroundings",)),
        "processor time per input [ms]": lambda c: round(1e3 * c["cpu_seconds"] / c["inputs"]),
    }
    rows = [[name, rule(counts), rule(long)] for name, rule in rules.items()]
    return {
        "columns": ["", "`make evidence`", "longest run"],
        "formats": ["", "d", "d"],
        "rows": rows,
    }


def _count(counts: dict[str, Any], rules: tuple[str, ...], word: str | None = None) -> int:
    """Return how many inputs broke one of some rules, or have a find with a word."""
    return sum(
        find["count"]
        for signature, find in counts["finds"].items()
        if (word is not None and word in signature)
        or (signature.partition(":")[0] in rules and "TimeIsUp" not in signature)
    )
