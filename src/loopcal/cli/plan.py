# SPDX-License-Identifier: Apache-2.0
"""`loopcal plan`: which poses to measure, in which order, and a sheet to measure them by."""

from __future__ import annotations

import functools
import math
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from loopcal.cli import show
from loopcal.cli.identifiability import assumed_instrument
from loopcal.cli.options import FILE, Quantity, instrument_options, json_option, robot_argument
from loopcal.errors import DataError, UnitError
from loopcal.units import Dimension, parse_quantity

if TYPE_CHECKING:
    from loopcal.measure import Instrument, Measurements
    from loopcal.mechanism import Mechanism
    from loopcal.planning.constraints import Constraints
    from loopcal.planning.result import Plan

POSES = 40


class Goal(click.ParamType):
    """An accuracy with its unit: a length for positions, an angle for orientations."""

    name = "quantity"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, str]:
        """Return the SI value and what it is of, or fail with what is allowed."""
        if isinstance(value, tuple):
            return value
        with suppress(UnitError):
            return parse_quantity(value, Dimension.ANGLE), "orientation"
        try:
            return parse_quantity(value, Dimension.LENGTH), "position"
        except UnitError as error:
            self.fail(f"{error}; or give an angle, such as 10urad", param, ctx)


@dataclass(frozen=True)
class Asked:
    """What `constraint_options` gave."""

    min_margin: float
    max_tilt: float | None
    seen_from: str | None
    facing: str
    cone: float
    nearest: float
    farthest: float | None

    def constraints(self) -> Constraints:
        """Return the constraints that the options describe."""
        from loopcal.planning.constraints import Constraints, LineOfSight

        if self.seen_from is None:
            given = click.get_current_context().get_parameter_source
            for name in ("facing", "cone", "nearest", "farthest"):
                if given(name) is click.core.ParameterSource.COMMANDLINE:
                    raise DataError(
                        f"--{name} is about a line of sight; say from where, with --seen-from"
                    )
            return Constraints(self.min_margin, self.max_tilt)
        station = _three(self.seen_from, "--seen-from", Dimension.LENGTH)
        facing = _three(self.facing, "--facing", None)
        sight = LineOfSight(
            station,
            facing,
            self.cone,
            self.nearest,
            math.inf if self.farthest is None else self.farthest,
        )
        return Constraints(self.min_margin, self.max_tilt, sight)


def constraint_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add what planned poses must keep to; the command gets it as `asked`."""
    length, angle = Quantity(Dimension.LENGTH), Quantity(Dimension.ANGLE)

    @functools.wraps(command)
    def packed(**given: Any) -> Any:
        asked = Asked(**{f.name: given.pop(f.name) for f in fields(Asked)})
        return command(**given, asked=asked)

    for option in (
        click.option("--farthest", type=length, metavar="QUANTITY", help="Largest distance of the "
                                                                         "target."),
        click.option("--nearest", type=length, default="0mm", metavar="QUANTITY", help="Smallest distance of the target."),
        click.option("--cone", type=angle, default="90deg", show_default=True, metavar="QUANTITY",
                     help="With --seen-from: half the angle within which the target can be seen."),
        click.option("--facing", default="0,0,1", show_default=True, metavar="X,Y,Z",
                     help="With --seen-from: where the target faces, in the axes of the platform."),
        click.option("--seen-from", metavar="X,Y,Z", help="Where the instrument stands in the base "
                                                          "frame, as 1.5m,-0.8m,1.1m."),
        click.option("--max-tilt", type=angle, metavar="QUANTITY", help="Largest tilt of the "
                                                                        "platform, such as 20deg."),
        click.option("--min-margin", type=float, default=0.1, show_default=True,
                     help="Smallest distance from a singularity, as a share of the workspace's "
                          "median."),
    ):  # fmt: skip
        packed = option(packed)
    return packed


@click.command(short_help="Plan which poses to measure, and write a sheet to measure them by.")
@robot_argument
@click.option("-o", "--output", required=True, type=FILE, help="The folder to make.")
@click.option("--poses", type=int, metavar="N", help=f"Number of poses to fit (default {POSES}).")
@click.option(
    "--accuracy",
    type=Goal(),
    metavar="QUANTITY",
    help="In place of --poses: as many as this error takes, as 20um.",
)
@click.option(
    "--criterion",
    type=click.Choice(("I", "D")),
    default="I",
    show_default=True,
    help="What is made small: I the mean predicted variance of poses, D the uncertainty of the "
    "parameters.",
)
@click.option(
    "--hold-out",
    type=int,
    metavar="N",
    help="Further poses to judge by, drawn evenly (default: one for four).",
)
@click.option(
    "--like",
    type=FILE,
    metavar="DATA",
    help="Measurement file whose settings describe the instrument.",
)
@click.option(
    "--measure",
    metavar="NAMES",
    help="Short for --kind component: some of x,y,z,phi,theta,psi; or plane-line.",
)
@click.option(
    "--frames",
    metavar="NAMES",
    help="What else is unknown: base (the instrument's frame in it), tool, or both.",
)
@instrument_options
@click.option(
    "--groups",
    type=int,
    metavar="N",
    help="With --measure plane-line: number of planes with a line.",
)
@click.option("--points", type=int, metavar="N", help="With --measure plane-line: points of each.")
@click.option(
    "--allowed",
    type=FILE,
    metavar="CSV",
    help="The poses to choose from; default: drawn from the workspace.",
)
@click.option(
    "--measured",
    type=FILE,
    multiple=True,
    metavar="DATA",
    help="Measurements made already; several times.",
)
@constraint_options
@click.option(
    "--candidates",
    type=click.IntRange(min=10),
    default=1000,
    show_default=True,
    help="Poses drawn to choose from.",
)
@click.option("--curve", is_flag=True, help="Also tell expected errors by the number of poses.")
@click.option(
    "--seed",
    type=click.IntRange(min=0),
    default=1,
    show_default=True,
    help="Seed of all random choices.",
)
@click.option("--force", is_flag=True, help="Replace a plan that is there.")
@json_option
def plan(
    robot: str,
    output: Path,
    like: Path | None,
    allowed: Path | None,
    measured: tuple[Path, ...],
    groups: int | None,
    points: int | None,
    seed: int,
    force: bool,
    as_json: bool,
    **options: Any,
) -> None:
    """Plan which poses of ROBOT to measure with an instrument, and write a folder with a sheet and
    a data file to fill in.

    The instrument is described by --measure (or --kind, --components, --orientation), --frames and
    the sigmas, or by the settings of a measurement file with --like. Strokes, joint limits and
    cones of ROBOT are always kept to, on the way too.

    \b
    Examples:
      loopcal plan hexapod-42 -o plan --poses 30 --sigma-position 5um --sigma-angle 10urad
      loopcal plan hexapod-42 -o plan --accuracy 20um --kind position
      loopcal plan 3-prs -o plan --measure x,y,z,phi,theta --max-tilt 20deg --min-margin 0.2 --curve
      loopcal plan hexapod-42 -o plan --kind position --seen-from 1.5m,-0.8m,0.6m --cone 60deg
      loopcal plan my-hexapod.yaml -o plan --like tracker.csv --measured last-week.csv --poses 12
      loopcal plan hexapod-nategh-agheli -o plan --measure plane-line --groups 10 --points 8
      --sigma-position 1um
    """  # noqa: D301
    from loopcal.io import load_robot
    from loopcal.io.runs.plan_folder import FORMAT, refuse_plan_folder

    refuse_plan_folder(output, force)
    machine = load_robot(robot)
    if options["measure"] == "plane-line":
        from loopcal.cli.plan_groups import plan_groups, refuse_others

        refuse_others(click.get_current_context())
        constraints, counts = options["asked"].constraints(), (groups, points)
        inputs = _inputs(robot, None, None, ())
        plan_groups(
            machine,
            output,
            counts,
            options["sigma_position"],
            constraints,
            inputs,
            seed,
            force,
            as_json,
        )
        return
    if groups is not None or points is not None:
        raise DataError("--groups and --points belong to --measure plane-line; leave them out")
    looking = _instrument(machine, like, options)
    show.progress("planning ...")
    made = _planned(machine, looking, allowed, measured, seed, options)
    _write(output, made, _inputs(robot, like, allowed, measured), force)
    if as_json:
        show.json_document({"format": FORMAT, **made.to_dict()})
        return
    show.say(str(made))
    show.say(
        f"\nwritten to {output}: plan.csv to measure by, measurements.csv to fill in, plan.json, "
        "pictures"
    )
    files = shlex.join(str(path) for path in (*measured, output / "measurements.csv"))
    show.say(f"then: loopcal calibrate {shlex.quote(robot)} {files} -o run")


def _instrument(robot: Mechanism, like: Path | None, options: Mapping[str, Any]) -> Instrument:
    """Return the instrument that the options, or the settings of a file, describe."""
    from loopcal.io.data.instrument_file import load_instrument_to_plan

    if like is not None and like.suffix in (".yaml", ".yml"):
        raise DataError(
            f"--like {like} is no measurement file, which is CSV; its settings stand in front of "
            "or beside it"
        )
    names = (
        "measure",
        "frames",
        "kind",
        "components",
        "orientation",
        "sigma_position",
        "sigma_angle",
    )
    if like is None:
        return assumed_instrument(**{name: options[name] for name in names})
    given = click.get_current_context().get_parameter_source
    for name in names:
        if given(name) is click.core.ParameterSource.COMMANDLINE:
            raise DataError(
                f"--like {like} describes the instrument; leave out --{name.replace('_', '-')}, or "
                "--like"
            )
    return load_instrument_to_plan(like, robot)


def _planned(
    robot: Mechanism,
    looking: Instrument,
    allowed: Path | None,
    measured: tuple[Path, ...],
    seed: int,
    options: Mapping[str, Any],
) -> Plan:
    """Plan as the options ask."""
    from loopcal.io.data.measurement_file import load_poses
    from loopcal.planning import PlanOptions
    from loopcal.planning import plan as plan_poses

    goal, n = options["accuracy"], options["poses"]
    if goal is not None and n is not None:
        raise DataError(
            "there are both --poses and --accuracy; give the number of poses, or what they are to "
            "reach"
        )
    if goal is not None and options["curve"]:
        raise DataError("--accuracy shows its own curve; leave out --curve")
    poses = None if allowed is None else load_poses(allowed, robot)
    before, taken = (None, ()) if not measured else _known(measured, robot)
    error, target = (None, "pose") if goal is None else goal
    return plan_poses(
        robot,
        looking,
        options=PlanOptions(
            n_poses=n,
            criterion=options["criterion"],
            target=target,
            goal=error,
            hold_out=options["hold_out"],
            constraints=options["asked"].constraints(),
            allowed_poses=poses,
            n_candidates=options["candidates"],
            measured=before,
            used_names=taken,
            curve=options["curve"],
            seed=seed,
        ),
    )


def _known(measured: Sequence[Path], robot: Mechanism) -> tuple[Measurements, tuple[str, ...]]:
    """Return what earlier files measured of poses to fit, and the names of all their poses."""
    from loopcal.cli.options import measurements
    from loopcal.io.data.pose_use import read_held_out_poses

    found = measurements(measured, robot)
    if not found.n_rows:
        raise DataError(
            f"--measured {' '.join(map(str, measured))} holds no measured value; fill it in, or "
            "leave it out"
        )
    held = read_held_out_poses(measured)
    fitted = [i for i, label in enumerate(found.labels) if label not in set(held)]
    if not fitted:
        raise DataError(
            f"--measured {' '.join(map(str, measured))} holds all its poses out; leave some to fit"
        )
    return (found.take(fitted) if held else found), found.labels


def _inputs(
    robot: str, like: Path | None, allowed: Path | None, measured: tuple[Path, ...]
) -> dict[str, Path]:
    """Return the files that are read."""
    from loopcal.io.robot.robot_file import find_robot_file

    files = {"robot": find_robot_file(robot), "like": like, "allowed": allowed}
    files |= {f"measured {i}": path for i, path in enumerate(measured, 1)}
    return {role: path for role, path in files.items() if path is not None}


def _write(output: Path, made: Plan, inputs: Mapping[str, Path], force: bool) -> None:
    """Write the folder."""
    from loopcal.io.runs.plan_folder import (
        DATA,
        SHEET,
        format_plan_data,
        format_sheet,
        write_plan_folder,
    )
    from loopcal.io.runs.run_folder import collect_provenance
    from loopcal.planning.stops import list_stops
    from loopcal.report.plan_drawing import draw_curve, draw_plan, save_figure

    texts = {SHEET: format_sheet(made, list_stops(made)), DATA: format_plan_data(made)}
    document = made.to_dict() | {
        "made_by": collect_provenance(sys.argv, inputs, {"plan": made.options.seed})
    }
    pictures = {"plan.png": functools.partial(save_figure, figure=draw_plan(made))}
    if made.curve is not None:
        pictures["curve.png"] = functools.partial(
            save_figure, figure=draw_curve(made.robot, made.curve)
        )
    write_plan_folder(output, texts, document, pictures, force)


def _three(text: str, option: str, dimension: Dimension | None) -> Any:
    """Return three numbers, with units where they have a dimension."""
    import numpy as np

    parts = text.split(",")
    try:
        found = [
            float(part) if dimension is None else parse_quantity(part, dimension) for part in parts
        ]
    except (UnitError, ValueError) as error:
        found, why = [], f" ({error})"
    else:
        why = ""
    if len(found) != 3:
        example = "0,0,1" if dimension is None else "1.5m,-0.8m,1.1m"
        raise DataError(f"{option} says {text!r}{why}; give three numbers, as {example}")
    return np.array(found)
