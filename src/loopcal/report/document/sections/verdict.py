# SPDX-License-Identifier: Apache-2.0
"""Verdict and scope: may the values be used, what does that cover, and how accurate are poses."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from loopcal.report.budget_view import build_share_table
from loopcal.report.document.elements import Element, Listing, Section
from loopcal.report.document.record import CalibrationRecord
from loopcal.report.validation_view import describe_commanded
from loopcal.workflow import Verdict

MEANING = {
    Verdict.CALIBRATED: "All quality gates are met, held-out poses were predicted, and there is no "
    "warning. The recommendation below states whether to use the corrected values.",
    Verdict.RESERVATIONS: "All quality gates are met, but the warnings below affect the accuracy "
    "of the corrected values. The recommendation below states whether to use them.",
    Verdict.UNDECIDED: "No quality gate failed, but the held-out poses do not suffice to state the "
    "accuracy at poses that were not fitted.",
    Verdict.NOT_CALIBRATED: "A quality gate is not met. Do not write these values to a machine.",
}
"""What each verdict means for the user."""

SCOPE = (
    "Scope: the verdict concerns the geometry of {robot} in the region and under the conditions of "
    "the measured poses ({fitted} fitted, {held_out} held out). It does not cover errors that did "
    "not act during the measurement, such as those of other loads, temperatures or speeds."
)

CONFORMITY = "conformity."
"""Beginning of the codes of statements on limits."""

OPEN = ("fit.unidentifiable", "fit.hardly", "workflow.undetermined", "workflow.frame", "setup.")
OUTLYING = ("outliers.", "validation.blunder", "validation.unreachable", "fit.excluded", "fit.low")
OF_RESIDUALS = ("noise.", "residuals.", "prior.")
"""Beginnings of the codes of findings that other sections list."""

TOP = 3
"""Findings that this section shows, beside all failures and warnings."""

IMPORTANT = ("refusal", "failure", "warning")


def build_verdict_section(record: CalibrationRecord) -> Section:
    """Return verdict, scope, expected error with its sources, limits, findings and next step."""
    result = record.result
    fitted, held_out = len(record.fitted_labels), len(record.held_out_labels)
    scope = SCOPE.format(
        robot=record.robot.name, fitted=fitted or "an unknown number", held_out=held_out
    )
    elements: list[Element] = [MEANING[record.verdict], scope]
    budget = result.get("expected_error")
    if budget and result.get("states_expected_error"):
        elements.append(budget["finding"]["text"])
        elements.append(build_share_table(budget))
    judged = [f for f in record.findings if f["code"].startswith(CONFORMITY)]
    if judged:
        elements.append(list_findings(judged))
        commanded = "" if record.validation is None else describe_commanded(record.validation)
        elements += [commanded] if commanded else []
    important = [f for f in select_important(record.findings) if f not in judged]
    if important:
        elements.append(list_findings(important))
    recommendation = result.get("recommendation")  # absent in runs of earlier versions
    if recommendation:
        elements.append(f"Recommendation: {recommendation['text']}")
    next_step = result.get("next_step")
    if next_step:
        elements.append(f"Next: {next_step['text']}")
    return Section("verdict", "Verdict and scope", tuple(elements))


def select_important(findings: Iterable[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Return failures and warnings, which other sections repeat, and as many of the others that no
    other section lists as make up TOP.
    """
    listed = list(findings)
    elsewhere = (CONFORMITY, *OPEN, *OUTLYING, *OF_RESIDUALS)
    urgent = [finding for finding in listed if finding["severity"] in IMPORTANT]
    others = [f for f in listed if f not in urgent and not f["code"].startswith(elsewhere)]
    return [*urgent, *others[: max(TOP - len(urgent), 0)]]


def list_findings(findings: Iterable[Mapping[str, Any]]) -> Listing:
    """Return findings with their severity."""
    return Listing(tuple((finding["severity"], finding["text"]) for finding in findings))
