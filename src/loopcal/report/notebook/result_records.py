# SPDX-License-Identifier: Apache-2.0
"""The numbers of setup parameters, repeatability, uncertainty budgets and compared runs."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from loopcal.apply import ErrorBudget, RunComparison
from loopcal.apply.repeatability_result import DIMENSIONS, Repeatability
from loopcal.estimate.nuisance.estimate import NuisanceEstimate
from loopcal.report.budget_view import name_source
from loopcal.report.notebook.records import (
    OTHER,
    Records,
    Variable,
    collect_records,
    number_from_one,
)
from loopcal.report.run_comparison_view import find_shift
from loopcal.units import SI_SYMBOLS

PARAMETER, SOURCE, ROW = "parameter", "source", "row"


@collect_records.register
def collect_nuisance(result: NuisanceEstimate) -> Records:
    """Return setup parameters in the units in which they are shown."""
    factor = np.array([factor for factor, _ in result.display])
    nominal = np.array([entry.nominal for entry in result.table.entries])
    columns = {"nominal": nominal, "estimate": result.estimate, "sd": result.sd}
    units = np.array([symbol for _, symbol in result.display], dtype=str)
    return Records(
        PARAMETER,
        (
            Variable("unit", (PARAMETER,), units),
            *(Variable(name, (PARAMETER,), values / factor) for name, values in columns.items()),
        ),
        {PARAMETER: result.names},
    )


@collect_records.register
def collect_repeatability(result: Repeatability) -> Records:
    """Return AP and RP with their intervals, one row for each pose and component [SI]."""
    words: dict[str, list[str]] = {}
    numbers: dict[str, list[float]] = {}
    for quantity, poses in result.poses.items():
        for pose in poses:
            rows = list(zip(pose.components, pose.accuracies, pose.repeatabilities, strict=True))
            if pose.accuracy is not None and pose.repeatability is not None:
                rows.insert(0, ("all", pose.accuracy, pose.repeatability))
            for component, accuracy, repeatability in rows:
                named = {"pose": pose.pose, "target": pose.target, "direction": pose.direction}
                named |= {"quantity": quantity, "component": component}
                named["unit"] = SI_SYMBOLS[DIMENSIONS[quantity]]
                for key, word in named.items():
                    words.setdefault(key, []).append(word)
                for key, estimate in (("AP", accuracy), ("RP", repeatability)):
                    for part, value in zip(("", "_low", "_high"), estimate, strict=True):
                        numbers.setdefault(f"{key}{part}", []).append(value)
                numbers.setdefault("visits", []).append(pose.visits)
    row = (ROW,)
    return Records(
        ROW,
        (
            *(Variable(key, row, np.array(values, dtype=str)) for key, values in words.items()),
            *(Variable(key, row, np.array(values)) for key, values in numbers.items()),
        ),
        {ROW: number_from_one(len(words.get("pose", ())))},
    )


@collect_records.register
def collect_budget(result: ErrorBudget) -> Records:
    """Return the part of each source as standard uncertainties (k = 1), and what is left with half
    its sigma [SI].
    """
    lines, source = result.lines, (SOURCE,)
    names = [name_source(line.source.kind, line.source.name) for line in lines]
    halved = [(math.nan, math.nan) if line.halved is None else line.halved[:2] for line in lines]
    variances = np.array([line.parameters for line in lines]).reshape(len(lines), len(result.names))
    table = (
        ("position", [math.sqrt(line.position) for line in lines], "m"),
        ("orientation", [math.sqrt(line.orientation) for line in lines], "rad"),
        ("position_if_halved", [left[0] for left in halved], "m"),
        ("orientation_if_halved", [left[1] for left in halved], "rad"),
    )
    return Records(
        SOURCE,
        (
            Variable("type", source, np.array([line.source.evaluation for line in lines], str)),
            Variable("degrees", source, np.array([line.source.degrees for line in lines]), "1"),
            *(Variable(name, source, np.array(values), unit) for name, values, unit in table),
            Variable("parameter_variance", (SOURCE, OTHER), variances, "square of the SI unit"),
        ),
        {SOURCE: names, OTHER: result.names},
    )


@collect_records.register
def collect_runs(result: RunComparison) -> Records:
    """Return the estimates of each run, and their shifts from the first run, in shown units."""
    factor = np.array([unit.factor_to_si for unit in result.units])
    words = np.array([unit.symbol for unit in result.units], dtype=str)
    variables = [Variable("unit", (PARAMETER,), words)]

    def add(name: str, values: list[Any]) -> None:
        numbers = np.array([math.nan if v is None else v for v in values], dtype=float)
        variables.append(Variable(name, (PARAMETER,), numbers / factor))

    for run in result.runs:
        add(f"{run.name} estimate", [run.estimates.get(name) for name in result.parameters])
        add(f"{run.name} plus_minus", [run.plus_minus.get(name) for name in result.parameters])
    for pair in result.pairs:
        shifts = [find_shift(pair, name) for name in result.parameters]
        add(f"{pair.second} shift", [shift for shift, _, _ in shifts])
        add(f"{pair.second} shift_sd", [sd for _, sd, _ in shifts])
        significant = np.array([flag for _, _, flag in shifts])
        variables.append(Variable(f"{pair.second} significant", (PARAMETER,), significant))
    return Records(PARAMETER, tuple(variables), {PARAMETER: result.parameters})
