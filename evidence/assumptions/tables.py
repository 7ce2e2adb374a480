# SPDX-License-Identifier: Apache-2.0
"""Tables of the cases: coverage, errors and explanations, false alarms; before and now."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from evidence.assumptions.cases import SETUPS, list_cases
from evidence.assumptions.evaluation import FITS, evaluate_setup, is_met
from evidence.assumptions.levels import STATED_LEVELS
from evidence.assumptions.simulation import HELD_OUT, SEED

BEFORE = Path(__file__).with_name("before.json")
"""Statistics of the same cases by the code of the commit that the file names."""

KEPT = ("fits", "parameters", "moved", "position", "orientation", "median", "rms", "explained")
"""What the tables show of the statistics before."""

SHOWN = 0.1
"""Share of fits from which an alarm is listed."""

WHEN = ("before", "now")


def collect_robot(name: str, fits: int = FITS) -> dict[str, Any]:
    """Return the document of one robot: its statistics and their tables."""
    before = json.loads(BEFORE.read_text("utf-8"))
    now = evaluate_setup(SETUPS[name], fits)
    then = before["robots"][name]
    return {
        "robot": name,
        "seed": SEED,
        "held-out poses": HELD_OUT,
        "before": before["commit"],
        "statistics": now,
        "tables": {
            "coverage": tabulate_coverage(then, now),
            "explanations": tabulate_explanations(then, now),
            "alarms": tabulate_alarms(now),
        },
    }


def tabulate_coverage(then: dict[str, Any], now: dict[str, Any]) -> dict[str, Any]:
    """Return the coverage of intervals and of expanded uncertainties of poses, before and now."""
    keys = {
        "parameters": "parameters",
        "moved": "parameters that are off",
        "position": "position U",
        "orientation": "orientation U",
    }
    rows = []
    for case in list_cases():
        row: list[Any] = [case.name, now[case.name]["fits"]]
        for key in keys:
            is_shown = key != "moved" or case.single or case.group
            row += [_percent(of[case.name][key] if is_shown else None) for of in (then, now)]
        is_good = is_met(now[case.name], case.is_clean)
        rows.append([*row, _percent(now[case.name]["worst"]), "yes" if is_good else "no"])
    columns = [f"{title} [%]: {when}" for title in keys.values() for when in WHEN]
    return {
        "columns": ["case", "fits", *columns, "worst parameter [%]: now", "met"],
        "formats": ["", "d", *[".1f"] * (len(columns) + 1), ""],
        "rows": rows,
    }


def tabulate_explanations(then: dict[str, Any], now: dict[str, Any]) -> dict[str, Any]:
    """Return errors over those of least squares and the rate of explanations, before and now, and
    the alarms now.
    """
    rows = []
    for case in list_cases():
        old, new = then[case.name], now[case.name]
        errors = [of[key] for key in ("median", "rms") for of in (old, new)]
        alarms = {c: new["codes"][c] for c in new["alarms"] if new["codes"][c] >= SHOWN}
        listed = ", ".join(f"{code} {100 * rate:.0f}" for code, rate in alarms.items())
        explained = [_percent(of["explained"]) for of in (old, new)]
        rows.append([case.name, *errors, *explained, listed or None])
    errors = [f"error / least squares, {k}: {w}" for k in ("median", "rms") for w in WHEN]
    explained = [f"explained [% of fits]: {when}" for when in WHEN]
    return {
        "columns": ["case", *errors, *explained, "alarms now [% of fits]"],
        "formats": ["", *[".2f"] * 4, *[".1f"] * 2, ""],
        "rows": rows,
    }


def tabulate_alarms(now: dict[str, Any]) -> dict[str, Any]:
    """Return how often each group of findings is an alarm where every assumption holds."""
    clean = [case.name for case in list_cases() if case.is_clean]
    groups = {group for name in clean for group in now[name]["groups"]}
    rows = []
    for group in sorted(groups | set(STATED_LEVELS)):
        rates = [_percent(now[name]["groups"].get(group, 0.0)) for name in clean]
        rows.append([group, _percent(STATED_LEVELS.get(group)), *rates])
    return {
        "columns": ["finding", "stated level [%]", *(f"{name} [% of fits]" for name in clean)],
        "formats": ["", "g", *[".2f"] * len(clean)],
        "rows": rows,
    }


def _percent(share: float | None) -> float | None:
    return None if share is None else 100.0 * share
