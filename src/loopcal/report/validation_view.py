# SPDX-License-Identifier: Apache-2.0
"""Validation, repeatability, comparison, curves and intervals as people read them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from loopcal.apply.repeatability import DIMENSIONS, Repeatability
from loopcal.apply.validation import FEW_ROWS, ErrorChange, Validation
from loopcal.diagnose.row_errors import METRICS, SUMMARY
from loopcal.findings import Finding, Severity, sort_by_importance
from loopcal.findings.wording import list_names, name_count
from loopcal.report.words import say
from loopcal.results.presenters import register
from loopcal.results.tables import (
    ABSENT,
    ROUNDING,
    Block,
    Column,
    Table,
    choose_unit,
    format_in,
    format_list,
    format_number,
    format_uncertainty,
    format_with_uncertainty,
    make_table,
)
from loopcal.units import DISPLAY_UNITS, Dimension, Unit

if TYPE_CHECKING:
    from loopcal.apply.run_comparison import RunComparison
    from loopcal.diagnose.bootstrap import Bootstrap
    from loopcal.diagnose.cross_validation import RegularizationCurve, RegularizationCurves
    from loopcal.diagnose.intervals import (
        Intervals,
        JointRegion,
        PosteriorSample,
        SimultaneousIntervals,
    )
    from loopcal.mechanism.model import Mechanism

# Beginning of the codes of statements on limits, which follow the tables.
CONFORMITY = "conformity."
NOTICEABLE = 0.01  # share of the error after calibration above which such a difference is stated
SIMILAR = 5e-3  # relative difference up to which two errors are called equal


def list_findings(findings: Sequence[Finding]) -> list[str]:
    """Return findings with their severity, as lines."""
    return format_list([(f.severity.value, str(f)) for f in findings])


@register("page", Validation)
def view_validation(
    validation: Validation, with_before: bool = True, verbose: bool = False
) -> list[Block]:
    """Return the page of a validation.

    with_before : whether there is a geometry before calibration to compare with.
    """
    blocks = view_errors(validation, "measured", with_before)
    if with_before:
        blocks += describe_improvements(validation)
    others = (f for f in validation.findings if not f.code.startswith(CONFORMITY))
    notes = [f for f in others if f.severity is not Severity.FAILURE]
    if notes:
        blocks += ["", *list_findings(notes)]
    if verbose:
        blocks += view_error_statistics(validation, with_before)
    return blocks


def view_errors(validation: Validation, what: str, with_before: bool = True) -> list[Block]:
    """Return the tables of errors; their captions name the rows, the count and the frame.

    what : of the rows, such as "held-out". with_before : whether there is a geometry before
        calibration to compare with.
    """
    poses = name_count(validation.judged, f"{what} pose")
    blocks: list[Block] = []
    divided = f"Errors at {poses}, divided by sigma"
    if validation.quantities:
        caption = f"Errors at {poses}, {validation.frame}"
        blocks.append(_build_error_summary(validation, caption, with_before))
        divided = "Errors divided by sigma"
    blocks += _build_kind_summary(validation, divided, with_before)
    if (rest := validation.without_blunders) is not None and rest.judged:
        labels = [label for blunder in validation.blunders for label in blunder.poses]
        noun = "pose" if len(labels) == 1 else "poses"
        caption = f"Without {noun} {list_names(labels)}"
        if rest.quantities:
            blocks.append(_build_error_summary(rest, caption, with_before))
        else:
            blocks += _build_kind_summary(rest, caption, with_before)
    blocks += [str(f) for f in validation.findings if f.code.startswith(CONFORMITY)]
    commanded = describe_commanded(validation) if with_before else ""
    return [*blocks, commanded] if commanded else blocks


def _build_error_summary(validation: Validation, caption: str, with_before: bool) -> Table:
    """Return rms and largest error of each quantity before and after, beside the noise floor."""
    floor = validation.noise_floor
    rows = []
    for quantity in validation.quantities:
        before, after = (e.statistics(quantity) for e in (validation.before, validation.after))
        unit, measured = validation.units[quantity], validation.after[quantity].measured
        is_part = quantity == "position" and len(measured) < 3
        name = f"{quantity} {' '.join(measured)}" if is_part else quantity
        for key in SUMMARY:
            values = (before[key], after[key], floor.metrics.get(key, {}).get(quantity, math.nan))
            fine = choose_unit(unit, values[1:])  # errors before may be far larger
            shown = (format_in(fine, x, 3) for x in values)
            rows.append([name, METRICS[key].words, str(after.count), *shown, fine.symbol])
    return _build_error_table(caption, "quantity", rows, with_before)


def _build_kind_summary(validation: Validation, caption: str, with_before: bool) -> list[Table]:
    """Return the errors of each kind divided by sigma; no table where one quantity says it all."""
    if not validation.has_several_kinds and validation.quantities:
        return []
    rows = []
    for kind in validation.kinds:
        if kind.kind != "all" or validation.has_several_kinds:
            name = "all kinds" if kind.kind == "all" else kind.kind
            errors = (format_number(x, 3) for x in (kind.before, kind.after, kind.noise_floor))
            rows.append([name, "rms", str(kind.count), *errors, "sigma"])
    return [_build_error_table(caption, "kind", rows, with_before)]


def _build_error_table(
    caption: str, subject: str, rows: Sequence[list[str]], with_before: bool
) -> Table:
    """Return a table of errors, without those before where there is no such geometry."""
    titles = ["count", "before", "after", "noise floor"]
    if not with_before:
        titles[1:3] = ["error"]
        rows = [row[:3] + row[4:] for row in rows]
    return make_table(caption, (subject, "metric", *map(Column, titles), "unit"), rows)


def view_error_statistics(validation: Validation, with_before: bool = True) -> list[Block]:
    """Return all statistics of the errors, and whether actuators can correct these.

    Errors after commanding are left out where they equal the prediction errors, because the
    actuators can correct everything.
    """
    is_correctable = bool(validation.quantities) and not list_missed_quantities(validation)
    errors = validation.errors() if with_before else {"predicted": validation.after}
    if is_correctable:
        errors = {name: e for name, e in errors.items() if name.startswith("predicted")}
    rows = []
    for name, error in errors.items():
        for quantity in validation.quantities:
            statistics = error.statistics(quantity)
            after = validation.after.statistics(quantity)
            unit = choose_unit(validation.units[quantity], [after[key] for key in METRICS])
            cells = (format_in(unit, statistics[key], 3) for key in METRICS)
            rows.append((name, quantity, str(statistics.count), *cells, unit.symbol))
    numbers = map(Column, ("count", *(metric.words for metric in METRICS.values())))
    caption = f"Error statistics (rows x targets), {validation.frame}"
    table = make_table(caption, ("error", "quantity", *numbers, "unit"), rows)
    if not rows:
        return []
    if with_before and is_correctable:
        return [table, "The actuators can correct all of the measured error."]
    return [table]


def list_missed_quantities(validation: Validation) -> list[str]:
    """Return the quantities whose measured errors the actuators cannot correct in full."""
    errors, units = validation.not_compensable, validation.units
    return [
        quantity
        for quantity in validation.quantities
        if not errors.statistics(quantity).max / units[quantity].factor_to_si < ROUNDING
    ]


def describe_commanded(validation: Validation) -> str:
    """Return by how much coordinates that nobody commands differ after calibration, by the model
    alone, as a sentence; empty where the actuators can correct all of the measured error.
    """
    shown = []
    for quantity in list_missed_quantities(validation):
        rms = validation.not_compensable.statistics(quantity).rms
        unit, after = validation.units[quantity], validation.after.statistics(quantity).rms
        if math.isfinite(rms) and rms > NOTICEABLE * after:
            shown.append(f"{format_in(unit, rms, 3)} {unit.symbol} in {quantity}")
    return say("errors.commanded", errors=" and ".join(shown)) if shown else ""


def describe_improvements(validation: Validation) -> list[str]:
    """Return how much each error changed by calibration, as lines."""
    if validation.judged < FEW_ROWS:
        return []
    lines = []
    for quantity, change in validation.checked.changes().items():
        name = "error divided by sigma" if quantity == "weighted" else f"{quantity} error"
        lines.append(f"{name[0].upper()}{name[1:]} (rms): {_compare(change)}.")
    return lines


def _compare(change: ErrorChange) -> str:
    """Return in words how much an error changed."""
    if math.isnan(change.before):  # the geometry before has no setup that fits
        return "not known before calibration"
    if math.isnan(change.after):
        return "not known after calibration"
    if change.is_noise:
        return "within the noise before and after calibration"
    if abs(change.times - 1.0) < SIMILAR:
        return "equal before and after calibration"
    if math.isinf(change.times):
        return "zero after calibration"
    if change.times > 1.0:
        return f"{change.times:.3g} times smaller after calibration"
    if change.times > 0.0:
        return f"{1.0 / change.times:.3g} times larger after calibration"
    return "larger after calibration"


@register("page", Repeatability)
def view_repeatability(result: Repeatability, robot: Mechanism | None = None) -> list[Block]:
    """Return the page of pose accuracy and repeatability, in the units of a robot's file."""
    units = DISPLAY_UNITS if robot is None else robot.shown_units
    blocks: list[Block] = []
    for quantity, poses in result.poses.items():
        sizes = (e.value for p in poses for e in (*p.accuracies, *p.repeatabilities))
        unit, rows = choose_unit(units[DIMENSIONS[quantity]], sizes), []
        for pose in poses:  # the whole position, then its components
            named = list(zip(pose.components, pose.accuracies, pose.repeatabilities, strict=True))
            if pose.accuracy is not None and pose.repeatability is not None and len(named) > 1:
                named.insert(0, ("position", pose.accuracy, pose.repeatability))
            first = (pose.pose, pose.target, pose.direction, str(pose.visits))
            for name, *estimates in named:
                numbers = (format_in(unit, x, 3) for estimate in estimates for x in estimate)
                rows.append((*first, name, *numbers, unit.symbol))
        numbers = map(Column, ("AP", "from", "to", "RP", "from", "to"))
        titles = ("pose", "target", "approach", Column("visits"), "of", *numbers, "unit")
        kept = [i for i in range(len(titles)) if any(row[i] for row in rows)]
        caption = f"{quantity.capitalize()} by ISO 9283 with intervals of 95 %, {result.frame}"
        cells = ([row[i] for i in kept] for row in rows)
        blocks.append(make_table(caption, [titles[i] for i in kept], cells))
    unit = units[Dimension.LENGTH]
    for (pose, target), value in result.variations.items():
        of = f"{pose}, target {target}" if target else pose
        number = f"{format_in(unit, value, 3)} {unit.symbol}"
        blocks.append(f"Variation between directions of approach (vAP) at pose {of}: {number}.")
    return [*blocks, "", *list_findings(result.findings)] if result.findings else blocks


# Several calibrations side by side: findings, parameters, shifts, and errors at the same poses.


@register("page", "loopcal.apply.run_comparison:RunComparison")
def view_comparison(comparison: RunComparison) -> list[Block]:
    """Return the page of a comparison."""
    names = ", ".join(run.name for run in comparison.runs)
    findings = list_findings(sort_by_importance(comparison.findings))
    blocks: list[Block] = [f"Comparison of {names}.", "", *findings, ""]
    blocks += [*format_list(list_runs(comparison)), "", build_estimates(comparison), ""]
    if any(pair.moved is not None for pair in comparison.pairs):
        blocks += [build_shifts(comparison), ""]
    return [*blocks, build_errors(comparison)]


def list_runs(comparison: RunComparison) -> list[tuple[str, str]]:
    """Return each run with its robot, its verdict and its method."""
    return [
        (run.name, f"{run.robot}: {run.verdict}, {run.method.partition('(')[0]}")
        for run in comparison.runs
    ]


def build_estimates(comparison: RunComparison) -> Table:
    """Return the estimates of each run with their 95 % intervals."""
    rows = []
    for name, unit in zip(comparison.parameters, comparison.units, strict=True):
        cells = [name]
        for run in comparison.runs:
            value, half = run.estimates.get(name), run.plus_minus.get(name)
            if value is None:
                cells += ["fixed", ABSENT]
            elif half is None:
                cells += [format_in(unit, value, 9), "unknown"]
            else:
                value, half = value / unit.factor_to_si, half / unit.factor_to_si
                cells += [format_with_uncertainty(value, half), format_uncertainty(half)]
        rows.append((*cells, unit.symbol))
    of_runs = (Column(title) for run in comparison.runs for title in (run.name, "+/-"))
    caption = "Estimates and half-widths of their 95 % intervals"
    return make_table(caption, ("parameter", *of_runs, "unit"), rows)


def build_shifts(comparison: RunComparison) -> Table:
    """Return the change of each parameter from the first run, also in standard deviations."""
    rows = []
    for name, unit in zip(comparison.parameters, comparison.units, strict=True):
        cells = [name]
        for pair in comparison.pairs:
            shift, sd, is_significant = pair.find_shift(name)
            if not math.isfinite(sd):
                cells += [ABSENT, ABSENT]
                continue
            factor = unit.factor_to_si
            cells.append(format_with_uncertainty(shift / factor, sd / factor))
            cells.append(f"{round(shift / sd, 1) + 0.0:.1f}{'*' if is_significant else ' '}")
        rows.append((*cells, unit.symbol))
    of_pairs = (Column(title) for pair in comparison.pairs for title in (pair.second, "in sd"))
    caption = say("comparison.shifts", first=comparison.runs[0].name)
    return make_table(caption, ("parameter", *of_pairs, "unit"), rows)


def build_errors(comparison: RunComparison) -> Table:
    """Return the errors after calibration of each run: at common held-out poses, or at its own."""
    has_common = comparison.common_poses > 0
    rows = []
    for of_run in comparison.errors:
        errors = of_run.common if has_common else of_run.own
        for quantity, error in errors.items():
            unit = comparison.error_units[quantity]
            cells = (format_in(unit, error[key], 3) for key in SUMMARY)
            rows.append((of_run.run, quantity, str(error.count), *cells, unit.symbol))
        if not errors:
            rows.append((of_run.run, *[ABSENT] * (2 + len(SUMMARY)), ""))
    caption = (
        f"Errors after calibration at {comparison.common_poses} poses that are common to all runs"
        if has_common
        else "Errors after calibration at the held-out poses of each run, which are different poses"
    )
    metrics = (Column(METRICS[key].words) for key in SUMMARY)
    return make_table(caption, ("run", "quantity", Column("count"), *metrics, "unit"), rows)


def tabulate_comparison(comparison: RunComparison) -> Table:
    """Return one row for each run and parameter, to be written as CSV."""

    def write(value: float | None, unit: Unit) -> str:
        is_known = value is not None and math.isfinite(value)
        return f"{value / unit.factor_to_si:.10g}" if value is not None and is_known else ""

    rows = []
    pairs = {pair.second: pair for pair in comparison.pairs}
    for run in comparison.runs:
        pair = pairs.get(run.name)
        for name, unit in zip(comparison.parameters, comparison.units, strict=True):
            nothing = (math.nan, math.nan, False)
            shift, sd, is_significant = nothing if pair is None else pair.find_shift(name)
            numbers = (run.estimates.get(name), run.plus_minus.get(name), shift, sd)
            cells = (write(value, unit) for value in numbers)
            is_tested = math.isfinite(sd)
            ratio = f"{shift / sd:.4g}" if is_tested else ""
            tested = ("yes" if is_significant else "no") if is_tested else ""
            rows.append((run.name, name, unit.symbol, *cells, ratio, tested))
    titles = ("run", "parameter", "unit", "estimate", "plus_minus", "shift", "shift_sd")
    return make_table("", (*titles, "shift_in_sd", "significant"), rows)


# Regularization curves as tables.

# Name of a curve -> the method in words, and its number.
WORDS = {"lam": ("Ridge", "lam"), "k": ("Truncated SVD", "k")}
SCORES = (Column("held-out error"), Column("standard error"))  # columns of a score
ROWS = 9  # values of a curve that the table contains beside those that rules choose


@register("page", "loopcal.diagnose.cross_validation:RegularizationCurves")
def view_regularization(curves: RegularizationCurves) -> list[Block]:
    """Return the page of regularization curves: what rules choose, then the curves."""
    left_out = (
        "each pose left out in turn, to first order"
        if curves.scheme == "leave-one-out"
        else f"{curves.left_out} folds of poses left out and fitted again"
    )
    page: list[Block] = [
        f"{curves.robot}: {curves.poses} poses, {curves.parameters} parameters; {left_out}.",
        say("curves.score"),
    ]
    if curves.assumed:
        page.append(say("curves.assumed", assumed=curves.assumed))
    if curves.scheme == "folds":
        page.append(say("curves.folds"))
    rows = [("given robot", "", "", *_format_score(*curves.nominal))]
    for curve in (curves.ridge, curves.truncation):
        method, number = WORDS[curve.name]
        rows += [
            (method, c.rule, f"{number} = {c.value:.4g}", *_format_score(*curve.score_at(c.value)))
            for c in curve.chosen
        ]
    chosen = make_table("Chosen values", ("method", "chosen by", "value", *SCORES), rows)
    return [*page, chosen, _tabulate_curve(curves.ridge), _tabulate_curve(curves.truncation)]


def _tabulate_curve(curve: RegularizationCurve) -> Table:
    """Return a table of some values of a curve."""
    method, number = WORDS[curve.name]
    count = len(curve.values)
    score, error = curve.score.tolist(), curve.standard_error.tolist()
    places = np.unique(np.linspace(0, count - 1, min(ROWS, count)).round().astype(int))
    rows = ((f"{curve.values[i]:.4g}", *_format_score(score[i], error[i])) for i in places)
    return make_table(method, (Column(number), *SCORES), rows)


def tabulate_points(curves: RegularizationCurves) -> Table:
    """Return all points of both curves, for programs."""
    rows = (
        (curve.name, *(repr(float(x)) if np.isfinite(x) else "" for x in point))
        for curve in (curves.ridge, curves.truncation)
        for point in zip(curve.values, curve.score, curve.standard_error, strict=True)
    )
    return make_table("", ("parameter", *map(Column, ("value", "score", "standard error"))), rows)


def _format_score(score: float, error: float) -> tuple[str, str]:
    """Return a score and its standard error."""
    if not np.isfinite(score):
        return "not determined", ABSENT
    if not np.isfinite(error):
        return format_number(score, 4), ABSENT
    return format_with_uncertainty(score, error), format_uncertainty(error)


# Bootstrap, sampled posterior and joint regions.


@register("page", "loopcal.diagnose.bootstrap:Bootstrap")
def view_bootstrap(result: Bootstrap, intervals: Intervals | None = None) -> list[Block]:
    """Return the page of a bootstrap: what was drawn, findings, intervals."""
    blocks, count = result.blocks, len(result.draws)
    drawn = f"{count} resamples of {blocks.count} {blocks.unit}s, scheme {result.scheme}"
    return _view_draws(f"bootstrap, {drawn}", result, intervals or result.intervals())


@register("page", "loopcal.diagnose.intervals:PosteriorSample")
def view_posterior(sample: PosteriorSample, intervals: Intervals | None = None) -> list[Block]:
    """Return the page of a sampled posterior: effective size, findings, intervals."""
    drawn = f"{len(sample.draws)} weighted draws worth {sample.effective_size:.0f}"
    return _view_draws(f"exact posterior, {drawn}", sample, intervals or sample.intervals())


def _view_draws(
    drawn: str, result: Bootstrap | PosteriorSample, intervals: Intervals
) -> list[Block]:
    """Return draws, findings, intervals beside linear ones, in units of the robot's file."""
    fit, level = result.fit, intervals.level
    factor, symbols = fit.free_parameters.display()
    lower, upper, half, estimates, stated = (
        (values / factor).tolist()
        for values in (
            intervals.lower,
            intervals.upper,
            0.5 * (intervals.upper - intervals.lower),
            fit.estimate,
            fit.interval(level),
        )
    )
    rows = []
    for i, name in enumerate(intervals.names):
        ends = (estimates[i], lower[i], upper[i])
        cells = (format_with_uncertainty(x, half[i]) for x in ends)
        change = 100.0 * float(intervals.largest_shift[i])
        shown = format_number(change, 2) if np.isfinite(lower[i]) else ABSENT
        mark = "yes" if intervals.is_off[i] else ""
        rows.append((name, *cells, format_uncertainty(stated[i]), shown, mark, symbols[i]))
    numbers = (*map(Column, ("estimate", "from", "to", "stated +/-")), Column("nonlinear", "%"))
    caption = f"{100 * level:.4g} % intervals by {intervals.source}"
    title = f"{fit.robot.name}: {drawn}, seed {result.seed}"
    table = make_table(caption, ("name", *numbers, "off", "unit"), rows)
    return [title, "", *list_findings(result.findings), table]


def view_region(
    region: JointRegion | None, intervals: SimultaneousIntervals, robot: Mechanism
) -> list[Block]:
    """Return the page of simultaneous intervals and, where there is one, of the joint region."""
    level, count = f"{100 * intervals.level:.4g} %", len(intervals.names)
    together = f"all {count} parameters at once" if count > 1 else "1 parameter"
    numbers = (intervals.center, intervals.single, intervals.half_widths)
    rows = []
    for name, *of_name in zip(intervals.names, *(x.tolist() for x in numbers), strict=True):
        unit = robot.get_unit(robot.parameters.entries[robot.parameters.index(name)].dimension)
        value, single, half = (x / unit.factor_to_si for x in of_name)
        cells = (format_uncertainty(single), format_uncertainty(half))
        rows.append((name, format_with_uncertainty(value, half), *cells, unit.symbol))
    titles = map(Column, ("estimate", "+/- one at a time", "+/- all at once"))
    blocks: list[Block] = [
        f"{robot.name}: {level} intervals that hold for {together}",
        f"Rule: {intervals.rule}.",
        make_table("Intervals", ("name", *titles, "unit"), rows),
    ]
    if region is None:
        return blocks
    estimated = f"noise with {region.degrees:.3g} degrees of freedom"
    noise = "known noise" if np.isinf(region.degrees) else estimated
    scaled = (region.axes / region.standard_deviations).T.tolist()
    axes = make_table(
        "Principal axes, in standard deviations",
        ("name", *(Column(f"axis {j}") for j in range(1, len(region.axes) + 1))),
        (
            (name, *(format_number(x, 3) for x in of_axes))
            for name, of_axes in zip(region.names, scaled, strict=True)
        ),
    )
    text = f"Joint {level} region: squared distance up to {region.square:.4g} ({noise})."
    return [*blocks, text, axes]
