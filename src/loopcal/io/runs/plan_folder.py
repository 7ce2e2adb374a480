# SPDX-License-Identifier: Apache-2.0
"""The folder of a plan.

    plan.csv           the operator's sheet: the commands step by step, in the units of the robot
    measurements.csv   the data file to fill in: poses and readings, without measured values
    poses.csv          poses and readings alone, where pictures bring the measured values
    plan.json          the plan in SI
    plan.png           the poses and the path through them
    curve.png          expected errors by the number of poses

`loopcal calibrate` reads measurements.csv when it is filled in, and holds out the poses that the
plan holds out. A plan of points on planes and lines has other sheets, because its readings are
measured.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from loopcal.errors import FileError
from loopcal.io.core.csv_table import format_row, parse_exact
from loopcal.io.core.outputs import FolderKind
from loopcal.io.core.text_file import open_bytes, read_json, sha256
from loopcal.io.data.columns import COMMANDED, FIT, HELD_OUT, USE_COLUMN
from loopcal.io.data.measurement_file import format_data_sheet, format_measurements
from loopcal.io.robot.robot_file import list_shipped_robots
from loopcal.measure.kinds.joints import Closure
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import Observations
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.platform_coordinates import POSITION, get_dimension
from loopcal.units import Dimension

if TYPE_CHECKING:
    from loopcal.planning.plane_line_planning import SurfacePlan
    from loopcal.planning.pose_planning import Plan, Stop

FORMAT = 1
SHEET, DATA, RESULT = "plan.csv", "measurements.csv", "plan.json"
POSES = "poses.csv"
CAMERAS = ("camera",)  # column of the stations of a camera, where there are several
FILES = (SHEET, DATA, POSES, "plan.png", "curve.png")
PLAN = FolderKind("plan", RESULT, ("robot", "made_by"), FILES)
VIA = "via"
DIGITS = 12  # significant digits of a number: more than it was rounded to, fewer than a double has


# Cell of `hold` at the first point of a group, which sets the coordinates of the others.
FREE = "free"
INSTRUCTIONS = """\
## Points of the tool of {robot}, in this order. Point p0 of a group is free: move close to its row,
## stop, and note the position that the measuring machine shows. Move to each other point of the
## group until the coordinates under hold equal those noted for p0 within the tolerance. Then write
## the readings into the data file. Write the readings of p0 into both of its rows, as it is on the
## plane and on the line. All numbers here are nominal values."""


def format_sheet(plan: Plan, stops: Sequence[Stop], stations: Iterable[str] = ()) -> str:
    """Return the operator's sheet: the stops in order, with home where a straight path is blocked.

    `stops` are those of `loopcal.planning.pose_planning.list_stops`, `stations` lines on cameras.
    """
    robot = plan.robot
    headers, factors = _list_columns(robot)
    # paths are straight in these coordinates; a tilt moves along its vector
    names = [name for name in robot.controlled if name not in ("phi", "theta")]
    tilt = ["theta*cos(phi)", "theta*sin(phi)"] if "phi" in robot.controlled else []
    path = ", ".join([*names, *tilt])
    cameras = dict(zip(plan.poses.labels, plan.poses.cameras, strict=False))
    lines = [
        f"## Poses of {robot.name} to measure in this order, starting from home.",
        f"## Between two poses move straight in {path}. Measure {FIT} and",
        f"## {HELD_OUT} poses alike; only pass through {VIA} poses.",
        *(f"## {line}" for line in stations),
        format_row(["step", "pose", USE_COLUMN.name, *CAMERAS[: len(cameras)], *headers]),
    ]
    for step, stop in enumerate(stops, 1):
        use = VIA if stop.is_via else HELD_OUT if stop.is_held_out else FIT
        numbers = map(_format, (*stop.coordinates, *stop.readings), factors)
        seen_from = [cameras.get(stop.label, "")] if cameras else []
        lines.append(format_row([str(step), stop.label, use, *seen_from, *numbers]))
    return "\n".join(lines) + "\n"


def format_plan_data(plan: Plan) -> str:
    """Return the data file to fill in; its readings have the same digits as the sheet.

    They are empty where they are what is measured.
    """
    sensors = tuple(
        replace(s, rows=plan.poses.groups) if s.kind.poses_per_row > 1 else s
        for s in plan.instrument.sensors
    )
    if cameras := plan.poses.cameras:
        rows = [np.flatnonzero(np.array(cameras) == getattr(s.kind, "camera", "")) for s in sensors]
        sensors = tuple(
            replace(s, rows=np.repeat(own, s.kind.rows_per_pose))
            for s, own in zip(sensors, rows, strict=True)
        )
    factors = _list_columns(plan.robot)[1][-len(plan.robot.actuators) :]
    readings = np.array(
        [
            [parse_exact(_format(q, f), f) for q, f in zip(row, factors, strict=True)]
            for row in plan.poses.readings.tolist()
        ]
    )
    if any(isinstance(s.kind, Closure) for s in plan.instrument.sensors):
        readings[:] = np.nan  # they are what is measured
    instrument = replace(plan.instrument, sensors=sensors)
    labels = plan.poses.labels
    return format_data_sheet(plan.robot, instrument, readings, labels, plan.poses.held_out)


def format_poses(plan: Plan) -> str:
    """Return names, uses and readings of the poses, in the order of visiting."""
    count, poses = len(plan.robot.actuators), plan.poses
    headers, factors = _list_columns(plan.robot)
    texts = (poses.labels, poses.uses, *filter(None, [poses.cameras]))
    lines = [format_row(["pose", USE_COLUMN.name, *CAMERAS[: len(texts) - 2], *headers[-count:]])]
    rows = zip(*texts, poses.readings.tolist(), strict=True)
    lines += [format_row([*words, *map(_format, q, factors[-count:])]) for *words, q in rows]
    return "\n".join(lines) + "\n"


def find_plan_sheet(data: Path) -> Path:
    """Return the operator's sheet beside a data file without readings, which has the commands."""
    beside = data.parent / SHEET
    if not beside.is_file():
        sentence = f"this sheet has no readings, and its folder lacks {SHEET}"
        raise FileError(f"{sentence}. Fill in the readings, or name the file in its plan", data)
    return beside


def _read_plan(sheet: Path) -> Mapping[str, Any]:
    """Return the document of the plan that a sheet belongs to; empty where there is none."""
    path = sheet.parent / RESULT
    document = read_json(path, "plan", "repeat the command") if path.is_file() else {}
    return document if isinstance(document, dict) else {}


def find_plan_robot(sheet: Path) -> tuple[str, bool]:
    """Return the robot file of a plan, the name of a shipped one, and whether it has changed since;
    FileError if unknown.
    """
    with open_bytes(sheet, "measurement file"):
        file = _read_plan(sheet).get("made_by", {}).get("inputs", {}).get("robot", {})
    path = str(file.get("path", ""))
    shipped = list_shipped_robots().get(name := Path(path).stem)
    if shipped is not None and sha256(shipped) == file.get("sha256"):
        return name, False
    if not Path(path).is_file():
        sentence = "the plan of this sheet does not name its robot file"
        if path:
            sentence = f"the robot file {path} of this plan does not exist"
        raise FileError(f"{sentence}. Name the robot", sheet)
    return path, sha256(path) != file.get("sha256")


def find_asked(sheet: Path) -> Mapping[str, Any]:
    """Return what a plan was asked for, see `loopcal.planning.constraints.restore_options`."""
    return dict(_read_plan(sheet).get("asked", {}))


def _list_columns(robot: Mechanism) -> tuple[list[str], list[float]]:
    """Return headers and units [SI] of the commanded coordinates and of the readings."""
    readings = {actuator.name: actuator.dimension for actuator in robot.actuators}
    dimensions = {
        COMMANDED + name if name in readings else name: get_dimension(name)
        for name in robot.controlled
    }
    units = {name: robot.get_unit(of) for name, of in (dimensions | readings).items()}
    headers = [f"{name} [{unit.symbol}]" for name, unit in units.items()]
    return headers, [unit.factor_to_si for unit in units.values()]


def _format(value: float, factor: float) -> str:
    """Return a number [SI] in its unit, as short as it was rounded."""
    return f"{value / factor + 0.0:.{DIGITS}g}"


def format_surface_sheet(plan: SurfacePlan) -> str:
    """Return the operator's sheet: coordinates to hold, tolerance and command of each point."""
    robot = plan.robot
    length = robot.get_unit(Dimension.LENGTH)
    columns, factors = _list_columns(robot)
    headers = ["step", "pose", "group", "role", "hold", f"tolerance [{length.symbol}]"]
    headers += [*(f"hold.{name} [{length.symbol}]" for name in POSITION), *columns]
    lines, poses = [INSTRUCTIONS.format(robot=robot.name), format_row(headers)], plan.poses
    for g, members in enumerate(poses.groups):
        for i, (role, row) in enumerate(zip(plan.list_roles(), members, strict=True)):
            hold = plan.list_fixed_coordinates(g, i)
            via = f" ({VIA} home)" if poses.via_home[row] else ""
            cells = [str(row + 1), poses.labels[row], f"group{g + 1}", role]
            cells += [f"{' '.join(hold) if i else FREE}{via}"]
            cells += [_format(plan.options.sigma, length.factor_to_si) if i else ""]
            cells += [
                _format(position, length.factor_to_si) if name in hold else ""
                for name, position in zip(POSITION, plan.positions[g, 0], strict=True)
            ]
            cells += map(_format, (*poses.coordinates[row], *poses.readings[row]), factors)
            lines.append(format_row(cells))
    return "\n".join(lines) + "\n"


def format_surface_data(plan: SurfacePlan) -> str:
    """Return the data file to fill in: gaps are zero, readings empty, rows in pose order."""
    robot = plan.robot
    observations = []
    for sensor in plan.instrument.sensors:
        assert sensor.rows is not None  # the plan states them
        gaps = np.zeros((len(sensor.rows), len(sensor.kind.columns)))
        sigma = sensor.noise.sigma
        observations.append(
            Observations.from_sigma(sensor.kind, sensor.rows, gaps, sigma, "", sensor.group)
        )
    labels, empty = plan.poses.labels, np.full_like(plan.poses.readings, np.nan)
    data = Measurements(
        robot.name, empty, tuple(observations), labels=labels, reading_sigma=np.array(np.inf)
    )
    return format_measurements(data, robot, is_by_pose=True)
