# SPDX-License-Identifier: Apache-2.0
"""`loopcal identifiability`: which parameters can be known from measurements, before anything is fitted."""

from __future__ import annotations

from pathlib import Path

import click

from loopcal.cli import show
from loopcal.cli.options import (
    FILE,
    data_options,
    draw_option,
    drawn_poses,
    instrument,
    instrument_options,
    json_option,
    robot_argument,
)
from loopcal.errors import DataError


@click.command(short_help="Tell which parameters measurements can determine.")
@robot_argument
@click.argument("data", metavar="[DATA]", type=FILE, required=False)
@click.option("--poses", type=FILE, help="In place of DATA: CSV file of poses that could be measured.")
@draw_option
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Seed of drawn poses.")
@instrument_options
@data_options
@json_option
def identifiability(
    robot: str,
    data: Path | None,
    poses: Path | None,
    draw: int,
    seed: int,
    kind: str,
    components: str | None,
    orientation: str | None,
    sigma_position: float,
    sigma_angle: float,
    allow_outside_stroke: bool,
    allow_duplicates: bool,
    as_json: bool,
) -> None:
    """Tell what DATA can determine of the parameters of ROBOT, and what stays open.

    Without DATA an instrument is assumed, at --poses or at poses drawn evenly from the workspace that ROBOT states; its
    options are --kind, --components, --orientation and the sigmas. DATA states its own.

    \b
    Examples:
      loopcal identifiability hexapod-42 measurements.csv
      loopcal identifiability linear-delta --kind component --components z --sigma-position 20um
      loopcal identifiability hexapod-42 --poses poses.csv --kind component --components x,y,z --sigma-position 5um
    """  # noqa: D301
    from loopcal.calibrate import identifiability as identifiable
    from loopcal.io import load_measurements, load_robot
    from loopcal.io.measurement_file import load_poses
    from loopcal.measure import simulate

    if data is not None and poses is not None:
        raise DataError("there are both DATA and --poses; give measurements, or poses that could be measured, but not both")
    machine = load_robot(robot)
    drawn = ""
    if data is not None:
        measured = load_measurements(
            data, machine, allow_outside_stroke=allow_outside_stroke, allow_duplicates=allow_duplicates
        )
    else:
        seen_by = instrument(kind, components, orientation, sigma_position, sigma_angle)
        if poses is not None:
            targets = load_poses(poses, machine)
        else:
            targets, drawn = drawn_poses(machine, draw, seed)
        measured = simulate(machine, targets, seen_by, seed=0)
    found = identifiable(machine, measured)
    if as_json:
        show.json_document(found.to_dict())
    else:
        if drawn:
            show.say(drawn)
        show.say(str(found))
