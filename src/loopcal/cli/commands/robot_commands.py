# SPDX-License-Identifier: Apache-2.0
"""`loopcal new` and `loopcal check`: write a robot file, and show one."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

import click

from loopcal.cli import terminal
from loopcal.cli.options.instrument_options import (
    instrument_options,
    make_instrument,
    unknown_options,
)
from loopcal.cli.options.shared_options import (
    file_option,
    flag_option,
    force_option,
    json_option,
    robot_argument,
)


@click.command()
@click.argument("family", metavar="FAMILY")
@file_option("-o", "--output", help="Robot file to write; the robot gets its name.", required=True)
@file_option("--measurements", help="Also write a measurement file with columns but no rows.")
@unknown_options
@instrument_options
@force_option("an output file")
@json_option
def new(
    family: str, output: Path, measurements: Path | None, force: bool, as_json: bool, **options: Any
) -> None:
    """Write a robot file of FAMILY: gough, linear-delta, 3-prs, ru-pus-prs, limbs, stages, or the
    name of a shipped robot.

    The file contains a complete robot. Replace its numbers with your own. The options of the
    instrument are for --measurements.

    \b
    Examples:
      loopcal new gough -o my-hexapod.yaml --measurements tracker.csv
      loopcal new linear-delta -o printer.yaml --measurements heights.csv \\
          --kind component --components z
      loopcal new gough -o my-hexapod.yaml --measurements tracker.csv \\
          --kind position --targets SMR1,SMR2,SMR3 --frames base --sigma-position 15um
    """  # noqa: D301
    from loopcal.io.core.csv_table import refuse_settings_beside
    from loopcal.io.core.names import make_name
    from loopcal.io.core.outputs import refuse_outputs, restore_on_failure
    from loopcal.io.core.text_file import write_text
    from loopcal.io.core.yaml_file import parse_yaml
    from loopcal.io.data.measurement_writer import format_template
    from loopcal.io.robot.derived_robots import format_new_robot
    from loopcal.io.robot.robot_file import build_robot

    make_instrument(options)  # refuses wrong options before anything is written
    refuse_outputs((output, measurements), (), force)
    robot_text = format_new_robot(family, make_name(output.stem))
    robot = build_robot(parse_yaml(robot_text, output, "robot file"))
    instrument = make_instrument(options, robot)
    template = format_template(robot, instrument)
    if measurements is not None:
        refuse_settings_beside(measurements)
    with restore_on_failure((output, measurements)):
        write_text(output, robot_text)
        if measurements is not None:
            write_text(measurements, template)
    if as_json:
        terminal.print_json({"robot": output, "measurements": measurements})
        return
    page = [
        f"{output}: a complete robot. Replace its numbers with yours.",
        f"Next: loopcal check {shlex.quote(str(output))}",
    ]
    if measurements is not None:
        page += [
            f"{measurements}: columns without rows. Fill in your measurements.",
            f"Next: loopcal calibrate {shlex.join(map(str, (output, measurements)))} -o run",
        ]
    terminal.print_page(page)


@click.command()
@robot_argument
@file_option(
    "--plot", help="Draw the robot at home into FILE (.png, .svg or .pdf).", metavar="FILE"
)
@force_option("the picture")
@flag_option("--expand", help="Also show links, joints, transmissions, and how parameters enter.")
@json_option
def check(robot: str, plot: Path | None, force: bool, expand: bool, as_json: bool) -> None:
    """Read ROBOT, a robot file or the name of a shipped robot, and show its actuators and
    parameters.

    An error in the file is reported with its line: units, joints, dimensions, mobility.

    \b
    Examples:
      loopcal check hexapod-42
      loopcal check my-robot.yaml --json
      loopcal check linear-delta --expand
      loopcal check 3-prs --plot 3-prs.png
    """  # noqa: D301
    from loopcal.io import load_robot
    from loopcal.io.core.outputs import refuse_outputs
    from loopcal.io.core.text_file import write_bytes
    from loopcal.io.robot.robot_file import find_robot_file
    from loopcal.workflow.robot_inspection import inspect_robot

    refuse_outputs((plot,), (find_robot_file(robot),), force)
    inspection = inspect_robot(load_robot(robot))
    if plot is not None:
        from loopcal.report.figures import draw_robot
        from loopcal.report.pictures import save_figure

        save_figure(plot, draw_robot(inspection.robot), write=write_bytes)
    if as_json:
        assembly = {"assembly": inspection.robot.assembly} if expand else {}
        terminal.print_json(inspection.to_dict() | assembly)
        return
    from loopcal.report.assembly_view import view_assembly
    from loopcal.report.robot_view import view_robot

    page = view_robot(inspection)
    if expand:
        page += view_assembly(inspection.robot)
    if plot is not None:
        page += ["", f"Picture: {plot}"]
    terminal.print_page(page)
