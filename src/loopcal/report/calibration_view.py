# SPDX-License-Identifier: Apache-2.0
"""A calibration as people read it: the verdict first, then the parameters."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from loopcal.estimate import Identification
from loopcal.estimate.result import LAST_DIGITS
from loopcal.findings import Finding
from loopcal.findings.wording import list_names
from loopcal.mechanism import Mechanism
from loopcal.report.height_view import view_heights
from loopcal.report.numbers import (
    format_exact_beside,
    format_in,
    format_number,
    format_uncertainty,
    format_with_uncertainty,
    units_of,
)
from loopcal.report.tables import Column, Table, build_table, word_column
from loopcal.report.text_page import Block, format_list
from loopcal.report.validation_view import (
    READING_NOISE,
    describe_improvements,
    view_error_statistics,
    view_errors,
)
from loopcal.workflow import CalibrationReport

if TYPE_CHECKING:
    from loopcal.diagnose import ModelChoice, ReadingError
    from loopcal.estimate import PriorConflict

WHOLE, MANY = 100.0, 10_000.0
"""Degrees of freedom from which they are shown without decimals, and from which they no longer
matter.
"""

Hint = Callable[[Finding], str | None]
"""From a finding to advice of the caller, such as a command-line option."""


def no_hint(_: Finding) -> None:
    """Return no advice."""


def with_hint(finding: Finding, hint: Hint) -> str:
    """Return the text of a finding, with its advice in parentheses where there is any."""
    advice = hint(finding)
    return str(finding) if advice is None else f"{finding} (Hint: {advice})"


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
    blocks += ["", *format_list([(f.severity.value, with_hint(f, hint)) for f in selected])]
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
    from loopcal.report.budget_view import build_budget_table

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
        blocks.append(build_model_table(report.model_choice))
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
        (word_column("name"), lambda row: row["name"]),
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
        (word_column("unit"), lambda row: row["unit"]),
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
    rows = (
        ("all deviations", conflict.statistic, conflict.degrees, conflict.p_value, ()),
        *(
            (title, test.statistic, test.count, test.p_value, test.names)
            for title, test in (
                ("worst direction", conflict.direction),
                ("worst parameter", conflict.parameter),
            )
        ),
    )
    return build_table(
        f"Stated tolerances against the data: p = {format_number(conflict.joint_p_value, 2)} "
        "for the three tests together",
        rows,
        (word_column("test"), lambda row: row[0]),
        (Column("statistic [1]"), lambda row: format_number(row[1], 3)),
        (Column("degrees or number"), lambda row: format_number(row[2], 3)),
        (Column("p"), lambda row: format_number(row[3], 2)),
        (word_column("parameters"), lambda row: list_names(row[4])),
    )


def build_last_value_table(rows: Iterable[Mapping[str, Any]]) -> Table:
    """Return the values at which an iteration ended that did not converge, without precision."""
    return build_table(
        "Where the iteration ended (no estimates)",
        rows,
        (word_column("name"), lambda row: row["name"]),
        (Column("nominal"), lambda row: format_number(row["nominal"])),
        (Column("last value"), lambda row: format_number(row["estimate"], LAST_DIGITS)),
        (word_column("unit"), lambda row: row["unit"]),
    )


def build_model_table(choice: ModelChoice) -> Table:
    """Return the comparison of parameter sets."""
    return build_table(
        "Parameter sets: mean square error on held-out poses [sigma^2], conditioning",
        choice.candidates,
        (word_column("free"), lambda row: row.name + " (chosen)" * (row is choice.chosen)),
        (Column("parameters"), lambda row: str(len(row.parameters))),
        (Column("rank"), lambda row: str(row.conditioning.rank)),
        (Column("condition"), lambda row: format_number(row.conditioning.condition, 3)),
        (Column("score"), lambda row: format_number(row.score, 4)),
        (Column("+/-"), lambda row: format_number(row.standard_error, 2)),
    )


def build_reading_table(robot: Mechanism, errors: Sequence[ReadingError]) -> Table:
    """Return recorded actuator readings minus the estimated ones."""
    units = units_of(robot)
    count = max(error.count for error in errors)
    return build_table(
        f"Actuator readings, recorded minus estimated, of up to {count} poses",
        errors,
        (word_column("reading"), lambda row: row.name),
        (Column("rms"), lambda row: format_in(units[row.reading_dimension], row.reading, 3)),
        (word_column("unit"), lambda row: units[row.reading_dimension].symbol),
        (
            Column("rms of the joint"),
            lambda row: format_in(units[row.joint_dimension], row.joint, 3),
        ),
        (Column("largest"), lambda row: format_in(units[row.joint_dimension], row.largest, 3)),
        (word_column("unit"), lambda row: units[row.joint_dimension].symbol),
        (word_column("at pose"), lambda row: row.pose),
    )


def view_fit(fit: Identification) -> list[Block]:
    """Return the parameters of a fit and how it ended."""
    rows = fit.to_dict()["parameters"]
    caption = f"{fit.robot.name}: {len(fit.names)} parameters"
    table = build_parameter_table(caption, rows)
    shown = [table, *_note_intervals(fit)] if fit.converged else [build_last_value_table(rows)]
    return [*shown, _describe_iteration(fit)]


def _describe_iteration(fit: Identification) -> str:
    """Return how a fit ended, and its residuals in one number."""
    status = fit.status.name.lower().replace("_", " ")
    ending = f"Iteration: {status} after {fit.history.iterations} steps."
    return f"{ending}\n{fit.describe_statistics()}\n{fit.describe_intervals()}".rstrip()
