# SPDX-License-Identifier: Apache-2.0
"""The uncertainty budget of a calibration on one screen."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from loopcal.mechanism import Mechanism
from loopcal.report.numbers import ABSENT, format_in, format_number, units_of
from loopcal.report.tables import Column, Table, build_table, word_column
from loopcal.report.text_page import Block
from loopcal.units import Dimension, find_unit

WORDS = {
    "instrument": "instrument: {name}",
    "readings": "actuator readings",
    "setup": "setup parameters",
    "tolerances": "tolerances",
    "earlier calibration": "earlier calibration",
    "repeatability": "repeatability in use",
    "residuals.model-discrepancy": "model discrepancy: {name}",
    "residuals.correlated": "correlated errors",
    "residuals.drift": "drift",
    "residuals.trend": "trend",
    "residuals.sessions-differ": "differences of sessions",
    "residuals.depend-on-temperature": "temperature",
    "residuals.depend-on-reading": "dependence on a reading",
    "prior.inflation": "factor on the tolerances",
}
"""Kind of a source -> words; others are codes of findings that added a covariance."""

MEANING = (
    "Standard uncertainties (k = 1): root mean square over {poses} {over}, tool point, and the "
    "parameter that is known worst in tolerances. Their squares add up. Setup parameters: what not "
    "knowing them adds to an instrument with a known setup. Type A: evaluated by statistics; type "
    "B: stated. Halved: what remains with half the sigma of this source, all weights changed."
)


def view_budget(budget: Mapping[str, Any], robot: Mechanism) -> list[Block]:
    """Return the page of a budget.

    Parameters
    ----------
    budget : `ErrorBudget.to_dict()`, or `expected_error` of a run. robot : for its units.
    """
    return [str(budget["finding"]["text"]), "", build_budget_table(budget, robot)]


def build_budget_table(budget: Mapping[str, Any], robot: Mechanism) -> Table:
    """Return one line for each source of errors, and their sum; without orientation where the
    platform does not rotate.
    """
    length, angle = (units_of(robot)[d] for d in (Dimension.LENGTH, Dimension.ANGLE))
    worst = budget["worst_parameter"]
    table = robot.parameters
    dimension = table.entries[table.index(worst)].dimension if worst else Dimension.LENGTH
    unit = find_unit(robot.get_unit(dimension).symbol)
    lines = [*budget["sources"], _add(budget)]
    rows = [_list_row(line, worst, (length, angle, unit)) for line in lines]
    over = "poses of the workspace" if budget["over"] == "workspace" else "measured poses"
    titles = [("position", length.symbol), ("orientation", angle.symbol)]
    if worst:
        titles.append((worst, unit.symbol))
    columns = [word_column("source"), word_column("type"), Column("degrees of freedom")]
    columns += [Column(title, symbol) for title, symbol in titles]
    columns += [Column(f"halved: {title}", symbol) for title, symbol in titles]
    orientations = (4, 4 + len(titles)) if budget["orientation"]["rms"] == 0.0 else ()
    shown = [(i, column) for i, column in enumerate(columns) if i not in orientations]
    return build_table(
        MEANING.format(poses=budget["poses"], over=over),
        rows,
        *((column, lambda row, i=i: row[i]) for i, column in shown),
    )


def build_share_table(budget: Mapping[str, Any]) -> Table:
    """Return the share of each source in the variance of poses."""
    kinds = ("position",) if budget["orientation"]["rms"] == 0.0 else ("position", "orientation")
    totals = [sum(line[kind] or 0.0 for line in budget["sources"]) for kind in kinds]
    shares: list[tuple[Column, Callable[[Mapping[str, Any]], str]]] = [
        (Column(kind, "%"), lambda line, kind=kind, total=total: _show_share(line[kind], total))
        for kind, total in zip(kinds, totals, strict=True)
    ]
    return build_table(
        "Share of each source in the variance of the expected error",
        budget["sources"],
        (word_column("source"), _name_source),
        (word_column("type"), lambda line: line["evaluation"]),
        *shares,
    )


def _show_share(variance: float | None, total: float) -> str:
    """Return a part of a variance in percent; a dash where one of them is not finite."""
    if variance is None or not math.isfinite(total) or total <= 0.0:
        return ABSENT
    share = 100.0 * variance / total
    return "below 0.1" if 0.0 < share < 0.1 else f"{share:.1f}"


def name_source(kind: str, name: str) -> str:
    """Return the words for a source of this kind and name."""
    return WORDS[kind].format(name=name) if kind in WORDS else kind


def _name_source(line: Mapping[str, Any]) -> str:
    return name_source(line["kind"], line["name"])


def _add(budget: Mapping[str, Any]) -> dict[str, Any]:
    """Return the line of the sum."""
    worst = budget["worst_parameter"]
    return {
        "kind": "all sources",
        "name": "",
        "evaluation": "",
        "degrees": None,
        "position": _square(budget["position"]["rms"]),
        "orientation": _square(budget["orientation"]["rms"]),
        "parameters": {worst: _square(budget["parameters"][worst])} if worst else {},
        "halved": None,
    }


def _list_row(line: Mapping[str, Any], worst: str, units: Sequence[Any]) -> list[str]:
    """Return the cells of a line; a dash where there is no number."""
    values = [line["position"], line["orientation"]]
    halved = line["halved"]
    left = [None, None] if halved is None else [halved["position_rms"], halved["orientation_rms"]]
    if worst:
        values.append(line["parameters"][worst])
        left.append(None if halved is None else halved["worst_parameter_sd"])
    degrees = line["degrees"]
    return [
        _name_source(line),
        line["evaluation"],
        ABSENT if degrees is None else format_number(degrees, 3),
        *(
            _show(None if v is None else math.sqrt(v), u)
            for v, u in zip(values, units, strict=False)
        ),
        *(_show(value, u) for value, u in zip(left, units, strict=False)),
    ]


def _square(value: float | None) -> float | None:
    """Return the square of a number; None where it is infinite, as in files."""
    return None if value is None else value**2


def _show(value: float | None, unit: Any) -> str:
    return ABSENT if value is None else format_in(unit, float(value), 3)
