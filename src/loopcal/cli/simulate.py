# SPDX-License-Identifier: Apache-2.0
"""`loopcal simulate`: measure a simulated machine, for trying things out before anybody buys time on an instrument."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from loopcal.cli import show
from loopcal.cli.options import FILE, Quantity, json_option, robot_argument
from loopcal.units import Dimension

if TYPE_CHECKING:
    from loopcal.measure import Instrument


@click.command(short_help="Make a measurement file by simulation.")
@robot_argument
@click.option("--poses", required=True, type=FILE, help="CSV file of commanded poses, one column per coordinate.")
@click.option("-o", "--output", required=True, type=FILE, help="The measurement file to write.")
@click.option("--kind", default="pose", show_default=True, help="Kind of measurement: pose or component.")
@click.option("--components", help="For the kind component: which coordinates, such as z or x,y,z.")
@click.option("--orientation", help="How angles are written: rotation-vector, quaternion, tilt-torsion, euler-xyz, ...")
@click.option("--sigma-position", type=Quantity(Dimension.LENGTH), default="0.01mm", show_default=True, metavar="QUANTITY",
              help="Standard deviation of each measured length.")  # fmt: skip
@click.option("--sigma-angle", type=Quantity(Dimension.ANGLE), default="50urad", show_default=True, metavar="QUANTITY",
              help="Standard deviation of each measured angle.")  # fmt: skip
@click.option("--draw-errors", is_flag=True, help="Give the machine errors drawn from the tolerances of the robot file.")
@click.option("--truth", type=FILE, help="Also write the true machine, as a robot file.")
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Seed of noise and errors.")
@json_option
def simulate(
    robot: str,
    poses: Path,
    output: Path,
    kind: str,
    components: str | None,
    orientation: str | None,
    sigma_position: float,
    sigma_angle: float,
    draw_errors: bool,
    truth: Path | None,
    seed: int,
    as_json: bool,
) -> None:
    """Command ROBOT to poses by its nominal geometry, and write down what an instrument would see of the true machine.

    The true machine has the identified values of the robot file where it has any, or drawn ones with --draw-errors.

    \b
    Examples:
      loopcal simulate hexapod-42 --poses poses.csv --draw-errors --truth truth.yaml -o measurements.csv
      loopcal simulate truth.yaml --poses poses.csv --sigma-position 0.001mm --sigma-angle 5urad -o measurements.csv
    """  # noqa: D301
    from loopcal import measure
    from loopcal.io import load_robot, save_measurements, save_robot
    from loopcal.io.measurement_file import load_poses

    machine = load_robot(robot)
    if draw_errors:
        machine = machine.with_values(measure.sample_truth(machine, 1, seed)[0])
    instrument = _instrument(kind, components, orientation, sigma_position, sigma_angle)
    data = measure.simulate(machine, load_poses(poses, machine), instrument, seed)
    measure.check_strokes(data, machine)
    save_measurements(data, output, machine, f"simulated by loopcal: {poses.name}, seed {seed}")
    if truth is not None:
        save_robot(machine, truth)
    if as_json:
        show.json_document({"output": output, "truth": truth, "n_poses": data.n_poses, "n_rows": data.n_rows, "seed": seed})
    else:
        show.say(f"{output}: {data.n_poses} poses of {machine.name}, {data.n_rows} measured values, seed {seed}")


def _instrument(
    kind: str, components: str | None, orientation: str | None, sigma_position: float, sigma_angle: float
) -> Instrument:
    """Return the instrument that the options describe."""
    import numpy as np

    from loopcal.errors import DataError, nearest
    from loopcal.io.sensor_settings import kind_settings
    from loopcal.measure import KINDS, Gaussian, Instrument, Sensor

    if kind not in KINDS:
        raise DataError(f"{kind!r} is not a kind of measurement{nearest(kind, KINDS)}; known are {', '.join(KINDS)}")
    stated = {"components": components and tuple(components.split(",")), "orientation": orientation}
    settings = {name: value for name, value in stated.items() if value}
    for name in settings:
        if name not in kind_settings(KINDS[kind]):
            raise DataError(f"--{name} does not belong to the kind {kind!r}; leave it out, or choose another kind")
    made = KINDS[kind](**settings)
    sigma = {Dimension.LENGTH: sigma_position, Dimension.ANGLE: sigma_angle}
    return Instrument((Sensor(made, Gaussian(np.array([sigma[c.dimension] for c in made.noise_columns]))),))
