# SPDX-License-Identifier: Apache-2.0
"""A calibration as people read it: the verdict first, then the parameters."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from loopcal.diagnose import ModelChoice, ReadingError
from loopcal.estimate import Identification
from loopcal.findings import Finding
from loopcal.mechanism import Mechanism
from loopcal.report.numbers import (
    format_number,
    format_uncertainty,
    format_with_uncertainty,
    units_of,
)
from loopcal.report.tables import Column, Table, word_column
from loopcal.report.text_page import Block, format_list
from loopcal.report.validation_view import (
    build_error_statistics,
    build_error_summary,
    describe_improvements,
    is_fully_compensable,
)
from loopcal.workflow import CalibrationReport

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

    Verdict, errors with the noise floor, the most important findings, the next step, and the
    parameters. With `verbose` also every finding and table.
    """
    fit = report.identification
    rows = fit.to_dict()
    blocks: list[Block] = [report.headline, *_view_errors(report)]
    shown = report.findings if verbose else report.top_findings
    blocks += ["", *format_list([(f.severity.value, with_hint(f, hint)) for f in shown])]
    if more := len(report.findings) - len(shown):
        blocks.append(f"  ({more} more finding{'' if more == 1 else 's'} in the full report)")
    blocks += ["", f"Next: {report.next_step}"]
    if advice := hint(report.next_step):
        blocks.append(f"Hint: {advice}")
    blocks.append(build_parameter_table("Parameters", rows["parameters"]))
    if verbose:
        blocks += _view_details(report, rows)
    return blocks


def _view_errors(report: CalibrationReport) -> list[Block]:
    """Return the table of errors, on held-out poses or else on the fitted ones."""
    if report.validation is not None:
        n = len(report.validation.poses)
        caption = f"Error on {n} held-out {'row' if n == 1 else 'rows'} (rms)"
        return [build_error_summary(report.validation, caption)]
    if report.fitted_errors is not None:
        caption = "Error on the fitted poses (rms), which is optimistic"
        return [build_error_summary(report.fitted_errors, caption)]
    return []


def _view_details(report: CalibrationReport, rows: Mapping[str, Any]) -> list[Block]:
    """Return everything that the summary leaves out."""
    fit = report.identification
    blocks: list[Block] = []
    if rows["local"]:
        blocks.append(build_parameter_table("Setup parameters", rows["local"]))
    blocks += [
        "",
        (
            f"Iteration: {fit.status.name.lower().replace('_', ' ')} after "
            f"{fit.history.iterations} steps; "
            f"rank {fit.rank} of {len(fit.names)}."
        ),
        f"Chi-square {fit.chi_square:.5g} with {rows['degrees']:.4g} degrees of freedom.",
    ]
    for suggestion in report.suggestions or ():
        blocks.append(f"Suggested measurement: {suggestion}")
    if report.model_choice is not None:
        blocks.append(build_model_table(report.model_choice))
    if report.reading_errors is not None:
        blocks.append(build_reading_table(report.robot, report.reading_errors))
    errors = report.validation or report.fitted_errors
    if errors is not None:
        blocks += [build_error_statistics(errors), *describe_improvements(errors)]
        if is_fully_compensable(errors):
            blocks.append("The actuators can correct all of the measured error.")
    return blocks


def build_parameter_table(caption: str, rows: Iterable[Mapping[str, Any]]) -> Table:
    """Return identified parameters: rows of `Identification.to_dict()["parameters"]`."""
    columns = (
        word_column("name"),
        Column("nominal"),
        Column("estimate"),
        Column("+/- (95 %)"),
        Column("unit", align="left"),
    )
    cells = []
    for row in rows:
        half = row["plus_minus"]
        values = (format_with_uncertainty(row[name], half) for name in ("nominal", "estimate"))
        is_fixed = not row.get("free", True)
        uncertainty = "fixed" if is_fixed else format_uncertainty(half)
        cells.append((row["name"], *values, uncertainty, row["unit"]))
    return Table(caption, columns, tuple(cells))


def build_model_table(choice: ModelChoice) -> Table:
    """Return the comparison of parameter sets."""
    columns = (word_column("free"), Column("parameters"), Column("score"), Column("+/-"))
    rows = tuple(
        (
            candidate.name + (" (chosen)" if candidate is choice.chosen else ""),
            str(len(candidate.parameters)),
            format_number(candidate.validation.score, 4),
            format_number(candidate.validation.standard_error, 2),
        )
        for candidate in choice.candidates
    )
    return Table("Parameter sets, mean square error on held-out poses [sigma^2]", columns, rows)


def build_reading_table(robot: Mechanism, errors: Sequence[ReadingError]) -> Table:
    """Return recorded actuator readings minus the estimated ones."""
    units = units_of(robot)
    rows = []
    for error in errors:
        reading, joint = units[error.reading_dimension], units[error.joint_dimension]
        moved = (error.joint / joint.factor_to_si, error.largest / joint.factor_to_si)
        rows.append(
            (
                error.name,
                format_number(error.reading / reading.factor_to_si, 3),
                reading.symbol,
                *(format_number(value, 3) for value in moved),
                joint.symbol,
                error.pose,
            )
        )
    columns = (
        word_column("reading"),
        Column("rms"),
        Column("unit", align="left"),
        Column("rms of the joint"),
        Column("largest"),
        Column("unit", align="left"),
        word_column("at pose"),
    )
    count = max(error.count for error in errors)
    caption = f"Actuator readings, recorded minus estimated, of up to {count} poses"
    return Table(caption, columns, tuple(rows))


def view_fit(fit: Identification) -> list[Block]:
    """Return the parameters of a fit and how it ended."""
    rows = fit.to_dict()
    return [
        build_parameter_table(f"{fit.robot.name}: {len(fit.names)} parameters", rows["parameters"]),
        (
            f"Iteration: {fit.status.name.lower().replace('_', ' ')}; rank {fit.rank} of "
            f"{len(fit.names)}; chi-square {fit.chi_square:.5g}."
        ),
    ]
