# SPDX-License-Identifier: Apache-2.0
"""`loopcal calibrate`, `loopcal budget`, `loopcal validate` and `loopcal compensate`."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from loopcal.cli import terminal
from loopcal.cli.hints import hint_for
from loopcal.cli.options.fit_options import fit_options, make_fit_options
from loopcal.cli.options.shared_options import (
    FILE,
    Count,
    PoseShare,
    data_argument,
    data_options,
    file_option,
    flag_option,
    force_option,
    frame_option,
    json_option,
    limit_options,
    print_convention_note,
    read_checked_measurements,
    read_measurements,
    robot_argument,
    seed_option,
    verbose_option,
)

if TYPE_CHECKING:
    from loopcal.findings import Finding

ALLOWED = ("allow_outside_stroke", "allow_duplicates")
"""Options that accept doubtful measurements."""

TAKEN_OPTIONS = (
    "limit_position",
    "limit_angle",
    "choose_model",
    "free_limb",
    "frame",
    "allow_still",
)
"""Options of the command that options of the library have by the same name."""


@click.command()
@robot_argument
@data_argument("DATA...")
@file_option("-o", "--output", help="Run folder to make.", required=True)
@click.option(
    "--hold-out",
    type=PoseShare(),
    default=0.0,
    metavar="SHARE",
    help="Share of the poses, from 0 to below 1, to keep out of the fit for validation, such as "
    "0.25. The poses are those of data.split(hold_out=SHARE, seed=SEED) in Python.",
)
@fit_options
@flag_option(
    "--choose-model",
    help="Free only as many parameters as held-out predictions justify: offsets, then lengths, "
    "ideal, complete, and what the controller stores; prints their condition numbers.",
)
@file_option(
    "--prior",
    help="Run folder of an earlier calibration of this machine, which is used as the prior.",
    metavar="RUN",
)
@file_option(
    "--compare",
    help="Stored values to compare with the estimate, such as those of a firmware: a robot file, "
    "or a file with the table 'identified' of some parameters.",
)
@click.option(
    "--free-limb",
    metavar="LIMB",
    help="With --prior: a limb that was repaired, such as leg3, whose parameters return to nominal "
    "with their tolerances.",
)
@frame_option()
@limit_options
@seed_option("the choice of held-out poses")
@data_options
@force_option("the run", ", and call the robot file of a failed calibration robot.yaml")
@verbose_option
@json_option
def calibrate(
    robot: str,
    data: tuple[Path, ...],
    output: Path,
    hold_out: float,
    prior: Path | None,
    compare: Path | None,
    seed: int,
    force: bool,
    verbose: bool,
    as_json: bool,
    **options: Any,
) -> int:
    """Identify the free parameters of ROBOT from DATA, validate them on held-out poses, and write a
    run folder with the corrected robot file.

    DATA may be several files, which are joined by the names of poses.

    \b
    The verdict is one of
      calibrated                    use the result
      calibrated with reservations  usable; a warning affects its accuracy
      undecided                     no held-out poses, or too few
      not calibrated                exit code 2; the run folder is still written, but its robot
                                    file is called robot-not-calibrated.yaml

    "Not calibrated" means that the fit did not converge, the residuals contradict the stated noise,
    errors on held-out poses grew, or a limit is exceeded.

    \b
    Examples:
      loopcal calibrate hexapod-42 measurements.csv -o run --hold-out 0.25
      loopcal calibrate robot.yaml data.csv -o run --hold-out 0.25 --limit-position 0.02mm
      loopcal calibrate printer.yaml heights.csv -o run --noise estimated
      loopcal calibrate robot.yaml poses.csv tracker.csv inclinometer.csv -o run
      loopcal calibrate hexapod-42 after-repair.csv -o run2 --prior run --free-limb leg3
      loopcal calibrate robot.yaml samples.csv -o run --compare published.yaml
    """  # noqa: D301
    from loopcal import io, workflow
    from loopcal.io.runs.run_folder import build_document, load_run, refuse_run_folder, save_run
    from loopcal.io.runs.run_verdict import name_robot_file
    from loopcal.report.calibration_view import view_calibration

    inputs = _list_inputs(robot, data, prior, compare)
    machine = io.load_robot(robot)
    settings = workflow.CalibrationOptions(
        make_fit_options(options),
        hold_out,
        seed=seed,
        prior=None if prior is None else load_run(prior).load_posterior(),
        compare_with=None if compare is None else io.load_stored_values(compare, machine),
        check_conventions=not options["allow_implausible"],
        **{name: options[name] for name in TAKEN_OPTIONS},
    )
    refuse_run_folder(output, force, list(inputs.values()))
    measurements = read_measurements(data, machine, **{name: options[name] for name in ALLOWED})
    with terminal.ProgressBar() as progress:
        report = workflow.calibrate(machine, measurements, settings, progress)
    print_convention_note(report.conventions, data)
    with terminal.ProgressBar() as progress:
        progress(0, 1, "writing the run folder")
        save_run(output, report, inputs, sys.argv, force)
    if as_json:
        terminal.print_json(build_document(report, inputs, sys.argv))
    else:
        written = f"Written to {output}: result.json, arrays.npz, {name_robot_file(report, force)}"
        terminal.print_page([*view_calibration(report, verbose, hint_for), "", written])
    terminal.print_failures(report.failures, shown=not as_json)
    return report.exit_code


def _list_inputs(
    robot: str, data: Sequence[Path], prior: Path | None, compare: Path | None
) -> dict[str, Path]:
    """Return role -> file of everything that is read."""
    from loopcal.io.data.measurement_file import list_measurement_files
    from loopcal.io.robot.robot_file import find_robot_file
    from loopcal.io.runs.run_result import RESULT

    inputs = {"robot": find_robot_file(robot), **list_measurement_files(data)}
    if prior is not None:
        inputs["prior"] = prior / RESULT
    if compare is not None:
        inputs["compare"] = find_robot_file(compare)
    return inputs


@click.command()
@click.argument("run", metavar="RUN", type=FILE)
@json_option
def budget(run: Path, as_json: bool) -> int:
    """Show the uncertainty budget of RUN, a run folder: what each source of errors contributes to
    poses and parameters, and what half its sigma would gain.

    The frame of the pose errors is that of the calibration, see its option --frame. A run without
    intervals has no budget.

    \b
    Examples:
      loopcal budget run
      loopcal budget run --json
    """  # noqa: D301
    from loopcal.io.runs.run_folder import load_run
    from loopcal.report.budget_view import view_budget

    calibrated = load_run(run)
    content = calibrated.load_budget()
    if as_json:
        terminal.print_json(content)
    else:
        terminal.print_page(view_budget(content, calibrated.robot))
    return 0


@click.command()
@click.argument("run", metavar="RUN", type=FILE)
@data_argument("DATA...")
@limit_options
@data_options
@click.option(
    "--refit",
    multiple=True,
    metavar="NAME",
    help="Frame, target or surface that was moved since RUN, to be fitted to DATA again. May be "
    "given several times.",
)
@flag_option("--allow-fitted-data", help="Accept measurements that the run was fitted to.")
@verbose_option
@json_option
def validate(
    run: Path,
    data: tuple[Path, ...],
    limit_position: float | None,
    limit_angle: float | None,
    refit: tuple[str, ...],
    allow_fitted_data: bool,
    verbose: bool,
    as_json: bool,
    **flags: bool,
) -> int:
    """Compare the robot of RUN, a run folder or a robot file, with DATA, one file or several.

    The errors are those before and after calibration; of a robot file without identified values
    there is only one. The noise floor is the error that the measurement noise alone causes.

    Frames, targets and surfaces keep their values in RUN, by name. Others are fitted to DATA,
    which makes the errors optimistic; a note says so.

    The exit code is 2 where a limit is exceeded.

    \b
    Examples:
      loopcal validate run more-measurements.csv
      loopcal validate run more.csv --limit-position 0.02mm --limit-angle 0.01deg
      loopcal validate robot.yaml measurements.csv --limit-position 0.1mm
    """  # noqa: D301
    from loopcal.apply import report_reused_rows
    from loopcal.apply import validate as validate_robot
    from loopcal.io.runs.run_folder import load_run_or_robot
    from loopcal.measure import check_instruments
    from loopcal.report.validation_view import view_validation

    calibrated = load_run_or_robot(run)
    measurements = read_checked_measurements(data, calibrated.robot, **flags)
    noted: list[Finding] = []
    if not allow_fitted_data:
        reused = report_reused_rows(calibrated.fitted_rows, measurements)
        noted += [] if reused is None else [reused]
    noted += check_instruments(measurements.all_observations)
    for finding in noted:
        terminal.print_note(str(finding))
    validation = validate_robot(
        calibrated.robot,
        measurements,
        limit_position,
        limit_angle,
        calibrated.initial_robot,
        nuisance_values=calibrated.nuisance_values,
        nuisance_values_before=calibrated.initial_nuisance_values,
        refit=refit,
        uncertainty=calibrated.load_uncertainty(),
    )
    if as_json:
        complete = replace(validation, findings=(*validation.findings, *noted))
        terminal.print_json(complete.to_dict())
    else:
        is_changed = bool((calibrated.robot.values != calibrated.initial_robot.values).any())
        page = view_validation(validation, is_changed, verbose)
        hints = [hint for f in validation.findings if (hint := hint_for(f))]
        terminal.print_page([*page, *(f"Hint: {hint}" for hint in hints)])
    return terminal.print_failures(validation.failures)


@click.command()
@click.argument("run", metavar="RUN", type=FILE)
@click.argument("targets", metavar="TARGETS", type=FILE)
@file_option("-o", "--output", help="CSV file to write; without it the CSV text is printed.")
@click.option(
    "--mode",
    type=click.Choice(("readings", "commands")),
    default="readings",
    help="Actuator readings to set, or shifted commands for a controller that cannot be changed.",
)
@click.option(
    "--controller",
    metavar="ROBOT",
    help="Robot file with the geometry of the controller; by default the nominal robot.",
)
@click.option(
    "--steps", type=Count("STEPS", 1), default=3, help="Iterations of the shifted commands."
)
@frame_option()
@force_option("the output file", ", and compute also from a calibration that failed")
@json_option
def compensate(
    run: Path,
    targets: Path,
    output: Path | None,
    mode: Literal["readings", "commands"],
    controller: str | None,
    steps: int,
    frame: str,
    force: bool,
    as_json: bool,
) -> int:
    """Compute readings or commands with which the machine of RUN reaches TARGETS, a CSV file of
    controlled coordinates.

    RUN is a run folder, or a robot file (then no uncertainty is known). Each target states the
    error before and after compensation, what no actuator can correct, and its uncertainty.

    The exit code is 2 where a target cannot be reached, or where RUN failed; then nothing is
    written without --force.

    \b
    Examples:
      loopcal compensate run targets.csv -o readings.csv
      loopcal compensate run targets.csv --mode commands -o commands.csv
    """  # noqa: D301
    from loopcal.apply import compensate as compensate_targets
    from loopcal.io import load_robot
    from loopcal.io.core.outputs import refuse_outputs
    from loopcal.io.runs.compensation_file import (
        format_compensation,
        load_targets,
        save_compensation,
    )
    from loopcal.io.runs.run_folder import find_failure, load_posterior_or_robot
    from loopcal.mechanism import Mechanism
    from loopcal.report.calibration_view import with_hint
    from loopcal.report.compensation_view import view_compensation

    inputs = (run, targets, None if controller is None else Path(controller))
    refuse_outputs((output,), inputs, force)
    failure = find_failure(run)
    if failure is not None and not force:
        return terminal.print_failures([with_hint(failure, hint_for)])
    known = load_posterior_or_robot(run)
    robot = known if isinstance(known, Mechanism) else known.robot
    coordinates, labels = load_targets(targets, robot)
    old = None if controller is None else load_robot(controller)
    with terminal.ProgressBar() as progress:
        result = compensate_targets(
            known, coordinates, mode, old, steps, labels, progress, frame=frame
        )
    if output is not None:
        save_compensation(result, output)
    if as_json:
        terminal.print_json(result.to_dict())
    elif output is None:
        terminal.print_text(format_compensation(result))
    else:
        terminal.print_page([*view_compensation(result), "", f"Written to {output}"])
    missed = [
        f"target {label!r}: {with_hint(result.findings[i], hint_for)}"
        for i, (label, is_usable) in enumerate(zip(labels, result.usable, strict=True))
        if not is_usable
    ]
    return terminal.print_failures([*([] if failure is None else [failure]), *missed])
