# SPDX-License-Identifier: Apache-2.0
"""Temporary: options and findings of a fit, until the fit itself has them."""

from __future__ import annotations

from typing import Any

from loopcal.findings import Finding, report_finding


def findings_of(*sources: Any) -> list[Finding]:
    """Return the findings of results, some of which still have sentences."""
    result: list[Finding] = []
    for source in sources:
        if source is None:
            continue
        notes = getattr(source, "findings", None)
        if notes is None:
            notes = getattr(source, "notes", None) or getattr(source, "sentences", None)
        if notes is None:
            notes = (getattr(source, "finding", None) or source.sentence,)
        result += [
            note if isinstance(note, Finding) else report_finding("workflow.note", text=str(note))
            for note in notes
        ]
    return result
