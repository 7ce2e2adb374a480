# SPDX-License-Identifier: Apache-2.0
"""A calibration as people read it: the verdict first, then the parameters."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from loopcal.apply.error_budget import (
    COMMON,
    EARLIER,
    INSTRUMENT,
    LENGTHS,
    READINGS,
    SETUP,
    TOLERANCES,
    Source,
)
from loopcal.apply.volume_accuracy import CONDITIONS
from loopcal.diagnose.fit_examination import ROUNDING
from loopcal.diagnose.row_errors import METRICS, SUMMARY
from loopcal.estimate.result import LAST_DIGITS, Identification
from loopcal.findings import Finding, Severity, report_finding
from loopcal.findings.wording import FINE, add_advice, count_decimals, list_names, name_count
from loopcal.report.validation_view import describe_improvements, view_error_statistics, view_errors
from loopcal.report.words import say
from loopcal.results.description import Field
from loopcal.results.presenters import register
from loopcal.results.tables import (
    ABSENT,
    Block,
    Column,
    Table,
    build_table,
    choose_coarser,
    choose_unit,
    format_exact_beside,
    format_in,
    format_list,
    format_number,
    format_uncertainty,
    format_with_uncertainty,
    make_table,
    to_quantity,
    word_column,
)
from loopcal.units import UNITS, Dimension

if TYPE_CHECKING:
    from loopcal.apply.calibration_report import CalibrationReport
    from loopcal.apply.compensation import Compensation
    from loopcal.apply.height_errors import HeightErrors
    from loopcal.apply.inspection import IdentifiabilityReport
    from loopcal.diagnose.fit_examination import ReadingError
    from loopcal.diagnose.identifiable_parameters import Identifiability, Observability
    from loopcal.estimate.prior_inflation import PriorConflict
    from loopcal.mechanism.model import Mechanism


MOST_POINTS, MOST_LINES, MOST_MOVED = 200, 25, 10
"""Heights that a table lists; heights and parameters up to which the page of a calibration has a
table of all; parameters that the table of many has.
"""


def build_height_summary(heights: HeightErrors) -> Table:
    """Return rms and largest error of the fitted and of the held-out heights."""
    unit, rows = heights.unit, []
    for name, is_held_out in heights.list_sets():
        before, after = (heights.statistics(e, is_held_out) for e in ("before", "after"))
        for key in SUMMARY:
            shown = (format_in(unit, s[key], 3) for s in (before, after))
            rows.append((name, METRICS[key].words, str(after.count), *shown, unit.symbol))
    numbers = (Column("count"), Column("before"), Column("after"))
    caption = "Height errors (predicted - measured)"
    return make_table(caption, ("points", "metric", *numbers, "unit"), rows)


def build_height_map(heights: HeightErrors) -> Table | str:
    """Return the error of each height with its place, to the third digit of the largest error; of
    many heights a sentence.
    """
    unit, count = heights.unit, len(heights.poses)
    if count > MOST_POINTS:
        return f"The errors of {count:,} heights are too many for a table."
    errors = np.stack([heights.before, heights.after], axis=1) / unit.factor_to_si
    largest = float(np.abs(errors).max())
    decimals = count_decimals(largest, 3) if largest > 0.0 else 0
    places = heights.points / unit.factor_to_si
    rows = [
        (
            pose,
            *(f"{x:z.1f}" for x in place),  # z: 0.0 in place of -0.0
            *(f"{x:z.{decimals}f}" for x in of_pose),
            "held out" if is_held_out else "in the fit",
        )
        for pose, place, of_pose, is_held_out in zip(
            heights.poses, places.tolist(), errors.tolist(), heights.is_held_out, strict=True
        )
    ]
    numbers = (Column(title, unit.symbol) for title in ("x", "y", "before", "after"))
    caption = "Height errors by point (predicted - measured); x, y in the base frame"
    return make_table(caption, ("pose", *numbers, "used"), rows)


@register("page", "loopcal.apply.height_errors:HeightErrors")
def view_heights(heights: HeightErrors | None, verbose: bool = False) -> list[Block]:
    """Return the tables of a page: each of few points, and rms and largest error of many."""
    if heights is None:
        return []
    if len(heights.poses) <= MOST_LINES:
        return [build_height_map(heights)]
    return [build_height_summary(heights), *([build_height_map(heights)] if verbose else [])]


WHOLE, MANY = 100.0, 10_000.0
"""Degrees of freedom from which they are shown without decimals, and from which they no longer
matter.
"""

Hint = Callable[[Finding], str | None]
"""From a finding to advice of the caller, such as a command-line option."""


@register("page", "loopcal.apply.calibration_report:CalibrationReport")
def view_calibration(
    report: CalibrationReport, verbose: bool = False, hint: Hint = lambda _: None
) -> list[Block]:
    """Return the page of a calibration.

    Verdict, typical error, errors with the noise floor, warnings, the recommendation, the next
    step, and the parameters, of many those that moved most. With `verbose` also every finding and
    table.
    """
    fit = report.identification
    stated = fit.to_dict()
    task: list[Block] = []
    if report.budget is not None and report.states_expected_error:
        task = ["", str(report.budget if verbose else report.budget.summary)]
    told = () if report.volume is None else report.volume.findings
    task += [str(f) for f in told if f.code != CONDITIONS]
    blocks: list[Block] = [report.headline, *task]
    if report.validation is not None:
        blocks += view_errors(report.validation, "held-out")
    elif report.fitted_errors is not None:
        blocks += view_errors(report.fitted_errors, "fitted (optimistic)")
    errors = report.validation or report.fitted_errors
    if errors is not None and report.reading_errors is not None:
        blocks.append(say("errors.reading-noise"))
    blocks += view_heights(report.height_errors, verbose)
    more = [f for f in report.findings if str(f) not in blocks]  # than what the page says already
    selected = more if verbose else [f for f in more if f in report.top_findings]
    step, advice = str(report.next_step), hint(report.next_step) or ""
    lines = []
    for f in selected:  # without what the next step says, too
        text, of_text = str(f), hint(f) or ""
        text = text.removesuffix(f" {f.action}") if f.action in step else text
        lines.append((f.severity.value, add_advice(text, None if of_text in advice else of_text)))
    blocks += ["", *format_list(lines)]
    if count := len(more) - len(selected):
        blocks.append(f"  ({name_count(count, 'more finding')} in the full report)")
    if fit.converged and not verbose and fit.regularization is not None:
        blocks.append(f"  {fit.regularization.finding}")
    if report.comparison is not None:
        blocks += ["", str(report.comparison.outcome)]
    blocks += ["", f"Recommendation: {report.recommendation}", f"Next: {step}"]
    if advice:
        blocks.append(f"Hint: {advice}")
    if fit.converged:
        shown, caption = stated["parameters"], "Parameters"
        if not verbose and len(shown) > MOST_LINES:
            moved = [abs(row["estimate"] - row["nominal"]) / row["tolerance"] for row in shown]
            most = np.argsort(np.negative(moved), kind="stable")[:MOST_MOVED]
            shown = [shown[i] for i in np.sort(most)]
            others = len(stated["parameters"]) - len(shown)
            caption = f"Parameters that moved most; {others} others are in the run and its report"
        blocks += _view_parameters(fit, caption, shown)
    elif verbose:
        blocks.append(build_last_value_table(stated["parameters"]))
    return [*blocks, *_view_details(report, stated)] if verbose else blocks


def _view_details(report: CalibrationReport, stated: Mapping[str, Any]) -> list[Block]:
    """Return everything that the summary leaves out."""
    fit, errors = report.identification, report.validation or report.fitted_errors
    blocks: list[Block] = []
    if stated["local"] and fit.converged:
        blocks += _view_parameters(fit, "Setup parameters", stated["local"])
    blocks += ["", _describe_iteration(fit)]
    if fit.converged and fit.prior_conflict is not None:
        blocks.append(build_prior_table(fit.prior_conflict))
    blocks += [f"Suggested measurement: {suggestion}" for suggestion in report.suggestions or ()]
    if report.budget is not None:
        blocks.append(build_budget_table(report.budget.to_dict(), report.robot))
    if report.model_choice is not None:
        blocks.append(report.model_choice.compare_sets())
    if report.reading_errors is not None:
        blocks.append(build_reading_table(report.robot, report.reading_errors))
    if errors is not None:
        blocks += [*view_error_statistics(errors), *describe_improvements(errors)]
    return blocks


def _view_parameters(
    fit: Identification, caption: str, rows: Iterable[Mapping[str, Any]]
) -> list[Block]:
    """Return a table of parameters, and the sentence on intervals that use a prior."""
    note = [] if fit.interval_note is None else [str(fit.interval_note)]
    return [build_parameter_table(caption, rows), *note]


def build_parameter_table(
    caption: str, rows: Iterable[Mapping[str, Any]], is_complete: bool = False
) -> Table:
    """Return identified parameters: rows of `Identification.to_dict()["parameters"]`.

    is_complete : whether standard uncertainty, degrees of freedom, coverage factor, and the shift
        in spreads have columns, too.
    """
    cells = []
    for row in rows:
        nominal, estimate, half = row["nominal"], row["estimate"], row["plus_minus"]
        shown = [
            row["name"],
            format_exact_beside(nominal, half),
            format_with_uncertainty(estimate, half),
        ]
        if is_complete:
            sd = row["sd"]
            factor = half / sd if sd > 0.0 else math.nan
            shown += [
                f"{(estimate - nominal) / row['tolerance']:+.2f}",
                format_uncertainty(sd),
                _format_degrees(row["degrees"]),
                f"{factor:.2f}" if math.isfinite(factor) else ABSENT,
            ]
        interval = format_uncertainty(half) if row.get("free", True) else "fixed"
        cells.append((*shown, interval, row["unit"]))
    titles = ["nominal", "estimate", "+/- (95 %)"]
    if is_complete:
        titles[2:] = ["shift [expected spreads]", "u", "degrees of freedom", "k", "U (95 %)"]
    return make_table(caption, ("name", *map(Column, titles), "unit"), cells)


def _format_degrees(degrees: float) -> str:
    """Return degrees of freedom, which are infinite where no variance was estimated."""
    if math.isinf(degrees):
        return "infinite"
    if degrees > MANY:
        return f"over {MANY:.0f}"
    return f"{degrees:.0f}" if degrees >= WHOLE else format_number(degrees, 3)


def build_prior_table(conflict: PriorConflict) -> Table:
    """Return the tests of the stated spreads."""
    whole = ("all deviations", conflict.statistic, conflict.degrees, conflict.p_value, ())
    tests = (("worst direction", conflict.direction), ("worst parameter", conflict.parameter))
    rows = (
        (title, format_number(x, 3), f"{count:.3g}", format_number(p, 2), list_names(names))
        for title, x, count, p, names in (
            whole,
            *((title, t.statistic, t.count, t.p_value, t.names) for title, t in tests),
        )
    )
    numbers = (Column(title) for title in ("statistic [1]", "degrees or number", "p"))
    p_value = format_number(conflict.joint_p_value, 2)
    caption = f"Expected spreads against the data: p = {p_value} for the three tests together"
    return make_table(caption, ("test", *numbers, "parameters"), rows)


def build_last_value_table(rows: Iterable[Mapping[str, Any]]) -> Table:
    """Return the values at which an iteration ended that did not converge, without precision."""
    return build_table(
        "Values at the end of the iteration (no estimates)",
        rows,
        Field("name"),
        Field("nominal"),
        Field("estimate", title="last value", digits=LAST_DIGITS),
        Field("unit"),
    )


def build_reading_table(robot: Mechanism, errors: Sequence[ReadingError]) -> Table:
    """Return recorded actuator readings minus the estimated ones."""
    count = max(error.count for error in errors)
    return build_table(
        f"Actuator readings, recorded minus estimated, of up to {count} poses",
        errors,
        Field("name", title="reading"),
        Field("reading", title="rms", digits=3, units="reading_dimension"),
        Field("reading_dimension", title="unit"),
        Field("joint", title="rms of the joint", digits=3, units="joint_dimension"),
        Field("largest", digits=3, units="joint_dimension"),
        Field("joint_dimension", title="unit"),
        Field("pose", title="at pose"),
        units=robot.shown_units,
    )


def view_fit(fit: Identification) -> list[Block]:
    """Return the parameters of a fit and how it ended."""
    rows, iteration = fit.list_parameters(), _describe_iteration(fit)
    if not fit.converged:
        return [build_last_value_table(rows), iteration]
    caption = f"{fit.robot.name}: {len(fit.names)} parameters"
    return [*_view_parameters(fit, caption, rows), iteration]


@register("page", Identification)
def _view_fit_and_findings(fit: Identification) -> list[Block]:
    """Return the page of a fit, its setup parameters, and its findings."""
    blocks, local = view_fit(fit), fit.list_nuisance()
    if local and fit.converged:
        blocks.append(build_parameter_table("Setup parameters", local))
    elif local:
        blocks.append(build_last_value_table(local))
    return [*blocks, *(f"{f.severity.value}: {f}" for f in fit.findings)]


def _describe_iteration(fit: Identification) -> str:
    """Return how a fit ended, and its residuals in one number."""
    status = fit.status.name.lower().replace("_", " ")
    ending = f"Iteration: {status} after {fit.history.iterations} steps."
    return f"{ending}\n{fit.describe_statistics()}\n{fit.describe_intervals()}".rstrip()


# The uncertainty budget of a calibration: `ErrorBudget.to_dict()`, or `expected_error` of a run.


def view_budget(
    budget: Mapping[str, Any], robot: Mechanism, volume: Mapping[str, Any] | None = None
) -> list[Block]:
    """Return the page of a budget, and the statement on a working volume.

    robot : for its units. volume : of a run.
    """
    stated = [finding["text"] for finding in (volume or {}).get("findings", ())]
    tables = [build_budget_table(budget, robot), *build_gum_tables(budget, robot)]
    return [str(budget["finding"]["text"]), "", *tables, *stated]


def build_budget_table(budget: Mapping[str, Any], robot: Mechanism) -> Table:
    """Return one line for each source of errors, and their sum; without orientation where the
    platform does not rotate.
    """
    worst, table, units = budget["worst_parameter"], robot.parameters, robot.shown_units
    total = {**{kind: budget[kind]["rms"] for kind in LENGTHS}, **budget["parameters"]}
    shown = {k: choose_unit(units[LENGTHS[k]], [total[k]], FINE) for k in _list_kinds(budget)}
    if worst:
        unit = robot.get_unit(table.entries[table.index(worst)].dimension)
        shown[worst] = choose_unit(unit, [total[worst]])

    def list_cells(
        words: str, evaluation: str, freedom: str, *errors: Mapping[str, float | None]
    ) -> list[str]:
        numbers = (format_in(unit, of.get(k), 3) for of in errors for k, unit in shown.items())
        return [words, evaluation, freedom, *numbers]

    rows = []
    for line in budget["sources"]:
        halved, left = line["halved"], {}
        if halved is not None:
            left = {kind: halved[f"{kind}_rms"] for kind in LENGTHS}
            left[worst] = halved["worst_parameter_sd"]
        squares = {**{kind: line[kind] for kind in LENGTHS}, **line["parameters"]}
        errors = {k: None if square is None else math.sqrt(square) for k, square in squares.items()}
        fixed = _name_source(line), line["evaluation"], _format_degrees(line["degrees"] or math.inf)
        rows.append(list_cells(*fixed, errors, left))
    rows.append(list_cells("all sources", "", "", total, {}))
    titles = ((before + k, unit) for before in ("", "halved: ") for k, unit in shown.items())
    columns = [Column(title, unit.symbol) for title, unit in titles]
    over = "poses of the workspace" if budget["over"] == "workspace" else "measured poses"
    caption = say("budget.meaning", poses=budget["poses"], over=over)
    return make_table(caption, ("source", "type", Column("degrees of freedom"), *columns), rows)


# Kind of a source without one value -> where its size is from; else residuals gave it.
UNSTATED = {TOLERANCES: "by parameter", SETUP: "estimated", EARLIER: "earlier run"}
UNSTATED |= {READINGS: "from the data", INSTRUMENT: "several values", COMMON: "several values"}


def build_gum_tables(budget: Mapping[str, Any], robot: Mechanism) -> list[Table]:
    """Return the budget of positions, and of orientations, as JCGM 100 arranges one."""
    return [_build_gum_table(budget, robot, kind) for kind in _list_kinds(budget)]


def _build_gum_table(budget: Mapping[str, Any], robot: Mechanism, kind: str) -> Table:
    """Return one line for each source: its stated value, what it contributes, and their ratio."""
    unit = choose_unit(robot.shown_units[LENGTHS[kind]], [budget[kind]["rms"]], FINE)
    rows = []
    for line in budget["sources"]:
        stated, error = line.get("stated"), math.sqrt(line[kind] or 0.0)
        cells = [UNSTATED.get(line["kind"], "from residuals"), *[ABSENT] * 4]
        if stated:
            of = choose_coarser(UNITS[stated["unit"]], stated["value"])
            factor = UNITS[stated["unit"]].factor_to_si / of.factor_to_si
            value, u = factor * stated["value"], factor * stated["u"]
            is_ratio = of.dimension is unit.dimension
            sensitivity = error / u / of.factor_to_si if is_ratio else error / u / unit.factor_to_si
            per = "" if is_ratio or not error else f" {unit} per {of}"
            divisor = format_number(stated["divisor"], 3)
            cells = [f"{value:.6g} {of}", stated["distribution"], divisor]
            cells += [f"{format_number(u, 3)} {of}", f"{format_number(sensitivity, 3)}{per}"]
        shown = [*cells, format_in(unit, error, 3), _format_degrees(line["degrees"] or math.inf)]
        rows.append((_name_source(line), line["evaluation"], *shown))
    total = format_in(unit, budget[kind]["rms"] or 0.0, 3)
    degrees = _format_degrees(budget[kind].get("degrees") or math.inf)
    rows.append(("all sources", "", *[""] * 5, total, degrees))
    numbers = (Column(title) for title in ("divisor", "u", "sensitivity"))
    columns = ("source", "type", Column("value"), "distribution", *numbers)
    ends = (Column("contribution", unit.symbol), Column("degrees of freedom"))
    return make_table(say("budget.gum", kind=kind), (*columns, *ends), rows)


def build_share_table(budget: Mapping[str, Any]) -> Table:
    """Return the share of each source in the variance of poses."""
    kinds = _list_kinds(budget)
    totals = {kind: sum(line[kind] or 0.0 for line in budget["sources"]) for kind in kinds}
    rows = (
        (_name_source(line), line["evaluation"], *(_show_share(line[k], totals[k]) for k in kinds))
        for line in budget["sources"]
    )
    caption = "Share of each source in the variance of the expected error"
    return make_table(caption, ("source", "type", *(Column(kind, "%") for kind in kinds)), rows)


def _list_kinds(budget: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the errors of poses: those of orientation only where the platform rotates."""
    rms = budget["orientation"]["rms"]
    return tuple(LENGTHS)[: 1 if rms is not None and rms <= ROUNDING else 2]


def _show_share(variance: float | None, total: float) -> str:
    """Return a part of a variance in percent; a dash where one of them is not finite."""
    if variance is None or not math.isfinite(total) or total <= 0.0:
        return ABSENT
    share = 100.0 * variance / total
    return "below 0.1" if 0.0 < share < 0.1 else f"{share:.1f}"


def _name_source(line: Mapping[str, Any]) -> str:
    return Source(line["kind"], line["name"], "", 0.0).words


def view_compensation(result: Compensation) -> list[Block]:
    """Return the table of targets with their errors before and after, the convergence of shifted
    commands, and the frame.
    """
    robot, uncertainty = result.robot, result.uncertainty
    length, angle = robot.get_unit(Dimension.LENGTH), robot.get_unit(Dimension.ANGLE)
    values = [
        (title, np.linalg.norm(result.drop_rounding(of_title)[:, part], axis=1), unit)
        for unit, part in ((length, slice(3, 6)), (angle, slice(0, 3)))
        for title, of_title in (("before", result.before), ("after", result.remaining))
    ]
    if uncertainty is not None:
        values.append(("U", uncertainty.expanded_position, length))
        values.append(("U", uncertainty.expanded_orientation, angle))
    columns: list[str | Column] = ["target", "status"]
    cells: list[Sequence[str]] = [result.labels, [reach.value for reach in result.reach]]
    for title, numbers, unit in values:
        shown = choose_unit(unit, numbers.tolist())
        columns.append(Column(title, shown.symbol))
        cells.append([format_in(shown, number, 3) for number in numbers])
    caption = f"{robot.name}: {len(result.labels)} targets, {result.mode}"
    blocks: list[Block] = [make_table(caption, columns, zip(*cells, strict=True))]
    if result.residual_map is not None:
        blocks.append(str(result.residual_map))
    usable = result.usable
    if result.commands is not None and usable.any():
        distances = np.stack([result.residual_orientation, result.residual_position], axis=2)
        largest = distances[1:, usable].max(axis=1).repeat(3, axis=1)
        for step, (turn, *_, shift) in enumerate(result.drop_rounding(largest), 1):
            most = f"{to_quantity(shift, length)} and {to_quantity(turn, angle)}"
            blocks.append(f"After step {step}: at most {most} from the best reachable poses.")
    if uncertainty is not None:
        is_of_all = uncertainty.reference.data["frame"] in ("fitted", "base")
        others = "" if is_of_all else " Errors before and after are in the base frame."
        blocks.append(
            "Errors are distances and angles. 95 % of the machine's errors after compensation are "
            f"below U. Frame{'' if is_of_all else ' of U'}: {uncertainty.frame}.{others}"
        )
    return blocks


@register("page", "loopcal.apply.compensation:Compensation")
def _view_targets_and_findings(result: Compensation) -> list[Block]:
    """Return the targets, and the findings of those that are not reached."""
    return [str(result), *view_compensation(result)]


# Identifiability as people read it: what the data determine, then each parameter.

MOST_COMBINATIONS, FEW_PARAMETERS = 8, 12
"""Combinations and suggestions that a page lists, and parameters that a summary lists one by one;
of more combinations the rest is counted.
"""

COMBINATIONS = ("fit.unidentifiable", "fit.hardly-observable")


def view_identifiability(report: IdentifiabilityReport, verbose: bool = False) -> list[Block]:
    """Return the page of an identifiability analysis.

    Rank, what is undetermined, what to measure, and a table of the parameters of small robots. With
    `verbose` also every combination, the singular values, the table of every robot and the
    observability indices.
    """
    analysis, useful = report.analysis, report.useful

    def name_terms(row: Any) -> str:
        """Return the strongest terms of a combination."""
        pairs = zip(row.names, row.coefficients, strict=True)
        return list_names([f"{c:+.2f} {name}" for name, c in pairs], 4).replace(" and ", ", ")

    blocks: list[Block] = [str(finding) for finding in report.summary]
    if (verbose and report.suggestions) or any(
        finding.severity is Severity.SUGGESTION for finding in report.summary
    ):
        blocks.append(str(report_finding("identifiability.known-frames-assumed")))
    if verbose:
        said = {finding.code for finding in report.summary}
        left = [f for f in analysis.findings if f.code not in said]
        combinations = [str(f) for f in left if f.code in COMBINATIONS]
        blocks += ["", *(str(f) for f in left if f.code not in COMBINATIONS)]
        listed = {"combinations": combinations, "suggestions": [*map(str, report.suggestions)]}
        for what, lines in listed.items():
            blocks += lines[:MOST_COMBINATIONS]
            if (left_out := len(lines) - MOST_COMBINATIONS) > 0:
                blocks.append(f"and {left_out} more {what}")
    if useful is not None and verbose:  # the best and the worst known ones about it
        n = MOST_COMBINATIONS
        table = build_table(
            "Combinations next to the useful accuracy",
            [*useful.determined[-n:], *useful.undetermined[:n]],
            (word_column("combination of length one", wraps=True), name_terms),
            Field("sd", title="sd / useful accuracy", digits=3),
        )
        blocks.append(table)
    if verbose or analysis.n_parameters <= FEW_PARAMETERS:
        blocks += _view_parameter_states(analysis)
    if verbose:
        blocks.append(_build_observability_table(analysis.indices))
    if report.subset is not None:
        blocks += ["", str(report.subset)]
    return blocks


@register("page", "loopcal.diagnose.identifiable_parameters:Identifiability")
def _view_analysis(analysis: Identifiability) -> list[Block]:
    """Return the findings on what measurements determine, the parameters, and the indices."""
    tables = _view_parameter_states(analysis), _build_observability_table(analysis.indices)
    return [*map(str, analysis.findings), *tables[0], tables[1]]


def _view_parameter_states(analysis: Identifiability) -> list[Block]:
    """Return the table of what measurements determine of each parameter, and its meaning."""
    states, rows = {"determined": "yes", "not at all": "no"}, []
    for row in analysis.parameters:
        others = f"only with {list_names(row.others, MOST_COMBINATIONS // 2)}"
        rows.append((row.name, states.get(row.state) or others, f"{row.left:.2f}"))
    columns = ("name", word_column("determined", wraps=True), Column("sd / prior sd"))
    return [make_table("Parameters", columns, rows), say("parameters.sd")]


def _build_observability_table(indices: Observability) -> Table:
    """Return the observability indices with their meaning."""
    values = [(n, meaning, format_number(x, 3)) for n, x, meaning in indices.rows()]
    columns = ("index", word_column("meaning", wraps=True), Column("value"))
    return make_table("Observability", columns, values)
