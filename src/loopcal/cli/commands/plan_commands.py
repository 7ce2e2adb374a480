# SPDX-License-Identifier: Apache-2.0
"""`loopcal plan`: which poses to measure, in which order, and a sheet to measure them by."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from loopcal.cli import terminal
from loopcal.cli.hints import list_hints
from loopcal.cli.options import (
    Count,
    Goal,
    constraint_options,
    data_option,
    file_option,
    flag_option,
    force_option,
    frame_option,
    instrument_options,
    is_given,
    library_option,
    make_constraints,
    make_instrument,
    read_checked_measurements,
    refuse_given,
    robot_argument,
    seed_option,
    unknown_options,
)
from loopcal.cli.terminal import Output, shows_output
from loopcal.errors import DataError

if TYPE_CHECKING:
    from loopcal.mechanism.model import Mechanism
    from loopcal.planning.constraints import PlanOptions
    from loopcal.planning.plane_line_planning import SurfacePlan
    from loopcal.planning.result import Plan

PLANE_LINE = "plane-line"
"""Word of --measure for points on planes and lines that a coordinate measuring machine holds."""

OPTIONS = "loopcal.planning.constraints:PlanOptions"
SURFACES = "loopcal.planning.plane_line_planning:SurfaceOptions"

_COUNTED = "which is counted by --groups and --points"
_HELD = "where a measuring machine holds x, y or z to --sigma-position"
_CHOSEN = "which moves points within the workspace and chooses by criterion D"
EXCLUDED_BY_PLANE_LINE = {
    **dict.fromkeys(("poses", "accuracy", "curve"), _COUNTED),
    **dict.fromkeys(("like", "kind", "components", "orientation", "sigma_angle"), _HELD),
    **dict.fromkeys(("criterion", "n_candidates", "allowed"), _CHOSEN),
    "hold_out": "where every point is fitted",
    "measured": "which plans without earlier measurements",
    "frames": "whose surfaces are unknown in every group",
    "targets": "which checks the tool",
}
"""Options that have no effect with --measure plane-line, and why."""


@click.command()
@robot_argument
@file_option("-o", "--output", help="Folder to make.", required=True)
@click.option(
    "--poses",
    type=Count("PLANNED_POSES"),
    metavar="N",
    help="Number of poses for the calibration.  [default: 40]",
)
@click.option(
    "--accuracy",
    type=Goal(),
    help="Instead of --poses: expected error to reach, such as 20um or 10urad.",
)
@library_option(
    "--criterion",
    of=OPTIONS,
    type=click.Choice(("I", "D")),
    help="What the plan minimizes: the mean predicted variance of poses (I), or the uncertainty of "
    "the parameters (D).",
)
@click.option(
    "--hold-out",
    type=Count("PLANNED_POSES"),
    metavar="N",
    help="Number of further poses for validation, drawn evenly.  "
    "[default: one for four, at least 5]",
)
@data_option("--like", "Measurement file whose settings describe the instrument.")
@unknown_options
@instrument_options
@library_option(
    "--groups",
    of=SURFACES,
    type=Count("GROUPS"),
    metavar="N",
    help="With --measure plane-line: number of planes with a line.",
)
@library_option(
    "--points",
    of=SURFACES,
    type=Count("POINTS"),
    metavar="N",
    help="With --measure plane-line: number of points on each.",
)
@file_option(
    "--allowed", help="Poses to choose from; by default drawn from the workspace.", metavar="CSV"
)
@data_option(
    "--measured", "Measurements that exist already. May be given several times.", multiple=True
)
@constraint_options
@library_option(
    "--candidates",
    "n_candidates",
    of=OPTIONS,
    type=Count("CANDIDATES", 10),
    metavar="N",
    help="Number of candidate poses to draw.",
)
@flag_option("--curve", help="Also compute the expected errors by the number of poses.")
@frame_option("fitted, base, or relative (to home)")
@seed_option("all random choices")
@force_option("the plan")
@shows_output
def plan(
    robot: str,
    output: Path,
    like: Path | None,
    allowed: Path | None,
    measured: tuple[Path, ...],
    groups: int,
    points: int,
    seed: int,
    force: bool,
    **options: Any,
) -> Output:
    """Plan which poses of ROBOT to measure with an instrument. Write a folder with a sheet for the
    measurement and a data file to fill in.

    The instrument is described by --measure (or --kind, --components, --orientation), --frames and
    the sigmas, or by a measurement file with --like. Strokes, joint limits and cones of ROBOT are
    always respected, also on the path between poses.

    \b
    Examples:
      loopcal plan hexapod-42 -o plan --poses 30 --sigma-position 5um --sigma-angle 10urad
      loopcal plan hexapod-42 -o plan --accuracy 20um --kind position
      loopcal plan 3-prs -o plan --measure x,y,z,phi,theta --max-tilt 20deg --curve
      loopcal plan hexapod-42 -o plan --kind position --seen-from 1.5m,-0.8m,0.6m --cone 60deg
      loopcal plan my-hexapod.yaml -o plan --like tracker.csv --measured last-week.csv
      loopcal plan hexapod-nategh-agheli -o plan --measure plane-line --groups 10 --points 8
    """  # noqa: D301
    from loopcal.io.core.outputs import refuse_folder
    from loopcal.io.data.measurement_file import load_instrument_to_plan
    from loopcal.io.robot.robot_file import find_robot_file, load_robot
    from loopcal.io.runs.plan_folder import FORMAT, PLAN

    files = {"robot": find_robot_file(robot), "like": like, "allowed": allowed}
    files |= {f"measured {i}": path for i, path in enumerate(measured, 1)}
    inputs = {role: path for role, path in files.items() if path is not None}
    refuse_folder(output, PLAN, force, list(inputs.values()))
    machine = load_robot(robot)
    if options["measure"] == PLANE_LINE:
        from loopcal.planning.plane_line_planning import SurfaceOptions, plan_surfaces

        for name, reason in EXCLUDED_BY_PLANE_LINE.items():
            sentence = (
                "{option} cannot be combined with --measure plane-line, {reason}; leave it out"
            )
            refuse_given((name,), reason, sentence)
        sigma, constraints = options["sigma_position"], make_constraints(options)
        surface_options = SurfaceOptions(groups, points, sigma, constraints, seed)
        with terminal.ProgressBar() as progress:
            result = plan_surfaces(machine, surface_options, progress)
        document = result.to_dict()
    else:
        if is_given("groups") or is_given("points"):
            raise DataError("--groups and --points belong to --measure plane-line; leave them out")
        if like is None:
            instrument = make_instrument(options, machine)
        else:
            described = (*unknown_options.names, *instrument_options.names)
            sentence = "{reason} describes the instrument; leave out {option}, or --like"
            refuse_given(described, f"--like {like}", sentence)
            instrument = load_instrument_to_plan(like, machine)
        plan_options = _make_plan_options(machine, allowed, measured, seed, options)
        from loopcal.planning.pose_planning import plan as plan_poses

        with terminal.ProgressBar() as progress:
            result = plan_poses(machine, instrument, options=plan_options, progress=progress)
        document = {"format": FORMAT, **result.to_dict()}
    written = _write_plan(output, result, inputs, seed, force)
    data = shlex.join(str(path) for path in (*measured, output / "measurements.csv"))
    page = [
        str(result),
        *list_hints(result.findings),
        "",
        f"Written to {output}: {written}",
        f"Next: loopcal calibrate {shlex.quote(robot)} {data} -o run",
    ]
    return Output(document, lambda: page)


def _make_plan_options(
    robot: Mechanism,
    allowed: Path | None,
    measured: tuple[Path, ...],
    seed: int,
    options: Mapping[str, Any],
) -> PlanOptions:
    """Return the options of the library."""
    from loopcal.io.data.measurement_file import load_poses
    from loopcal.planning.constraints import PlanOptions

    accuracy = options["accuracy"]
    if accuracy is not None and options["poses"] is not None:
        raise DataError(
            "--poses and --accuracy exclude each other; give the number of poses, or the error to "
            "reach"
        )
    if accuracy is not None and options["curve"]:
        raise DataError("--accuracy shows its own curve; leave out --curve")
    goal, target = (None, "pose") if accuracy is None else accuracy
    earlier = read_checked_measurements(measured, robot) if measured else None
    if earlier is not None:
        files = " ".join(map(str, measured))
        if not earlier.n_rows:
            raise DataError(
                f"--measured {files} contains no measured value; fill it in, or leave it out"
            )
        if earlier.is_held_out.all():
            raise DataError(f"--measured {files} holds all its poses out; leave some to fit")
    return PlanOptions(
        n_poses=options["poses"],
        criterion=options["criterion"],
        target=target,
        goal=goal,
        hold_out=options["hold_out"],
        frame=options["frame"],
        constraints=make_constraints(options),
        allowed_poses=None if allowed is None else load_poses(allowed, robot),
        n_candidates=options["n_candidates"],
        measured=None if earlier is None else earlier.fitted,
        used_names=() if earlier is None else earlier.labels,
        curve=options["curve"],
        seed=seed,
    )


def _write_plan(
    output: Path, result: Plan | SurfacePlan, inputs: Mapping[str, Path], seed: int, force: bool
) -> str:
    """Write the folder of a plan; return its files in words."""
    from loopcal.io.core.outputs import write_result_folder
    from loopcal.io.runs.plan_folder import (
        DATA,
        FORMAT,
        PLAN,
        SHEET,
        format_plan_data,
        format_sheet,
        format_surface_data,
        format_surface_sheet,
    )
    from loopcal.io.runs.run_folder import collect_provenance
    from loopcal.planning.result import Plan, list_stops
    from loopcal.report.figures.plan_figures import draw_curve, draw_plan
    from loopcal.report.pictures import render_figure

    figures = {}
    if isinstance(result, Plan):
        texts = {SHEET: format_sheet(result, list_stops(result)), DATA: format_plan_data(result)}
        figures["plan.png"] = draw_plan(result)
        if result.curve is not None:
            figures["curve.png"] = draw_curve(result.robot, result.curve)
    else:
        texts = {SHEET: format_surface_sheet(result), DATA: format_surface_data(result)}
    document = {"format": FORMAT, **result.to_dict()}
    document["made_by"] = collect_provenance(sys.argv, inputs, {"plan": seed})
    pictures = {name: render_figure(figure, ".png") for name, figure in figures.items()}
    contents = {name: text.encode() for name, text in texts.items()} | pictures
    write_result_folder(output, PLAN, document, contents, force)
    files = "plan.csv for the measurement, measurements.csv to fill in, plan.json"
    return f"{files}, pictures" if pictures else files
