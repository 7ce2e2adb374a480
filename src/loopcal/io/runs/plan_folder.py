# SPDX-License-Identifier: Apache-2.0
"""A plan in a folder, for whoever stands at the machine.

    plan.csv           the operator's sheet: what to command, step by step, in the units of the robot file
    measurements.csv   the data file to fill in: poses and readings are there, measured values are not
    plan.json          everything about the plan, SI
    plan.png           the poses and the way through them;  curve.png  expected errors by the number of poses

`loopcal calibrate` reads measurements.csv when it is filled in, and holds out the poses that the
plan holds out.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from loopcal.errors import FileError
from loopcal.io.core.csv_table import quote_cell
from loopcal.io.core.json_text import to_json
from loopcal.io.data.measurement_writer import format_data_sheet
from loopcal.io.core.numbers import parse_exact
from loopcal.io.data.columns import get_dimension
from loopcal.io.core.text_file import sha256, report_write_errors
from loopcal.io.data.columns import FIT, HELD_OUT
from loopcal.io.data.pose_use import USE, insert_use_column
from loopcal.units import (Dimension, find_unit)

if TYPE_CHECKING:
    from loopcal.planning.result import Plan
    from loopcal.mechanism import Mechanism

FORMAT = 1
SHEET, DATA, RESULT = "plan.csv", "measurements.csv", "plan.json"
OWN = (SHEET, DATA, RESULT, "plan.png", "curve.png")
"""All files that a plan's folder holds."""
VIA = "via"
DIGITS = 12
"""Significant ones at most of a number: more than it was rounded to, less than a double has."""


def format_sheet(plan: Plan) -> str:
    """Return the operator's sheet: steps in order, with home between two poses where the straight
    way is not allowed.
    """
    from loopcal.planning.candidates import home_coordinates
    from loopcal.mechanism import inverse

    robot = plan.robot
    commanded = [unit_of(robot, get_dimension(name)) for name in robot.controlled]
    reading = [unit_of(robot, actuator.dimension) for actuator in robot.actuators]
    headers = [f"{name} [{symbol}]" for name, (symbol, _) in zip(robot.controlled, commanded, strict=True)]
    headers += [f"{a.name} [{symbol}]" for a, (symbol, _) in zip(robot.actuators, reading, strict=True)]
    home = home_coordinates(robot)
    stops = []
    for i, label in enumerate(plan.poses.labels):
        if plan.poses.via_home[i]:
            stops.append(("home", VIA, home, inverse(robot, home[None]).q[0]))
        stops.append((label, HELD_OUT if plan.poses.held_out[i] else FIT, plan.poses.coordinates[i], plan.poses.readings[i]))
    lines = [
        f"## Poses of {robot.name} to measure, in this order, from home; between two of them the "
        "machine moves straight in",
        f"## {straight_in(robot)}. use: {FIT} and {HELD_OUT} are measured alike; {VIA} is only "
        "passed through.",
        ",".join(["step", "pose", USE, *headers]),
    ]
    factors = [factor for _, factor in (*commanded, *reading)]
    for step, (label, use, x, q) in enumerate(stops, 1):
        numbers = (_text(value, factor) for value, factor in zip((*x, *q), factors, strict=True))
        lines.append(",".join([str(step), quote_cell(label), use, *numbers]))
    return "\n".join(lines) + "\n"


def format_plan_data(plan: Plan) -> str:
    """Return the data file to fill in."""
    sensors = plan.instrument.sensors
    looking = tuple(replace(s, rows=plan.poses.groups) if s.kind.poses_per_row > 1 else s for s in sensors)
    factors = [unit_of(plan.robot, actuator.dimension)[1] for actuator in plan.robot.actuators]
    # the doubles that the texts of the sheet stand for, so that both files say the same digits
    readings = [[parse_exact(_text(q, f), f) for q, f in zip(row, factors, strict=True)] for row in plan.poses.readings.tolist()]
    text = format_data_sheet(plan.robot, replace(plan.instrument, sensors=looking), readings, plan.poses.labels)
    return insert_use_column(text, {label: HELD_OUT if held else FIT for label, held in zip(plan.poses.labels, plan.poses.held_out, strict=True)})


def straight_in(robot: Mechanism) -> str:
    """Say in what a way is straight; a tilt by phi and theta goes by its vector, see
    `loopcal.planning.path`.
    """
    names = [name for name in robot.controlled if name not in ("phi", "theta")]
    tilt = ["theta*cos(phi)", "theta*sin(phi)"] if "phi" in robot.controlled else []
    return ", ".join([*names, *tilt])


def _text(value: float, factor: float) -> str:
    """Return a number [SI] in its unit, as short as it was rounded."""
    return f"{value / factor + 0.0:.{DIGITS}g}"


def refuse_plan_folder(path: Path, force: bool) -> None:
    """Refuse a folder that a plan may not replace: nothing that was measured or written by hand is
    ever removed.

    Raises
    ------
    FileError
        A file, or a folder that holds something and `force` is not given, or something other than a
        plan as it was written.
    """
    if path.exists() and not path.is_dir():
        raise FileError("this is a file where the folder of a plan is to be written; choose "
                        "another name", path)
    if not path.is_dir() or not any(path.iterdir()):
        return
    if not force:
        raise FileError("this folder is not empty; choose another name, or replace the plan in it "
                        "with --force", path)
    if not (path / RESULT).exists():
        raise FileError("this folder holds something other than a plan, which --force does not "
                        "replace; choose another", path)
    for found in sorted(path.iterdir()):
        if found.name not in OWN or not found.is_file():
            raise FileError("this is no part of a plan, and --force does not remove it; move it "
                            "away, or choose another", found)
    written = _written(path / RESULT)
    for name in (DATA, SHEET):
        if (path / name).exists() and sha256(path / name) != written.get(name):
            raise FileError(
                "this was filled in or changed since the plan was written, and --force does not "
                "remove it; move it away, or "
                "choose another folder",
                path / name,
            )


def _written(path: Path) -> Mapping[str, str]:
    """Return name -> sha256 of the texts of a plan as they were written; nothing where its
    plan.json does not tell.
    """
    try:
        found = json.loads(path.read_bytes())["files"]
        return {str(name): str(digest) for name, digest in found.items()}
    except (ValueError, KeyError, TypeError, AttributeError):
        return {}


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
    path : the folder to make. texts : name -> text of a file. document : content of plan.json;
        `format`, and `files` with the sha256 of each text, are added.
    pictures : name -> what writes it. force : replace a plan that is there, see
        `refuse_plan_folder`.

    Raises
    ------
    FileError
        The folder is in use, or cannot be written.
    """
    refuse_plan_folder(path, force)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    with report_write_errors(path):
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            temporary.mkdir()
            for name, text in texts.items():
                (temporary / name).write_bytes(text.encode())
            files = {name: sha256(temporary / name) for name in texts}
            (temporary / RESULT).write_text(to_json({"format": FORMAT, **document, "files": files}), encoding="utf-8")
            for name, save in pictures.items():
                save(temporary / name)
            if path.is_dir():
                for name in OWN:
                    (path / name).unlink(missing_ok=True)
                path.rmdir()
            temporary.rename(path)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)


def unit_of(robot: Mechanism, dimension: Dimension) -> tuple[str, float]:
    """Return symbol and factor of the robot's unit."""
    found = find_unit(robot.units[dimension])
    return found.symbol, found.factor_to_si
