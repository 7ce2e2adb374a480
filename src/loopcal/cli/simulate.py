# SPDX-License-Identifier: Apache-2.0
"""`loopcal simulate`: measure a simulated machine, for trying things out before anybody buys time on an instrument."""

from __future__ import annotations

from pathlib import Path

import click

from loopcal.cli import show
from loopcal.cli.options import FILE, draw_option, drawn_poses, instrument, instrument_options, json_option, robot_argument


@click.command(short_help="Make a measurement file by simulation.")
@robot_argument
@click.option("--poses", type=FILE, help="CSV file of commanded poses, one column per coordinate.")
@draw_option
@click.option("-o", "--output", required=True, type=FILE, help="The measurement file to write.")
@instrument_options
@click.option("--draw-errors", is_flag=True, help="Give the machine errors drawn from the tolerances of the robot file.")
@click.option("--truth", type=FILE, help="Also write the true machine, as a robot file.")
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Seed of poses, errors and noise.")
@click.option("--force", is_flag=True, help="Replace files that are there.")
@json_option
def simulate(
    robot: str,
    poses: Path | None,
    draw: int,
    output: Path,
    kind: str,
    components: str | None,
    orientation: str | None,
    sigma_position: float,
    sigma_angle: float,
    draw_errors: bool,
    truth: Path | None,
    seed: int,
    force: bool,
    as_json: bool,
) -> None:
    """Command ROBOT to poses by its nominal geometry, and write down what an instrument would see of the true machine.

    Without --poses, poses are drawn evenly from the workspace that the robot file states.

    The true machine has the identified values of the robot file where it has any, or drawn ones with --draw-errors.

    \b
    Examples:
      loopcal simulate hexapod-42 --draw-errors --truth truth.yaml -o measurements.csv
      loopcal simulate hexapod-42 --poses poses.csv --draw-errors -o measurements.csv
      loopcal simulate truth.yaml --poses poses.csv --sigma-position 0.001mm --sigma-angle 5urad -o measurements.csv
    """  # noqa: D301
    from loopcal import measure
    from loopcal.io import load_robot, save_measurements, save_robot
    from loopcal.io.measurement_file import load_poses
    from loopcal.io.outputs import refuse_outputs
    from loopcal.io.robot_file import robot_path

    refuse_outputs((output, truth), (robot_path(robot), poses), force)
    machine = load_robot(robot)
    if draw_errors:
        machine = machine.with_values(measure.sample_truth(machine, 1, seed)[0])
    seen_by = instrument(kind, components, orientation, sigma_position, sigma_angle)
    if poses is None:
        targets, words = drawn_poses(machine.nominal, draw, seed)
    else:
        targets, words = load_poses(poses, machine), f"{poses.name}, seed {seed}"
    data = measure.simulate(machine, targets, seen_by, seed)
    measure.check_strokes(data, machine)
    save_measurements(data, output, machine, f"simulated by loopcal: {words}")
    if truth is not None:
        save_robot(machine, truth)
    if as_json:
        show.json_document({"output": output, "truth": truth, "n_poses": data.n_poses, "n_rows": data.n_rows, "seed": seed})
    else:
        show.say(f"{output}: {data.n_poses} poses of {machine.name}, {data.n_rows} measured values, seed {seed}")
