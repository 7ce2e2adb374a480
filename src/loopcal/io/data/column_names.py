# SPDX-License-Identifier: Apache-2.0
"""Names that files of measurements, poses and plans cannot have as a column."""

from __future__ import annotations

from loopcal.findings import Finding, report_finding
from loopcal.io.data.columns import COMMANDED, COVARIANCE, MEASURED, ROLES, SIGMA, find_open_column

SHEET_COLUMNS = ("step", "role", "hold", "tolerance")
"""Further columns of the operator's sheet of a plan."""


def find_column_fault(name: str, what: str) -> Finding | None:
    """Return why a column cannot have this name; None where it can.

    Parameters
    ----------
    name : of an actuator or of a measured column. what : what has this name, for the message.
    """
    if "[" in name or "]" in name or name != name.strip():
        return report_finding("files.name-not-a-column", what=what, name=name)
    is_taken = name in (*ROLES, *SHEET_COLUMNS) or find_open_column(name) is not None
    if is_taken or name.startswith((COMMANDED, MEASURED, SIGMA, COVARIANCE)):
        return report_finding("files.name-of-a-column", what=what, name=name)
    return None
