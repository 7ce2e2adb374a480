# SPDX-License-Identifier: Apache-2.0
"""The numbers of poses: errors, uncertainty, plans, compensation, solutions."""

from __future__ import annotations

from typing import Any

import numpy as np

from loopcal.apply import (
    AccuracyMap,
    AccuracySimulation,
    Compensation,
    HeightErrors,
    PoseUncertainty,
    Validation,
)
from loopcal.apply.accuracy import COMPONENTS
from loopcal.mechanism import POSITION, Jacobian, Mechanism, Solution, Status
from loopcal.planning import Plan, SurfacePlan
from loopcal.report.notebook.records import Records, Variable, collect_records, number_from_one
from loopcal.units import SI_SYMBOLS

POSE, COMPONENT, COORDINATE, ACTUATOR = "pose", "component", "coordinate", "actuator"
TWIST_UNITS = ("rad", "rad", "rad", "m", "m", "m")
"""Units of a small rotation and a displacement."""


def _collect_coordinates(name: str, names: tuple[str, ...], values: Any) -> Variable:
    """Return controlled coordinates (n, c) [SI]."""
    units = tuple("m" if coordinate in POSITION else "rad" for coordinate in names)
    return Variable(name, (POSE, COORDINATE), values, units)


def _collect_readings(robot: Mechanism, values: Any) -> Variable:
    """Return actuator readings (n, a) [SI]."""
    units = tuple(SI_SYMBOLS[actuator.dimension] for actuator in robot.actuators)
    return Variable("reading", (POSE, ACTUATOR), values, units)


def _name_actuators(robot: Mechanism) -> tuple[str, ...]:
    return tuple(actuator.name for actuator in robot.actuators)


@collect_records.register
def collect_validation(result: Validation) -> Records:
    """Return the sizes of the errors before and after of each quantity, row and target [SI]."""
    poses, targets, quantities, units = [], [], [], []
    sizes: dict[str, list[float]] = {"before": [], "after": []}
    for quantity in result.quantities:
        after = result.after[quantity]
        poses += [result.poses[i] for i in after.rows]
        targets += list(after.targets)
        quantities += [quantity] * len(after.rows)
        units += [SI_SYMBOLS[after.dimension]] * len(after.rows)
        for name, errors in (("before", result.before), ("after", result.after)):
            sizes[name] += errors[quantity].size.tolist()
    row = ("row",)
    words = {"pose": poses, "target": targets, "quantity": quantities, "unit": units}
    return Records(
        "row",
        (
            *(Variable(name, row, np.array(values, str)) for name, values in words.items()),
            *(Variable(name, row, np.array(values, float)) for name, values in sizes.items()),
        ),
        {"row": number_from_one(len(poses))},
    )


@collect_records.register
def collect_heights(result: HeightErrors) -> Records:
    """Return places and errors of heights [SI]."""
    row = ("row",)
    return Records(
        "row",
        (
            Variable("pose", row, np.array(result.poses, str)),
            Variable("x", row, result.points[:, 0], "m"),
            Variable("y", row, result.points[:, 1], "m"),
            Variable("before", row, result.before, "m"),
            Variable("after", row, result.after, "m"),
            Variable("held_out", row, result.is_held_out),
        ),
        {"row": number_from_one(len(result.poses))},
    )


def _collect_uncertainty(result: PoseUncertainty) -> tuple[Variable, ...]:
    """Return uncertainties of poses [rad, m]."""
    return (
        Variable("position", (POSE,), result.position, "m"),
        Variable("orientation", (POSE,), result.orientation, "rad"),
        Variable("sd", (POSE, COMPONENT), result.sd, TWIST_UNITS),
        Variable("expanded", (POSE, COMPONENT), result.expanded, TWIST_UNITS),
    )


@collect_records.register
def collect_uncertainty(result: PoseUncertainty) -> Records:
    """Return standard and expanded uncertainties of poses."""
    labels = {POSE: number_from_one(len(result.T)), COMPONENT: COMPONENTS}
    return Records(POSE, _collect_uncertainty(result), labels)


@collect_records.register
def collect_map(result: AccuracyMap) -> Records:
    """Return coordinates with their uncertainty."""
    labels = {
        POSE: number_from_one(len(result.coordinates)),
        COMPONENT: COMPONENTS,
        COORDINATE: result.names,
    }
    coordinates = _collect_coordinates("commanded", result.names, result.coordinates)
    extrapolated = Variable("extrapolated", (POSE,), result.extrapolated)
    return Records(
        POSE, (coordinates, extrapolated, *_collect_uncertainty(result.uncertainty)), labels
    )


@collect_records.register
def collect_simulation(result: AccuracySimulation) -> Records:
    """Return predicted and observed errors."""
    shape = (POSE, COMPONENT)
    return Records(
        POSE,
        (
            Variable("predicted", shape, result.predicted.sd, TWIST_UNITS),
            Variable("observed", shape, result.observed, TWIST_UNITS),
            Variable("ratio", shape, result.ratio, "1"),
        ),
        {POSE: number_from_one(len(result.observed)), COMPONENT: COMPONENTS},
    )


@collect_records.register
def collect_compensation(result: Compensation) -> Records:
    """Return what to set or command at each target, and the errors before and after."""
    variables = [
        Variable("status", (POSE,), np.array([reach.value for reach in result.reach])),
        _collect_readings(result.robot, result.readings),
        Variable("before", (POSE, COMPONENT), result.before, TWIST_UNITS),
        Variable("remaining", (POSE, COMPONENT), result.remaining, TWIST_UNITS),
    ]
    names = result.robot.controlled
    if result.commands is not None:
        variables.insert(1, _collect_coordinates("command", names, result.commands))
    labels = {POSE: result.labels, ACTUATOR: _name_actuators(result.robot)}
    return Records(POSE, tuple(variables), {**labels, COORDINATE: names, COMPONENT: COMPONENTS})


@collect_records.register(Plan)
@collect_records.register(SurfacePlan)
def collect_plan(result: Plan | SurfacePlan) -> Records:
    """Return the poses in their order."""
    poses, robot = result.poses, result.robot
    use = np.where(poses.held_out, "held-out", "fit")
    return Records(
        POSE,
        (
            Variable("use", (POSE,), use),
            _collect_coordinates("commanded", robot.controlled, poses.coordinates),
            _collect_readings(robot, poses.readings),
        ),
        {POSE: poses.labels, COORDINATE: robot.controlled, ACTUATOR: _name_actuators(robot)},
    )


@collect_records.register
def collect_solution(result: Solution) -> Records:
    """Return status, position of the platform, readings and passive joints [SI]."""
    status = [Status(int(value)).name.lower().replace("_", " ") for value in result.status]
    reading, passive = number_from_one(result.q.shape[1]), result.passive_names
    return Records(
        POSE,
        (
            Variable("status", (POSE,), np.array(status)),
            Variable("platform", (POSE, "axis"), result.T[:, :3, 3], "m"),
            Variable("reading", (POSE, ACTUATOR), result.q, "m or rad"),
            Variable("residual", (POSE,), result.residual, "m"),
            Variable("passive", (POSE, "joint"), result.passive, "m or rad"),
            Variable("T_base_platform", (POSE, "row", "column"), result.T, "m"),
        ),
        {
            POSE: number_from_one(len(result)),
            "axis": POSITION,
            ACTUATOR: reading,
            "joint": passive,
            "row": number_from_one(4),
            "column": number_from_one(4),
        },
    )


@collect_records.register
def collect_jacobian(result: Jacobian) -> Records:
    """Return the derivatives of each component of each pose by parameters and readings [SI]."""
    n, components = len(result.parameters), result.components
    by_parameter = result.parameters.reshape(-1, len(result.parameter_names))
    by_reading = result.readings.reshape(-1, len(result.reading_names))
    of_row = ("row",)
    return Records(
        "row",
        (
            Variable("pose", of_row, np.repeat(number_from_one(n), len(components))),
            Variable("component", of_row, np.array(list(components) * n, str)),
            Variable("unit", of_row, np.array(TWIST_UNITS * n, str)),
            Variable(
                "by",
                ("row", "parameter"),
                by_parameter,
                tuple(f"unit per {unit}" for unit in result.parameter_units),
            ),
            Variable(
                "by_reading",
                ("row", ACTUATOR),
                by_reading,
                tuple(f"unit per {unit}" for unit in result.reading_units),
            ),
        ),
        {
            "row": number_from_one(n * len(components)),
            "parameter": result.parameter_names,
            ACTUATOR: result.reading_names,
        },
    )
