# SPDX-License-Identifier: Apache-2.0
"""Compensation as people read it: the targets with their errors before and after."""

from __future__ import annotations

import numpy as np

from loopcal.apply import Compensation
from loopcal.apply.compensation import ROUNDING
from loopcal.report.numbers import format_number, units_of
from loopcal.report.tables import Column, Table, word_column
from loopcal.report.text_page import Block
from loopcal.units import Dimension


def view_compensation(result: Compensation) -> list[Block]:
    """Return the table of targets, the convergence of shifted commands, and the frame."""
    units = units_of(result.robot)
    length, angle = units[Dimension.LENGTH], units[Dimension.ANGLE]
    columns = [word_column("target"), word_column("status")]
    values = []
    for rows, unit in ((slice(3, 6), length), (slice(0, 3), angle)):
        for name, errors in (("before", result.before), ("after", result.remaining)):
            columns.append(Column(name, unit.symbol))
            size = np.linalg.norm(errors[:, rows], axis=1)
            rounding = ROUNDING * (result.robot.size if unit is length else 1.0)
            values.append(np.where(size < rounding, 0.0, size) / unit.factor_to_si)
    if result.uncertainty is not None:
        columns += [Column("U", length.symbol), Column("U", angle.symbol)]
        values += [
            result.uncertainty.expanded_position / length.factor_to_si,
            result.uncertainty.expanded_orientation / angle.factor_to_si,
        ]
    cells = tuple(
        (label, reach.value, *(format_number(float(column[i]), 3) for column in values))
        for i, (label, reach) in enumerate(zip(result.labels, result.reach, strict=True))
    )
    caption = f"{result.robot.name}: {len(cells)} targets, {result.mode}"
    blocks: list[Block] = [Table(caption, tuple(columns), cells)]
    usable = result.usable
    if result.commands is not None and usable.any():
        for step in range(1, len(result.residual_position)):
            position = result.residual_position[step, usable].max() / length.factor_to_si
            turn = result.residual_orientation[step, usable].max() / angle.factor_to_si
            blocks.append(
                f"After step {step}: at most {format_number(position, 3)} {length} and "
                f"{format_number(turn, 3)} {angle} from the best reachable poses."
            )
    if result.uncertainty is not None:
        is_of_all = result.uncertainty.reference.data["frame"] in ("fitted", "base")
        others = "" if is_of_all else " Errors before and after are in the base frame."
        blocks.append(
            "Errors are distances and angles. 95 % of those of the machine after compensation are "
            f"below U. Frame{'' if is_of_all else ' of U'}: {result.uncertainty.frame}.{others}"
        )
    return blocks
