# SPDX-License-Identifier: Apache-2.0
"""What the data say of the fit: open combinations, outlying rows, residuals, other findings."""

from __future__ import annotations

from collections.abc import Iterator

from loopcal.report.document.elements import Element, Section
from loopcal.report.document.figures import draw_residual_picture
from loopcal.report.document.record import CalibrationRecord
from loopcal.report.document.sections.verdict import (
    CONFORMITY,
    OF_RESIDUALS,
    OPEN,
    OUTLYING,
    list_findings,
    select_important,
)
from loopcal.report.numbers import format_number

NO_RESIDUALS = (
    "This run folder was written by an earlier version and does not contain the labels of its "
    "residuals. Repeat the calibration to see them."
)


def build_open_section(record: CalibrationRecord) -> Section:
    """Return what the data do not determine, and which measurement would determine it."""
    fit = record.result["fit"]
    names = [row["name"] for row in fit["parameters"]]
    elements: list[Element] = []
    if not record.converged:
        elements.append("The fit did not converge, so it does not state what the data determine.")
    elif fit["rank"] == len(names):
        elements.append(f"The data determine all {len(names)} parameters.")
    else:
        elements.append(
            f"The data determine {fit['rank']} of {len(names)} combinations of the parameters."
        )
    stated = [f for f in record.findings if f["code"].startswith(OPEN)]
    if stated:
        elements.append(list_findings(stated))
    elements += [
        f"Suggested measurement: {suggestion['finding']['text']}"
        for suggestion in record.result.get("remedies") or ()
    ]
    return Section("determined", "What the data do not determine", tuple(elements))


def build_outlier_section(record: CalibrationRecord) -> Section:
    """Return which rows do not fit, and which poses were excluded."""
    stated = [f for f in record.findings if f["code"].startswith(OUTLYING)]
    elements: list[Element] = [list_findings(stated)] if stated else []
    excluded = record.result["fit"].get("dropped") or ()
    if excluded:
        elements.append(f"Excluded from the fit by its options: {', '.join(excluded)}.")
    if not elements:
        elements.append("Outlying rows were not searched for, because the fit did not converge.")
    return Section("outliers", "Outlying rows", tuple(elements))


def build_residual_section(record: CalibrationRecord) -> Section:
    """Return the residuals against the noise, in words and as a figure."""
    fit = record.result["fit"]
    elements: list[Element] = []
    if record.converged and fit["degrees"]:
        elements.append(
            f"Chi-square is {format_number(fit['chi_square'], 4)} with "
            f"{format_number(fit['degrees'], 4)} degrees of freedom (p = "
            f"{format_number(fit['p_value'], 2)})."
        )
    elements += _draw_residuals(record)
    stated = [f for f in record.findings if f["code"].startswith(OF_RESIDUALS)]
    if stated:
        elements.append(list_findings(stated))
    return Section("residuals", "Residuals of the fit", tuple(elements))


def _draw_residuals(record: CalibrationRecord) -> Iterator[Element]:
    """Yield the figure of the residuals, and of how many it shows some."""
    if not record.converged:
        return
    if not record.residuals:
        yield NO_RESIDUALS
        return
    yield from draw_residual_picture(record)


def build_finding_section(record: CalibrationRecord) -> Section:
    """Return the findings that no other section shows."""
    shown = (CONFORMITY, *OPEN, *OUTLYING, *OF_RESIDUALS)
    top = [finding["text"] for finding in select_important(record.findings)]
    rest = [
        finding
        for finding in record.findings
        if not finding["code"].startswith(shown) and finding["text"] not in top
    ]
    return Section("findings", "Other findings", (list_findings(rest),) if rest else ())
