# SPDX-License-Identifier: Apache-2.0
"""`loopcal measure`: a companion on the terminal while measuring the poses of a plan."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Literal

import click

import loopcal as lc
from loopcal.cli import options as opt
from loopcal.cli import terminal
from loopcal.cli.hints import suggest_command
from loopcal.cli.terminal import Output
from loopcal.errors import DataError
from loopcal.units import Dimension, list_symbols


@opt.command()
def measure(
    plan: Path = opt.argument("PLAN", type=opt.FILE),
    output: Path = opt.path("Folder of the session, new or to resume.", "-o", required=True),
    robot: str | None = opt.option(
        "Robot file, or the name of a shipped robot.  [default: from PLAN]"
    ),
    accuracy: tuple[float, Literal["position", "orientation"]] | None = opt.option(
        "Goal: error over the workspace (rms), such as 20um or 10urad.  [default: from PLAN]",
        type=opt.GOAL,
    ),
    minutes: float | None = opt.option(
        "Time to measure a pose. loopcal then shows the time left.",
        type=opt.NumberRange(0.0, min_open=True),
        metavar="MINUTES",
    ),
    speed: float | None = opt.option(
        "Speed of travel in mm per minute, with --minutes.  [default: travel takes no time]",
        type=opt.NumberRange(0.0, min_open=True),
        metavar="NUMBER",
    ),
    check_every: int = opt.option(
        "Number of rows between two checks for drift, which measure a pose again. 0: no checks.",
        of="loopcal.planning.companion:CompanionTask",
        type=opt.Count("PLANNED_POSES", 0),
    ),
    follow: Path | None = opt.path(
        "Also take rows from the export that an instrument writes.", metavar="EXPORT"
    ),
    profile: str | None = opt.profile("How to read --follow."),
    unit: str | None = opt.option(
        "Unit of lengths in --follow.  [default: from the profile]",
        type=click.Choice(list_symbols(Dimension.LENGTH)),
    ),
    decimal: str | None = opt.DECIMAL,
    by_order: bool = opt.flag("Ignore names in --follow: rows belong to the suggested poses."),
    gcode: bool = opt.flag("Show each pose as a line of G-code, too."),
    at: tuple[tuple[str, float], ...] = opt.AT,
) -> Output:
    """Measure the poses of PLAN, a folder or its measurements.csv, with a companion.

    It shows the next pose and takes the measured values: typed or pasted, from standard input, or
    from the export of an instrument. After each row it says whether the row fits, how accurate the
    robot is by now, and when to stop. It writes each row to the disk before it asks for the next
    one. To resume a session, repeat the command.

    Examples:
      loopcal measure plan -o session --accuracy 20um
      loopcal measure plan -o session --minutes 2 --gcode
      loopcal measure plan -o session --follow points.txt --profile leica
    """
    from loopcal.cli.measuring_dialog import Dialog, print_lines
    from loopcal.findings.wording import name_count
    from loopcal.io.exports.growing_export import GrowingExport
    from loopcal.io.exports.profile import find_profile_file, read_profile, with_local_settings
    from loopcal.io.runs.plan_folder import DATA, find_plan_robot
    from loopcal.io.runs.session_folder import open_session
    from loopcal.measuring import prepare_session
    from loopcal.planning.companion import Pace

    if (follow is None) != (profile is None):
        raise DataError("--follow and --profile belong together. Give both, or none")
    if follow is None:
        opt.refuse_given(("unit", "decimal", "by_order"), "without --follow")
    if speed is not None and minutes is None:
        raise DataError("--speed weighs travel against measuring. Also give --minutes")
    sheet = plan / DATA if plan.is_dir() else plan
    if robot is None:
        robot, has_changed = find_plan_robot(sheet)
        if has_changed:
            terminal.print_finding("session.robot-changed", robot=robot)
    machine = lc.load_robot(robot).with_conditions(dict(at))
    pace = Pace(minutes) if speed is None else Pace(minutes, 1e-3 * speed)
    task, table, entry = prepare_session(sheet, machine, accuracy, pace, check_every)
    export = None
    if follow is not None and profile is not None:
        read = read_profile(find_profile_file(profile))
        read = with_local_settings(read, unit, decimal == "comma")
        export = GrowingExport(follow, read, entry, by_order)
    is_silent = click.get_current_context().params["as_json"]
    say = (lambda *_: None) if is_silent else print_lines
    with open_session(output, table, [column.name for column in entry.kind.columns]) as journal:
        dialog = Dialog(task, journal, say, export, gcode)
        with suppress(KeyboardInterrupt):  # each row is on the disk
            dialog.run()
    visits = journal.visits
    used = sum(bool(visit.is_used) for visit in visits)
    data = output / DATA
    document = {
        "session": output,
        "measurements": data if used else None,
        "rows": len(visits),
        "used": used,
        "findings": dialog.progress,
    }
    page = [f"{output}: {name_count(len(visits), 'row')}, {used} used"]
    if used:
        page.append(suggest_command("calibrate", robot, data, "-o", "run"))
    return Output(document, lambda: page)
