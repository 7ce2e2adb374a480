# SPDX-License-Identifier: Apache-2.0
"""Sheet and data file for points on planes and lines, where the readings are measured."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from loopcal.io.core.csv_table import quote_cell
from loopcal.io.data.columns import get_dimension
from loopcal.io.data.measurement_writer import format_measurements
from loopcal.io.runs.plan_folder import DIGITS, VIA, get_unit
from loopcal.mechanism import POSITION
from loopcal.units import Dimension

if TYPE_CHECKING:
    from loopcal.planning.plane_line_planning import SurfacePlan

FREE = "free"
"""Cell of `hold` at the first point of a group, which sets the coordinates of the others."""

INSTRUCTIONS = """\
## Points of the tool of {robot}, in this order. Point p0 of a group is free: move close to its row,
## stop, and note the position that the measuring machine shows. Move to each other point of the
## group until the coordinates under hold equal those noted for p0 within the tolerance. Then write
## the readings into the data file; those of p0 belong into both of its rows, because it is on the
## plane and on the line. All numbers here are nominal values."""


def format_surface_sheet(plan: SurfacePlan) -> str:
    """Return the operator's sheet: coordinates to hold, tolerance and command of each point."""
    robot = plan.robot
    symbol, length = get_unit(robot, Dimension.LENGTH)
    commanded = [get_unit(robot, get_dimension(name)) for name in robot.controlled]
    readings = [get_unit(robot, actuator.dimension) for actuator in robot.actuators]
    headers = ["step", "pose", "group", "role", "hold", f"tolerance [{symbol}]"]
    headers += [f"hold.{n} [{symbol}]" for n in POSITION]
    headers += [f"{name} [{s}]" for name, (s, _) in zip(robot.controlled, commanded, strict=True)]
    headers += [f"{a.name} [{s}]" for a, (s, _) in zip(robot.actuators, readings, strict=True)]
    lines = [INSTRUCTIONS.format(robot=robot.name), ",".join(headers)]
    factors = [factor for _, factor in (*commanded, *readings)]
    poses = plan.poses
    for g, members in enumerate(poses.groups):
        for i, (role, row) in enumerate(zip(plan.list_roles(), members, strict=True)):
            hold = plan.list_fixed_coordinates(g, i)
            via = f" ({VIA} home)" if poses.via_home[row] else ""
            cells = [str(row + 1), poses.labels[row], f"group{g + 1}", role]
            cells += [f"{' '.join(hold) if i else FREE}{via}"]
            cells += [f"{plan.options.sigma / length:.{DIGITS}g}" if i else ""]
            cells += [
                f"{plan.positions[g, 0, j] / length:.{DIGITS}g}" if n in hold else ""
                for j, n in enumerate(POSITION)
            ]
            numbers = zip((*poses.coordinates[row], *poses.readings[row]), factors, strict=True)
            cells += [f"{value / factor:.{DIGITS}g}" for value, factor in numbers]
            lines.append(",".join(quote_cell(cell) for cell in cells))
    return "\n".join(lines) + "\n"


def format_surface_data(plan: SurfacePlan) -> str:
    """Return the data file to fill in: gaps are zero, readings empty, rows in pose order."""
    from loopcal.measure import Measurements, Observations

    robot = plan.robot
    observations = []
    for one in plan.instrument.sensors:
        assert one.rows is not None  # the plan states them
        gaps = np.zeros((len(one.rows), len(one.kind.columns)))
        sigma = one.noise.sigma
        observations.append(Observations.from_sigma(one.kind, one.rows, gaps, sigma, "", one.group))
    poses = plan.poses
    data = Measurements(robot.name, poses.readings, tuple(observations), labels=poses.labels)
    lines = format_measurements(data, robot).splitlines()
    first = next(i for i, line in enumerate(lines) if not line.startswith("#"))
    names = {f"{a.name} [{get_unit(robot, a.dimension)[0]}]" for a in robot.actuators}
    is_reading = [name in names for name in lines[first].split(",")]
    order = {label: i for i, label in enumerate(poses.labels)}
    rows = sorted((line.split(",") for line in lines[first + 1 :]), key=lambda row: order[row[0]])
    empty = [["" if is_reading[i] else cell for i, cell in enumerate(row)] for row in rows]
    return "\n".join([*lines[: first + 1], *(",".join(row) for row in empty)]) + "\n"
