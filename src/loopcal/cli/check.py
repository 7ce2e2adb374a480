# SPDX-License-Identifier: Apache-2.0
"""`loopcal check`: read a robot file, build the robot, and show what was understood."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from loopcal.cli import expand as expanded
from loopcal.cli import show
from loopcal.cli.options import FILE, json_option, robot_argument

if TYPE_CHECKING:
    from loopcal.mechanism import Mechanism

SLACK = 1e-9
"""How far beyond a limit home may be by rounding [m or rad]."""


@click.command(short_help="Read a robot file and show what it says.")
@robot_argument
@click.option(
    "--plot",
    type=FILE,
    metavar="FILE",
    help="Draw the robot at home into FILE (.png, .svg or .pdf).",
)
@click.option("--force", is_flag=True, help="Replace a file that is there.")
@click.option(
    "--expand",
    is_flag=True,
    help="Also show limbs, links, joints, transmissions and how parameters enter.",
)
@json_option
def check(robot: str, plot: Path | None, force: bool, expand: bool, as_json: bool) -> None:
    """Read ROBOT, a file or the name of a shipped robot, and show what was understood.

    Whatever is wrong with the file, its units, its joints or its mobility is said in one sentence
    with the line.

    \b
    Examples:
      loopcal check hexapod-42
      loopcal check my-robot.yaml --json
      loopcal check linear-delta --expand
      loopcal check 3-prs --plot 3-prs.png
    """  # noqa: D301
    from loopcal.io import load_robot
    from loopcal.io.core.outputs import refuse_outputs
    from loopcal.io.robot.robot_file import find_robot_file

    refuse_outputs((plot,), (find_robot_file(robot),), force)
    machine = load_robot(robot)
    if plot is not None:
        from loopcal.report import save_picture

        save_picture(plot, machine)
    if as_json:
        show.json_document(_document(machine) | ({"assembly": machine.assembly} if expand else {}))
    else:
        _print(machine)
        if expand:
            expanded.assembly(machine)
        if plot is not None:
            show.say(f"\npicture: {plot}")


def _document(robot: Mechanism) -> dict[str, Any]:
    """Return the robot as one document, in SI."""
    table = robot.parameters
    return {
        "name": robot.name,
        "path": robot.record.path,
        "freedoms": robot.freedoms,
        "controlled": robot.controlled,
        "size": robot.size,
        "home": robot.home,
        "tool": robot.tool,
        "actuators": [
            {"name": a.name, "dimension": a.dimension, "stroke": a.stroke} for a in robot.actuators
        ],
        "parameters": [
            {
                "name": p.name,
                "dimension": p.dimension,
                "nominal": p.nominal,
                "value": robot.values[i],
                "tolerance": p.tolerance,
                "free": p.free,
            }
            for i, p in enumerate(table.entries)
        ],
        "notes": robot.notes,
    }


def _print(robot: Mechanism) -> None:
    """Print the robot's tables."""
    units, table = show.units_of(robot), robot.parameters
    words = {"freedoms": robot.freedoms, "commanded in": robot.controlled}
    show.say(
        f"{robot.name}: {len(robot.actuators)} actuators, {len(table)} parameters, "
        f"{int(table.free.sum())} free"
    )
    show.say(f"file: {robot.record.path}")
    for what, names in words.items():
        show.say(f"{what}: {' '.join(names)}")
    readings, exceeded = _home(robot)
    notes = [*robot.notes]
    if exceeded:
        notes.append(
            f"at home {', '.join(exceeded)} is exceeded; correct home, lengths, strokes or limits"
        )
    for note in notes:
        show.say(f"note: {note}")
    rows = []
    for actuator, reading in zip(robot.actuators, readings, strict=True):
        unit = units[actuator.dimension]
        low, high = actuator.stroke or (float("nan"), float("nan"))
        rows.append(
            (
                actuator.name,
                *(show.number(v / unit.factor_to_si) for v in (low, high, reading)),
                str(unit),
            )
        )
    show.table("Actuators", ("name", "lowest", "highest", "at home", "unit"), rows)
    rows = []
    for parameter, value in zip(table.entries, robot.values, strict=True):
        unit = units[parameter.dimension]
        numbers = [
            parameter.nominal,
            value,
            float("nan") if parameter.tolerance is None else parameter.tolerance,
        ]
        nominal, present, tolerance = (v / unit.factor_to_si for v in numbers)
        cells = (
            show.number(nominal, digits=9),
            show.number(present, digits=9),
            show.number(tolerance, digits=3),
        )
        rows.append((parameter.name, *cells, str(unit), "free" if parameter.free else "fixed"))
    show.table("Parameters", ("name", "nominal", "value", "tolerance (1 sd)", "unit", ""), rows)


def _home(robot: Mechanism) -> tuple[list[float], list[str]]:
    """Return the readings (a,) [SI] of the home pose, and which strokes and limits they exceed."""
    from loopcal.mechanism import evaluate_limits, inverse

    found = inverse(robot, robot.home[None])
    exceeded = [
        limit.name
        for limit in evaluate_limits(robot, robot.values[None], found.q[None], found.state)
        if limit.margin[0, 0] < -SLACK
    ]
    return found.q[0].tolist(), exceeded
