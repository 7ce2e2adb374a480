# SPDX-License-Identifier: Apache-2.0
"""Prepare measurements: what measurements determine, which poses to measure, simulated ones."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

import loopcal as lc
from loopcal.cli import options as opt
from loopcal.cli import terminal
from loopcal.cli.hints import list_hints, suggest_command
from loopcal.cli.terminal import Output
from loopcal.errors import DataError

if TYPE_CHECKING:
    from loopcal.apply.simulated_measurements import SimulatedMeasurements


@opt.command()
def identifiability(
    robot: str = opt.ROBOT,
    data: tuple[Path, ...] = opt.data("[DATA]...", required=False),
    poses: Path | None = opt.path("Instead of DATA: CSV file of possible poses."),
    draw: int = opt.DRAW,
    seed: int = opt.seed("the drawn poses", f"{opt.SIMULATION}:predict_noise_free"),
    at: tuple[tuple[str, float], ...] = opt.AT,
    unknown: dict[str, Any] = opt.UNKNOWN,
    reduced: bool = opt.flag(
        "Also choose parameters to fix without loss, and show how the others contain them.",
        "--fix-unidentifiable",
    ),
    output: Path | None = opt.path(
        "With --fix-unidentifiable: robot file to write, with its 'fixed:' lines.", "-o"
    ),
    force: bool = opt.force("the output file"),
    instrument: dict[str, Any] = opt.INSTRUMENT,
    sigma_reading: str | None = opt.SIGMA_READING,
    rank_tolerance: float = opt.RANK_TOLERANCE,
    useful: float | None = opt.option(
        "Also show what the data determine to this standard deviation of lengths, such as 1um.",
        type=opt.POSITIVE_LENGTH,
        metavar="QUANTITY",
    ),
    useful_angle: float | None = opt.option(
        "Useful accuracy of angles. Default: the length over the size of ROBOT.",
        type=opt.POSITIVE_ANGLE,
        metavar="QUANTITY",
    ),
    allowed: dict[str, bool] = opt.ALLOWED,
    verbose: bool = opt.VERBOSE,
) -> Output:
    """Show which parameters of ROBOT the measurements DATA determine, which combinations they
    cannot determine, and which further measurement does.

    Without DATA, loopcal assumes an instrument that measures --poses, or poses drawn from the
    workspace of ROBOT. Its options are --measure (or --kind, --components, --orientation), --frames
    and the sigmas. With DATA they come from the file.

    Examples:
      loopcal identifiability hexapod-42 measurements.csv
      loopcal identifiability hexapod-42 poses.csv tracker.csv inclinometer.csv
      loopcal identifiability 3-prs --measure x,y,z,phi,theta
      loopcal identifiability hexapod-42 --frames base,tool --fix-unidentifiable -o reduced.yaml
      loopcal identifiability hexapod-42 --poses poses.csv --measure x,y,z --sigma-position 5um
      loopcal identifiability hexapod-42 measurements.csv --useful 1um
    """
    from loopcal.apply.inspection import analyze_identifiability
    from loopcal.apply.simulated_measurements import predict_noise_free
    from loopcal.io.core.text_file import write_text
    from loopcal.io.robot.robot_file import format_reduced_robot
    from loopcal.report.calibration_view import view_identifiability
    from loopcal.results.serialization import json_fields

    if data:
        if poses is not None:
            raise DataError("DATA and --poses exclude each other. Give one of the two")
        sentence = "DATA defines {reason}. Leave out {option}, or DATA"
        opt.refuse_given(opt.UNKNOWN.members, "the instrument and its unknowns", sentence)
        opt.refuse_given(("sigma_reading",), "the noise of its readings (reading_noise)", sentence)
    if output is not None and not reduced:
        raise DataError("-o writes the robot of --fix-unidentifiable. Add this, or leave out -o")
    if useful is None and useful_angle is not None:
        raise DataError("--useful-angle belongs to --useful. Add --useful, such as --useful 1um")
    machine, drawn = opt.open_robot(robot, (output,), (*data, poses), force), []
    machine = machine.with_conditions(dict(at))
    if data:
        measurements = opt.read_fitted_measurements(data, machine, allowed)
    else:
        if poses is None:
            drawn = [f"{_name_drawn_poses(machine, draw)}, seed {seed}"]
        measurements = predict_noise_free(
            machine,
            opt.make_instrument(unknown | instrument, machine),
            **_read_poses(poses, draw, machine),
            reading_sigma=opt.parse_reading_sigma(sigma_reading, machine),
            seed=seed,
        )
    accuracy = None if useful is None else (useful, useful_angle)
    report = analyze_identifiability(machine, measurements, reduced, rank_tolerance, accuracy)
    if report.subset is not None and output is not None:
        subset = report.subset
        words = {merged.name: merged.describe_effect(most=3) for merged in subset.dropped}
        write_text(output, format_reduced_robot(subset.robot, words))
    written = f"Written to {output}: the robot with the other parameters fixed"
    details = "the first combinations, suggested measurements, singular values and all parameters"
    page = [
        *drawn,
        *view_identifiability(report, verbose),
        *(list_hints(report.summary) if report.useful is None else ()),
        f"Hint: use {'--json for all combinations' if verbose else f'--verbose for {details}'}",
        *([] if output is None else ["", written]),
    ]
    return Output(json_fields(report), lambda: page)


def _read_poses(poses: Path | None, draw: int, robot: lc.Mechanism) -> dict[str, Any]:
    """Return the poses that a simulation is given: those of a file, or how many to draw."""
    from loopcal.io.data.measurement_file import load_pose_names, load_poses

    if poses is None:
        return {"poses": draw}
    labels, places = load_pose_names(poses)
    return {"poses": load_poses(poses, robot), "labels": labels, "places": places}


def _name_drawn_poses(robot: lc.Mechanism, count: int) -> str:
    """Return what the drawn poses are."""
    return f"{count} poses drawn from the workspace of {robot.name}"


@opt.command()
def simulate(
    robot: str = opt.ROBOT,
    poses: Path | None = opt.path(
        "CSV file of commanded poses, one column per coordinate. They keep their names."
    ),
    draw: int = opt.DRAW,
    fill: Path | None = opt.path(
        "Instead of poses and instrument: data file of a plan to fill in.", metavar="SHEET"
    ),
    output: Path = opt.path("Measurement file to write.", "-o", required=True),
    at: tuple[tuple[str, float], ...] = opt.AT,
    instrument: dict[str, Any] = opt.INSTRUMENT,
    distribution: str = opt.DISTRIBUTION,
    sigma_reading: str | None = opt.SIGMA_READING,
    draw_errors: bool = opt.flag(
        "Draw the errors of the true machine from the expected spreads of the robot file."
    ),
    skip_unreachable: bool = opt.flag("Leave out poses that the machine does not reach."),
    truth: Path | None = opt.path("Also write the true machine, as a robot file."),
    seed: int = opt.seed("poses, errors and noise", f"{opt.SIMULATION}:simulate_measurements"),
    force: bool = opt.force("an output file"),
) -> Output:
    """Command ROBOT to poses by its nominal geometry, and write what an instrument measures of the
    true machine.

    Default of --poses: drawn evenly from the workspace of ROBOT. The true machine has the
    identified values of ROBOT, or drawn ones with --draw-errors.

    Targets on the base (`of: base` in the settings of a file) need --fill with the sheet that
    `loopcal plan --like` wrote from such a file.

    Examples:
      loopcal simulate hexapod-42 --draw-errors --truth truth.yaml -o measurements.csv
      loopcal simulate hexapod-42 --poses poses.csv --draw-errors -o measurements.csv
      loopcal simulate truth.yaml --poses poses.csv --kind position -o measurements.csv
      loopcal simulate linear-delta --kind position --sigma-reading 5um -o measurements.csv
      loopcal simulate hexapod-42 --sigma-position 0.6um --sigma-angle 0.6urad \\
          --distribution uniform -o measurements.csv
      loopcal simulate hexapod-42 --fill plan/measurements.csv --draw-errors -o filled.csv
    """
    from loopcal.apply.simulated_measurements import simulate_measurements
    from loopcal.io.core.outputs import restore_on_failure

    machine = opt.open_robot(robot, (output, truth), (poses, fill), force)
    machine = machine.with_conditions(dict(at))
    if fill is not None:
        result = _fill_in(machine, fill, draw_errors, seed)
        source = fill.name
    else:
        result = simulate_measurements(
            machine,
            opt.make_instrument(instrument | {"distribution": distribution}, machine),
            **_read_poses(poses, draw, machine),
            draw_errors=draw_errors,
            reading_sigma=opt.parse_reading_sigma(sigma_reading, machine),
            seed=seed,
            skip_unreachable=skip_unreachable,
        )
        source = _name_drawn_poses(machine, draw) if poses is None else poses.name
    with restore_on_failure((output, truth)):
        remark = f"simulated by loopcal: {source}, seed {seed}"
        lc.save_measurements(result.data, output, result.truth, remark)
        if truth is not None:
            lc.save_robot(result.truth, truth)
    if draw_errors and not any(p.free and p.tolerance for p in machine.parameters.entries):
        terminal.print_finding("data.no-errors-drawn", robot=machine.name)
    counts = {name: getattr(result.data, name) for name in ("n_poses", "n_rows", "n_base_rows")}
    document = {"output": output, "truth": truth, **counts, "seed": seed, "skipped": result.skipped}
    n_poses, values = counts["n_poses"], f"{counts['n_rows']} measured values"
    if counts["n_base_rows"]:
        values += f" and {counts['n_base_rows']} of targets on the base"
    page = [f"{output}: {n_poses} poses of {machine.name}, {values}, seed {seed}"]
    if result.skipped:
        skipped, names = len(result.skipped), ", ".join(result.skipped)
        page.append(
            f"{skipped} of {skipped + n_poses} poses are outside its reach or strokes, "
            f"so loopcal skips them: {names}"
        )
    return Output(document, lambda: page)


def _fill_in(
    robot: lc.Mechanism, sheet: Path, draw_errors: bool, seed: int
) -> SimulatedMeasurements:
    """Return the filled-in data of a plan."""
    from loopcal.apply.simulated_measurements import fill_in_measurements
    from loopcal.io.data import measurement_file
    from loopcal.io.runs.plan_folder import find_plan_sheet

    others = ("poses", "draw", "distribution", "sigma_reading", "skip_unreachable")
    opt.refuse_given(
        (*others, *opt.INSTRUMENT.members), f"because --fill {sheet} defines poses and instrument"
    )
    instrument = measurement_file.load_instrument(sheet, robot)
    how = {"draw_errors": draw_errors, "seed": seed}
    if measurement_file.has_empty_readings(sheet, robot):
        planned = measurement_file.load_contact_sheet(sheet, find_plan_sheet(sheet), robot)
        is_closure = any(isinstance(rows.kind, lc.Closure) for rows in planned.observations)
        how["are_contacts"] = not is_closure
    else:
        planned = lc.load_measurements(sheet, robot)
    return fill_in_measurements(robot, planned, instrument, **how)


# Word of --measure for points on planes and lines that a coordinate measuring machine holds.
PLANE_LINE = "plane-line"
OPTIONS = "loopcal.planning.constraints:PlanOptions"
POSES = "loopcal.planning.constraints:N_POSES"
CHECK_POSES = 5  # poses of a check by default
SURFACES = "loopcal.planning.plane_line_planning:SurfaceOptions"
_COUNTED = "whose size is --groups and --points"
_HELD = "because a measuring machine holds x, y or z to --sigma-position"
_CHOSEN = "which moves points within the workspace and chooses by criterion D"
# Options that have no effect with --measure plane-line, and why.
EXCLUDED_BY_PLANE_LINE = {
    **dict.fromkeys(("poses", "accuracy", "curve"), _COUNTED),
    **dict.fromkeys(("like", "kinds", "components", "orientation", "sigma_angle"), _HELD),
    **dict.fromkeys(("criterion", "n_candidates", "allowed"), _CHOSEN),
    "hold_out": "because it fits every point",
    "check_up": "which calibrates",
    "share": "which gives no error over the workspace",
    "measured": "which plans without earlier measurements",
    "unknown_frames": "whose surfaces are unknown in every group",
    "targets": "which checks the tool",
}


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
    check_up: bool = opt.flag(
        "Plan 5 poses (or --poses) for loopcal check-up, at which changes by the expected spreads "
        "of ROBOT are clearest. ROBOT is the robot file of a run."
    ),
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
      loopcal plan run/robot.yaml -o check --check-up --like tracker.csv
      loopcal plan hexapod-42 -o plan --measure camera --board board.yaml
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
            constraints = _free_board(constraints, unknown)
            measuring = opt.make_instrument(
                unknown | instrument, machine, constraints=constraints, frame=frame, seed=seed
            )
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
        if check_up:
            sentence = "{reason} has poses for no fit, chosen by criterion D. Leave out {option}"
            opt.refuse_given(("accuracy", "criterion", "hold_out", "curve"), "--check-up", sentence)
            poses, criterion, hold_out = poses or CHECK_POSES, "D", 0
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
            allow_fewer_equations=check_up,
            seed=seed,
        )
        with terminal.TerminalProgress() as progress:
            result = lc.plan(machine, measuring, options=plan_options, progress=progress)
    made_by = collect_provenance(opt.list_words(), inputs, {"plan": seed})
    document = terminal.add_findings({"format": FORMAT, **result.to_dict(), "made_by": made_by})
    written = _write_plan(output, result, document, force)
    data = (*measured, output / "measurements.csv")
    board = ("--board", unknown["board"] or "board.yaml")
    pictured = (*board, "--poses", output / "poses.csv", "-o", output / "points.csv")
    following = (
        *(("check-up", "RUN", data[-1]) if check_up else ()),
        *(("photos", "PICTURES", *pictured) if unknown["measure"] == (opt.CAMERA,) else ()),
    ) or ("calibrate", robot, *data, "-o", "run")
    page = [
        *(str(result), *list_hints(result.findings), ""),
        *(f"Written to {output}: {written}", suggest_command(*following)),
    ]
    return Output(document, lambda: page)


def _free_board(constraints: lc.Constraints, unknown: Mapping[str, Any]) -> lc.Constraints:
    """Return constraints by which a board faces either side, unless --facing states one."""
    if unknown["measure"] != (opt.CAMERA,) or not constraints.sight or opt.is_given("facing"):
        return constraints
    return replace(constraints, sight=replace(constraints.sight, cone=math.pi))


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
    from loopcal.planning.camera_stations import describe_stations
    from loopcal.planning.pose_planning import list_stops
    from loopcal.report.figures.result_figures import draw_curve, draw_plan
    from loopcal.report.pictures import render_figure

    figures = {}
    if isinstance(result, lc.Plan):
        texts = {
            plan_folder.SHEET: plan_folder.format_sheet(
                result, list_stops(result), describe_stations(result)
            ),
            plan_folder.DATA: plan_folder.format_plan_data(result),
        }
        if any(sensor.kind.label_count for sensor in result.instrument.sensors):
            texts[plan_folder.POSES] = plan_folder.format_poses(result)
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


@opt.command()
def board(
    columns: int = opt.option("Columns of squares.", type=opt.Count("SQUARES", 3), default=10),
    rows: int = opt.option("Rows of squares.", type=opt.Count("SQUARES", 3), default=7),
    square: float = opt.option("Side of a square.", type=opt.POSITIVE_LENGTH, default="25mm"),
    paper: str = opt.option(
        "Sheet of paper.", type=click.Choice(("a4", "a3", "letter")), default="a4"
    ),
    output: Path = opt.path(
        "File that describes the board, such as board.yaml. The drawings get its name with .svg "
        "and .pdf.",
        "-o",
        required=True,
    ),
    force: bool = opt.force("the output files"),
) -> Output:
    """Draw a board to print: squares with markers (ChArUco), for pictures by a phone or camera.

    Print it at 100 %, without fit to page, glue it to a flat plate, and measure the two lengths
    next to the squares. Enter them in the file. The command needs the extra 'camera'.

    Examples:
      loopcal board -o board.yaml
      loopcal board -o board.yaml --columns 12 --rows 8 --square 15mm --paper letter
    """
    from loopcal.io.core.outputs import refuse_outputs, write_files
    from loopcal.io.pictures import (
        PAPERS,
        choose_board,
        draw_board,
        format_board,
        format_pdf,
        format_svg,
    )

    if output.suffix not in (".yaml", ".yml"):
        raise DataError(f"{output} describes the board. Use a name that ends in .yaml")
    files = output, output.with_suffix(".svg"), output.with_suffix(".pdf")
    refuse_outputs(files, (), force)
    chosen, sheet = choose_board(columns, rows, square), PAPERS[paper]
    shapes, words = draw_board(chosen, sheet)
    drawn = format_svg(shapes, words, sheet), format_pdf(shapes, words, sheet)
    write_files(dict(zip(files, (format_board(chosen), *drawn), strict=True)))
    document = {
        "board": files[0],
        "drawings": files[1:],
        "squares": chosen.squares,
        "square": chosen.square,
        "dictionary": chosen.dictionary,
        "lengths": chosen.marks,
    }
    x, y = (1e3 * length for length in chosen.marks)
    page = [
        f"{files[0]}: {columns} x {rows} squares, drawn in {files[1]} and {files[2]}",
        "Print at 100 %, without fit to page, and glue the print to a flat plate",
        f"Measure {x:g} mm along x and {y:g} mm along y. Enter both as 'measured' in {files[0]}",
    ]
    return Output(document, lambda: page)


@opt.command()
def photos(
    folder: Path = opt.argument("DIR", type=opt.FILE),
    board: Path = opt.path("File of the board, by loopcal board.", required=True),
    poses: Path | None = opt.path(
        "Table of the poses, such as poses.csv. Pictures have its names of poses, or their "
        "order, or its column 'picture' names them.  [default: names of the pictures]"
    ),
    mount: str = opt.option(
        "What the platform carries.", type=click.Choice(("board", "camera")), default="board"
    ),
    sigma: float = opt.option("Noise of u and v.", type=opt.POSITIVE, default=0.1, metavar="PX"),
    most_blur: float = opt.option(
        "Blur of edges above which a picture is left out.",
        of="loopcal.io.pictures:BLUR",
        type=opt.POSITIVE,
        metavar="PX",
    ),
    workers: int | None = opt.option(
        "Processes that compute.  [default: the number of processors]", type=opt.Count("WORKERS", 1)
    ),
    residuals: Path | None = opt.path(
        "Run folder of a calibration with these pictures. Its residuals become arrows on the page, "
        "and the measurement file stays as it is."
    ),
    output: Path = opt.path(
        "Measurement file to write. The page of all pictures gets its name with .html.",
        "-o",
        required=True,
    ),
    force: bool = opt.force("the output files"),
) -> Output:
    """Find the corners of a printed board in all pictures of the folder DIR, by OpenCV.

    loopcal leaves out blurred, mirrored and zoomed pictures and other sizes, each with a reason.
    EXIF data give the first focal length. The command needs the extra 'camera'.

    Examples:
      loopcal photos pictures --board board.yaml -o points.csv
      loopcal photos pictures --board board.yaml --poses poses.csv -o points.csv
      loopcal photos pictures --board board.yaml -o points.csv --residuals run --force
    """
    from contextlib import closing

    from loopcal.cli.commands.study_commands import count_processors
    from loopcal.environment import import_optional
    from loopcal.estimate.result import residuals_from_arrays
    from loopcal.findings import report_finding
    from loopcal.io import pictures as of
    from loopcal.io.core.csv_table import refuse_settings_beside
    from loopcal.io.core.outputs import refuse_outputs, write_files
    from loopcal.studies.executors import Processes, Serial

    if output.suffix != ".csv":
        raise DataError(f"{output} becomes a measurement file. Use a name that ends in .csv")
    page_file, known = output.with_suffix(".html"), of.read_board(board)
    paths = of.list_pictures(folder)
    fitted = None
    if residuals is not None:
        fitted = residuals_from_arrays(lc.load_run(residuals).arrays)
    written = (output, page_file) if fitted is None else (page_file,)
    refuse_outputs(written, (board, poses, *paths), force)
    refuse_settings_beside(output)
    of.load_dictionary(import_optional("cv2", "camera"), known)
    if known.measured is None:
        terminal.print_finding("pictures.board-unmeasured")
    names, beside = of.name_poses(paths, poses), of.refer_to_poses(poses, output)
    count = min(workers or count_processors(), len(paths))
    executor = Serial() if count == 1 else Processes(count)
    tasks = [of.PictureTask(path, known, most_blur) for path in paths]
    lost = report_finding("pictures.unreadable", reason="it stopped the process that read it")
    found: dict[Path, of.Picture] = {}
    with (
        terminal.TerminalProgress("finding corners") as progress,
        closing(executor.map_blocks(of.examine_picture, tasks)) as answers,
    ):
        for answer in answers:
            path = answer.task.path
            found[path] = answer.result or of.Picture(path, fault=lost)
            progress(len(found), len(paths), "finding corners")
    pictures = of.compare_pictures([found[path] for path in paths])
    two_cameras = of.find_two_cameras(known, pictures)
    if two_cameras is not None:
        terminal.print_finding("pictures.two-cameras", **two_cameras)
    texts = {
        output: of.format_pictures(
            known, pictures, names, mount, sigma, beside, of.list_cameras(poses)
        ),
        page_file: of.format_contact_sheet(pictures, names, fitted),
    }
    write_files({file: texts[file] for file in written})
    used = [picture for picture in pictures if picture.fault is None]
    shown = [
        {"picture": p.path, "pose": names[p.path], "corners": len(p.corners)}
        | {"blur": p.blur, "focal": p.focal, "fault": p.fault}
        for p in pictures
    ]
    document = {"measurements": output, "sheet": page_file, "used": len(used), "pictures": shown}
    files = [] if beside else ["poses.csv"]
    page = [
        "\n".join(f"{p.path.name}: {of.describe_picture(p)}" for p in pictures),
        f"{output}: {len(used)} of {len(pictures)} pictures, {page_file} shows them",
        suggest_command("calibrate", "ROBOT", *files, output, "-o", "run"),
    ]
    return Output(document, lambda: page)
