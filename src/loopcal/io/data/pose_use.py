# SPDX-License-Identifier: Apache-2.0
"""The column `use` of a measurement file: which poses are fitted, and which are held out to judge
by.

A plan decides this before anything is measured, so that nobody can choose the poses that look best
afterwards. A cell says `fit` or `held-out`; an empty one says nothing, which is `fit`. Rows that
compare poses need none: such a row is held out with any of its poses.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

from loopcal.io.core.csv_table import quoted, read_table

USE, FIT, HELD_OUT = "use", "fit", "held-out"


def read_pose_use(paths: Sequence[Path]) -> dict[str, str]:
    """Return pose -> fit or held-out, for the poses of which files say so, in the order of the
    files.

    Raises
    ------
    FileError
        A cell says something else, or one pose is both.
    """
    said: dict[str, str] = {}
    for path in paths:
        table = read_table(path)
        if USE not in table.units:
            continue
        names = (
            table.text("pose")
            if "pose" in table.units
            else tuple(str(i + 1) for i in range(len(table.rows)))
        )
        for row, (name, cell) in enumerate(zip(names, table.text(USE), strict=True)):
            if not cell:
                continue
            if cell not in (FIT, HELD_OUT):
                raise table.row_error(
                    row,
                    f"column {USE!r} says {cell!r}; write {FIT} or {HELD_OUT}, or leave it empty",
                )
            if said.setdefault(name, cell) != cell:
                raise table.row_error(
                    row,
                    f"pose {name!r} is {said[name]} in another row and {cell} here; keep one of "
                    "the two",
                )
    return said


def read_held_out_poses(paths: Sequence[Path]) -> tuple[str, ...]:
    """Return the names of the poses that files hold out; raises as `use_of`."""
    return tuple(name for name, use in read_pose_use(paths).items() if use == HELD_OUT)


def insert_use_column(text: str, use: Mapping[str, str]) -> str:
    """Return the text of a measurement file with the column `use` behind the names of the poses."""
    lines, header = [], True
    for line in text.splitlines():
        if line.startswith("#") or not line.strip():
            lines.append(line)
            continue
        cells = next(csv.reader(io.StringIO(line)))
        place = 1 if header else 0
        second = USE if header else use.get(cells[0], "")
        header = header and not place
        lines.append(",".join(quoted(cell) for cell in (cells[0], second, *cells[1:])))
    return "\n".join(lines) + "\n"
