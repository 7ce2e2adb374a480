# SPDX-License-Identifier: Apache-2.0
"""`loopcal identifiability`: which parameters can be known from measurements, before anything is fitted."""

from __future__ import annotations

from pathlib import Path

import click

from loopcal.cli import show
from loopcal.cli.options import FILE, data_options, instrument, instrument_options, json_option, robot_argument
from loopcal.errors import DataError


@click.command(short_help="Tell which parameters measurements can determine.")
@robot_argument
@click.argument("data", metavar="[DATA]", type=FILE, required=False)
@click.option("--poses", type=FILE, help="In place of DATA: CSV file of poses that could be measured.")
@instrument_options
@data_options
@json_option
def identifiability(
    robot: str,
    data: Path | None,
    poses: Path | None,
    kind: str,
    components: str | None,
    orientation: str | None,
    sigma_position: float,
    sigma_angle: float,
    allow_outside_stroke: bool,
    allow_duplicates: bool,
    as_json: bool,
) -> None:
    """Tell what DATA, or an instrument at --poses, can determine of the parameters of ROBOT, and what stays open.

    The options of the instrument belong to --poses; DATA states its own.

    \b
    Examples:
      loopcal identifiability hexapod-42 measurements.csv
      loopcal identifiability hexapod-42 --poses poses.csv --kind component --components x,y,z --sigma-position 5um
    """  # noqa: D301
    from loopcal.calibrate import identifiability as identifiable
    from loopcal.io import load_measurements, load_robot
    from loopcal.io.measurement_file import load_poses
    from loopcal.measure import simulate

    if (data is None) == (poses is None):
        raise DataError("give either DATA, a measurement file, or --poses, a file of poses that could be measured")
    machine = load_robot(robot)
    if data is not None:
        measured = load_measurements(
            data, machine, allow_outside_stroke=allow_outside_stroke, allow_duplicates=allow_duplicates
        )
    else:
        seen_by = instrument(kind, components, orientation, sigma_position, sigma_angle)
        measured = simulate(machine, load_poses(poses or Path(), machine), seen_by, seed=0)
    found = identifiable(machine, measured)
    if as_json:
        show.json_document(found.to_dict())
    else:
        show.say(str(found))
