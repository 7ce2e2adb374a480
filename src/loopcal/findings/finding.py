# SPDX-License-Identifier: Apache-2.0
"""A finding: a code, a severity and numbers. The words are in the catalog."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from loopcal.presentation import HtmlResult


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
class Finding(HtmlResult):
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

    def to_dict(self) -> dict[str, Any]:
        """Return code, severity, data and text, for `loopcal.serialization.to_json`."""
        return {
            "code": self.code,
            "severity": self.severity.value,
            "data": dict(self.data),
            "text": str(self),
        }
