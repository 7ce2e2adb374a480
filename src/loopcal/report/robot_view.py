# SPDX-License-Identifier: Apache-2.0
"""A robot as people read it: actuators and parameters, in the units of its file."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from loopcal.findings.wording import name_count
from loopcal.mechanism import TRIANGLE_TERMS, Mechanism, compute_range
from loopcal.report.numbers import format_in, format_number, format_with_uncertainty, units_of
from loopcal.report.tables import Column, Table, build_table, word_column
from loopcal.report.text_page import Block, format_list
from loopcal.units import Dimension
from loopcal.workflow.robot_inspection import RobotInspection

DIGITS = 9
"""Significant digits of nominal values."""

RESOLUTION = 1e-5
"""Share of the stroke to which a reading at home is shown."""

NO_NUMBER = float("nan")


def view_robot(inspection: RobotInspection) -> list[Block]:
    """Return the page of a robot."""
    robot = inspection.robot
    n, free = len(robot.parameters), int(robot.parameters.free.sum())
    actuators, parameters = name_count(len(robot.actuators), "actuator"), name_count(n, "parameter")
    return [
        f"{robot.name}: {actuators}, {parameters}, {free} free",
        f"file: {robot.record.path}",
        f"freedoms: {' '.join(robot.freedoms)}",
        f"commanded in: {' '.join(robot.controlled)}",
        *format_list([(f.severity.value, str(f)) for f in inspection.findings]),
        _build_actuator_table(inspection),
        *([_build_triangle_table(robot)] if any(a.is_triangle for a in robot.actuators) else []),
        *([_build_sum_table(robot)] if any(a.weights for a in robot.actuators) else []),
        *([_build_parameter_table(robot)] if len(robot.parameters) else []),
        *([_build_common_error_table(robot)] if robot.parameters.common else []),
    ]


def _build_actuator_table(inspection: RobotInspection) -> Table:
    """Return strokes and readings at home."""
    units = units_of(inspection.robot)
    rows = []
    pairs = zip(inspection.robot.actuators, inspection.home_readings, strict=True)
    for actuator, reading in pairs:
        unit = units[actuator.dimension]
        low, high = actuator.stroke or (NO_NUMBER, NO_NUMBER)
        low, high, home = (float(v) / unit.factor_to_si for v in (low, high, reading))
        at_home = format_with_uncertainty(home, RESOLUTION * (high - low), DIGITS)
        rows.append((actuator.name, format_number(low), format_number(high), at_home, str(unit)))
    numbers = (Column(title) for title in ("lowest", "highest", "at home"))
    columns = (word_column("name"), *numbers, word_column("unit"))
    return Table("Actuators", columns, tuple(rows))


def _build_triangle_table(robot: Mechanism) -> Table:
    """Return the lengths of triangle drives at their dead points, and the angles there."""
    units = units_of(robot)
    length, angle = units[Dimension.LENGTH], units[Dimension.ANGLE]
    rows = []
    for actuator in robot.actuators:
        if actuator.is_triangle:
            terms = np.array([actuator.terms[term] for term in TRIANGLE_TERMS])
            middle, ends = terms[-1], np.array([-1.0, 1.0]) * terms[-2] * np.pi / 2
            numbers = [format_in(length, float(end), 6) for end in compute_range(terms)]
            angles = [format_in(angle, float(end), 6) for end in middle + ends]
            rows.append((actuator.name, *numbers, length.symbol, *angles, angle.symbol))
    columns = (
        word_column("drive"),
        *(Column(title) for title in ("shortest", "longest")),
        word_column("unit"),
        *(Column(title) for title in ("joint at shortest", "at longest")),
        word_column("unit"),
    )
    return Table("Triangles: dead points, where a drive turns nothing", columns, tuple(rows))


def _build_sum_table(robot: Mechanism) -> Table:
    """Return what each reading is a sum of."""
    rows = [
        (a.name, format_sum(a.weights or dict.fromkeys(a.driven_joints, 1.0)))
        for a in robot.actuators
    ]
    columns = (word_column("reading"), word_column("sum of joint values", wraps=True))
    if robot.has_open_sums:
        count = f"{len(robot.actuators)} of {robot.program.n_joints} joints"
        return Table(f"Sums: {count}, each of which the pose determines", columns, tuple(rows))
    return Table("Sums: what the transmission of a reading gives", columns, tuple(rows))


def format_sum(weights: Mapping[str, float]) -> str:
    """Return a weighted sum as text, such as `m + 2 k`."""
    text = ""
    for name, weight in weights.items():
        if weight:
            size = "" if abs(weight) == 1.0 else f"{format_number(abs(weight), DIGITS)} "
            sign = " - " if weight < 0.0 else " + "
            text += f"{sign if text else sign.strip(' +')}{size}{name}"
    return text


def _build_parameter_table(robot: Mechanism) -> Table:
    """Return nominal and present values with tolerances."""
    units = units_of(robot)
    return build_table(
        "Parameters",
        zip(robot.parameters.entries, robot.values, strict=True),
        (word_column("name"), lambda row: row[0].name),
        (Column("nominal"), lambda row: format_in(units[row[0].dimension], row[0].nominal, DIGITS)),
        (Column("value"), lambda row: format_in(units[row[0].dimension], row[1], DIGITS)),
        (
            Column("tolerance (1 sd)"),
            lambda row: format_in(
                units[row[0].dimension],
                NO_NUMBER if row[0].tolerance is None else row[0].tolerance,
                3,
            ),
        ),
        (word_column("unit"), lambda row: str(units[row[0].dimension])),
        (word_column(""), lambda row: "free" if row[0].free else "fixed"),
    )


def _build_common_error_table(robot: Mechanism) -> Table:
    """Return the errors that several parameters share in addition to their own."""
    units, table = units_of(robot), robot.parameters
    rows = []
    for error in table.common:
        unit = units[table.entries[table.index(error.parameters[0])].dimension]
        names = " ".join(error.parameters)
        rows.append((error.name, format_in(unit, error.tolerance, 3), str(unit), names))
    words = (word_column(title) for title in ("unit", "parameters"))
    columns = (word_column("name"), Column("tolerance (1 sd)"), *words)
    return Table("Common errors", columns, tuple(rows))
