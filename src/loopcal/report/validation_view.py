# SPDX-License-Identifier: Apache-2.0
"""Validation as people read it: the errors with the noise floor, and all statistics."""

from __future__ import annotations

import math
from dataclasses import replace

from loopcal.apply import Validation
from loopcal.apply.validation_findings import FEW_ROWS, ErrorChange
from loopcal.findings import Severity
from loopcal.findings.wording import list_names
from loopcal.report.numbers import ROUNDING, format_number
from loopcal.report.tables import Column, Table, word_column
from loopcal.report.text_page import Block, format_list

CONFORMITY = "conformity."
"""Beginning of the codes of statements on limits, which follow the tables."""

READING_NOISE = (
    "The noise floor does not contain the noise of the actuator readings, so it is a lower bound."
)
"""Sentence for robots whose readings are uncertain."""

COMMANDED = (
    "These errors and the statements on limits compare predicted with measured poses at the same "
    "readings. The actuators cannot correct all of the measured error: with the calibrated values "
    "a controller still misses commanded poses by {errors} (rms)."
)
"""Sentence for robots whose geometric errors also move what they cannot command."""

SIMILAR = 5e-3
"""Relative difference up to which two errors are called equal."""


def build_error_summary(validation: Validation, caption: str, with_before: bool = True) -> Table:
    """Return rms and largest error of each quantity before and after, beside the noise floor."""
    floor = validation.noise_floor
    rows = []
    for quantity in validation.quantities:
        before, after = (e.statistics(quantity) for e in (validation.before, validation.after))
        name, unit = name_quantity(validation, quantity), validation.units[quantity]
        for metric, key, noise in (("rms", "rms", floor.rms), ("largest", "max", floor.max)):
            values = (getattr(before, key), getattr(after, key), noise[quantity])
            shown = (format_number(x / unit.factor_to_si, 3) for x in values)
            rows.append((name, metric, str(after.count), *shown, unit.symbol))
    return _drop_before(_build(caption, "quantity", tuple(rows)), with_before)


def build_kind_summary(
    validation: Validation, caption: str, with_before: bool = True
) -> list[Table]:
    """Return the errors of each kind divided by sigma; no table where one quantity says it all."""
    if not validation.has_several_kinds and validation.quantities:
        return []
    rows = tuple(
        (
            "all kinds" if kind.kind == "all" else kind.kind,
            "rms",
            str(kind.count),
            *(format_number(x, 3) for x in (kind.before, kind.after, kind.noise_floor)),
            "sigma",
        )
        for kind in validation.kinds
        if kind.kind != "all" or validation.has_several_kinds
    )
    return [_drop_before(_build(caption, "kind", rows), with_before)]


def name_quantity(validation: Validation, quantity: str) -> str:
    """Return the name of a quantity, with the components of a position that is measured in part."""
    measured = validation.after[quantity].measured
    is_part = quantity == "position" and len(measured) < 3
    return f"{quantity} {' '.join(measured)}" if is_part else quantity


def _build(caption: str, subject: str, rows: tuple[tuple[str, ...], ...]) -> Table:
    """Return a table of errors."""
    numbers = (Column("count"), Column("before"), Column("after"), Column("noise floor"))
    words = (word_column(subject), word_column("metric"))
    return Table(caption, (*words, *numbers, word_column("unit")), rows)


def _drop_before(table: Table, with_before: bool) -> Table:
    """Return a table without the errors before calibration, where there is no such geometry."""
    if with_before:
        return table
    place = [column.title for column in table.columns].index("before")
    columns = tuple(c for i, c in enumerate(table.columns) if i != place)
    named = tuple(replace(c, title="error") if c.title == "after" else c for c in columns)
    rows = tuple(tuple(cell for i, cell in enumerate(row) if i != place) for row in table.rows)
    return Table(table.caption, named, rows)


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
    numeric = (Column(title) for title in ("count", "largest", "rms", "mean", "sd"))
    columns = (word_column("error"), word_column("of"), *numeric, word_column("unit"))
    caption = f"Error statistics (rows x targets), {validation.frame}"
    return Table(caption, columns, tuple(rows))


def view_error_statistics(validation: Validation, with_before: bool = True) -> list[Block]:
    """Return all statistics of the errors, and whether actuators can correct these."""
    blocks: list[Block] = [_build_error_statistics(validation, with_before)]
    if with_before and is_fully_compensable(validation):
        blocks.append("The actuators can correct all of the measured error.")
    return blocks


def is_fully_compensable(validation: Validation) -> bool:
    """Return whether the actuators can correct all of the measured error."""
    errors = validation.not_compensable
    return bool(validation.quantities) and all(
        errors.statistics(quantity).max / validation.units[quantity].factor_to_si < ROUNDING
        for quantity in validation.quantities
    )


def describe_commanded(validation: Validation) -> str:
    """Return by how much commanded poses are missed after calibration, as a sentence; empty where
    the actuators can correct all of the measured error.
    """
    if not validation.quantities or is_fully_compensable(validation):
        return ""
    shown = []
    for quantity in validation.quantities:
        statistics = validation.commanded_after.statistics(quantity)
        unit = validation.units[quantity]
        if statistics.count and math.isfinite(statistics.rms):
            shown.append(f"{format_number(statistics.rms / unit.factor_to_si, 3)} {unit.symbol}")
    return COMMANDED.format(errors=" and ".join(shown)) if shown else ""


def describe_improvements(validation: Validation) -> list[str]:
    """Return how much each error changed by calibration, as lines."""
    if validation.judged < FEW_ROWS:
        return []
    lines = []
    for quantity, change in (validation.without_blunders or validation).changes().items():
        name = "error divided by sigma" if quantity == "weighted" else f"{quantity} error"
        lines.append(f"{name[0].upper()}{name[1:]} (rms): {_compare(change)}.")
    return lines


def view_errors(validation: Validation, what: str, with_before: bool = True) -> list[Block]:
    """Return the tables of errors; their captions name the rows, the count and the frame.

    Parameters
    ----------
    what : of the rows, such as "held-out". with_before : whether there is a geometry before
        calibration to compare with.
    """
    n = validation.judged
    poses = f"{n} {what} {'pose' if n == 1 else 'poses'}"
    blocks: list[Block] = []
    divided = f"Errors at {poses}, divided by sigma"
    if validation.quantities:
        caption = f"Errors at {poses}, {validation.frame}"
        blocks.append(build_error_summary(validation, caption, with_before))
        divided = "The same divided by sigma"
    blocks += build_kind_summary(validation, divided, with_before)
    if (rest := validation.without_blunders) is not None and rest.judged:
        labels = [label for blunder in validation.blunders for label in blunder.poses]
        noun = "pose" if len(labels) == 1 else "poses"
        caption = f"The same without {noun} {list_names(labels)}"
        if rest.quantities:
            blocks.append(build_error_summary(rest, caption, with_before))
        else:
            blocks += build_kind_summary(rest, caption, with_before)
    judged = [str(f) for f in validation.findings if f.code.startswith(CONFORMITY)]
    commanded = describe_commanded(validation) if with_before else ""
    return [*blocks, *judged, *([commanded] if commanded else [])]


def view_validation(validation: Validation, with_before: bool, verbose: bool) -> list[Block]:
    """Return the page of a validation.

    Parameters
    ----------
    with_before : whether there is a geometry before calibration to compare with.
    """
    blocks = view_errors(validation, "measured", with_before)
    if with_before:
        blocks += describe_improvements(validation)
    others = (f for f in validation.findings if not f.code.startswith(CONFORMITY))
    notes = [f for f in others if f.severity is not Severity.FAILURE]
    if notes:
        blocks += ["", *format_list([(f.severity.value, str(f)) for f in notes])]
    if verbose:
        blocks += view_error_statistics(validation, with_before)
    return blocks


def _compare(change: ErrorChange) -> str:
    """Return in words how much an error changed."""
    if math.isnan(change.before):  # the geometry before has no setup that fits
        return "not known before calibration"
    if math.isnan(change.after):
        return "not known after calibration"
    if change.is_noise:
        return "within the noise before and after calibration"
    if abs(change.times - 1.0) < SIMILAR:
        return "the same before and after calibration"
    if math.isinf(change.times):
        return "zero after calibration"
    if change.times > 1.0:
        return f"{change.times:.3g} times smaller after calibration"
    if change.times > 0.0:
        return f"{1.0 / change.times:.3g} times larger after calibration"
    return "larger after calibration"
