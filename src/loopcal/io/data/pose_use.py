# SPDX-License-Identifier: Apache-2.0
"""The column `use` of measurement files: poses for the fit, and held-out poses for validation.

A plan fills it in before anything is measured, so that the choice does not depend on the results.
An empty cell means `fit`. A row that compares poses is held out with any of its poses.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path

from loopcal.io.core.csv_table import quote_cell, read_table
from loopcal.io.data.column_types import TextColumn
from loopcal.io.data.columns import FIT, HELD_OUT

USE = "use"
USE_COLUMN = TextColumn(USE, (FIT, HELD_OUT))


def read_pose_use(paths: Sequence[Path]) -> dict[str, str]:
    """Return pose -> `fit` or `held-out`, for the poses whose use is stated, in order.

    Raises
    ------
    FileError : another cell, or two different uses of one pose.
    """
    uses: dict[str, str] = {}
    for path in paths:
        table = read_table(path)
        cells = USE_COLUMN.parse(table)
        for row, (name, cell) in enumerate(zip(table.pose_names(), cells, strict=True)):
            if cell and uses.setdefault(name, cell) != cell:
                sentence = f"pose {name!r} is {cell} here and {uses[name]} in another row"
                raise table.row_error(row, f"{sentence}; correct one")
    return uses


def read_held_out_poses(paths: Sequence[Path]) -> tuple[str, ...]:
    """Return the names of the poses that files hold out; raise as `read_pose_use`."""
    return tuple(name for name, use in read_pose_use(paths).items() if use == HELD_OUT)


def insert_use_column(text: str, uses: Mapping[str, str]) -> str:
    """Return the text of a measurement file with the column `use` after the names of the poses."""
    lines, is_header = [], True
    for line in text.splitlines():
        if line.startswith("#") or not line.strip():
            lines.append(line)
            continue
        name, *cells = next(csv.reader([line]))
        use = USE if is_header else uses.get(name, "")
        lines.append(",".join(quote_cell(cell) for cell in (name, use, *cells)))
        is_header = False
    return "\n".join(lines) + "\n"
