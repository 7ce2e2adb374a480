# SPDX-License-Identifier: Apache-2.0
"""The folder of a plan.

    plan.csv           the operator's sheet: the commands step by step, in the units of the robot
    measurements.csv   the data file to fill in: poses and readings, without measured values
    plan.json          the plan in SI
    plan.png           the poses and the path through them
    curve.png          expected errors by the number of poses

`loopcal calibrate` reads measurements.csv when it is filled in, and holds out the poses that the
plan holds out.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from loopcal.errors import FileError
from loopcal.io.core.csv_table import quote_cell
from loopcal.io.core.folders import refuse_folder_in_use, replace_folder
from loopcal.io.core.json_text import to_json
from loopcal.io.core.numbers import parse_exact
from loopcal.io.core.text_file import sha256
from loopcal.io.data.columns import FIT, HELD_OUT, USE_COLUMN, get_dimension
from loopcal.io.data.measurement_writer import format_data_sheet
from loopcal.mechanism import Mechanism
from loopcal.units import Dimension, find_unit

if TYPE_CHECKING:
    from loopcal.planning.result import Plan, Stop

FORMAT = 1
SHEET, DATA, RESULT = "plan.csv", "measurements.csv", "plan.json"
OWN_FILES = (SHEET, DATA, RESULT, "plan.png", "curve.png")
"""All files of a plan's folder."""
VIA = "via"
DIGITS = 12
"""Significant digits of a number: more than it was rounded to, fewer than a double has."""


def format_sheet(plan: Plan, stops: Sequence[Stop]) -> str:
    """Return the operator's sheet: the stops in order, with home where a straight path is blocked.

    `stops` are those of `loopcal.planning.result.list_stops`.
    """
    robot = plan.robot
    commanded = [get_unit(robot, get_dimension(name)) for name in robot.controlled]
    readings = [get_unit(robot, actuator.dimension) for actuator in robot.actuators]
    headers = [f"{n} [{s}]" for n, (s, _) in zip(robot.controlled, commanded, strict=True)]
    headers += [f"{a.name} [{s}]" for a, (s, _) in zip(robot.actuators, readings, strict=True)]
    path = _list_path_coordinates(robot)
    lines = [
        f"## Poses of {robot.name} to measure in this order, starting from home.",
        f"## Between two poses move straight in {path}. Measure {FIT} and",
        f"## {HELD_OUT} poses alike; only pass through {VIA} poses.",
        ",".join(["step", "pose", USE_COLUMN.name, *headers]),
    ]
    factors = [factor for _, factor in (*commanded, *readings)]
    for step, stop in enumerate(stops, 1):
        use = VIA if stop.is_via else HELD_OUT if stop.is_held_out else FIT
        numbers = zip((*stop.coordinates, *stop.readings), factors, strict=True)
        cells = [str(step), quote_cell(stop.label), use, *(_format(v, f) for v, f in numbers)]
        lines.append(",".join(cells))
    return "\n".join(lines) + "\n"


def format_plan_data(plan: Plan) -> str:
    """Return the data file to fill in; its readings have the same digits as the sheet."""
    sensors = tuple(
        replace(s, rows=plan.poses.groups) if s.kind.poses_per_row > 1 else s
        for s in plan.instrument.sensors
    )
    factors = [get_unit(plan.robot, actuator.dimension)[1] for actuator in plan.robot.actuators]
    readings = [
        [parse_exact(_format(q, f), f) for q, f in zip(row, factors, strict=True)]
        for row in plan.poses.readings.tolist()
    ]
    instrument = replace(plan.instrument, sensors=sensors)
    labels = plan.poses.labels
    held_out = zip(labels, plan.poses.held_out, strict=True)
    uses = {label: HELD_OUT if is_held_out else FIT for label, is_held_out in held_out}
    return format_data_sheet(plan.robot, instrument, readings, labels, uses)


def refuse_plan_folder(path: Path, force: bool) -> None:
    """Refuse a folder that a plan must not replace; filled-in or hand-written files are never lost.

    Raises
    ------
    FileError
        A file, a used folder without `force`, or a folder with other or changed files.
    """
    refuse_folder_in_use(path, "plan", RESULT, force)
    if not path.is_dir() or not any(path.iterdir()):
        return
    for file in sorted(path.iterdir()):
        if file.name not in OWN_FILES or not file.is_file():
            sentence = "this file does not belong to a plan and is never removed"
            raise FileError(f"{sentence}; move it, or choose another folder", file)
    written = _read_digests(path / RESULT)
    for file in (path / DATA, path / SHEET):
        if file.exists() and sha256(file) != written.get(file.name):
            sentence = "this file was filled in or changed since the plan was written"
            raise FileError(f"{sentence}; move it, or choose another folder", file)


def write_plan_folder(
    path: Path,
    texts: Mapping[str, str],
    document: Mapping[str, Any],
    pictures: Mapping[str, Callable[[Path], None]],
    force: bool = False,
) -> None:
    """Write the folder of a plan whole or not at all.

    Parameters
    ----------
    path : the folder to make. texts : name -> text of a file.
    document : content of plan.json; `format`, and `files` with the sha256 of each text, are added.
    pictures : name -> function that writes it. force : replace an older, unchanged plan.

    Raises
    ------
    FileError : the folder is in use, or cannot be written.
    """
    refuse_plan_folder(path, force)
    with replace_folder(path) as folder:
        for name, text in texts.items():
            (folder / name).write_bytes(text.encode())
        files = {name: sha256(folder / name) for name in texts}
        text = to_json({"format": FORMAT, **document, "files": files})
        (folder / RESULT).write_text(text, encoding="utf-8")
        for name, save in pictures.items():
            save(folder / name)


def get_unit(robot: Mechanism, dimension: Dimension) -> tuple[str, float]:
    """Return symbol and factor of the unit of a dimension in the robot file."""
    unit = find_unit(robot.units[dimension])
    return unit.symbol, unit.factor_to_si


def _list_path_coordinates(robot: Mechanism) -> str:
    """Return the coordinates in which paths are straight; a tilt moves along its vector."""
    names = [name for name in robot.controlled if name not in ("phi", "theta")]
    tilt = ["theta*cos(phi)", "theta*sin(phi)"] if "phi" in robot.controlled else []
    return ", ".join([*names, *tilt])


def _format(value: float, factor: float) -> str:
    """Return a number [SI] in its unit, as short as it was rounded."""
    return f"{value / factor + 0.0:.{DIGITS}g}"


def _read_digests(path: Path) -> Mapping[str, str]:
    """Return name -> sha256 of the written texts of a plan; nothing where plan.json lacks them."""
    try:
        files = json.loads(path.read_bytes())["files"]
        return {str(name): str(digest) for name, digest in files.items()}
    except (ValueError, KeyError, TypeError, AttributeError):
        return {}
