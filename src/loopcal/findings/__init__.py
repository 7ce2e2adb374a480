# SPDX-License-Identifier: Apache-2.0
"""Findings: what loopcal noticed, as codes and numbers; the catalog words them."""

from __future__ import annotations

from typing import Any

from loopcal.findings.finding import Finding as Finding
from loopcal.findings.finding import Severity as Severity
from loopcal.findings.wording import Quantity as Quantity


def report_finding(code: str, severity: Severity | None = None, **data: Any) -> Finding:
    """Return a finding of the catalog.

    Parameters
    ----------
    code : of the entry. severity : in place of that of the entry.
    data : what the sentence needs, ready for JSON: numbers, strings, tuples of these, quantities.

    Raises
    ------
    KeyError : the code is not in the catalog, or `data` lacks one of its fields.
    """
    from loopcal.findings.catalog import find_entry as find_entry

    entry = find_entry(code)
    if missing := entry.fields - data.keys():
        raise KeyError(f"{code} needs {', '.join(sorted(missing))}")
    return Finding(code, entry.severity if severity is None else severity, data)
