# SPDX-License-Identifier: Apache-2.0
"""Findings: what loopcal noticed, as codes and numbers; the catalog words them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from loopcal.findings.wording import Quantity as Quantity
from loopcal.plain_text import escape


class Severity(StrEnum):
    """How much a finding matters."""

    INFO = "info"
    """Worth knowing; nothing to do."""

    SUGGESTION = "suggestion"
    """A step that would improve the result."""

    WARNING = "warning"
    """The result is usable with care; the finding says what to check."""

    FAILURE = "failure"
    """The result must not be used as it is: a quality gate is not met."""

    REFUSAL = "refusal"
    """The input was refused before anything was computed."""


@dataclass(frozen=True)
class Finding:
    """What loopcal noticed, in a form that programs can read.

    Build findings with `loopcal.findings.report_finding`, which takes the severity from the catalog
    and checks that `data` holds what the sentence needs.

    Parameters
    ----------
    code : name of the entry in the catalog, `subject.what`, such as `noise.sigma-too-small`.
    severity : how much it matters.
    data : names and numbers of the sentence, ready for JSON. A quantity is a
        `loopcal.findings.Quantity`: a value with the symbol of its unit.
    """

    code: str
    severity: Severity
    data: Mapping[str, Any]

    def __str__(self) -> str:
        """Return the sentence of the catalog."""
        from loopcal.findings.catalog import find_entry

        return find_entry(self.code).word(self.data)

    @property
    def action(self) -> str:
        """What to do next: the action of the catalog, or the last sentence of the text."""
        from loopcal.findings.catalog import find_entry
        from loopcal.findings.wording import fill_template

        action = find_entry(self.code).action
        return fill_template(action, **self.data) if action else str(self).split(". ")[-1]

    def _repr_html_(self) -> str:
        """Return the sentence for notebooks."""
        from html import escape as escape_html

        return f'<div class="loopcal"><pre>{escape_html(escape(str(self), chr(10)))}</pre></div>'

    def to_dict(self) -> dict[str, Any]:
        """Return code, severity, data and text, for `loopcal.results.serialization.to_json`."""
        return {
            "code": self.code,
            "severity": self.severity.value,
            "data": dict(self.data),
            "text": str(self),
        }


def report_finding(code: str, severity: Severity | None = None, **data: Any) -> Finding:
    """Return a finding of the catalog.

    code : of the entry. severity : in place of that of the entry.
    data : what the sentence needs, ready for JSON: numbers, strings, tuples of these, quantities.

    KeyError : the code is not in the catalog, or `data` lacks one of its fields.
    """
    from loopcal.findings.catalog import find_entry

    entry = find_entry(code)
    if missing := entry.fields - data.keys():
        raise KeyError(f"{code} needs {', '.join(sorted(missing))}")
    return Finding(code, entry.severity if severity is None else severity, data)


# Codes of findings, most important first. Codes that are absent here come after these.
IMPORTANCE = """
fit.no-descent fit.no-progress fit.out-of-iterations
gates.poses-unreachable gates.errors-grew
noise.residuals-too-large residuals.frame-moved residuals.base-targets-moved
conformity.fails gates.limit-exceeded gates.limit-not-measured conformity.undecided
outliers.all-poses outliers.some outliers.pose outliers.ambiguous outliers.search-not-converged
outliers.swapped-picture residuals.print-scale residuals.zoomed-picture residuals.moving-picture
residuals.board-moved
outliers.conflict data.several-days
workflow.no-held-out-poses workflow.few-held-out-poses workflow.held-out-setup
workflow.undetermined-combinations validation.setup-moved
prior.machine-changed prior.agree-too-well prior.tolerances-inflated
prior.tolerances-too-narrow prior.components-inflated fit.beyond-tolerance
model.no-expected-gain model.nothing-gained
residuals.lack-of-fit residuals.repeatability-larger
residuals.heavy-tailed
noise.doubtful noise.no-degrees-of-freedom
workflow.height-shift workflow.undetermined-scale
setup.two-solutions setup.fixed identifiability.board-scale
noise.consistent noise.estimated outliers.none outliers.not-testable workflow.height-tilt
workflow.frame-freedoms
prior.machine-unchanged model.simpler-suffices model.all-needed model.expected-gain
residuals.start-not-calibrated residuals.start-within-noise residuals.start-is-best
prior.undetectable prior.inflation
"""


def sort_by_importance(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Return findings with the most severe first, and of equal severity the most important."""
    rank = {code: i for i, code in enumerate(IMPORTANCE.split())}
    severities = list(Severity)

    def place(finding: Finding) -> tuple[int, int]:
        return -severities.index(finding.severity), rank.get(finding.code, len(rank))

    return tuple(sorted(findings, key=place))
