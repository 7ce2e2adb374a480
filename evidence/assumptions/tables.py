# SPDX-License-Identifier: Apache-2.0
"""Tables of the cases: coverage, errors and explanations, false alarms."""

from __future__ import annotations

from typing import Any

from evidence.assumptions.cases import SETUPS, list_cases
from evidence.assumptions.evaluation import FITS, evaluate_setup, is_met
from evidence.assumptions.levels import STATED_LEVELS
from evidence.assumptions.simulation import HELD_OUT, SEED

SHOWN = 0.1
"""Share of fits from which an alarm is listed."""


def collect_robot(name: str, fits: int = FITS) -> dict[str, Any]:
    """Return the document of one robot: its statistics and their tables."""
    statistics = evaluate_setup(SETUPS[name], fits)
    return {
        "robot": name,
        "seed": SEED,
        "held-out poses": HELD_OUT,
        "statistics": statistics,
        "tables": {
            "coverage": tabulate_coverage(statistics),
            "explanations": tabulate_explanations(statistics),
            "alarms": tabulate_alarms(statistics),
        },
    }


def tabulate_coverage(statistics: dict[str, Any]) -> dict[str, Any]:
    """Return the coverage of intervals and of expanded uncertainties of poses."""
    keys = {
        "parameters": "parameters",
        "moved": "parameters that are off",
        "position": "position U",
        "orientation": "orientation U",
    }
    rows = []
    for case in list_cases():
        of = statistics[case.name]
        row: list[Any] = [case.name, of["fits"]]
        for key in keys:
            is_shown = key != "moved" or case.single or case.group
            row.append(_percent(of[key] if is_shown else None))
        is_good = is_met(of, case.is_clean)
        rows.append([*row, _percent(of["worst"]), "yes" if is_good else "no"])
    columns = [f"{title} [%]" for title in keys.values()]
    return {
        "columns": ["case", "fits", *columns, "worst parameter [%]", "met"],
        "formats": ["", "d", *[".1f"] * (len(columns) + 1), ""],
        "rows": rows,
    }


def tabulate_explanations(statistics: dict[str, Any]) -> dict[str, Any]:
    """Return errors over those of least squares, the rate of explanations and the alarms."""
    rows = []
    for case in list_cases():
        of = statistics[case.name]
        alarms = {c: of["codes"][c] for c in of["alarms"] if of["codes"][c] >= SHOWN}
        listed = ", ".join(f"{code} {100 * rate:.0f}" for code, rate in alarms.items())
        rows.append([case.name, of["median"], of["rms"], _percent(of["explained"]), listed or None])
    errors = [f"error / least squares, {k}" for k in ("median", "rms")]
    return {
        "columns": ["case", *errors, "explained [% of fits]", "alarms [% of fits]"],
        "formats": ["", ".2f", ".2f", ".1f", ""],
        "rows": rows,
    }


def tabulate_alarms(statistics: dict[str, Any]) -> dict[str, Any]:
    """Return how often each group of findings is an alarm where every assumption holds."""
    clean = [case.name for case in list_cases() if case.is_clean]
    groups = {group for name in clean for group in statistics[name]["groups"]}
    rows = []
    for group in sorted(groups | set(STATED_LEVELS)):
        rates = [_percent(statistics[name]["groups"].get(group, 0.0)) for name in clean]
        rows.append([group, _percent(STATED_LEVELS.get(group)), *rates])
    return {
        "columns": ["finding", "nominal level [%]", *(f"{name} [% of fits]" for name in clean)],
        "formats": ["", "g", *[".2f"] * len(clean)],
        "rows": rows,
    }


def _percent(share: float | None) -> float | None:
    return None if share is None else 100.0 * share
