# SPDX-License-Identifier: Apache-2.0
"""`loopcal compensate`: readings, or shifted commands, that take the calibrated machine to its
targets.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

import click

from loopcal.cli import show
from loopcal.cli.options import FILE, json_option
from loopcal.units import Dimension

if TYPE_CHECKING:
    from loopcal.apply.compensation import Compensation


@click.command(short_help="Readings or shifted commands for targets.")
@click.argument("run", metavar="RUN", type=FILE)
@click.argument("targets", metavar="TARGETS", type=FILE)
@click.option(
    "-o", "--output", type=FILE, help="The CSV file to write; without it the CSV text is printed."
)
@click.option("--mode", type=click.Choice(("readings", "commands")), default="readings", show_default=True,
              help="Set the actuators, or shift what a closed controller is commanded.")  # fmt: skip
@click.option(
    "--controller",
    metavar="ROBOT",
    help="Robot file of the controller's geometry; default: the nominal robot.",
)
@click.option(
    "--steps", type=click.IntRange(min=1), default=3, show_default=True, help="Steps of the shift."
)
@click.option("--force", is_flag=True, help="Replace a file that is there.")
@json_option
def compensate(
    run: Path,
    targets: Path,
    output: Path | None,
    mode: Literal["readings", "commands"],
    controller: str | None,
    steps: int,
    force: bool,
    as_json: bool,
) -> int:
    """Compute what to tell the machine of RUN so that it goes to TARGETS, a CSV file of controlled
    coordinates.

    RUN is a folder made by `loopcal calibrate`, or a robot file (then no uncertainty is known).
    Each target says what can be compensated, what no actuator can remove, and how sure the pose is.

    The exit code is 2 where a target cannot be reached within the machine's limits.

    \b
    Examples:
      loopcal compensate run targets.csv -o readings.csv
      loopcal compensate run targets.csv --mode commands -o commands.csv
    """  # noqa: D301
    from loopcal.apply.compensation import compensate as compute
    from loopcal.estimate.inference.posterior import Posterior
    from loopcal.io import load_robot
    from loopcal.io.core.outputs import refuse_outputs
    from loopcal.io.core.text_file import write_text
    from loopcal.io.runs.calibration_run import load_posterior_or_robot
    from loopcal.io.runs.compensation_file import format_compensation, load_targets

    refuse_outputs(
        (output,), (run, targets, None if controller is None else Path(controller)), force
    )
    known = load_posterior_or_robot(run)
    robot = known.robot if isinstance(known, Posterior) else known
    wanted, labels = load_targets(targets, robot)
    found = compute(
        known, wanted, mode, None if controller is None else load_robot(controller), steps, labels
    )
    text = format_compensation(found)
    if output is not None:
        write_text(output, text)
    if as_json:
        show.json_document(found.to_dict())
    elif output is None:
        click.echo(text, nl=False)
    else:
        _print(found)
        show.say(f"\nwritten to {output}")
    return show.gates(
        f"target {label!r} {str(found.findings[i])}"
        for i, label in enumerate(labels)
        if not found.usable[i]
    )


def _print(found: Compensation) -> None:
    """Print errors before and after, their uncertainty and the status of each target."""
    import numpy as np

    units = show.units_of(found.robot)
    length, angle = units[Dimension.LENGTH], units[Dimension.ANGLE]
    headers = [
        "target",
        "status",
        f"before [{length}]",
        f"after [{length}]",
        f"before [{angle}]",
        f"after [{angle}]",
    ]
    columns = [np.linalg.norm(e[:, part], axis=1) / u.factor_to_si
               for part, u in ((slice(3, 6), length), (slice(0, 3), angle))
               for e in (found.before, found.remaining)]  # fmt: skip
    if found.uncertainty is not None:
        headers += [f"U [{length}]", f"U [{angle}]"]
        columns += [
            2 * found.uncertainty.position / length.factor_to_si,
            2 * found.uncertainty.orientation / angle.factor_to_si,
        ]
    rows = [
        (label, found.reach[i].value, *(show.number(float(c[i]), digits=3) for c in columns))
        for i, label in enumerate(found.labels)
    ]
    show.table(
        f"{found.robot.name}: {len(rows)} targets, {found.mode}", headers, rows, text_columns=2
    )
    if found.commands is not None:
        for step in range(1, len(found.residual_position)):
            off = np.nanmax(found.residual_position[step]) / length.factor_to_si
            turned = np.nanmax(found.residual_orientation[step]) / angle.factor_to_si
            show.say(f"after step {step}: within {show.number(off, digits=3)} {length} and"
                     f" {show.number(turned, digits=3)} {angle} of the best reachable poses")  # fmt: skip
    if found.uncertainty is not None:
        show.say(f"U = 2 x rms uncertainty: {found.uncertainty.frame}")
