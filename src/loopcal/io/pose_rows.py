# SPDX-License-Identifier: Apache-2.0
"""Which pose each row of a measurement file saw, and the readings of every pose.

Rows with one name in the column `pose` saw one pose; its readings stand in the first of them and are the same, or left
out, in the others. `a;b` names the poses that a row compares, which have rows of their own.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from loopcal.errors import nearest
from loopcal.io.csv_table import Table, require_columns
from loopcal.io.robot_file import load_robot
from loopcal.units import Dimension

if TYPE_CHECKING:
    import numpy as np

    from loopcal.mechanism import Mechanism

COMMANDED, LINK = "commanded.", ";"


@dataclass(frozen=True)
class PoseRows:
    """The n poses of a file.

    Parameters
    ----------
    labels : tuple of str
        Names of the poses.
    readings : ndarray
        (n, a) [SI].
    block : ndarray
        (n,) poses of equal number are never split.
    members : tuple of tuple of int
        The poses that each row of the file saw.
    """

    labels: tuple[str, ...]
    readings: np.ndarray
    block: np.ndarray
    members: tuple[tuple[int, ...], ...]


def read_pose_rows(table: Table, robot: Mechanism) -> PoseRows:
    """Read the columns `pose`, `block`, and those of the readings or of commanded coordinates.

    Raises
    ------
    FileError
        A pose without readings or with two sets of them, a comparison with a pose that is not there.
    DataError
        A commanded pose that the controller cannot reach.
    """
    import numpy as np

    from loopcal.measure import readings_from_commanded

    names = table.text("pose") if "pose" in table.units else tuple(str(i + 1) for i in range(len(table.rows)))
    first = _first_rows(table, names)
    labels, place = tuple(first), {name: i for i, name in enumerate(first)}
    members = tuple(_members(table, row, cell, place) for row, cell in enumerate(names))
    controller = _controller(table, robot)
    rows = _rows(table, robot, controller)
    for row, seen in enumerate(members):
        origin = first[labels[seen[0]]]
        if row == origin:
            for column in np.flatnonzero(np.isnan(rows[row])):
                raise table.row_error(row, f"column {list(_dimensions(robot, controller))[column]!r} is empty; write its value")
        elif not (np.isnan(rows[row]).all() or (len(seen) == 1 and (rows[row] == rows[origin]).all())):
            has = f"pose {names[row]!r} has other readings here than in line {table.lines[origin]}; give it another name"
            links = f"a row that compares poses ({names[row]!r}) has no readings of its own; leave these cells empty"
            raise table.row_error(row, has if len(seen) == 1 else links)
    readings = rows[list(first.values())]
    if controller is not None:
        readings = readings_from_commanded(controller, readings, labels)
    return PoseRows(labels, readings, _blocks(table, first), members)


def measured_name(column: str, robot: Mechanism) -> str:
    """Return what a file calls a measured column: `measured.q1` where a reading has the plain name."""
    taken = {"pose", "block", "kind", *(actuator.name for actuator in robot.actuators)}
    return f"measured.{column}" if column in taken else column


def dimension_of(coordinate: str) -> Dimension:
    """Return what a controlled coordinate measures: x, y, z lengths, the others angles."""
    return Dimension.LENGTH if coordinate in ("x", "y", "z") else Dimension.ANGLE


def _first_rows(table: Table, names: tuple[str, ...]) -> dict[str, int]:
    """Return pose -> its first row, in the order of the file."""
    first: dict[str, int] = {}
    for row, cell in enumerate(names):
        if not cell:
            raise table.row_error(row, "column 'pose' is empty, but every row needs it; write a name or a number")
        if LINK not in cell:
            first.setdefault(cell, row)
    if not first:
        raise table.row_error(0, "no row has readings of a pose; give each compared pose a row of its own")
    return first


def _members(table: Table, row: int, cell: str, place: dict[str, int]) -> tuple[int, ...]:
    """Return the poses that a row saw."""
    found = []
    for name in (part.strip() for part in cell.split(LINK)):
        if name not in place:
            hint = nearest(name, place)
            raise table.row_error(row, f"there is no pose {name!r}{hint}; give it a row with its readings")
        found.append(place[name])
    return tuple(found)


def _dimensions(robot: Mechanism, controller: Mechanism | None) -> dict[str, Dimension]:
    """Return column -> dimension of the readings, or of what the controller was commanded to."""
    if controller is None:
        return {actuator.name: actuator.dimension for actuator in robot.actuators}
    return {COMMANDED + name: dimension_of(name) for name in controller.controlled}


def _rows(table: Table, robot: Mechanism, controller: Mechanism | None) -> np.ndarray:
    """Return (rows, a or c) readings or commanded coordinates [SI], NaN where a row has none."""
    import numpy as np

    dimensions = _dimensions(robot, controller)
    why = f"is the reading of an actuator of {robot.name}"
    if controller is not None:
        why = f"is a coordinate that {controller.name} is commanded in"
        read = [a.name for a in robot.actuators if a.name in table.units]
        if read:
            raise table.header_error(f"there are readings ({read[0]!r}) and commanded coordinates; keep one of the two")
    require_columns(table, list(dimensions), why)
    return np.column_stack([table.numbers(name, dimension) for name, dimension in dimensions.items()])


def _controller(table: Table, robot: Mechanism) -> Mechanism | None:
    """Return the robot whose geometry turned commanded coordinates into readings; None where readings are given."""
    name = table.settings.content.get("controller")
    if not any(column.startswith(COMMANDED) for column in table.names):
        if name is not None:
            sentence = "a controller is named, but there are readings, not commanded coordinates; remove 'controller'"
            raise table.settings.error(sentence, ("controller",))
        return None
    if name is None:
        return robot.nominal
    beside = table.path.parent / str(name)
    return load_robot(beside if beside.exists() else str(name))


def _blocks(table: Table, first: dict[str, int]) -> np.ndarray:
    """Return (n,) block numbers: those of the column `block` in the first row of each pose, else each pose alone."""
    import numpy as np

    if "block" not in table.units:
        return np.arange(len(first))
    cells = [table.text("block")[row] for row in first.values()]
    for row, cell in zip(first.values(), cells, strict=True):
        if not cell:
            raise table.row_error(row, "column 'block' is empty, but every pose needs it; write a name or a number")
    order = {cell: i for i, cell in enumerate(dict.fromkeys(cells))}
    return np.array([order[cell] for cell in cells])
