# SPDX-License-Identifier: Apache-2.0
"""Rows of measurement files that measure targets on the base, and checks of these targets."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from loopcal.findings import report_finding
from loopcal.io.core.csv_table import Table
from loopcal.io.data.columns import COMMANDED
from loopcal.io.data.kind_rows import KindRows
from loopcal.mechanism import Mechanism
from loopcal.typing import BoolArray

if TYPE_CHECKING:
    from loopcal.measure import Kind

FEWEST = 2
"""Fewest targets on the base that may determine the frame of an instrument. A single one shows no
rotation, and no other target would reveal its error.
"""


def find_base_rows(table: Table, kinds: Sequence[KindRows]) -> BoolArray:
    """Return the rows (rows,) of a file that measure the base."""
    is_base = np.zeros(len(table), dtype=bool)
    for entry in (entry for entry in kinds if entry.kind.is_of_base):
        is_base[entry.rows] = True
    return is_base


def refuse_poses_of_base(table: Table, is_base: BoolArray, robot: Mechanism) -> None:
    """Raise FileError where a row of the base names a pose, its use or block, or has readings."""
    actuators = [actuator.name for actuator in robot.actuators]
    names = ("pose", "use", "block", *actuators, *(COMMANDED + name for name in robot.controlled))
    for name in (name for name in names if name in table.units):
        cells = table.text(name)
        for row in np.flatnonzero(is_base).tolist():
            if cells[row]:
                sentence = f"this row measures the base and belongs to no pose, but column {name!r}"
                raise table.row_error(row, f"{sentence} is {cells[row]!r}; leave it empty")


def check_base_targets(tables: Sequence[Table], kinds: Sequence[Sequence[KindRows]]) -> None:
    """Refuse a target on the base that is also on a platform, a single target on the base, and
    targets in a frame in which no pose is measured.

    Parameters
    ----------
    tables : of all files. kinds : of each file.

    Raises
    ------
    FileError
        `data.target-on-two-bodies`, `data.base-frame-known`, `data.base-frame-unused` or
        `data.single-base-target`, at the settings of the kind.
    """
    from loopcal.measure.base_rows import list_moving_targets

    all_kinds = [entry.kind for of_file in kinds for entry in of_file]
    known = {target for kind in all_kinds if kind.is_of_base for target in kind.target_columns}
    moving = [kind for kind in all_kinds if not kind.is_of_base]
    frames = tuple(dict.fromkeys(name for kind in moving if (name := _find_frame(kind))))
    for table, of_file in zip(tables, kinds, strict=True):
        for entry in (entry for entry in of_file if entry.kind.is_of_base):
            place = (*entry.location, "targets")
            if shared := list_moving_targets(entry.kind, all_kinds):
                finding = report_finding("data.target-on-two-bodies", targets=shared)
                raise table.settings.error(finding, place)
            name = _find_frame(entry.kind)
            if not name:
                targets = tuple(entry.kind.target_columns)
                finding = report_finding("data.base-frame-known", targets=targets)
                raise table.settings.error(finding, (*entry.location, "of"))
            if moving and name not in frames:
                finding = report_finding("data.base-frame-unused", frame=name, frames=frames)
                key = "frame" if name != "frame" else "unknown"
                raise table.settings.error(finding, (*entry.location, key))
            if len(known) < FEWEST:
                finding = report_finding("data.single-base-target", targets=tuple(known))
                raise table.settings.error(finding, place)


def _find_frame(kind: Kind) -> str:
    """Return the name of the unknown frame in which a kind measures; empty without one."""
    return str(getattr(kind, "frame", "")) if "frame" in kind.unknown else ""
