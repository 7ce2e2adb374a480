# SPDX-License-Identifier: Apache-2.0
"""`loopcal validate`: judge a calibration by measurements that it has not seen."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import click

from loopcal.cli import show
from loopcal.cli.options import (
    FILE,
    data_argument,
    data_options,
    gate_options,
    json_option,
    measurements,
)


@click.command(short_help="Judge a calibration, or a robot file, by measurements.")
@click.argument("run", metavar="RUN", type=FILE)
@data_argument
@gate_options
@data_options
@click.option("--refit", multiple=True, metavar="NAME",
              help="A frame, target or surface that was set up anew since RUN, to be found from "
                   "DATA.")  # fmt: skip
@click.option(
    "--allow-fitted-data", is_flag=True, help="Accept measurements that the run was fitted to."
)
@json_option
def validate(
    run: Path,
    data: tuple[Path, ...],
    limit_position: float | None,
    limit_angle: float | None,
    allowed: Mapping[str, bool],
    refit: tuple[str, ...],
    allow_fitted_data: bool,
    as_json: bool,
) -> int:
    """Compare the robot of RUN, a folder made by `loopcal calibrate` or a robot file, with DATA,
    one file or several.

    Errors are those before and after calibration; of a robot file without identified values, its
    own alone.

    Frames, targets and surfaces that RUN found are used as it found them, by name; others are
    fitted to DATA, and that is said.

    The exit code is 2 where a quality gate is not met.

    \b
    Examples:
      loopcal validate run more-measurements.csv
      loopcal validate run more-measurements.csv --limit-position 0.02mm --limit-angle 0.01deg
      loopcal validate robot.yaml measurements.csv --limit-position 0.1mm
    """  # noqa: D301
    from loopcal.apply import validate as compare
    from loopcal.io.runs.calibration_run import check_reused_data, load_run_or_robot

    calibrated = load_run_or_robot(run)
    measured = measurements(data, calibrated.robot, **allowed)
    if not allow_fitted_data and (again := check_reused_data(calibrated, data, measured)):
        click.echo(f"loopcal: note: {again}", err=True)
    known = {
        "known": calibrated.nuisance_values,
        "known_before": calibrated.initial_nuisance_values,
        "refit": refit,
    }
    found = compare(
        calibrated.robot, measured, limit_position, limit_angle, calibrated.initial_robot, **known
    )
    if as_json:
        show.json_document(found.to_dict())
    else:
        changed = bool((calibrated.robot.values != calibrated.initial_robot.values).any())
        show.validation(found, "measured", before=changed)
    return show.gates(map(str, found.failures))
