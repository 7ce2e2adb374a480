# SPDX-License-Identifier: Apache-2.0
"""`loopcal simulate`: measure a simulated machine, for trying things out before anybody buys time
on an instrument.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from loopcal.cli import show
from loopcal.cli.options import (
    FILE,
    draw_option,
    drawn_poses,
    instrument,
    instrument_options,
    json_option,
    robot_argument,
    sigma_of_readings,
    sigma_reading_option,
)
from loopcal.errors import DataError

if TYPE_CHECKING:
    import numpy as np

    from loopcal.measure import Instrument, Measurements
    from loopcal.mechanism import Mechanism


@click.command(short_help="Make a measurement file by simulation.")
@robot_argument
@click.option("--poses", type=FILE, help="CSV file of commanded poses, one column per coordinate.")
@draw_option
@click.option(
    "--fill",
    type=FILE,
    metavar="SHEET",
    help="In place of poses and instrument: the data file of a plan to fill in.",
)
@click.option("-o", "--output", required=True, type=FILE, help="The measurement file to write.")
@instrument_options
@sigma_reading_option
@click.option(
    "--draw-errors",
    is_flag=True,
    help="Give the machine errors drawn from the tolerances of the robot file.",
)
@click.option("--truth", type=FILE, help="Also write the true machine, as a robot file.")
@click.option(
    "--seed",
    type=click.IntRange(min=0),
    default=1,
    show_default=True,
    help="Seed of poses, errors and noise.",
)
@click.option("--force", is_flag=True, help="Replace files that are there.")
@json_option
def simulate(
    robot: str,
    poses: Path | None,
    draw: int,
    fill: Path | None,
    output: Path,
    kind: str,
    components: str | None,
    orientation: str | None,
    sigma_position: float,
    sigma_angle: float,
    sigma_reading: str | None,
    draw_errors: bool,
    truth: Path | None,
    seed: int,
    force: bool,
    as_json: bool,
) -> None:
    """Command ROBOT to poses by its nominal geometry, and write down what an instrument would see
    of the true machine.

    Without --poses, poses are drawn evenly from the workspace that the robot file states.

    The true machine has the identified values of the robot file where it has any, or drawn ones
    with --draw-errors.

    \b
    Examples:
      loopcal simulate hexapod-42 --draw-errors --truth truth.yaml -o measurements.csv
      loopcal simulate hexapod-42 --poses poses.csv --draw-errors -o measurements.csv
      loopcal simulate truth.yaml --poses poses.csv --sigma-position 0.001mm --sigma-angle 5urad -o
      measurements.csv loopcal simulate linear-delta --kind position --sigma-reading 5um
      --draw-errors -o measurements.csv loopcal simulate hexapod-42 --fill plan/measurements.csv
      --draw-errors --truth truth.yaml -o filled.csv
    """  # noqa: D301
    from loopcal import measure
    from loopcal.io import load_robot, save_robot
    from loopcal.io.core.outputs import refuse_outputs
    from loopcal.io.core.text_file import write_text
    from loopcal.io.robot.robot_file import find_robot_file

    refuse_outputs((output, truth), (find_robot_file(robot), poses, fill), force)
    machine = load_robot(robot)
    if draw_errors:
        machine = machine.with_values(measure.sample_truth(machine, 1, seed)[0])
    if fill is not None:
        data, text = _filled(machine, fill, seed)
    else:
        seen_by = instrument(kind, components, orientation, sigma_position, sigma_angle)
        data, text = _simulated(
            machine, poses, draw, seen_by, sigma_of_readings(sigma_reading, machine), seed
        )
    write_text(output, text)
    if truth is not None:
        save_robot(machine, truth)
    if as_json:
        show.json_document(
            {
                "output": output,
                "truth": truth,
                "n_poses": data.n_poses,
                "n_rows": data.n_rows,
                "seed": seed,
            }
        )
    else:
        show.say(
            f"{output}: {data.n_poses} poses of {machine.name}, {data.n_rows} measured values, "
            f"seed {seed}"
        )


def _simulated(
    machine: Mechanism,
    poses: Path | None,
    draw: int,
    seen_by: Instrument,
    sigma_reading: np.ndarray | None,
    seed: int,
) -> tuple[Measurements, str]:
    """Measure poses of a file, or drawn ones: what was measured, and the file that says so."""
    from loopcal import measure
    from loopcal.io.data.measurement_file import load_poses
    from loopcal.io.data.measurement_writer import format_measurements

    if poses is None:
        targets, words = drawn_poses(machine.nominal, draw, seed)
    else:
        targets, words = load_poses(poses, machine), f"{poses.name}, seed {seed}"
    data = measure.simulate(machine, targets, seen_by, seed, reading_sigma=sigma_reading)
    measure.check_strokes(data, machine)
    return data, format_measurements(data, machine, f"simulated by loopcal: {words}")


def _filled(machine: Mechanism, sheet: Path, seed: int) -> tuple[Measurements, str]:
    """Fill in the data file of a plan: what was measured, and the file that says so."""
    from loopcal.io import load_measurements
    from loopcal.io.data.instrument_file import load_instrument, refuse_empty_readings
    from loopcal.io.data.measurement_writer import format_measurements
    from loopcal.io.data.pose_use import insert_use_column, read_pose_use
    from loopcal.measure.sheet_simulation import replace_measured_values

    given = click.get_current_context().get_parameter_source
    for name in (
        "poses",
        "draw",
        "kind",
        "components",
        "orientation",
        "sigma_position",
        "sigma_angle",
        "sigma_reading",
    ):
        if given(name) is click.core.ParameterSource.COMMANDLINE:
            raise DataError(
                f"--fill {sheet} states poses and instrument; leave out "
                f"--{name.replace('_', '-')}, or --fill"
            )
    refuse_empty_readings(sheet, machine)
    data = replace_measured_values(
        machine, load_measurements(sheet, machine), load_instrument(sheet, machine), seed
    )
    text = format_measurements(data, machine, f"simulated by loopcal: {sheet.name}, seed {seed}")
    use = read_pose_use([sheet])
    return data, insert_use_column(text, use) if use else text
