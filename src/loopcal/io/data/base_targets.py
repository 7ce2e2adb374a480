# SPDX-License-Identifier: Apache-2.0
"""Rows of measurement files that measure targets on the base, and checks of these targets."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from loopcal.findings import report_finding
from loopcal.io.core.csv_table import Table
from loopcal.io.data.kind_rows import KindRows
from loopcal.typing import BoolArray

FEWEST = 2
"""Targets on the base, at least, by which an instrument finds its frame. One shows no rotation, and
a wrong one could not be noticed.
"""


def find_base_rows(table: Table, kinds: Sequence[KindRows]) -> BoolArray:
    """Return the rows (rows,) of a file that measure the base."""
    is_base = np.zeros(len(table), dtype=bool)
    for entry in (entry for entry in kinds if entry.kind.is_of_base):
        is_base[entry.rows] = True
    return is_base


def check_base_targets(
    tables: Sequence[Table], kinds: Sequence[Sequence[KindRows]]
) -> None:
    """Refuse a target on the base that is also on a platform, and a single target on the base.

    Parameters
    ----------
    tables : of all files. kinds : of each file.

    Raises
    ------
    FileError
        `data.target-on-two-bodies` or `data.single-base-target`, at the settings of the kind.
    """
    from loopcal.measure.base_rows import list_moving_targets

    every = [entry.kind for of_file in kinds for entry in of_file]
    known = {target for kind in every if kind.is_of_base for target in kind.target_columns}
    for table, of_file in zip(tables, kinds, strict=True):
        for entry in (entry for entry in of_file if entry.kind.is_of_base):
            place = (*entry.location, "targets")
            if shared := list_moving_targets(entry.kind, every):
                finding = report_finding("data.target-on-two-bodies", targets=shared)
                raise table.settings.error(finding, place)
            if len(known) < FEWEST and "frame" in entry.kind.unknown:
                finding = report_finding("data.single-base-target", targets=tuple(known))
                raise table.settings.error(finding, place)
