# SPDX-License-Identifier: Apache-2.0
"""The order in which findings are shown: by severity, then by importance."""

from __future__ import annotations

from collections.abc import Iterable

from loopcal.findings.finding import Finding, Severity

SEVERITIES = (
    Severity.REFUSAL,
    Severity.FAILURE,
    Severity.WARNING,
    Severity.SUGGESTION,
    Severity.INFO,
)
"""Most severe first."""

IMPORTANCE = (
    "fit.bad-start",
    "fit.no-descent",
    "fit.no-progress",
    "fit.out-of-iterations",
    "gates.poses-unreachable",
    "gates.errors-grew",
    "noise.residuals-too-large",
    "residuals.frame-moved",
    "residuals.base-targets-moved",
    "gates.limit-exceeded",
    "gates.limit-not-measured",
    "conformity.fails",
    "conformity.undecided",
    "outliers.some",
    "outliers.pose",
    "outliers.ambiguous",
    "outliers.search-not-converged",
    "outliers.conflict",
    "workflow.no-held-out-poses",
    "workflow.few-held-out-poses",
    "workflow.held-out-setup",
    "workflow.undetermined-combinations",
    "validation.setup-moved",
    "prior.machine-changed",
    "prior.agrees-too-well",
    "prior.tolerances-inflated",
    "prior.tolerances-too-narrow",
    "prior.components-inflated",
    "fit.beyond-tolerance",
    "model.no-expected-gain",
    "model.nothing-gained",
    "residuals.lack-of-fit",
    "residuals.repeatability-larger",
    "residuals.common-errors",
    "residuals.heavy-tailed",
    "noise.doubtful",
    "noise.no-degrees-of-freedom",
    "workflow.undetermined-scale",
    "noise.consistent",
    "noise.estimated",
    "outliers.none",
    "outliers.one-degree",
    "workflow.frame-freedoms",
    "prior.machine-unchanged",
    "model.simpler-suffices",
    "model.all-needed",
    "model.expected-gain",
    "residuals.start-not-calibrated",
    "residuals.start-within-noise",
    "residuals.start-is-best",
    "residuals.common-errors-small",
    "prior.undetectable",
    "prior.inflation",
)
"""Codes of findings, most important first. Codes that are absent here come after these."""


def sort_by_importance(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Return findings with the most severe first, and of equal severity the most important."""
    rank = {code: i for i, code in enumerate(IMPORTANCE)}

    def place(finding: Finding) -> tuple[int, int]:
        return SEVERITIES.index(finding.severity), rank.get(finding.code, len(rank))

    return tuple(sorted(findings, key=place))
