# SPDX-License-Identifier: Apache-2.0
"""Sheet and data file of points on planes and lines: here the readings are what is measured, and
the gaps are zero.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from loopcal.io.core.csv_table import quote_cell
from loopcal.io.data.measurement_writer import format_measurements
from loopcal.io.data.columns import get_dimension
from loopcal.io.runs.plan_folder import DIGITS, VIA, unit_of
from loopcal.mechanism import POSITION
from loopcal.units import Dimension

if TYPE_CHECKING:
    from loopcal.planning.plane_line_planning import SurfacePlan


FREE = "free"
"""Under hold: the foot of a group, which sets what the others are held to."""


def format_surface_sheet(plan: SurfacePlan) -> str:
    """Return the operator's sheet: each point with the coordinates to hold, how exactly, and the
    nominal command.
    """
    robot = plan.robot
    symbol, length = unit_of(robot, Dimension.LENGTH)
    commanded = [unit_of(robot, get_dimension(name)) for name in robot.controlled]
    reading = [unit_of(robot, actuator.dimension) for actuator in robot.actuators]
    headers = [
        "step",
        "pose",
        "group",
        "role",
        "hold",
        f"tolerance [{symbol}]",
        *(f"hold.{n} [{symbol}]" for n in POSITION),
    ]
    headers += [f"{name} [{s}]" for name, (s, _) in zip(robot.controlled, commanded, strict=True)]
    headers += [f"{a.name} [{s}]" for a, (s, _) in zip(robot.actuators, reading, strict=True)]
    lines = [
        (
            f"## Points of the tool of {robot.name}, in this order. p0 is free: go near to where "
            "its "
            "row says, stay there and"
        ),
        (
            "## note where the measuring machine shows it. Every other point of its group is moved "
            "until the coordinates under"
        ),
        (
            "## hold agree with those noted of p0 within the tolerance; then the readings are "
            "written "
            "into the data file, those"
        ),
        (
            "## of p0 into both of its rows alike, as it lies on the plane and on the line. "
            "Numbers "
            "are nominal, to go there by."
        ),
        ",".join(headers),
    ]
    factors = [factor for _, factor in (*commanded, *reading)]
    poses = plan.poses
    for g, members in enumerate(poses.groups):
        for i, (role, row) in enumerate(zip(plan.list_roles(), members, strict=True)):
            hold = plan.list_held(g, i)
            cells = [str(row + 1), poses.labels[row], f"group{g + 1}", role]
            held, exactly = (
                (" ".join(hold), f"{plan.options.sigma / length:.{DIGITS}g}") if i else (FREE, "")
            )
            cells += [held + (f" ({VIA} home)" if poses.via_home[row] else ""), exactly]
            cells += [
                f"{plan.positions[g, 0, j] / length:.{DIGITS}g}" if n in hold else ""
                for j, n in enumerate(POSITION)
            ]
            numbers = (*poses.coordinates[row], *poses.readings[row])
            cells += [
                f"{value / factor:.{DIGITS}g}"
                for value, factor in zip(numbers, factors, strict=True)
            ]
            lines.append(",".join(quote_cell(cell) for cell in cells))
    return "\n".join(lines) + "\n"


def format_surface_data(plan: SurfacePlan) -> str:
    """Return the data file to fill in: the gaps are zero, the readings empty."""
    from loopcal.measure import Measurements, Observations

    robot = plan.robot
    observations = []
    for sensor in plan.instrument.sensors:
        assert sensor.rows is not None  # the plan spells them out
        zero = np.zeros((len(sensor.rows), len(sensor.kind.columns)))
        seen = Observations.from_sigma(
            sensor.kind, sensor.rows, zero, sensor.noise.sigma, "", sensor.group
        )
        observations.append(seen)
    text = format_measurements(
        Measurements(
            robot.name, plan.poses.readings, tuple(observations), labels=plan.poses.labels
        ),
        robot,
    )
    return _by_pose(plan, text)


def _by_pose(plan: SurfacePlan, text: str) -> str:
    """Put the rows in the order of the poses, and leave the cells of the readings empty."""
    lines = text.splitlines()
    first = next(i for i, line in enumerate(lines) if not line.startswith("#"))
    names = {f"{a.name} [{unit_of(plan.robot, a.dimension)[0]}]" for a in plan.robot.actuators}
    places = {i for i, name in enumerate(lines[first].split(",")) if name in names}
    order = {label: i for i, label in enumerate(plan.poses.labels)}
    rows = sorted(
        (line.split(",") for line in lines[first + 1 :]), key=lambda cells: order[cells[0]]
    )
    shown = (
        ",".join("" if i in places else cell for i, cell in enumerate(cells)) for cells in rows
    )
    return "\n".join([*lines[: first + 1], *shown]) + "\n"
