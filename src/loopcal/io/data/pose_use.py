# SPDX-License-Identifier: Apache-2.0
"""The column `use`: which poses are held out for validation.

It has the same meaning in every file that `load_measurements` reads: measurement files, files that
only hold readings, and those that a file names as `poses`. A cell is a statement about every pose
that its row names. An empty cell states nothing, and a pose without any statement is fitted.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from loopcal.findings import report_finding
from loopcal.io.core.csv_table import Table
from loopcal.io.data.columns import HELD_OUT, USE_COLUMN
from loopcal.io.data.pose_rows import PoseRows
from loopcal.typing import BoolArray


def read_held_out(tables: Sequence[Table], poses: PoseRows) -> BoolArray:
    """Return which poses (n,) the files hold out.

    Parameters
    ----------
    tables : of all files. poses : the poses of their rows.

    Raises
    ------
    FileError : another cell, or two different uses of one pose, with file and line of both.
    """
    stated: dict[int, tuple[str, str]] = {}
    for table, members in zip(tables, poses.members, strict=True):
        for row, cell in enumerate(USE_COLUMN.parse(table)):
            for pose in members[row] if cell else ():
                use, place = stated.setdefault(pose, (cell, table.place(row)))
                if use != cell:
                    finding = report_finding(
                        "data.use-contradicted",
                        pose=poses.labels[pose],
                        use=cell,
                        other_use=use,
                        place=place,
                    )
                    raise table.row_error(row, finding)
    is_held_out = np.zeros(len(poses.labels), dtype=bool)
    is_held_out[[pose for pose, (use, _) in stated.items() if use == HELD_OUT]] = True
    return is_held_out
