# SPDX-License-Identifier: Apache-2.0
"""Read printed reports and their tables, to compare pages with the output of commands."""

import re


def read_table_rows(text: str) -> list[list[str]]:
    """Return the cells of the rows below each rule of a table in `text`, up to an empty line."""
    rows, in_table = [], False
    for line in text.splitlines():
        if line and not line.strip("─"):
            in_table = True
        elif not line or line.startswith("```"):
            in_table = False
        elif in_table:
            rows.append(line.split())
    return rows


def read_report(text: str) -> str:
    """Return a printed calibration report of a page or of a command, from the verdict on.

    The number of findings that only the full report has is left out.
    """
    report = text[text.index("Undecided: ") :].partition("```")[0]
    return re.sub(r"\(\d+ more findings", "(more findings", report)
