# SPDX-License-Identifier: Apache-2.0
"""Pose accuracy and repeatability as people read them."""

from __future__ import annotations

from loopcal.apply.repeatability_result import DIMENSIONS, Estimate, Repeatability, VisitedPose
from loopcal.mechanism import Mechanism
from loopcal.report.numbers import format_number, units_of
from loopcal.report.tables import Column, Table, word_column
from loopcal.report.text_page import Block, format_list
from loopcal.units import DISPLAY_UNITS, Dimension, Unit


def view_repeatability(result: Repeatability, robot: Mechanism | None = None) -> list[Block]:
    """Return the page of pose accuracy and repeatability, in the units of a robot's file."""
    units = DISPLAY_UNITS if robot is None else units_of(robot)
    blocks: list[Block] = []
    for quantity, poses in result.poses.items():
        unit = units[DIMENSIONS[quantity]]
        rows = tuple(row for pose in poses for row in _list_rows(pose, unit))
        columns = (
            *map(word_column, ("pose", "target", "approach")),
            Column("visits"),
            word_column("of"),
            *map(Column, ("AP", "from", "to", "RP", "from", "to")),
            word_column("unit"),
        )
        caption = f"{quantity.capitalize()} by ISO 9283 with intervals of 95 %, {result.frame}"
        blocks.append(_drop_empty(Table(caption, columns, rows)))
    unit = units[Dimension.LENGTH]
    for (pose, target), value in result.variations.items():
        of = f"{pose}, target {target}" if target else pose
        number = format_number(value / unit.factor_to_si, 3)
        blocks.append(
            f"Variation between directions of approach (vAP) at pose {of}: {number} {unit.symbol}."
        )
    notes = [(f.severity.value, str(f)) for f in result.findings]
    return [*blocks, "", *format_list(notes)] if notes else blocks


def _list_rows(pose: VisitedPose, unit: Unit) -> list[tuple[str, ...]]:
    """Return the rows of a pose: the whole position, then its components."""
    rows = []
    named = list(zip(pose.components, pose.accuracies, pose.repeatabilities, strict=True))
    if pose.accuracy is not None and pose.repeatability is not None and len(named) > 1:
        named.insert(0, ("position", pose.accuracy, pose.repeatability))
    for name, accuracy, repeatability in named:
        first = (pose.pose, pose.target, pose.direction, str(pose.visits))
        numbers = (*_format(accuracy, unit), *_format(repeatability, unit))
        rows.append((*first, name, *numbers, unit.symbol))
    return rows


def _format(estimate: Estimate, unit: Unit) -> tuple[str, ...]:
    """Return a value and the bounds of its interval as text."""
    return tuple(format_number(x / unit.factor_to_si, 3) for x in estimate)


def _drop_empty(table: Table) -> Table:
    """Return a table without columns that are empty in all rows."""
    kept = [i for i in range(len(table.columns)) if any(row[i] for row in table.rows)]
    rows = tuple(tuple(row[i] for i in kept) for row in table.rows)
    return Table(table.caption, tuple(table.columns[i] for i in kept), rows)
