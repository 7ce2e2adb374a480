# SPDX-License-Identifier: Apache-2.0
"""`loopcal identifiability`: which parameters can be known from measurements, before anything is
fitted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

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
    measurements,
    robot_argument,
    sigma_of_readings,
    sigma_reading_option,
)
from loopcal.errors import DataError

if TYPE_CHECKING:
    from loopcal.diagnose import Identifiability, IdentifiableSubset, MeasurementSuggestion
    from loopcal.measure import Instrument

FRAMES = {"base": ("frame",), "tool": ("tool", "targets")}
"""What --frames calls unknown, and how kinds call it."""


@click.command(short_help="Tell which parameters measurements can determine.")
@robot_argument
@click.argument("data", metavar="[DATA]...", type=FILE, nargs=-1)
@click.option(
    "--poses", type=FILE, help="In place of DATA: CSV file of poses that could be measured."
)
@draw_option
@click.option(
    "--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Seed of drawn poses."
)
@click.option(
    "--measure", metavar="NAMES", help="Short for --kind component: some of x,y,z,phi,theta,psi."
)
@click.option(
    "--frames",
    metavar="NAMES",
    help="What else is unknown: base (the instrument's frame in it), tool, or both.",
)
@click.option(
    "--reduce",
    "reduced",
    is_flag=True,
    help="Choose a smallest set of parameters; say what is merged into what.",
)
@click.option(
    "-o", "--output", type=FILE, help="With --reduce: the robot file to write, the others fixed."
)
@click.option("--force", is_flag=True, help="Replace a file that is there.")
@instrument_options
@sigma_reading_option
@data_options
@json_option
def identifiability(
    robot: str,
    data: tuple[Path, ...],
    poses: Path | None,
    draw: int,
    seed: int,
    reduced: bool,
    output: Path | None,
    force: bool,
    sigma_reading: str | None,
    allowed: Mapping[str, bool],
    as_json: bool,
    **seen_by: Any,
) -> None:
    """Tell what DATA can determine of the parameters of ROBOT, what stays open, and what would
    determine it.

    Without DATA an instrument is assumed, at --poses or at poses drawn evenly from the workspace
    that ROBOT states; its options are --measure (or --kind, --components, --orientation), --frames
    and the sigmas. DATA states its own.

    \b
    Examples:
      loopcal identifiability hexapod-42 measurements.csv
      loopcal identifiability hexapod-42 poses.csv tracker.csv inclinometer.csv
      loopcal identifiability 3-prs --measure x,y,z,phi,theta
      loopcal identifiability hexapod-42 --frames base,tool --reduce -o reduced.yaml
      loopcal identifiability hexapod-42 --poses poses.csv --kind component --components x,y,z
      --sigma-position 5um
    """  # noqa: D301
    from loopcal.diagnose import choose_identifiable_subset, suggest_measurements
    from loopcal.diagnose import identifiability as identifiable
    from loopcal.io import load_robot
    from loopcal.io.core.outputs import refuse_outputs
    from loopcal.io.data.measurement_file import load_poses
    from loopcal.io.robot.robot_file import find_robot_file
    from loopcal.measure import simulate

    _refuse(data, poses, seen_by | {"readings": sigma_reading}, reduced, output)
    refuse_outputs((output,), (find_robot_file(robot), *data, poses), force)
    machine, drawn = load_robot(robot), ""
    if data:
        measured = measurements(data, machine, **allowed)
    else:
        looking = assumed_instrument(**seen_by)
        targets, drawn = (
            (load_poses(poses, machine), "")
            if poses is not None
            else drawn_poses(machine, draw, seed)
        )
        measured = simulate(
            machine,
            targets,
            looking,
            0,
            machine,
            reading_sigma=sigma_of_readings(sigma_reading, machine),
        )
    found = identifiable(machine, measured)
    cures, smaller = (
        suggest_measurements(found),
        choose_identifiable_subset(found) if reduced else None,
    )
    if smaller is not None and output is not None:
        _write(output, smaller)
    if as_json:
        document = found.to_dict() | {"remedies": [cure.to_dict() for cure in cures]}
        show.json_document(
            document if smaller is None else document | {"reduction": smaller.to_dict()}
        )
        return
    if drawn:
        show.say(drawn)
    _print(found, cures)
    if smaller is not None:
        show.say(f"\n{smaller}")
    if output is not None:
        show.say(f"\n{output}: the robot with these parameters fixed")


def _refuse(
    data: Sequence[Path],
    poses: Path | None,
    seen_by: Mapping[str, Any],
    reduced: bool,
    output: Path | None,
) -> None:
    """Refuse options that contradict each other."""
    if data and poses is not None:
        raise DataError(
            "there are both DATA and --poses; give measurements, or poses that could be measured, "
            "but not both"
        )
    if data and (seen_by["measure"] or seen_by["frames"]):
        raise DataError(
            "DATA states what is measured and what is unknown; leave out --measure and --frames, "
            "or DATA"
        )
    if data and seen_by["readings"]:
        raise DataError(
            "DATA states how far its readings are believed (reading_noise); leave out "
            "--sigma-reading, or DATA"
        )
    if output is not None and not reduced:
        raise DataError("-o writes what --reduce finds; add --reduce, or leave out -o")


def assumed_instrument(
    measure: str | None,
    frames: str | None,
    kind: str,
    components: str | None,
    orientation: str | None,
    sigma_position: float,
    sigma_angle: float,
) -> Instrument:
    """Return the instrument of `instrument_options`, with what --measure and --frames say."""
    from loopcal.measure import Instrument

    if measure is not None:
        if components is not None or kind != "pose":
            raise DataError(
                "--measure is short for --kind component --components; give one or the other"
            )
        kind, components = "component", measure
        if orientation is None and {"phi", "theta", "psi"} & set(measure.split(",")):
            orientation = "tilt-torsion"
    made = instrument(kind, components, orientation, sigma_position, sigma_angle)
    if frames is None:
        return made
    kinds: list[Any] = [sensor.kind for sensor in made.sensors]
    unknown = [replace(one, unknown=_unknown(frames, one)) for one in kinds]
    return Instrument(
        tuple(replace(sensor, kind=one) for sensor, one in zip(made.sensors, unknown, strict=True))
    )


def _unknown(frames: str, kind: object) -> tuple[str, ...]:
    """Return what a kind calls the frames that are unknown."""
    possible: tuple[str, ...] = getattr(kind, "allowed_unknown", ())
    found = []
    for name in frames.split(","):
        if name not in FRAMES:
            raise DataError(
                f"--frames says {name!r}; what can be unknown is base, tool, or base,tool"
            )
        known = [own for own in FRAMES[name] if own in possible]
        if not known:
            raise DataError(
                f"--frames {name} means nothing to this kind of measurement; leave it out"
            )
        found.append(known[0])
    return tuple(found)


def _print(found: Identifiability, cures: Sequence[MeasurementSuggestion]) -> None:
    """Print sentences, then what is said of each parameter, then the indices."""
    from loopcal.diagnose import ASSUMED_FRAMES

    for sentence in found.sentences():
        show.say(sentence)
    for cure in cures:
        show.say(f"to determine {cure}")
    if cures:
        show.say(f"note: {ASSUMED_FRAMES}")
    verdicts = [
        (v.name, "yes" if v.state == "determined" else str(v), f"{v.left:.2f}")
        for v in found.parameters
    ]
    show.table("Parameters", ("name", "determined", "sd / tolerance"), verdicts, text_columns=2)
    show.say("sd / tolerance: with the tolerances as a prior; 1 where nothing is learned")
    indices = [(name, meaning, f"{value:.3g}") for name, value, meaning in found.indices.rows()]
    show.table("Observability", ("index", "what", "value"), indices, text_columns=2)


def _write(output: Path, smaller: IdentifiableSubset) -> None:
    """Write the robot file with the parameters fixed that are left out."""
    from loopcal.io.core.text_file import write_text
    from loopcal.io.robot.reduced_robot import format_reduced_robot

    words = {merged.name: merged.words(most=3) for merged in smaller.dropped}
    write_text(output, format_reduced_robot(smaller.robot, words))
