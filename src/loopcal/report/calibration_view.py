# SPDX-License-Identifier: Apache-2.0
"""A calibration as people read it: the verdict first, then the parameters."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from operator import itemgetter
from typing import TYPE_CHECKING, Any

import numpy as np

from loopcal.apply.error_budget import Source
from loopcal.diagnose.row_errors import METRICS, SUMMARY
from loopcal.estimate.result import LAST_DIGITS, Identification
from loopcal.findings import Finding, report_finding
from loopcal.findings.wording import add_advice, count_decimals, list_names
from loopcal.report.validation_view import (
    READING_NOISE,
    describe_improvements,
    view_error_statistics,
    view_errors,
)
from loopcal.results.description import Field
from loopcal.results.tables import (
    ABSENT,
    Block,
    Column,
    Table,
    build_table,
    format_exact_beside,
    format_in,
    format_list,
    format_number,
    format_uncertainty,
    format_with_uncertainty,
    word_column,
)
from loopcal.units import Dimension, find_unit

if TYPE_CHECKING:
    from loopcal.apply.calibration_report import CalibrationReport
    from loopcal.apply.compensation import Compensation
    from loopcal.apply.height_errors import HeightErrors
    from loopcal.apply.inspection import IdentifiabilityReport
    from loopcal.diagnose.fit_examination import ReadingError
    from loopcal.diagnose.identifiable_parameters import UsefulAccuracy
    from loopcal.estimate.prior_inflation import PriorConflict
    from loopcal.mechanism.model import Mechanism
    from loopcal.typing import FloatArray


# --- Errors of measured heights, as tables.

MOST_POINTS, MOST_LINES = 200, 25
"""Points that a table lists, and up to which the page of a calibration has this table."""


def build_height_summary(heights: HeightErrors) -> Table:
    """Return rms and largest error of the fitted and of the held-out heights."""
    unit = heights.unit
    rows = []
    for name, is_held_out in heights.list_sets():
        before, after = (heights.statistics(e, is_held_out) for e in ("before", "after"))
        for key in SUMMARY:
            shown = (format_in(unit, s[key], 3) for s in (before, after))
            rows.append((name, METRICS[key].words, str(after.count), *shown, unit.symbol))
    columns = (word_column("points"), word_column("metric"))
    numbers = (Column("count"), Column("before"), Column("after"))
    caption = "Height errors (predicted - measured)"
    return Table(caption, (*columns, *numbers, word_column("unit")), tuple(rows))


def build_height_map(heights: HeightErrors) -> Table | str:
    """Return the error of each height with its place; of many heights a sentence."""
    unit, count = heights.unit, len(heights.poses)
    if count > MOST_POINTS:
        return f"The errors of {count:,} heights are too many for a table."

    def place(value: float) -> str:
        """Return a coordinate; 0.0 in place of -0.0."""
        return f"{round(value / unit.factor_to_si, 1) + 0.0:.1f}"

    rows = zip(
        heights.poses, heights.points, heights.before, heights.after, heights.is_held_out,
        strict=True,
    )  # fmt: skip
    return build_table(
        "Height errors by point (predicted - measured); x, y in the base frame",
        rows,
        ("pose", lambda row: row[0]),
        (Column("x", unit.symbol), lambda row: place(row[1][0])),
        (Column("y", unit.symbol), lambda row: place(row[1][1])),
        (Column("before", unit.symbol), lambda row: format_height(heights, row[2])),
        (Column("after", unit.symbol), lambda row: format_height(heights, row[3])),
        ("used", lambda row: "held out" if row[4] else "in the fit"),
    )


def format_height(heights: HeightErrors, error: float) -> str:
    """Return an error to the third digit of the largest error before or after."""
    largest = float(np.abs(np.concatenate([heights.before, heights.after])).max())
    factor = heights.unit.factor_to_si
    decimals = count_decimals(largest / factor) if largest > 0.0 else 0
    return f"{round(float(error) / factor, decimals) + 0.0:.{decimals}f}"


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


def no_hint(_: Finding) -> None:
    """Return no advice."""


def view_calibration(
    report: CalibrationReport, verbose: bool = False, hint: Hint = no_hint
) -> list[Block]:
    """Return the page of a calibration.

    Verdict, expected error and its sources, errors with the noise floor, the most important
    findings, the recommendation, the next step, and the parameters. With `verbose` also every
    finding and table.
    """
    fit = report.identification
    rows = fit.to_dict()
    task = ["", str(report.budget)] if report.states_expected_error else []
    blocks: list[Block] = [report.headline, *task, *_view_errors(report, verbose)]
    selected = report.findings if verbose else report.top_findings
    blocks += ["", *format_list([(f.severity.value, add_advice(f, hint(f))) for f in selected])]
    if more := len(report.findings) - len(selected):
        blocks.append(f"  ({more} more finding{'' if more == 1 else 's'} in the full report)")
    if fit.converged and not verbose and fit.regularization is not None:
        blocks.append(f"  {fit.regularization.finding}")
    if report.comparison is not None:
        blocks += ["", str(report.comparison.outcome)]
    blocks += ["", f"Recommendation: {report.recommendation}", f"Next: {report.next_step}"]
    if advice := hint(report.next_step):
        blocks.append(f"Hint: {advice}")
    if fit.converged:
        blocks.append(build_parameter_table("Parameters", rows["parameters"]))
        blocks += _note_intervals(fit)
    elif verbose:
        blocks.append(build_last_value_table(rows["parameters"]))
    if verbose:
        blocks += _view_details(report, rows)
    return blocks


def _view_errors(report: CalibrationReport, verbose: bool) -> list[Block]:
    """Return the tables of errors, at held-out poses or else at the fitted ones, and of heights."""
    if report.validation is not None:
        blocks = view_errors(report.validation, "held-out")
    elif report.fitted_errors is not None:
        blocks = view_errors(report.fitted_errors, "fitted (optimistic)")
    else:
        blocks = []
    if blocks and report.reading_errors is not None:
        blocks.append(READING_NOISE)
    return [*blocks, *view_heights(report.height_errors, verbose)]


def _view_details(report: CalibrationReport, rows: Mapping[str, Any]) -> list[Block]:
    """Return everything that the summary leaves out."""
    fit = report.identification
    blocks: list[Block] = []
    if rows["local"] and fit.converged:
        blocks.append(build_parameter_table("Setup parameters", rows["local"]))
        blocks += _note_intervals(fit)
    blocks += ["", _describe_iteration(fit)]
    if fit.converged and fit.prior_conflict is not None:
        blocks.append(build_prior_table(fit.prior_conflict))
    for suggestion in report.suggestions or ():
        blocks.append(f"Suggested measurement: {suggestion}")
    if report.budget is not None:
        blocks.append(build_budget_table(report.budget.to_dict(), report.robot))
    if report.model_choice is not None:
        blocks.append(report.model_choice.compare_sets())
    if report.reading_errors is not None:
        blocks.append(build_reading_table(report.robot, report.reading_errors))
    errors = report.validation or report.fitted_errors
    if errors is not None:
        blocks += [*view_error_statistics(errors), *describe_improvements(errors)]
    return blocks


def build_parameter_table(
    caption: str, rows: Iterable[Mapping[str, Any]], is_complete: bool = False
) -> Table:
    """Return identified parameters: rows of `Identification.to_dict()["parameters"]`.

    Parameters
    ----------
    is_complete : whether standard uncertainty, degrees of freedom, coverage factor, and the shift
        in tolerances have columns, too.
    """
    details = _list_details() if is_complete else []
    expanded = "U (95 %)" if is_complete else "+/- (95 %)"
    return build_table(
        caption,
        rows,
        ("name", lambda row: row["name"]),
        (Column("nominal"), lambda row: format_exact_beside(row["nominal"], row["plus_minus"])),
        (
            Column("estimate"),
            lambda row: format_with_uncertainty(row["estimate"], row["plus_minus"]),
        ),
        *details,
        (
            Column(expanded),
            lambda row: format_uncertainty(row["plus_minus"]) if row.get("free", True) else "fixed",
        ),
        ("unit", lambda row: row["unit"]),
    )


def _list_details() -> list[tuple[Column, Callable[[Mapping[str, Any]], str]]]:
    """Return the columns of a complete table of parameters."""

    def factor(row: Mapping[str, Any]) -> float:
        return row["plus_minus"] / row["sd"] if row["sd"] > 0.0 else math.nan

    def shift(row: Mapping[str, Any]) -> float:
        return (row["estimate"] - row["nominal"]) / row["tolerance"]

    return [
        (Column("shift [tolerances]"), lambda row: f"{shift(row):+.2f}"),
        (Column("u"), lambda row: format_uncertainty(row["sd"])),
        (Column("degrees of freedom"), lambda row: _format_degrees(row["degrees"])),
        (Column("k"), lambda row: _format_factor(factor(row))),
    ]


def _format_factor(factor: float) -> str:
    """Return a coverage factor with two decimal places."""
    return f"{factor:.2f}" if math.isfinite(factor) else format_number(factor, 3)


def _format_degrees(degrees: float) -> str:
    """Return degrees of freedom, which are infinite where no variance was estimated."""
    if math.isinf(degrees):
        return "infinite"
    if degrees > MANY:
        return f"over {MANY:.0f}"
    return f"{degrees:.0f}" if degrees >= WHOLE else format_number(degrees, 3)


def _note_intervals(fit: Identification) -> list[Block]:
    """Return the sentence below a table of intervals that use a prior."""
    return [] if fit.interval_note is None else [str(fit.interval_note)]


def build_prior_table(conflict: PriorConflict) -> Table:
    """Return the tests of the stated tolerances."""
    whole = ("all deviations", conflict.statistic, conflict.degrees, conflict.p_value, ())
    tests = (("worst direction", conflict.direction), ("worst parameter", conflict.parameter))
    return build_table(
        f"Stated tolerances against the data: p = {format_number(conflict.joint_p_value, 2)} "
        "for the three tests together",
        (whole, *((title, t.statistic, t.count, t.p_value, t.names) for title, t in tests)),
        Field("test", itemgetter(0)),
        Field("statistic [1]", itemgetter(1), digits=3),
        Field("degrees or number", itemgetter(2), digits=3),
        Field("p", itemgetter(3), digits=2),
        ("parameters", lambda row: list_names(row[4])),
    )


def build_last_value_table(rows: Iterable[Mapping[str, Any]]) -> Table:
    """Return the values at which an iteration ended that did not converge, without precision."""
    return build_table(
        "Where the iteration ended (no estimates)",
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
    rows = fit.list_parameters()
    caption = f"{fit.robot.name}: {len(fit.names)} parameters"
    table = build_parameter_table(caption, rows)
    shown = [table, *_note_intervals(fit)] if fit.converged else [build_last_value_table(rows)]
    return [*shown, _describe_iteration(fit)]


def _describe_iteration(fit: Identification) -> str:
    """Return how a fit ended, and its residuals in one number."""
    status = fit.status.name.lower().replace("_", " ")
    ending = f"Iteration: {status} after {fit.history.iterations} steps."
    return f"{ending}\n{fit.describe_statistics()}\n{fit.describe_intervals()}".rstrip()


# --- The uncertainty budget of a calibration on one screen.

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
    length, angle = (robot.shown_units[d] for d in (Dimension.LENGTH, Dimension.ANGLE))
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
        ("source", _name_source),
        ("type", lambda line: line["evaluation"]),
        *shares,
    )


def _show_share(variance: float | None, total: float) -> str:
    """Return a part of a variance in percent; a dash where one of them is not finite."""
    if variance is None or not math.isfinite(total) or total <= 0.0:
        return ABSENT
    share = 100.0 * variance / total
    return "below 0.1" if 0.0 < share < 0.1 else f"{share:.1f}"


def _name_source(line: Mapping[str, Any]) -> str:
    return Source(line["kind"], line["name"], "", 0.0).words


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


# --- Compensation as people read it: the targets with their errors before and after.


def view_compensation(result: Compensation) -> list[Block]:
    """Return the table of targets, the convergence of shifted commands, and the frame."""
    from loopcal.apply.compensation import ROUNDING

    units = result.robot.shown_units
    length, angle = units[Dimension.LENGTH], units[Dimension.ANGLE]
    columns = [word_column("target"), word_column("status")]
    values = []
    for rows, unit in ((slice(3, 6), length), (slice(0, 3), angle)):
        for name, errors in (("before", result.before), ("after", result.remaining)):
            columns.append(Column(name, unit.symbol))
            size = np.linalg.norm(errors[:, rows], axis=1)
            rounding = ROUNDING * (result.robot.size if unit is length else 1.0)
            values.append(np.where(size < rounding, 0.0, size) / unit.factor_to_si)
    if result.uncertainty is not None:
        columns += [Column("U", length.symbol), Column("U", angle.symbol)]
        values += [
            result.uncertainty.expanded_position / length.factor_to_si,
            result.uncertainty.expanded_orientation / angle.factor_to_si,
        ]
    cells = tuple(
        (label, reach.value, *(format_number(float(column[i]), 3) for column in values))
        for i, (label, reach) in enumerate(zip(result.labels, result.reach, strict=True))
    )
    caption = f"{result.robot.name}: {len(cells)} targets, {result.mode}"
    blocks: list[Block] = [Table(caption, tuple(columns), cells)]
    usable = result.usable
    if result.commands is not None and usable.any():
        for step in range(1, len(result.residual_position)):
            position = result.residual_position[step, usable].max() / length.factor_to_si
            turn = result.residual_orientation[step, usable].max() / angle.factor_to_si
            blocks.append(
                f"After step {step}: at most {format_number(position, 3)} {length} and "
                f"{format_number(turn, 3)} {angle} from the best reachable poses."
            )
    if result.uncertainty is not None:
        is_of_all = result.uncertainty.reference.data["frame"] in ("fitted", "base")
        others = "" if is_of_all else " Errors before and after are in the base frame."
        blocks.append(
            "Errors are distances and angles. 95 % of those of the machine after compensation are "
            f"below U. Frame{'' if is_of_all else ' of U'}: {result.uncertainty.frame}.{others}"
        )
    return blocks


# --- Identifiability as people read it: what the data determine, then each parameter.

SD_MEANING = (
    "sd / tolerance: standard deviation with the tolerances as a prior; 1 means that the data add "
    "nothing."
)


MOST_COMBINATIONS = 8
"""Combinations and suggestions that a page lists; the rest is counted."""

COMBINATIONS = ("fit.unidentifiable", "fit.hardly-observable")

FEW_PARAMETERS = 12
"""Parameters that a summary lists one by one."""


def view_identifiability(report: IdentifiabilityReport, verbose: bool = False) -> list[Block]:
    """Return the page of an identifiability analysis.

    Rank, what is undetermined, what to measure, and a table of the parameters of small robots. With
    `verbose` also every combination, the singular values, the table of every robot and the
    observability indices.
    """
    blocks: list[Block] = [str(finding) for finding in report.summary]
    if report.suggestions:
        blocks.append(str(report_finding("identifiability.known-frames-assumed")))
    if verbose:
        blocks += ["", *_view_findings(report)]
    if report.useful is not None and verbose:
        blocks += _view_useful(report.useful)
    if verbose or report.analysis.n_parameters <= FEW_PARAMETERS:
        blocks += _view_parameters(report)
    if verbose:
        blocks.append(_view_indices(report))
    if report.subset is not None:
        blocks += ["", str(report.subset)]
    return blocks


def _view_findings(report: IdentifiabilityReport) -> list[Block]:
    """Return the findings that the summary leaves out, and the measurement for each combination."""
    said = {finding.code for finding in report.summary}
    findings = [f for f in report.analysis.findings if f.code not in said]
    combinations = [f for f in findings if f.code in COMBINATIONS]
    others = [str(f) for f in findings if f.code not in COMBINATIONS]
    return [
        *others,
        *_shorten([str(f) for f in combinations], "combinations"),
        *_shorten([str(suggestion) for suggestion in report.suggestions], "suggestions"),
    ]


def _shorten(lines: list[str], what: str) -> list[Block]:
    """Return the first lines and the number of the others."""
    left = len(lines) - MOST_COMBINATIONS
    more = [f"and {left} more {what}"] if left > 0 else []
    return [*lines[:MOST_COMBINATIONS], *more]


def _view_useful(useful: UsefulAccuracy) -> list[Block]:
    """Return the best and the worst known combinations about the useful accuracy."""
    rows = [*useful.determined[-MOST_COMBINATIONS:], *useful.undetermined[:MOST_COMBINATIONS]]
    table = build_table(
        "Combinations next to the useful accuracy",
        rows,
        (
            word_column("combination of length one", wraps=True),
            lambda row: _name_terms(row.names, row.coefficients),
        ),
        Field("sd", title="sd / useful accuracy", digits=3),
    )
    return [table]


def _name_terms(names: Sequence[str], coefficients: FloatArray) -> str:
    """Return the strongest terms of a combination."""
    terms = [f"{c:+.2f} {name}" for name, c in zip(names, coefficients, strict=True)]
    return list_names(terms, 4).replace(" and ", ", ")


def _view_parameters(report: IdentifiabilityReport) -> list[Block]:
    """Return what the data determine of each parameter."""
    states = {"determined": "yes", "not at all": "no"}
    table = build_table(
        "Parameters",
        report.analysis.parameters,
        Field("name"),
        (
            word_column("determined", wraps=True),
            lambda row: (
                states.get(row.state)
                or f"only with {list_names(row.others, MOST_COMBINATIONS // 2)}"
            ),
        ),
        (Column("sd / tolerance"), lambda row: f"{row.left:.2f}"),
    )
    return [table, SD_MEANING]


def _view_indices(report: IdentifiabilityReport) -> Table:
    """Return the observability indices."""
    return build_table(
        "Observability",
        report.analysis.indices.rows(),
        Field("index", itemgetter(0)),
        (word_column("meaning", wraps=True), itemgetter(2)),
        Field("value", itemgetter(1), digits=3),
    )
