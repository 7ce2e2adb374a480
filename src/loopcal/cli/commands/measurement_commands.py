# SPDX-License-Identifier: Apache-2.0
"""`loopcal identifiability` and `loopcal simulate`: what measurements determine, and simulated
ones.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import loopcal as lc
from loopcal.cli import options as opt
from loopcal.cli import terminal
from loopcal.cli.hints import list_hints
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
        "Also choose a smallest set of parameters, and show how it contains the others.", "--reduce"
    ),
    output: Path | None = opt.path(
        "With --reduce: robot file to write, with the other parameters fixed.", "-o"
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
      loopcal identifiability hexapod-42 --frames base,tool --reduce -o reduced.yaml
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
        raise DataError("-o writes the robot of --reduce. Add --reduce, or leave out -o")
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
    written = []
    if output is not None:
        written = ["", f"Written to {output}: the robot with the other parameters fixed"]
    details = "the first combinations, suggested measurements, singular values and all parameters"
    page = [
        *drawn,
        *view_identifiability(report, verbose),
        *(list_hints(report.summary) if report.useful is None else ()),
        f"Hint: use {'--json for all combinations' if verbose else f'--verbose for {details}'}",
        *written,
    ]
    return Output(json_fields(report), lambda: page)


def _read_poses(poses: Path | None, draw: int, robot: lc.Mechanism) -> dict[str, Any]:
    """Return the arguments `poses`, `labels` and `places` of a simulation: those of a file, or how
    many to draw.
    """
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
        "Draw the errors of the true machine from the tolerances of the robot file."
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
