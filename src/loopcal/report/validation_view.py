# SPDX-License-Identifier: Apache-2.0
"""Validation as people read it: the errors with the noise floor, and all statistics."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from loopcal.apply.repeatability import DIMENSIONS, Estimate, Repeatability, VisitedPose
from loopcal.apply.validation import FEW_ROWS, ErrorChange, Validation
from loopcal.diagnose.row_errors import METRICS, SUMMARY, Statistics
from loopcal.findings import Finding, Severity, sort_by_importance
from loopcal.findings.wording import list_names
from loopcal.results.tables import (
    ABSENT,
    ROUNDING,
    Block,
    Column,
    Table,
    format_list,
    format_number,
    format_uncertainty,
    format_with_uncertainty,
    units_of,
    word_column,
)
from loopcal.units import DISPLAY_UNITS, Dimension, Unit, find_unit

if TYPE_CHECKING:
    from loopcal.apply.run_comparison import RunComparison, RunSummary
    from loopcal.diagnose.bootstrap import Bootstrap
    from loopcal.diagnose.intervals import Intervals
    from loopcal.diagnose.joint_regions import JointRegion, SimultaneousIntervals
    from loopcal.diagnose.posterior_sample import PosteriorSample
    from loopcal.diagnose.regularization_curves import RegularizationCurve, RegularizationCurves
    from loopcal.estimate.result import Identification
    from loopcal.mechanism.model import Mechanism
    from loopcal.typing import FloatArray

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
        for key in SUMMARY:
            values = (before[key], after[key], floor.metrics[key][quantity])
            shown = (format_number(x / unit.factor_to_si, 3) for x in values)
            rows.append((name, METRICS[key].words, str(after.count), *shown, unit.symbol))
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
    """Return all metrics of every error.

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
            cells = (format_number(statistics[key] / unit.factor_to_si, 3) for key in METRICS)
            rows.append((name, quantity, str(statistics.count), *cells, unit.symbol))
    numeric = (Column(title) for title in ("count", *(m.words for m in METRICS.values())))
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


# --- Pose accuracy and repeatability as people read them.


def view_repeatability(result: Repeatability, robot: Mechanism | None = None) -> list[Block]:
    """Return the page of pose accuracy and repeatability, in the units of a robot's file."""
    units = DISPLAY_UNITS if robot is None else units_of(robot)
    blocks: list[Block] = []
    for quantity, poses in result.poses.items():
        unit = units[DIMENSIONS[quantity]]
        rows = tuple(row for pose in poses for row in _list_rows(pose, unit))
        columns = (
            *map(word_column, ("pose", "target", "approach")),
            Column("visits"),
            word_column("of"),
            *map(Column, ("AP", "from", "to", "RP", "from", "to")),
            word_column("unit"),
        )
        caption = f"{quantity.capitalize()} by ISO 9283 with intervals of 95 %, {result.frame}"
        blocks.append(_drop_empty(Table(caption, columns, rows)))
    unit = units[Dimension.LENGTH]
    for (pose, target), value in result.variations.items():
        of = f"{pose}, target {target}" if target else pose
        number = format_number(value / unit.factor_to_si, 3)
        blocks.append(
            f"Variation between directions of approach (vAP) at pose {of}: {number} {unit.symbol}."
        )
    notes = [(f.severity.value, str(f)) for f in result.findings]
    return [*blocks, "", *format_list(notes)] if notes else blocks


def _list_rows(pose: VisitedPose, unit: Unit) -> list[tuple[str, ...]]:
    """Return the rows of a pose: the whole position, then its components."""
    rows = []
    named = list(zip(pose.components, pose.accuracies, pose.repeatabilities, strict=True))
    if pose.accuracy is not None and pose.repeatability is not None and len(named) > 1:
        named.insert(0, ("position", pose.accuracy, pose.repeatability))
    for name, accuracy, repeatability in named:
        first = (pose.pose, pose.target, pose.direction, str(pose.visits))
        numbers = (*_format(accuracy, unit), *_format(repeatability, unit))
        rows.append((*first, name, *numbers, unit.symbol))
    return rows


def _format(estimate: Estimate, unit: Unit) -> tuple[str, ...]:
    """Return a value and the bounds of its interval as text."""
    return tuple(format_number(x / unit.factor_to_si, 3) for x in estimate)


def _drop_empty(table: Table) -> Table:
    """Return a table without columns that are empty in all rows."""
    kept = [i for i in range(len(table.columns)) if any(row[i] for row in table.rows)]
    rows = tuple(tuple(row[i] for i in kept) for row in table.rows)
    return Table(table.caption, tuple(table.columns[i] for i in kept), rows)


# --- Several calibrations side by side: findings, parameters, shifts, and errors at the same
# poses.

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
            shift, sd, is_significant = pair.find_shift(name)
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
            rows.append((run_errors.run, *[ABSENT] * (2 + len(SUMMARY)), ""))
    caption = (
        f"Errors after calibration at {comparison.common_poses} poses that are common to all runs"
        if has_common
        else "Errors after calibration at the held-out poses of each run, which are different poses"
    )
    numbers = (Column("count"), *(Column(METRICS[key].words) for key in SUMMARY))
    words = (word_column("run"), word_column("quantity"))
    return Table(caption, (*words, *numbers, word_column("unit")), tuple(rows))


def tabulate_comparison(comparison: RunComparison) -> Table:
    """Return one row for each run and parameter, to be written as CSV."""
    rows = []
    pairs = {pair.second: pair for pair in comparison.pairs}
    for run in comparison.runs:
        pair = pairs.get(run.name)
        for name, unit in zip(comparison.parameters, comparison.units, strict=True):
            nothing = (math.nan, math.nan, False)
            shift, sd, is_significant = nothing if pair is None else pair.find_shift(name)
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


def _format_estimate(value: float | None, half: float | None, unit: Unit) -> tuple[str, str]:
    """Return the cells of an estimate and of its interval."""
    if value is None:
        return FIXED, ABSENT
    shown = value / unit.factor_to_si
    if half is None:
        return format_number(shown, 9), "unknown"
    half /= unit.factor_to_si
    return format_with_uncertainty(shown, half), format_uncertainty(half)


def _format_errors(error: Statistics, unit: Unit) -> tuple[str, ...]:
    """Return the cells of errors."""
    cells = (format_number(error[key] / unit.factor_to_si, 3) for key in SUMMARY)
    return str(error.count), *cells, unit.symbol


def _write(value: float | None, unit: Unit) -> str:
    """Return a number for a file; nothing where there is none."""
    if value is None or not math.isfinite(value):
        return ""
    return f"{value / unit.factor_to_si:.10g}"


# --- Regularization curves as tables.

SCORE = (
    "Held-out error: mean square of residuals over sigma at poses that were left out; 1 is noise."
)
WORDS = {"lam": ("Ridge", "lam"), "k": ("Truncated SVD", "k")}
"""Name of a curve -> the method in words, and its number."""

ROWS = 9
"""Values of a curve that the table contains beside those that rules choose."""


def view_regularization(curves: RegularizationCurves) -> list[Block]:
    """Return the page of regularization curves: what rules choose, then the curves."""
    left_out = (
        "each pose was left out in turn, to first order"
        if curves.scheme == "leave-one-out"
        else f"{curves.left_out} folds of poses were left out and fitted again"
    )
    page: list[Block] = [
        f"{curves.robot}: {curves.poses} poses, {curves.parameters} parameters; {left_out}.",
        f"{SCORE} lam is (sigma per tolerance)^2: lam = 1 uses the tolerances as a prior.",
    ]
    if curves.assumed:
        page.append(
            f"{curves.assumed} parameters have no stated tolerance; assumed ones scale them."
        )
    if curves.scheme == "folds":
        page.append(
            "Frames, targets and surfaces of held-out poses are estimated from these poses, which "
            "lowers all values alike."
        )
    return [
        *page,
        tabulate_choices(curves),
        tabulate_curve(curves.ridge),
        tabulate_curve(curves.truncation),
    ]


def tabulate_choices(curves: RegularizationCurves) -> Table:
    """Return a table of the chosen values of both methods, and of the given robot."""
    rows = [("given robot", "", "", *_format_score(*curves.nominal))]
    for curve in (curves.ridge, curves.truncation):
        method, number = WORDS[curve.name]
        rows += [
            (method, c.rule, f"{number} = {c.value:.4g}", *_format_score(*curve.score_at(c.value)))
            for c in curve.chosen
        ]
    columns = (word_column("method"), word_column("chosen by"), word_column("value"))
    return Table(
        "Chosen values", (*columns, Column("held-out error"), Column("standard error")), tuple(rows)
    )


def tabulate_curve(curve: RegularizationCurve) -> Table:
    """Return a table of some values of a curve."""
    method, number = WORDS[curve.name]
    count = len(curve.values)
    score, error = curve.score.tolist(), curve.standard_error.tolist()
    places = np.unique(np.linspace(0, count - 1, min(ROWS, count)).round().astype(int))
    rows = tuple((f"{curve.values[i]:.4g}", *_format_score(score[i], error[i])) for i in places)
    columns = (Column(number), Column("held-out error"), Column("standard error"))
    return Table(method, columns, rows)


def tabulate_points(curves: RegularizationCurves) -> Table:
    """Return all points of both curves, for programs."""
    columns = [Column(name) for name in ("value", "score", "standard error")]
    rows = tuple(
        (curve.name, *(repr(float(x)) if np.isfinite(x) else "" for x in point))
        for curve in (curves.ridge, curves.truncation)
        for point in zip(curve.values, curve.score, curve.standard_error, strict=True)
    )
    return Table("", (word_column("parameter"), *columns), rows)


def _format_score(score: float, error: float) -> tuple[str, str]:
    """Return a score and its standard error."""
    if not np.isfinite(score):
        return "not determined", ABSENT
    if not np.isfinite(error):
        return format_number(score, 4), ABSENT
    return format_with_uncertainty(score, error), format_uncertainty(error)


# --- Bootstrap, sampled posterior and joint regions as people read them.


def view_bootstrap(result: Bootstrap, intervals: Intervals) -> list[Block]:
    """Return the page of a bootstrap: what was drawn, findings, intervals."""
    blocks, count = result.blocks, len(result.draws)
    drawn = f"{count} resamples of {blocks.count} {blocks.unit}s, scheme {result.scheme}"
    title = f"{result.fit.robot.name}: bootstrap, {drawn}, seed {result.seed}"
    return [title, "", *_view_findings(result.findings), _build_table(result.fit, intervals)]


def view_posterior(sample: PosteriorSample, intervals: Intervals) -> list[Block]:
    """Return the page of a sampled posterior: effective size, findings, intervals."""
    size = f"{len(sample.draws)} weighted draws worth {sample.effective_size:.0f}"
    title = f"{sample.fit.robot.name}: exact posterior, {size}, seed {sample.seed}"
    return [title, "", *_view_findings(sample.findings), _build_table(sample.fit, intervals)]


def view_region(
    region: JointRegion | None, intervals: SimultaneousIntervals, robot: Mechanism
) -> list[Block]:
    """Return the page of simultaneous intervals and, where there is one, of the joint region."""
    units = [
        robot.get_unit(robot.parameters.entries[robot.parameters.index(name)].dimension)
        for name in intervals.names
    ]
    level, count = f"{100 * intervals.level:.4g} %", len(intervals.names)
    together = f"all {count} parameters at once" if count > 1 else "1 parameter"
    rows = []
    for i, (name, unit) in enumerate(zip(intervals.names, units, strict=True)):
        value, single, half = (
            float(array[i]) / unit.factor_to_si
            for array in (intervals.center, intervals.single, intervals.half_widths)
        )
        cells = (format_uncertainty(single), format_uncertainty(half))
        rows.append((name, format_with_uncertainty(value, half), *cells, unit.symbol))
    columns = (
        word_column("name"),
        Column("estimate"),
        Column("+/- one at a time"),
        Column("+/- all at once"),
        word_column("unit"),
    )
    blocks: list[Block] = [
        f"{robot.name}: {level} intervals that hold for {together}",
        f"Rule: {intervals.rule}.",
        Table("Intervals", columns, tuple(rows)),
    ]
    if region is None:
        return blocks
    degrees = (
        "known noise"
        if np.isinf(region.degrees)
        else f"noise with {region.degrees:.3g} degrees of freedom"
    )
    text = f"Joint {level} region: squared distance up to {region.square:.4g} ({degrees})."
    return [*blocks, text, _build_axes(region)]


def _view_findings(findings: Sequence[Finding]) -> list[Block]:
    """Return findings with their severity."""
    return list(format_list([(f.severity.value, str(f)) for f in findings]))


def _build_table(fit: Identification, intervals: Intervals) -> Table:
    """Return the intervals beside the linear ones, in the units of the robot's file."""
    factor, symbols = fit.free_parameters.display()
    stated = fit.interval(intervals.level)
    is_off, rows = intervals.is_off, []
    for i, name in enumerate(intervals.names):
        lower, upper, half, value, own = (
            float(array[i]) / factor[i]
            for array in (
                intervals.lower,
                intervals.upper,
                0.5 * (intervals.upper - intervals.lower),
                fit.estimate,
                stated,
            )
        )
        cells = tuple(format_with_uncertainty(x, half) for x in (value, lower, upper))
        change = 100.0 * float(intervals.largest_shift[i])
        mark = "yes" if is_off[i] else ""
        shown = format_number(change, 2) if np.isfinite(lower) else "-"
        rows.append((name, *cells, format_uncertainty(own), shown, mark, symbols[i]))
    level = f"{100 * intervals.level:.4g} %"
    columns = (
        word_column("name"),
        Column("estimate"),
        Column("from"),
        Column("to"),
        Column("stated +/-"),
        Column("nonlinear", "%"),
        word_column("off"),
        word_column("unit"),
    )
    return Table(f"{level} intervals by {intervals.source}", columns, tuple(rows))


def _build_axes(region: JointRegion) -> Table:
    """Return the principal axes of a region in standard deviations of its parameters."""
    scaled: FloatArray = region.axes / region.standard_deviations
    columns = (word_column("name"), *(Column(f"axis {i + 1}") for i in range(len(scaled))))
    rows = [
        (name, *(format_number(float(axis[j]), 3) for axis in scaled))
        for j, name in enumerate(region.names)
    ]
    return Table("Principal axes, in standard deviations", columns, tuple(rows))
