# SPDX-License-Identifier: Apache-2.0
"""`loopcal gcode` and `loopcal fill`: from a plan to the machine, and from the export of an
instrument back to its sheet. Also what `loopcal import` does with an instrument's export.
"""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Literal

import click

from loopcal.cli import terminal
from loopcal.cli.hints import hint_for
from loopcal.cli.options.shared_options import (
    FILE,
    decimal_option,
    file_option,
    flag_option,
    force_option,
    json_option,
    print_convention_note,
    profile_option,
    refuse_given,
    robot_argument,
)
from loopcal.units import Dimension, find_unit, list_symbols

SHOWN = 20
"""Lines that do not match a profile that are listed."""


@click.command()
@robot_argument
@click.argument("plan", metavar="PLAN", type=FILE)
@click.option(
    "--feed",
    type=float,
    metavar="NUMBER",
    help="Feed per minute, in the unit of the program.  [default: 300 mm, in inches as fast]",
)
@click.option(
    "--pause",
    type=float,
    metavar="SECONDS",
    help="Time to wait at each pose (G4).  [default: stop until the operator continues, M0]",
)
@click.option(
    "--unit",
    type=click.Choice(("mm", "in")),
    help="Unit of lengths in the program.  [default: that of ROBOT, or mm]",
)
@file_option("-o", "--output", help="Program to write, such as poses.ngc.", required=True)
@force_option("the output file")
@json_option
def gcode(
    robot: str,
    plan: Path,
    feed: float | None,
    pause: float | None,
    unit: Literal["mm", "in"] | None,
    output: Path,
    force: bool,
    as_json: bool,
) -> None:
    """Write G-code that moves ROBOT to the poses of PLAN, a folder or its plan.csv, in order.

    The program starts at home, waits at each pose, passes home where the plan does, and returns to
    home. X Y Z A B C are machine coordinates (G53) of the platform. Each straight path is checked
    for strokes, joint limits and singularities.

    \b
    Examples:
      loopcal gcode hexapod.yaml plan -o poses.ngc
      loopcal gcode hexapod.yaml plan -o poses.ngc --feed 600 --pause 5
    """  # noqa: D301
    from loopcal.io import load_robot
    from loopcal.io.core.outputs import refuse_outputs
    from loopcal.io.core.text_file import write_text
    from loopcal.io.formats.gcode_program import (
        DEFAULT_FEED,
        GcodeSettings,
        format_gcode,
        read_stops,
        refuse_coordinates,
    )
    from loopcal.io.robot.robot_file import find_robot_file
    from loopcal.planning import check_route

    refuse_outputs((output,), (find_robot_file(robot), plan), force)
    machine = load_robot(robot)
    is_in_inches = machine.units[Dimension.LENGTH] == "in"
    program_unit: Literal["mm", "in"] = unit or ("in" if is_in_inches else "mm")
    feed_unit = find_unit(program_unit).factor_to_si / 60.0  # [m/s]
    speed = DEFAULT_FEED if feed is None else feed * feed_unit
    stops = read_stops(plan, machine)
    refuse_coordinates(machine)
    home = check_route(machine, stops.labels, stops.coordinates)
    text = format_gcode(machine, stops, home, GcodeSettings(speed, pause, program_unit))
    write_text(output, text)
    counts = {"stops": len(stops.labels), "unit": program_unit}
    if as_json:
        terminal.print_json({"program": output, **counts})
        return
    terminal.print_page([f"{output}: {counts['stops']} stops, lengths in {program_unit}"])


@click.command()
@robot_argument
@click.argument("sheet", metavar="SHEET", type=FILE)
@click.argument("exports", metavar="EXPORT...", type=FILE, nargs=-1, required=True)
@profile_option("How to read EXPORT.", required=True)
@click.option(
    "--unit",
    type=click.Choice(list_symbols(Dimension.LENGTH)),
    help="Unit of lengths in EXPORT.  [default: as the profile states]",
)
@decimal_option
@flag_option(
    "--by-order",
    help="Ignore names: EXPORT has the points of all targets of the first pose, then those of the "
    "second, and so on.",
)
@flag_option(
    "--one-session",
    help="Several EXPORTs: the instrument was not moved between them. Otherwise each is a session.",
)
@flag_option(
    "--allow-implausible",
    help="Accept points that are not where the robot is expected, or in another unit.",
)
@file_option("-o", "--output", help="Measurement file to write.", required=True)
@force_option("the output file")
@json_option
def fill(
    robot: str,
    sheet: Path,
    exports: tuple[Path, ...],
    profile: str,
    unit: str | None,
    decimal: str | None,
    by_order: bool,
    one_session: bool,
    allow_implausible: bool,
    output: Path,
    force: bool,
    as_json: bool,
) -> None:
    """Fill in SHEET, the measurements.csv of a plan of ROBOT, with the points of an instrument's
    EXPORT.

    Points are joined by their names: POSE_TARGET, such as 12_SMR1. Missing, unknown and repeated
    points are listed. Points that lie where others are expected are refused.

    \b
    Examples:
      loopcal fill hexapod.yaml plan/measurements.csv points.txt --profile spatial-analyzer \\
          -o measured.csv
      loopcal fill hexapod.yaml plan/measurements.csv points.txt --profile leica --by-order \\
          --decimal comma -o measured.csv
      loopcal fill hexapod.yaml plan/measurements.csv monday.txt tuesday.txt --profile faro \\
          --unit in -o measured.csv
    """  # noqa: D301
    from loopcal.diagnose import check_conventions, examine_points
    from loopcal.io import load_robot
    from loopcal.io.core.outputs import refuse_outputs
    from loopcal.io.exports import find_profile_file, read_profile, with_local_settings
    from loopcal.io.exports.sheet_filling import fill_sheet, save_filled_sheet
    from loopcal.io.robot.robot_file import find_robot_file
    from loopcal.report.calibration_view import with_hint

    path = find_profile_file(profile)
    refuse_outputs((output,), (find_robot_file(robot), sheet, *exports, path), force)
    machine = load_robot(robot)
    filled = fill_sheet(
        machine,
        sheet,
        exports,
        with_local_settings(read_profile(path), unit, decimal == "comma"),
        by_order=by_order,
        has_one_session=one_session,
    )
    examined = () if allow_implausible else examine_points(machine, filled.data, filled.unit)
    conventions = check_conventions(
        machine, filled.data.fitted, allow_implausible=allow_implausible
    )
    print_convention_note(conventions, exports)
    save_filled_sheet(filled, output)
    findings = (*filled.findings, *examined)
    if as_json:
        misfits = [{"file": f, "line": n, "reason": reason} for f, n, reason in filled.misfits]
        document = {"measurements": output, "misfits": misfits, "findings": findings}
        terminal.print_json(document)
        return
    first, *others = (with_hint(finding, hint_for) for finding in findings)
    page = [f"{output}: {first}", *(f"note: {text}" for text in others)]
    page += [
        f"note: {file}:{line} does not match: {reason}"
        for file, line, reason in filled.misfits[:SHOWN]
    ]
    if len(filled.misfits) > SHOWN:
        page.append(f"note: {len(filled.misfits) - SHOWN} more lines do not match")
    page.append(f"Next: loopcal calibrate {shlex.join((robot, str(output)))} -o run")
    terminal.print_page(page)


def convert_instrument_export(
    file: Path,
    profile: str,
    local: tuple[str | None, bool],
    output: Path,
    force: bool,
    as_json: bool,
) -> int:
    """Write the measurements of an export; report lines that were skipped or do not match.

    `local` : the unit of lengths in place of that of the profile, and whether commas are decimal.
    """
    from loopcal.io.core.outputs import refuse_outputs
    from loopcal.io.exports import (
        convert_export,
        find_profile_file,
        read_profile,
        save_conversion,
        with_local_settings,
    )
    from loopcal.report.calibration_view import with_hint

    used = {"file", "profile", "output", "force", "as_json", "length_unit", "decimal"}
    names = (option.name or "" for option in click.get_current_context().command.params)
    refuse_given(
        (name for name in names if name not in used),
        "with --profile, which states how the file is read",
    )
    path = find_profile_file(profile)
    refuse_outputs((output,), (file, path), force)
    converted = convert_export(file, with_local_settings(read_profile(path), *local))
    save_conversion(converted, output)
    if as_json:
        misfits = [{"line": line, "reason": reason} for line, reason in converted.misfits]
        document = {
            "measurements": output,
            "rows": converted.rows,
            "passed": converted.passed,
            "misfits": misfits,
            "notes": [str(finding) for finding in converted.findings],
            "findings": converted.findings,
        }
        terminal.print_json(document)
        return 0
    page = [
        f"{output}: {converted.rows} rows; {converted.passed} lines skipped as the profile states",
        *(f"note: {with_hint(finding, hint_for)}" for finding in converted.findings),
        *(
            f"note: {file}:{line} does not match: {reason}"
            for line, reason in converted.misfits[:SHOWN]
        ),
    ]
    more = len(converted.misfits) - SHOWN
    if more > 0:
        page.append(f"note: {more} more lines do not match; {output} lists them")
    terminal.print_page(page)
    return 0
