# SPDX-License-Identifier: Apache-2.0
"""`loopcal repeatability`: pose accuracy and repeatability by ISO 9283."""

from __future__ import annotations

from pathlib import Path

import click

from loopcal.cli import terminal
from loopcal.cli.options.shared_options import (
    FILE,
    data_argument,
    data_options,
    json_option,
    read_checked_measurements,
)


@click.command()
@click.argument("robot", metavar="ROBOT", type=FILE)
@data_argument("DATA...")
@data_options
@json_option
def repeatability(robot: Path, data: tuple[Path, ...], as_json: bool, **flags: bool) -> int:
    """Compute pose accuracy (AP) and repeatability (RP) by ISO 9283 from DATA, in which each pose
    of ROBOT, a run folder or a robot file, was visited several times.

    Each visit is a row with a name of its own; visits of one pose have the same readings, or the
    same commanded coordinates. The geometry of ROBOT is that of the controller. Visits from several
    directions have the direction in the column group.

    \b
    Examples:
      loopcal repeatability robot.yaml visits.csv
      loopcal repeatability run visits.csv --json
    """  # noqa: D301
    from loopcal.apply import assess_repeatability
    from loopcal.io.runs.run_folder import load_run_or_robot
    from loopcal.report.repeatability_view import view_repeatability

    calibrated = load_run_or_robot(robot)
    measurements = read_checked_measurements(data, calibrated.robot, **flags)
    result = assess_repeatability(calibrated.robot, measurements, calibrated.nuisance_values)
    if as_json:
        terminal.print_json(result.to_dict())
    else:
        terminal.print_page(view_repeatability(result, calibrated.robot))
    return 0
