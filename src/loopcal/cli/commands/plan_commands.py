# SPDX-License-Identifier: Apache-2.0
"""`loopcal plan`: which poses to measure, in which order, and a sheet to measure them by."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import click

import loopcal as lc
from loopcal.cli import options as opt
from loopcal.cli import terminal
from loopcal.cli.hints import list_hints, suggest_command
from loopcal.cli.terminal import Output
from loopcal.errors import DataError

PLANE_LINE = "plane-line"
"""Word of --measure for points on planes and lines that a coordinate measuring machine holds."""

OPTIONS = "loopcal.planning.constraints:PlanOptions"
POSES = "loopcal.planning.constraints:N_POSES"
SURFACES = "loopcal.planning.plane_line_planning:SurfaceOptions"

_COUNTED = "whose size is --groups and --points"
_HELD = "because a measuring machine holds x, y or z to --sigma-position"
_CHOSEN = "which moves points within the workspace and chooses by criterion D"
EXCLUDED_BY_PLANE_LINE = {
    **dict.fromkeys(("poses", "accuracy", "curve"), _COUNTED),
    **dict.fromkeys(("like", "kinds", "components", "orientation", "sigma_angle"), _HELD),
    **dict.fromkeys(("criterion", "n_candidates", "allowed"), _CHOSEN),
    "hold_out": "because it fits every point",
    "share": "which gives no error over the workspace",
    "measured": "which plans without earlier measurements",
    "unknown_frames": "whose surfaces are unknown in every group",
    "targets": "which checks the tool",
}
"""Options that have no effect with --measure plane-line, and why."""


@opt.command()
def plan(
    robot: str = opt.ROBOT,
    output: Path = opt.path("Folder to make.", "-o", required=True),
    poses: int | None = opt.option(
        lambda: f"Number of poses for the calibration.  [default: {opt.look_up(POSES)}]",
        type=opt.Count("PLANNED_POSES"),
    ),
    accuracy: tuple[float, Literal["position", "orientation"]] | None = opt.option(
        "Instead of --poses: error over the workspace (rms) that machines are to end below, such "
        "as 20um or 10urad.",
        type=opt.GOAL,
    ),
    share: float = opt.option(
        "Share of machines that end below the stated errors.", of=OPTIONS, type=opt.OPEN_SHARE
    ),
    criterion: str = opt.option(
        "What the plan minimizes: the mean predicted variance of poses (I), or the uncertainty of "
        "the parameters (D).",
        of=OPTIONS,
        type=click.Choice(("I", "D")),
    ),
    hold_out: int | None = opt.option(
        "Number of further poses for validation, drawn evenly.  "
        "[default: one for four, at least 5]",
        type=opt.Count("PLANNED_POSES"),
    ),
    like: Path | None = opt.data_option("Measurement file whose settings describe the instrument."),
    unknown: dict[str, Any] = opt.UNKNOWN,
    instrument: dict[str, Any] = opt.INSTRUMENT,
    groups: int = opt.option(
        "With --measure plane-line: number of planes with a line.",
        of=SURFACES,
        type=opt.Count("GROUPS"),
    ),
    points: int = opt.option(
        "With --measure plane-line: number of points on each.",
        of=SURFACES,
        type=opt.Count("POINTS"),
    ),
    allowed: Path | None = opt.path(
        "Poses to choose from. Default: drawn from the workspace.", metavar="CSV"
    ),
    measured: tuple[Path, ...] = opt.data_option(
        "Measurements that exist already. Repeatable.", multiple=True
    ),
    at: tuple[tuple[str, float], ...] = opt.AT,
    constraints: lc.Constraints = opt.CONSTRAINTS,
    n_candidates: int = opt.option(
        "Number of candidate poses to draw.",
        "--candidates",
        of=OPTIONS,
        type=opt.Count("CANDIDATES", 10),
    ),
    curve: bool = opt.flag("Also compute the errors by the number of poses."),
    frame: Literal["fitted", "base", "relative"] = opt.frame(
        OPTIONS, "fitted, base, or relative (to home)"
    ),
    seed: int = opt.seed("all random choices", OPTIONS),
    force: bool = opt.force("the plan"),
) -> Output:
    """Plan which poses of ROBOT to measure with an instrument. Write a folder with a sheet for the
    measurement and a data file to fill in.

    Options for the instrument: --measure (or --kind, --components, --orientation), --frames and the
    sigmas, or a measurement file with --like. Poses and paths between them always keep strokes,
    joint limits and cones of ROBOT.

    Examples:
      loopcal plan hexapod-42 -o plan --poses 30 --sigma-position 5um --sigma-angle 10urad
      loopcal plan hexapod-42 -o plan --accuracy 20um --share 0.95 --kind position
      loopcal plan 3-prs -o plan --measure x,y,z,phi,theta --max-tilt 20deg --curve
      loopcal plan hexapod-42 -o plan --kind position --seen-from 1.5m,-0.8m,0.6m --cone 60deg
      loopcal plan my-hexapod.yaml -o plan --like tracker.csv --measured last-week.csv
      loopcal plan hexapod-nategh-agheli -o plan --measure plane-line --groups 10 --points 8
    """
    from loopcal.io.core.outputs import refuse_folder
    from loopcal.io.data.measurement_file import load_instrument_to_plan, load_poses
    from loopcal.io.robot.robot_file import find_robot_file
    from loopcal.io.runs.plan_folder import FORMAT, PLAN
    from loopcal.io.runs.run_folder import collect_provenance

    files = {"robot": find_robot_file(robot), "like": like, "allowed": allowed}
    files |= {f"measured {i}": path for i, path in enumerate(measured, 1)}
    inputs = {role: path for role, path in files.items() if path is not None}
    refuse_folder(output, PLAN, force, list(inputs.values()))
    machine = lc.load_robot(robot).with_conditions(dict(at))
    if unknown["measure"] == (PLANE_LINE,):
        for name, reason in EXCLUDED_BY_PLANE_LINE.items():
            sentence = "--measure plane-line takes no {option}, {reason}. Leave it out"
            opt.refuse_given((name,), reason, sentence)
        sigma = instrument["sigma_position"]
        surface_options = lc.SurfaceOptions(groups, points, sigma, constraints, seed)
        with terminal.TerminalProgress() as progress:
            result = lc.plan_surfaces(machine, surface_options, progress)
    else:
        if opt.is_given("groups") or opt.is_given("points"):
            raise DataError("--groups and --points belong to --measure plane-line. Leave them out")
        if like is None:
            measuring = opt.make_instrument(unknown | instrument, machine)
        else:
            described = (*opt.UNKNOWN.members, *opt.INSTRUMENT.members)
            sentence = "{reason} describes the instrument. Leave out {option}, or --like"
            opt.refuse_given(described, f"--like {like}", sentence)
            measuring = load_instrument_to_plan(like, machine)
        if accuracy is not None and poses is not None:
            raise DataError(
                "--poses and --accuracy exclude each other. Give the number of poses, or the error "
                "to reach"
            )
        if accuracy is not None and curve:
            raise DataError("--accuracy shows its own curve. Leave out --curve")
        goal, target = accuracy or (None, "pose")
        earlier = _read_measured(measured, machine) if measured else None
        plan_options = lc.PlanOptions(
            n_poses=poses,
            criterion=criterion,
            target=target,
            goal=goal,
            share=share,
            hold_out=hold_out,
            frame=frame,
            constraints=constraints,
            allowed_poses=None if allowed is None else load_poses(allowed, machine),
            n_candidates=n_candidates,
            measured=None if earlier is None else earlier.fitted,
            used_names=() if earlier is None else earlier.labels,
            curve=curve,
            seed=seed,
        )
        with terminal.TerminalProgress() as progress:
            result = lc.plan(machine, measuring, options=plan_options, progress=progress)
    made_by = collect_provenance(opt.list_words(), inputs, {"plan": seed})
    document = terminal.add_findings({"format": FORMAT, **result.to_dict(), "made_by": made_by})
    written = _write_plan(output, result, document, force)
    data = (*measured, output / "measurements.csv")
    page = [
        str(result),
        *list_hints(result.findings),
        "",
        f"Written to {output}: {written}",
        suggest_command("calibrate", robot, *data, "-o", "run"),
    ]
    return Output(document, lambda: page)


def _read_measured(paths: tuple[Path, ...], robot: lc.Mechanism) -> lc.Measurements:
    """Return measurements that exist already; refuse those without a fitted value."""
    earlier = opt.read_checked_measurements(paths, robot)
    files = " ".join(map(str, paths))
    if not earlier.n_rows:
        raise DataError(
            f"--measured {files} contains no measured value. Fill it in, or leave it out"
        )
    if earlier.is_held_out.all():
        raise DataError(f"--measured {files} holds all its poses out. Leave some to fit")
    return earlier


def _write_plan(
    output: Path, result: lc.Plan | lc.SurfacePlan, document: Mapping[str, Any], force: bool
) -> str:
    """Write the folder of a plan; return its files in words."""
    from loopcal.io.core.outputs import write_result_folder
    from loopcal.io.runs import plan_folder
    from loopcal.planning.pose_planning import list_stops
    from loopcal.report.figures.plan_figures import draw_curve, draw_plan
    from loopcal.report.pictures import render_figure

    figures = {}
    if isinstance(result, lc.Plan):
        texts = {
            plan_folder.SHEET: plan_folder.format_sheet(result, list_stops(result)),
            plan_folder.DATA: plan_folder.format_plan_data(result),
        }
        figures["plan.png"] = draw_plan(result)
        if result.curve is not None:
            figures["curve.png"] = draw_curve(result.robot, result.curve)
    else:
        texts = {
            plan_folder.SHEET: plan_folder.format_surface_sheet(result),
            plan_folder.DATA: plan_folder.format_surface_data(result),
        }
    pictures = {name: render_figure(figure, ".png") for name, figure in figures.items()}
    contents = {name: text.encode() for name, text in texts.items()} | pictures
    write_result_folder(output, plan_folder.PLAN, document, contents, force)
    files = "plan.csv for the measurement, measurements.csv to fill in, plan.json"
    return f"{files}, pictures" if pictures else files
