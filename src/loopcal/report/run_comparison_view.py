# SPDX-License-Identifier: Apache-2.0
"""Several calibrations side by side: findings, parameters, shifts, and errors at the same poses."""

from __future__ import annotations

import math
from collections.abc import Callable

from loopcal.apply import RunComparison
from loopcal.apply.run_comparison import PairComparison, QuantityErrors, RunSummary
from loopcal.findings.importance import sort_by_importance
from loopcal.report.numbers import (
    ABSENT,
    format_number,
    format_uncertainty,
    format_with_uncertainty,
)
from loopcal.report.tables import Column, Table, word_column
from loopcal.report.text_page import Block, format_list
from loopcal.units import Unit, find_unit

FIXED = "fixed"
"""Cell of a parameter that a run did not identify."""

MEANING = (
    "Shifts from {first}, with all other parameters free to have changed as well. They follow from "
    "the data alone; estimates are also drawn to nominal by the tolerances. A shift is significant "
    "(*) at 5 % for all parameters and runs together. A dash: the data of both runs do not "
    "determine it, or the runs are not tested."
)


def view_comparison(comparison: RunComparison, show_unit: Callable[[str], Unit]) -> list[Block]:
    """Return the page of a comparison.

    Parameters
    ----------
    show_unit : quantity ("position", ...) -> the unit of its errors.
    """
    findings = [(f.severity.value, str(f)) for f in sort_by_importance(comparison.findings)]
    names = ", ".join(run.name for run in comparison.runs)
    blocks: list[Block] = [f"Comparison of {names}.", "", *format_list(findings), ""]
    runs = [(run.name, _describe_run(run)) for run in comparison.runs]
    blocks += [*format_list(runs), "", build_estimates(comparison), ""]
    if any(pair.moved is not None for pair in comparison.pairs):
        blocks += [build_shifts(comparison), ""]
    return [*blocks, build_errors(comparison, show_unit)]


def _describe_run(run: RunSummary) -> str:
    """Return the robot of a run, its verdict and its method."""
    return f"{run.robot}: {run.verdict}, {run.method.partition('(')[0]}"


def build_runs(comparison: RunComparison) -> Table:
    """Return robot, verdict and method of each run."""
    columns = tuple(word_column(title, wraps=True) for title in ("run", "robot, verdict, method"))
    rows = tuple((run.name, _describe_run(run)) for run in comparison.runs)
    return Table("The compared runs", columns, rows)


def build_estimates(comparison: RunComparison) -> Table:
    """Return the estimates of each run with their 95 % intervals."""
    columns = [word_column("parameter")]
    for run in comparison.runs:
        columns += [Column(run.name), Column("+/-")]
    rows = []
    for name, unit in zip(comparison.parameters, comparison.units, strict=True):
        cells = [name]
        for run in comparison.runs:
            cells += _format_estimate(run.estimates.get(name), run.plus_minus.get(name), unit)
        rows.append((*cells, unit.symbol))
    caption = "Estimates and half-widths of their 95 % intervals"
    return Table(caption, (*columns, word_column("unit")), tuple(rows))


def build_shifts(comparison: RunComparison) -> Table:
    """Return the change of each parameter from the first run, also in standard deviations."""
    columns = [word_column("parameter")]
    for pair in comparison.pairs:
        columns += [Column(pair.second), Column("in sd")]
    rows = []
    for name, unit in zip(comparison.parameters, comparison.units, strict=True):
        cells = [name]
        for pair in comparison.pairs:
            shift, sd, is_significant = find_shift(pair, name)
            if not math.isfinite(sd):
                cells += [ABSENT, ABSENT]
                continue
            factor = unit.factor_to_si
            mark = "*" if is_significant else " "
            cells.append(format_with_uncertainty(shift / factor, sd / factor))
            cells.append(f"{shift / sd:.1f}{mark}")
        rows.append((*cells, unit.symbol))
    caption = MEANING.format(first=comparison.runs[0].name)
    return Table(caption, (*columns, word_column("unit")), tuple(rows))


def build_errors(comparison: RunComparison, show_unit: Callable[[str], Unit]) -> Table:
    """Return the errors after calibration of each run: at common held-out poses, or at its own."""
    has_common = comparison.common_poses > 0
    rows = []
    for run_errors in comparison.errors:
        errors = run_errors.common if has_common else run_errors.own
        for quantity, error in errors.items():
            rows.append((run_errors.run, quantity, *_format_errors(error, show_unit(quantity))))
        if not errors:
            rows.append((run_errors.run, ABSENT, ABSENT, ABSENT, ABSENT, ""))
    caption = (
        f"Errors after calibration at {comparison.common_poses} poses that are common to all runs"
        if has_common
        else "Errors after calibration at the held-out poses of each run, which are different poses"
    )
    numbers = (Column("count"), Column("rms"), Column("largest"))
    words = (word_column("run"), word_column("quantity"))
    return Table(caption, (*words, *numbers, word_column("unit")), tuple(rows))


def tabulate_comparison(comparison: RunComparison) -> Table:
    """Return one row for each run and parameter, to be written as CSV."""
    rows = []
    pairs = {pair.second: pair for pair in comparison.pairs}
    for run in comparison.runs:
        pair = pairs.get(run.name)
        for name, unit in zip(comparison.parameters, comparison.units, strict=True):
            shift, sd, is_significant = find_shift(pair, name)
            numbers = (run.estimates.get(name), run.plus_minus.get(name), shift, sd)
            cells = (_write(value, unit) for value in numbers)
            is_tested = math.isfinite(sd)
            ratio = f"{shift / sd:.4g}" if is_tested else ""
            tested = ("yes" if is_significant else "no") if is_tested else ""
            rows.append((run.name, name, unit.symbol, *cells, ratio, tested))
    titles = ("run", "parameter", "unit", "estimate", "plus_minus", "shift", "shift_sd")
    columns = tuple(word_column(title) for title in (*titles, "shift_in_sd", "significant"))
    return Table("", columns, tuple(rows))


def find_error_units(comparison: RunComparison) -> dict[str, Unit]:
    """Return the unit of each quantity of errors: that in which the parameters are shown."""
    symbols = {unit.dimension: unit for unit in comparison.units}
    angle, length = find_unit("deg"), find_unit("mm")
    lengths = symbols.get(length.dimension, length)
    angles = symbols.get(angle.dimension, angle)
    return {"position": lengths, "length": lengths, "orientation": angles}


def find_shift(pair: PairComparison | None, name: str) -> tuple[float, float, bool]:
    """Return the shift of a parameter, its standard deviation [SI], and whether it is significant;
    NaN where it is not tested.
    """
    if pair is None or name not in pair.names:
        return math.nan, math.nan, False
    place = pair.names.index(name)
    values = pair.shift[place], pair.shift_sd[place]
    return float(values[0]), float(values[1]), bool(pair.significant[place])


def _format_estimate(value: float | None, half: float | None, unit: Unit) -> tuple[str, str]:
    """Return the cells of an estimate and of its interval."""
    if value is None:
        return FIXED, ABSENT
    shown = value / unit.factor_to_si
    if half is None:
        return format_number(shown, 9), "unknown"
    half /= unit.factor_to_si
    return format_with_uncertainty(shown, half), format_uncertainty(half)


def _format_errors(error: QuantityErrors, unit: Unit) -> tuple[str, str, str, str]:
    """Return the cells of errors."""
    rms, largest = (format_number(x / unit.factor_to_si, 3) for x in (error.rms, error.largest))
    return str(error.count), rms, largest, unit.symbol


def _write(value: float | None, unit: Unit) -> str:
    """Return a number for a file; nothing where there is none."""
    if value is None or not math.isfinite(value):
        return ""
    return f"{value / unit.factor_to_si:.10g}"
