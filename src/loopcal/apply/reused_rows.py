# SPDX-License-Identifier: Apache-2.0
"""Rows that a calibration was fitted to are no independent validation."""

from __future__ import annotations

from loopcal.errors import DataError
from loopcal.findings import Finding, Severity, report_finding
from loopcal.measure import FittedRows, Measurements

REFUSED_SHARE = 0.5
"""Share of reused rows from which data are refused for validation."""


def report_reused_rows(fitted: FittedRows | None, data: Measurements) -> Finding | None:
    """Return the finding that some rows belong to a calibration; None where no row does.

    Parameters
    ----------
    fitted : the rows of the calibration; None where they are not known. data : for validation.

    Raises
    ------
    DataError : half of the rows or more belong to it.
    """
    reused = (fitted or FittedRows()).find_in(data)
    if not reused.count:
        return None
    refused = reused.count >= REFUSED_SHARE * reused.total
    finding = report_finding(
        "validation.rows-reused",
        Severity.REFUSAL if refused else Severity.WARNING,
        **reused._asdict(),
    )
    if refused:
        raise DataError(finding)
    return finding
