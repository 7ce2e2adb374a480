# SPDX-License-Identifier: Apache-2.0
"""Read printed tables, to compare pages with the output of commands."""


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
