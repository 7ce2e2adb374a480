# SPDX-License-Identifier: Apache-2.0
"""`loopcal regularize`: the held-out error against the strength of regularization."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from loopcal.cli import terminal
from loopcal.cli.options.shared_options import (
    Count,
    data_argument,
    data_options,
    file_option,
    force_option,
    json_option,
    leave_out_held_out,
    read_checked_measurements,
    robot_argument,
    seed_option,
    take_flags,
)


@click.command()
@robot_argument
@data_argument("DATA...")
@file_option("-o", "--output", help="Folder to make, with the curves and their figure.")
@click.option(
    "--folds",
    type=Count("FOLDS", 2),
    default=5,
    metavar="N",
    help="Number of folds of poses where frames, targets or surfaces are unknown.",
)
@click.option(
    "--drop", multiple=True, metavar="POSE", help="Exclude this pose. May be given several times."
)
@seed_option("the folds")
@force_option("the folder")
@data_options
@json_option
def regularize(
    robot: str,
    data: tuple[Path, ...],
    output: Path | None,
    folds: int,
    drop: tuple[str, ...],
    seed: int,
    force: bool,
    as_json: bool,
    **flags: Any,
) -> None:
    """Show how the error at held-out poses depends on the ridge parameter lam and on the number k
    of directions of truncated SVD, for your own DATA, and which values the rules choose.

    Use a chosen value with loopcal calibrate --method ridge --lam, or --method tsvd --keep.

    \b
    Examples:
      loopcal regularize hexapod-42 measurements.csv
      loopcal regularize robot.yaml measurements.csv -o curves
    """  # noqa: D301
    from loopcal.diagnose import compute_regularization_curves
    from loopcal.estimate import FitOptions
    from loopcal.io import load_robot
    from loopcal.io.data.measurement_file import list_measurement_files
    from loopcal.io.robot.robot_file import find_robot_file
    from loopcal.io.runs.curves_folder import refuse_curves, write_curves
    from loopcal.io.runs.run_folder import collect_provenance
    from loopcal.report.figures import draw_regularization
    from loopcal.report.pictures import render_figure
    from loopcal.report.regularization_view import tabulate_points, view_regularization

    machine = load_robot(robot)
    inputs = {"robot": find_robot_file(robot), **list_measurement_files(data)}
    if output is not None:
        refuse_curves(output, force, list(inputs.values()))
    measurements = leave_out_held_out(read_checked_measurements(data, machine, **take_flags(flags)))
    with terminal.ProgressBar() as progress:
        curves = compute_regularization_curves(
            machine,
            measurements,
            options=FitOptions(excluded_poses=drop),
            folds=folds,
            seed=seed,
            progress=progress,
        )
    if output is not None:
        picture = render_figure(draw_regularization(curves), ".png")
        made_by = collect_provenance(["loopcal", *sys.argv[1:]], inputs, {"folds": seed})
        document = {**curves.to_dict(), "made_by": made_by}
        write_curves(output, document, tabulate_points(curves).to_csv(), picture, force)
    if as_json:
        terminal.print_json(curves.to_dict())
        return
    written = f"Written to {output}: curves.json, curves.csv, curves.png"
    page = view_regularization(curves)
    terminal.print_page(page if output is None else [*page, "", written])
