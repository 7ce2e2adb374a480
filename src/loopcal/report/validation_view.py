# SPDX-License-Identifier: Apache-2.0
"""Validation as people read it: the errors with the noise floor, and all statistics."""

from __future__ import annotations

from loopcal.apply import Validation
from loopcal.findings import Severity
from loopcal.report.numbers import ROUNDING, format_number
from loopcal.report.tables import Column, Table, word_column
from loopcal.report.text_page import Block, format_list

SIMILAR = 5e-3
"""Relative difference up to which two errors are called equal."""


def build_error_summary(validation: Validation, caption: str, with_before: bool = True) -> Table:
    """Return the rms errors before and after calibration beside the noise floor.

    Where several kinds of measurement are mixed, the errors are divided by sigma and the noise
    floor is 1.
    """
    before = (Column("before"),) if with_before else ()
    numbers = (*before, Column("after" if with_before else "error"), Column("noise floor"))
    columns = (word_column("error"), *numbers, word_column("unit"))
    rows = []
    if validation.has_several_kinds:
        for kind in validation.kinds:
            name = "all kinds" if kind.kind == "all" else kind.kind
            rows.append((name, (kind.before, kind.after, 1.0), "sigma"))
    else:
        for quantity in validation.quantities:
            unit = validation.units[quantity]
            values = (
                validation.before.statistics(quantity).rms / unit.factor_to_si,
                validation.after.statistics(quantity).rms / unit.factor_to_si,
                getattr(validation.noise_floor, quantity) / unit.factor_to_si,
            )
            rows.append((quantity, values, unit.symbol))
    cells = tuple(
        (name, *(format_number(x, 3) for x in values[0 if with_before else 1 :]), unit)
        for name, values, unit in rows
    )
    return Table(caption, columns, cells)


def _build_error_statistics(validation: Validation, with_before: bool) -> Table:
    """Return maximum, rms, mean and standard deviation of every error.

    Errors after commanding are left out where they equal the prediction errors, because the
    actuators can correct everything.
    """
    errors = validation.errors()
    if is_fully_compensable(validation):
        errors = {name: e for name, e in errors.items() if name.startswith("predicted")}
    if not with_before:
        errors = {"predicted": validation.after}
    rows = []
    for name, error in errors.items():
        for quantity in validation.quantities:
            statistics, unit = error.statistics(quantity), validation.units[quantity]
            numbers = (statistics.max, statistics.rms, statistics.mean, statistics.sd)
            cells = (format_number(x / unit.factor_to_si, 3) for x in numbers)
            rows.append((name, quantity, str(statistics.count), *cells, unit.symbol))
    numeric = (Column(title) for title in ("rows", "max", "rms", "mean", "sd"))
    columns = (word_column("error"), word_column("of"), *numeric, word_column("unit"))
    return Table("Error statistics", columns, tuple(rows))


def view_error_statistics(validation: Validation, with_before: bool = True) -> list[Block]:
    """Return all statistics of the errors, and whether actuators can correct these."""
    blocks: list[Block] = [_build_error_statistics(validation, with_before)]
    if with_before and is_fully_compensable(validation):
        blocks.append("The actuators can correct all of the measured error.")
    return blocks


def is_fully_compensable(validation: Validation) -> bool:
    """Return whether the actuators can correct all of the measured error."""
    errors = validation.not_compensable
    return all(
        errors.statistics(quantity).max / validation.units[quantity].factor_to_si < ROUNDING
        for quantity in validation.quantities
    )


def describe_improvements(validation: Validation) -> list[str]:
    """Return how much each error changed by calibration, as lines."""
    lines = []
    for quantity, smaller in validation.improvements().items():
        name = "Error divided by sigma" if quantity == "weighted" else f"{quantity} error"
        lines.append(f"{name[0].upper()}{name[1:]} (rms): {_compare(smaller)}.")
    return lines


def view_validation(validation: Validation, with_before: bool, verbose: bool) -> list[Block]:
    """Return the page of a validation.

    Parameters
    ----------
    with_before : whether there is a geometry before calibration to compare with.
    """
    n = len(validation.poses)
    caption = f"Error on {n} measured {'row' if n == 1 else 'rows'} (rms)"
    blocks: list[Block] = [build_error_summary(validation, caption, with_before)]
    if with_before:
        blocks += describe_improvements(validation)
    notes = [f for f in validation.findings if f.severity is not Severity.FAILURE]
    if notes:
        blocks += ["", *format_list([(f.severity.value, str(f)) for f in notes])]
    if verbose:
        blocks += view_error_statistics(validation, with_before)
    return blocks


def _compare(smaller: float) -> str:
    """Return in words how many times smaller an error became."""
    if abs(smaller - 1.0) < SIMILAR:
        return "the same before and after calibration"
    if smaller > 1.0:
        return f"{smaller:.3g} times smaller after calibration"
    if smaller > 0.0:
        return f"{1.0 / smaller:.3g} times larger after calibration"
    return "larger after calibration"
