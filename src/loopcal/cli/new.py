# SPDX-License-Identifier: Apache-2.0
"""`loopcal new`: a robot file and a measurement file to fill in."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import click

from loopcal.cli import show
from loopcal.cli.options import FILE, instrument, instrument_options, json_option

if TYPE_CHECKING:
    from loopcal.measure import Instrument


@click.command(short_help="Write a robot file, and a measurement file, to fill in.")
@click.argument("family", metavar="FAMILY")
@click.option(
    "-o",
    "--output",
    required=True,
    type=FILE,
    help="The robot file to write; the robot is called after it.",
)
@click.option(
    "--measurements", type=FILE, help="Also write a measurement file with the columns, but no rows."
)
@instrument_options
@click.option("--force", is_flag=True, help="Replace files that are there.")
@json_option
def new(
    family: str,
    output: Path,
    measurements: Path | None,
    kind: str,
    components: str | None,
    orientation: str | None,
    sigma_position: float,
    sigma_angle: float,
    force: bool,
    as_json: bool,
) -> None:
    """Write a robot file of FAMILY (gough, linear-delta, 3-prs, ru-pus-prs, limbs), or a copy of a
    shipped robot.

    It holds a robot that works, for your own numbers to be put in. The options of the instrument
    are for --measurements.

    \b
    Examples:
      loopcal new gough -o my-hexapod.yaml --measurements tracker.csv
      loopcal new linear-delta -o printer.yaml --measurements heights.csv --kind component
      --components z
    """  # noqa: D301
    from loopcal.io.core.outputs import refuse_outputs
    from loopcal.io.core.text_file import write_text
    from loopcal.io.robot.new_robot import format_new_robot

    seen_by = instrument(kind, components, orientation, sigma_position, sigma_angle)
    refuse_outputs((output, measurements), (), force)
    robot_text = format_new_robot(family, output.stem)
    template = None if measurements is None else _template(robot_text, seen_by)
    write_text(output, robot_text)
    if measurements is not None and template is not None:
        write_text(measurements, template)
    if as_json:
        show.json_document({"robot": output, "measurements": measurements})
        return
    show.say(
        f"{output}: a working robot to put your own numbers into; then: loopcal check {output}"
    )
    if measurements is not None:
        show.say(
            f"{measurements}: columns without rows; fill in and: loopcal calibrate {output} "
            f"{measurements} -o run"
        )


def _template(robot_text: str, seen_by: Instrument) -> str:
    """Return a measurement file without rows for a robot that is not written yet."""
    from loopcal.io import load_robot
    from loopcal.io.data.measurement_writer import format_template

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "robot.yaml"
        path.write_text(robot_text, encoding="utf-8")
        return format_template(load_robot(path), seen_by)
