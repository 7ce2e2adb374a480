# SPDX-License-Identifier: Apache-2.0
"""A robot as people read it: actuators and parameters, in the units of its file."""

from __future__ import annotations

from loopcal.mechanism import Mechanism
from loopcal.report.numbers import format_number, format_with_uncertainty, units_of
from loopcal.report.tables import Column, Table, word_column
from loopcal.report.text_page import Block, format_list
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
    return [
        f"{robot.name}: {len(robot.actuators)} actuators, {n} parameters, {free} free",
        f"file: {robot.record.path}",
        f"freedoms: {' '.join(robot.freedoms)}",
        f"commanded in: {' '.join(robot.controlled)}",
        *format_list([(f.severity.value, str(f)) for f in inspection.findings]),
        _build_actuator_table(inspection),
        _build_parameter_table(robot),
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
        cells = (format_number(low), format_number(high), at_home)
        rows.append((actuator.name, *cells, str(unit)))
    numbers = (Column(title) for title in ("lowest", "highest", "at home"))
    columns = (word_column("name"), *numbers, Column("unit", align="left"))
    return Table("Actuators", columns, tuple(rows))


def _build_parameter_table(robot: Mechanism) -> Table:
    """Return nominal and present values with tolerances."""
    units = units_of(robot)
    rows = []
    for parameter, value in zip(robot.parameters.entries, robot.values, strict=True):
        unit = units[parameter.dimension]
        tolerance = NO_NUMBER if parameter.tolerance is None else parameter.tolerance
        nominal, present, tolerance = (
            float(v) / unit.factor_to_si for v in (parameter.nominal, value, tolerance)
        )
        rows.append(
            (
                parameter.name,
                format_number(nominal, DIGITS),
                format_number(present, DIGITS),
                format_number(tolerance, 3),
                str(unit),
                "free" if parameter.free else "fixed",
            )
        )
    numbers = (Column(title) for title in ("nominal", "value", "tolerance (1 sd)"))
    columns = (word_column("name"), *numbers, Column("unit", align="left"), word_column(""))
    return Table("Parameters", columns, tuple(rows))
