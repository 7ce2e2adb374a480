# SPDX-License-Identifier: Apache-2.0
"""Calibrate a robot, and what uses a calibration: its accuracy, its uncertainty beyond linear
intervals, comparisons, documents.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import loopcal as lc
from loopcal.cli import options as opt
from loopcal.cli import terminal
from loopcal.cli.hints import hint_for, list_hints, with_hint
from loopcal.cli.terminal import Output
from loopcal.errors import LoopcalError

if TYPE_CHECKING:
    from loopcal.results.tables import Block

OPTIONS = "loopcal.apply.calibration_options:CalibrationOptions"
CHECK_UP = "loopcal.apply.check_up:check_up"
REGULARIZATION = "loopcal.diagnose.cross_validation:compute_regularization_curves"


@opt.command()
def calibrate(
    robot: str = opt.ROBOT,
    data: tuple[Path, ...] = opt.data(),
    output: Path | None = opt.path(
        "Run folder to make. Without it the command only shows the result.", "-o"
    ),
    hold_out: float = opt.option(
        "Share of the poses, from 0 to below 1, to keep out of the fit for validation, such as "
        "0.25. In Python: data.split(hold_out=SHARE, seed=SEED).",
        of="loopcal.apply.calibration_options:CalibrationOptions",
        type=opt.POSE_SHARE,
    ),
    fit: lc.FitOptions = opt.FIT,
    choose_model: bool = opt.flag(
        "Free only as many parameters as held-out predictions justify: offsets, then lengths, "
        "ideal, complete, and what the controller stores. Prints their condition numbers."
    ),
    prior: Path | None = opt.path(
        "Run folder of an earlier calibration of this machine, as the prior.", metavar="RUN"
    ),
    compare: Path | None = opt.path(
        "Stored values to compare with the estimate, such as from a firmware: a robot file, or a "
        "file with the table 'identified' of some parameters."
    ),
    free_limb: str | None = opt.option(
        "With --prior: a repaired limb, such as leg3, whose parameters return to nominal with "
        "their expected spreads.",
        metavar="LIMB",
    ),
    frame: str = opt.frame(OPTIONS),
    limit_position: float | None = opt.LIMIT_POSITION,
    limit_angle: float | None = opt.LIMIT_ANGLE,
    volume: opt.Parts = opt.volume(),
    seed: int = opt.seed("the choice of held-out poses", OPTIONS),
    allowed: dict[str, bool] = opt.ALLOWED,
    force: bool = opt.force(
        "the run", ", and call the robot file of a failed calibration robot.yaml"
    ),
    verbose: bool = opt.VERBOSE,
) -> Output:
    """Identify the free parameters of ROBOT from DATA, validate them on held-out poses, and with -o
    write a run folder with the corrected robot file.

    DATA may be several files, joined by the names of poses.

    Verdicts:
      calibrated                    use the result
      calibrated with reservations  usable, with a warning that affects accuracy
      undecided                     no held-out poses, or too few
      not calibrated                exit code 2. The run folder then has a robot file
                                    with the name robot-not-calibrated.yaml

    "Not calibrated" means: the fit failed to converge, the residuals contradict the given noise,
    errors on held-out poses grew, or an error exceeds its limit.

    Examples:
      loopcal calibrate hexapod-42 measurements.csv --hold-out 0.25
      loopcal calibrate hexapod-42 measurements.csv -o run --hold-out 0.25
      loopcal calibrate robot.yaml data.csv -o run --hold-out 0.25 --limit-position 0.02mm
      loopcal calibrate robot.yaml data.csv -o run --volume radius=80mm --volume z=0mm..60mm
      loopcal calibrate printer.yaml heights.csv -o run --noise estimated
      loopcal calibrate robot.yaml poses.csv tracker.csv inclinometer.csv -o run
      loopcal calibrate hexapod-42 after-repair.csv -o run2 --prior run --free-limb leg3
      loopcal calibrate robot.yaml samples.csv -o run --compare published.yaml
    """
    from loopcal.io.core.outputs import refuse_folder
    from loopcal.io.data.measurement_file import list_measurement_files
    from loopcal.io.robot.robot_file import find_robot_file
    from loopcal.io.runs.run_folder import RESULT, RUN, build_document, name_robot_file
    from loopcal.report.calibration_view import view_calibration

    inputs = {"robot": find_robot_file(robot), **list_measurement_files(data)}
    if prior is not None:
        inputs["prior"] = prior / RESULT
    if compare is not None:
        inputs["compare"] = find_robot_file(compare)
    inputs.update(("volume", file) for name, file in volume if name == "points")
    machine = lc.load_robot(robot)
    settings = lc.CalibrationOptions(
        fit,
        hold_out,
        seed=seed,
        limit_position=limit_position,
        limit_angle=limit_angle,
        volume=opt.read_volume(volume, machine),
        choose_model=choose_model,
        prior=None if prior is None else lc.load_run(prior).load_posterior(),
        free_limb=free_limb,
        frame=frame,
        compare_with=None if compare is None else lc.load_stored_values(compare, machine),
        check_conventions=not allowed.pop("allow_implausible"),
        allow_still=allowed.pop("allow_still"),
        allow_duplicates=allowed["allow_duplicates"],
    )
    if output is not None:
        refuse_folder(output, RUN, force, list(inputs.values()))
    measurements = opt.read_measurements(data, machine, **allowed)
    with terminal.TerminalProgress() as progress:
        report = lc.calibrate(machine, measurements, settings, progress)
    opt.print_convention_note(report.conventions, data)
    written = "No file written: use -o RUN to keep the result and the corrected robot file."
    if output is not None:
        with terminal.TerminalProgress("writing the run folder"):
            lc.save_run(report, output, inputs, opt.list_words(), force)
        written = f"Written to {output}: result.json, arrays.npz, {name_robot_file(report, force)}"
    return Output(
        build_document(report, inputs, opt.list_words()),
        lambda: [*view_calibration(report, verbose, hint_for), "", written],
        report.failures,
        shown=True,
        exit_code=report.exit_code,
    )


@opt.command()
def budget(run: Path = opt.RUN) -> Output:
    """Show the uncertainty budget of RUN, a run folder: the contribution of each source to poses
    and parameters, and the effect of half its sigma.

    Pose errors are in the frame of the calibration (option --frame). A budget needs a run with
    intervals.

    Examples:
      loopcal budget run
      loopcal budget run --json
    """
    from loopcal.report.calibration_view import view_budget

    calibrated = lc.load_run(run)
    content, volume = calibrated.load_budget(), calibrated.result.get("volume")
    return Output(content, lambda: view_budget(content, calibrated.robot, volume))


@opt.command()
def accuracy(
    run: Path = opt.RUN,
    volume: opt.Parts = opt.volume(required=True),
    frame: str = opt.frame("loopcal.apply.volume_accuracy:bound_errors"),
    limit_position: float | None = opt.LIMIT_POSITION,
) -> Output:
    """Compute the largest position error of the tool in a volume, with a confidence of 95 %.

    The first number bounds the errors of all points of the volume together (simultaneously), and
    the second each single point (pointwise). RUN is a run folder.

    Examples:
      loopcal accuracy run --volume x=-40mm..40mm --volume y=-40mm..40mm
      loopcal accuracy run --volume radius=80mm --volume z=0mm..60mm --limit-position 0.02mm
      loopcal accuracy run --volume points.csv --frame tracker
    """
    calibrated = lc.load_run(run)
    posterior = calibrated.load_stated_errors()
    region = opt.read_volume(volume, posterior.robot)
    assert region is not None, "click requires the option"
    stated = lc.bound_errors(posterior, region, frame, limit=limit_position)
    return Output(stated, lambda: str(stated).splitlines(), stated.failures)


@opt.command()
def validate(
    run: Path = opt.RUN,
    data: tuple[Path, ...] = opt.data(),
    limit_position: float | None = opt.LIMIT_POSITION,
    limit_angle: float | None = opt.LIMIT_ANGLE,
    allowed: dict[str, bool] = opt.ALLOWED,
    refit: tuple[str, ...] = opt.option(
        "Frame, target or surface that moved since RUN, to fit to DATA again. Repeatable.",
        multiple=True,
        metavar="NAME",
    ),
    allow_fitted_data: bool = opt.flag("Accept measurements that the run also used."),
    verbose: bool = opt.VERBOSE,
) -> Output:
    """Compare the robot of RUN, a run folder or a robot file, with DATA, one file or several.

    A run has errors before and after calibration, a robot file without identified values only one.
    The noise floor is the error that the measurement noise alone causes.

    Frames, targets and surfaces keep their values in RUN, by name. DATA determine others: the
    errors are then optimistic, as a note says.

    Above a limit the exit code is 2.

    Examples:
      loopcal validate run more-measurements.csv
      loopcal validate run more.csv --limit-position 0.02mm --limit-angle 0.01deg
      loopcal validate robot.yaml measurements.csv --limit-position 0.1mm
    """
    from loopcal.apply.validation import report_reused_rows
    from loopcal.io.runs.run_folder import load_run_or_robot
    from loopcal.measure.observations import check_instruments
    from loopcal.report.validation_view import view_validation

    calibrated = load_run_or_robot(run)
    measurements = opt.read_checked_measurements(data, calibrated.robot, **allowed)
    noted: list[lc.Finding] = []
    if not allow_fitted_data:
        reused = report_reused_rows(calibrated.fitted_rows, measurements)
        noted += [] if reused is None else [reused]
    noted += check_instruments(measurements.all_observations)
    for finding in noted:
        terminal.print_note(finding)
    validation = lc.validate(
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
    is_changed = bool((calibrated.robot.values != calibrated.initial_robot.values).any())
    hints = list_hints(validation.findings)
    return Output(
        replace(validation, findings=(*validation.findings, *noted)).to_dict(),
        lambda: [*view_validation(validation, is_changed, verbose), *hints],
        validation.failures,
    )


@opt.command()
def check_up(
    run: Path = opt.RUN,
    checks: tuple[Path, ...] = opt.argument("CHECK...", type=opt.FILE, nargs=-1, required=True),
    false_alarms: float = opt.option(
        "Probability of any false alarm in a year.", of=CHECK_UP, type=opt.OPEN_SHARE
    ),
    a_year: int = opt.option("Number of checks in a year.", of=CHECK_UP, type=opt.Count(least=1)),
    refit: tuple[str, ...] = opt.option(
        "Target or surface that moved since RUN, which each check determines. Repeatable.",
        multiple=True,
        metavar="NAME",
    ),
    output: Path | None = opt.path("Picture of the history (.png, .svg or .pdf) to write.", "-o"),
    allowed: dict[str, bool] = opt.ALLOWED,
    force: bool = opt.force("the picture"),
) -> Output:
    """Test whether the machine of RUN, a run folder, has changed since its calibration.

    Each CHECK is a measurement file of a few poses, such as 5. Give all checks since RUN in the
    order of time. Each determines the frame of its instrument; targets keep their values in RUN.

    If the machine has changed, the exit code is 2, and the page names the parameter or limb that
    explains it.

    Examples:
      loopcal plan run/robot.yaml -o check --check-up --like tracker.csv
      loopcal check-up run week-1.csv
      loopcal check-up run week-*.csv -o history.svg
    """
    from loopcal.io.core.outputs import refuse_outputs
    from loopcal.io.core.text_file import write_bytes
    from loopcal.report.pictures import save_figure

    refuse_outputs((output,), (run, *checks), force)
    calibrated = lc.load_run(run)
    data = {
        str(file): opt.read_checked_measurements(
            (file,), calibrated.robot, is_check=True, **allowed
        )
        for file in checks
    }
    with terminal.TerminalProgress("comparing the checks"):
        result = lc.check_up(
            calibrated, data, false_alarms=false_alarms, a_year=a_year, refit=refit
        )
    written = []
    if output is not None:
        save_figure(output, result.plot(), write=write_bytes)
        written = ["", f"Written to {output}"]
    hints = list_hints(result.findings)
    return Output(result.to_dict(), lambda: [*result.page(), *hints, *written], result.failures)


@opt.command()
def compensate(
    run: Path = opt.RUN,
    targets: Path = opt.argument("TARGETS", type=opt.FILE),
    output: Path | None = opt.path("CSV file to write. Default: standard output.", "-o"),
    mode: Literal["readings", "commands"] = opt.option(
        "Actuator readings to set, or shifted commands for a controller with a fixed geometry.",
        of="loopcal.apply.compensation:compensate",
        type=opt.Words("loopcal.apply.compensation:Mode"),
    ),
    controller: str | None = opt.option(
        "Robot file with the geometry of the controller. Default: the nominal robot.",
        metavar="ROBOT",
    ),
    steps: int = opt.option(
        "Iterations of the shifted commands.",
        of="loopcal.apply.compensation:compensate",
        type=opt.Count("STEPS", 1),
    ),
    at: tuple[tuple[str, float], ...] = opt.AT,
    frame: str = opt.frame("loopcal.apply.compensation:compensate"),
    residual_map: bool = opt.flag(
        "Correct also the smooth errors that the residuals show, if held-out regions prove a gain."
    ),
    force: bool = opt.force("the output file", ", and compute also from a calibration that failed"),
) -> Output:
    """Compute readings or commands with which the machine of RUN reaches TARGETS, a CSV file of
    controlled coordinates.

    RUN is a run folder, or a robot file (without uncertainty). Each target gets its error before
    and after compensation, the part that actuators cannot correct, and its uncertainty.

    The exit code is 2 if a target is out of reach or RUN failed. Only --force then writes files.

    Examples:
      loopcal compensate run targets.csv -o readings.csv
      loopcal compensate run targets.csv --mode commands -o commands.csv
      loopcal compensate run targets.csv --at temperature.arms=31 -o readings.csv
    """
    from loopcal.io.core.outputs import refuse_outputs
    from loopcal.io.core.text_file import write_text
    from loopcal.io.runs.result_files import format_compensation, load_targets
    from loopcal.io.runs.run_folder import find_failure, load_run_or_robot
    from loopcal.report.calibration_view import view_compensation

    inputs = (run, targets, None if controller is None else Path(controller))
    refuse_outputs((output,), inputs, force)
    failure = find_failure(run)
    if failure is not None and not force:
        return Output({"reasons": [failure]}, list, [with_hint(failure)])
    source = load_run_or_robot(run)
    known = source.load_posterior() if run.is_dir() else source.robot
    robot = known if isinstance(known, lc.Mechanism) else known.robot
    coordinates, labels = load_targets(targets, robot)
    old = None if controller is None else lc.load_robot(controller)
    with terminal.TerminalProgress() as progress:
        how = {"frame": frame, "residual_map": residual_map, "conditions": dict(at)}
        result = lc.compensate(known, coordinates, mode, old, steps, labels, progress, **how)
    if output is not None:
        write_text(output, format_compensation(result))
    missed = [
        f"target {label!r}: {with_hint(result.findings[i])}"
        for i, (label, is_usable) in enumerate(zip(labels, result.usable, strict=True))
        if not is_usable
    ]

    def view() -> list[Block] | str:
        if output is None:
            return format_compensation(result)
        return [*view_compensation(result), "", f"Written to {output}"]

    failures = [*([] if failure is None else [failure]), *missed]
    return Output(result.to_dict(), view, failures)


@opt.command()
def certificate(
    run: Path = opt.RUN,
    facts: Path = opt.argument("FACTS", type=opt.FILE),
    volume: opt.Parts = opt.volume(),
    limit_position: float | None = opt.LIMIT_POSITION,
) -> Output:
    """Print a digital calibration certificate of RUN: XML by PTB's schema DCC 3.3.0.

    FACTS is a YAML file with facts outside the run: laboratory, customer, dates, serial number. The
    instruments come from the measurement files. Expanded uncertainties rest on the prior of the
    calibration, if it has one: the certificate says so.

    Examples:
      loopcal new --report-facts facts.yaml
      loopcal certificate run facts.yaml > certificate.xml
      loopcal certificate run facts.yaml --volume radius=80mm --limit-position 20um
    """
    from loopcal.io.runs.certificate import format_certificate, load_administration
    from loopcal.io.runs.run_folder import load_run_or_robot

    stated, failures = _state_volume(load_run_or_robot(run), volume, limit_position)
    text = format_certificate(stated, load_administration(facts))
    return Output({"certificate": text, "reasons": failures}, lambda: text, failures)


def _state_volume(
    run: lc.Run, parts: opt.Parts, limit: float | None
) -> tuple[lc.Run, tuple[lc.Finding, ...]]:
    """Return a run with the largest error in the volume of the command line, if it states one, and
    the finding of a limit that is not met.
    """
    from loopcal.documents import state_volume

    if (region := opt.read_volume(parts, run.robot)) is None:
        opt.refuse_given(("limit_position",), "without --volume")
        return run, ()
    run, stated = state_volume(run, region, limit)
    return run, stated.failures


@opt.command()
def compare(
    runs: tuple[Path, ...] = opt.argument("RUN...", type=opt.FILE, nargs=-1, required=True),
    data: tuple[Path, ...] = opt.option(
        "Measurements for comparing the errors of all runs. Repeatable.",
        type=opt.FILE,
        multiple=True,
        metavar="DATA",
    ),
    output: Path | None = opt.path(
        "File to write: .html (a page with figures), .json, or .csv (one row for each run and "
        "parameter).",
        "-o",
    ),
    allowed: dict[str, bool] = opt.ALLOWED,
    force: bool = opt.force("the output file"),
) -> Output:
    """Compare calibrations side by side: two or more run folders, of sessions, machines or methods.

    The first RUN is the reference of the others. For independent data, a test shows whether the
    machine has changed, and names the parameter or limb that explains it. The false-alarm rate is 5
    % for all runs together. Runs that share measurements get no test.

    All runs must have one mechanism, with equal free parameters and fixed values.

    Examples:
      loopcal compare may june
      loopcal compare map ridge --data more.csv
      loopcal compare may june july -o sessions.html
      loopcal compare may june july -o sessions.csv
    """
    from loopcal.documents import ENDINGS, check_ending
    from loopcal.io.core.outputs import refuse_outputs
    from loopcal.report.validation_view import view_comparison

    if output is not None:
        check_ending(output, "comparison", ENDINGS)
        refuse_outputs((output,), (*runs, *data), force)
    loaded = [lc.load_run(run) for run in runs]
    measurements = opt.read_checked_measurements(data, loaded[0].robot, **allowed) if data else None
    comparison = lc.compare_runs(loaded, measurements)
    if output is not None:
        lc.save_comparison(comparison, output)
    written = [] if output is None else ["", f"Written to {output}"]
    return Output(comparison.to_dict(), lambda: [*view_comparison(comparison), *written])


@opt.command()
def repeatability(
    robot: Path = opt.argument("ROBOT", type=opt.FILE),
    data: tuple[Path, ...] = opt.data(),
    allowed: dict[str, bool] = opt.ALLOWED,
) -> Output:
    """Compute pose accuracy (AP) and repeatability (RP) by ISO 9283 from several visits of each
    pose in DATA. ROBOT is a run folder or a robot file.

    Each visit is a row with a separate name. Visits of one pose have equal readings, or equal
    commanded coordinates. ROBOT has the geometry of the controller. Visits from several directions
    have the direction in the column group.

    Examples:
      loopcal repeatability robot.yaml visits.csv
      loopcal repeatability run visits.csv --json
    """
    from loopcal.io.runs.run_folder import load_run_or_robot
    from loopcal.report.validation_view import view_repeatability

    calibrated = load_run_or_robot(robot)
    measurements = opt.read_checked_measurements(data, calibrated.robot, **allowed)
    result = lc.assess_repeatability(calibrated.robot, measurements, calibrated.nuisance_values)
    return Output(result.to_dict(), lambda: view_repeatability(result, calibrated.robot))


@opt.command()
def report(
    run: Path = opt.RUN,
    output: Path = opt.path(
        "HTML file to write, with a name in .html. A JSON file with equal content appears next "
        "to it. Default: report.html.",
        "-o",
        default=Path("report.html"),
    ),
    pdf: bool = opt.flag(
        "Also print the report to a PDF file next to it, by an installed Chromium."
    ),
    facts: Path | None = opt.path(
        "Facts to print with the results: customer, serial number, ... `loopcal new "
        "--report-facts` writes a file to fill in."
    ),
    volume: opt.Parts = opt.volume(),
    limit_position: float | None = opt.LIMIT_POSITION,
    force: bool = opt.force("the output files"),
) -> Output:
    """Write the report of RUN, a run folder, as one HTML file that needs no network.

    The first page is for signature: machine, customer, instrument, result over the working volume,
    decision rule. Facts that are missing are lines to fill in on paper. Tables of errors,
    uncertainty budget and parameters follow, then what the data do not determine, residuals, values
    for the controller, and provenance.

    If the calibration failed, the report says so and the exit code is 2.

    Examples:
      loopcal report run
      loopcal report run -o hexapod.html --pdf --facts facts.yaml
      loopcal report run --volume radius=80mm --volume z=0mm..60mm --limit-position 20um
    """
    from loopcal.documents import check_browser, name_data, print_pdf
    from loopcal.io.core.outputs import refuse_outputs

    files = [output, name_data(output), *([output.with_suffix(".pdf")] if pdf else [])]
    calibrated = lc.load_run(run)
    refuse_outputs(files, [run / name for name in calibrated.result.get("files", {})], force)
    if pdf:
        check_browser(files[-1])
    calibrated, missed = _state_volume(calibrated, volume, limit_position)
    with terminal.TerminalProgress("writing the report") as progress:
        lc.save_report(calibrated, output, facts)
        if pdf:
            progress(0, 1, "printing the report")
            print_pdf(output, files[-1])
    failures = [*([] if calibrated.failure is None else [calibrated.failure]), *missed]
    written = f"Written to {', '.join(str(file) for file in files)}"
    return Output({"output": files, "reasons": failures}, lambda: [written], failures)


@opt.command()
def regularize(
    robot: str = opt.ROBOT,
    data: tuple[Path, ...] = opt.data(),
    output: Path | None = opt.path("Folder to make, with the curves and their figure.", "-o"),
    folds: int = opt.option(
        "Number of folds of poses where frames, targets or surfaces are unknown.",
        of=REGULARIZATION,
        type=opt.Count("FOLDS", 2),
    ),
    drop: tuple[str, ...] = opt.option(
        "Exclude this pose. Repeatable.", multiple=True, metavar="POSE"
    ),
    seed: int = opt.seed("the folds", REGULARIZATION),
    force: bool = opt.force("the folder"),
    allowed: dict[str, bool] = opt.ALLOWED,
) -> Output:
    """Show how the error at held-out poses of DATA depends on the ridge parameter lam and the
    number k of directions of truncated SVD, and the values that the rules choose.

    Use a chosen value with loopcal calibrate --method ridge --lam, or --method truncated-svd
    --keep.

    Examples:
      loopcal regularize hexapod-42 measurements.csv
      loopcal regularize robot.yaml measurements.csv -o curves
    """
    from loopcal.io.core.outputs import refuse_folder, write_result_folder
    from loopcal.io.data.measurement_file import list_measurement_files
    from loopcal.io.robot.robot_file import find_robot_file
    from loopcal.io.runs.result_files import CURVES, CURVES_FORMAT, PICTURE, POINTS
    from loopcal.io.runs.run_folder import collect_provenance
    from loopcal.report.figures.fit_figures import draw_regularization
    from loopcal.report.pictures import render_figure
    from loopcal.report.validation_view import tabulate_points, view_regularization

    machine = lc.load_robot(robot)
    inputs = {"robot": find_robot_file(robot), **list_measurement_files(data)}
    if output is not None:
        refuse_folder(output, CURVES, force, list(inputs.values()))
    measurements = opt.read_fitted_measurements(data, machine, allowed)
    with terminal.TerminalProgress() as progress:
        curves = lc.compute_regularization_curves(
            machine,
            measurements,
            options=lc.FitOptions(excluded_poses=drop),
            folds=folds,
            seed=seed,
            progress=progress,
        )
    made_by = collect_provenance(opt.list_words(), inputs, {"folds": seed})
    document = {"format": CURVES_FORMAT, **curves.to_dict(), "made_by": made_by}
    if output is None:
        return Output(document, lambda: view_regularization(curves))
    picture = render_figure(draw_regularization(curves), ".png")
    files = {POINTS: tabulate_points(curves).to_csv().encode(), PICTURE: picture}
    write_result_folder(output, CURVES, document, files, force)
    written = f"Written to {output}: curves.json, curves.csv, curves.png"
    return Output(document, lambda: [*view_regularization(curves), "", written])


MOST_DIGITS = 10  # digits of a number of poses; a longer text is no unit of resampling
BOOTSTRAP = "loopcal.diagnose.bootstrap"
SOURCE: Any = opt.argument("RUN|ROBOT")
LEVEL: Any = opt.option(
    "Coverage of the intervals.", of=f"{BOOTSTRAP}:Bootstrap.intervals", type=opt.OPEN_SHARE
)
FIT_NAMES = (*opt.FIT.members, *opt.ALLOWED.members)
DRAWS: Any = opt.path("CSV file for the draws, one row each.", "-o", metavar="CSV")


def load_fit(
    source: str, data: tuple[Path, ...], options: lc.FitOptions, allowed: Mapping[str, bool]
) -> tuple[lc.Identification, lc.Measurements]:
    """Return a fit with its measurements, and with the uncertainty that `calibrate` states: that of
    a run folder, repeated, or of a robot file and data by `fit_options` and `data_options`.
    """
    from loopcal.diagnose.adjusted_uncertainty import adjust_uncertainty
    from loopcal.io.runs.run_folder import repeat_fit

    if data:
        robot = lc.load_robot(source)
        measurements = opt.read_fitted_measurements(data, robot, allowed)
        with terminal.TerminalProgress() as progress:
            fit = lc.identify(robot, measurements, options=options, progress=progress)
    else:
        if Path(source).is_file():
            raise LoopcalError(
                f"{source}: this is a file. Give a run folder, or a robot file and then files of "
                "measurements"
            )
        opt.refuse_given(FIT_NAMES, "with a run folder")
        run = lc.load_run(source)
        with terminal.TerminalProgress() as progress:
            fit, measurements = repeat_fit(run, progress)
    return adjust_uncertainty(fit, measurements), measurements


@opt.command()
def bootstrap(
    source: str = SOURCE,
    data: tuple[Path, ...] = opt.data("[DATA...]", required=False),
    count: int = opt.option(
        "Number of resamples.", of=f"{BOOTSTRAP}:bootstrap", type=opt.Count("RESAMPLES", 2)
    ),
    scheme: Any = opt.option(
        "wild: errors of each block times a random factor. pairs: blocks drawn with replacement. "
        "normal: normal errors of the stated sigma.",
        of=f"{BOOTSTRAP}:bootstrap",
        type=opt.Words(f"{BOOTSTRAP}:Scheme"),
    ),
    unit: str | None = opt.option(
        "Unit of resampling: pose, block, session, day, or a number of consecutive poses.  "
        "[default: the largest unit with at least 12 blocks]",
        metavar="UNIT",
    ),
    kind: Any = opt.option(
        "Kind of the bootstrap intervals.",
        "--interval",
        of=f"{BOOTSTRAP}:Bootstrap.intervals",
        type=opt.Words(f"{BOOTSTRAP}:IntervalKind"),
    ),
    level: float = LEVEL,
    seed: int = opt.seed("the random draws", f"{BOOTSTRAP}:bootstrap"),
    output: Path | None = DRAWS,
    force: bool = opt.force("the output file"),
    fit_options: lc.FitOptions = opt.FIT,
    allowed: dict[str, bool] = opt.ALLOWED,
) -> Output:
    """Resample a calibration by blocks of poses, fit every resample, and compare the scatter with
    the intervals of the fit.

    RUN is a run folder, and the command repeats its fit. Or give a ROBOT and DATA, and the options
    of the fit.

    Examples:
      loopcal bootstrap run
      loopcal bootstrap run --unit session --count 2000 -o draws.csv
      loopcal bootstrap hexapod-42 measurements.csv --method least-squares
    """
    from loopcal.io.core.outputs import refuse_outputs
    from loopcal.report.validation_view import view_bootstrap

    refuse_outputs((output,), (Path(source), *data), force)
    fit, measurements = load_fit(source, data, fit_options, allowed)
    is_number = unit is not None and unit.isdecimal() and len(unit) < MOST_DIGITS
    chosen = int(unit) if unit is not None and is_number else unit
    with terminal.TerminalProgress() as progress:
        result = lc.bootstrap(
            fit, measurements, count, scheme=scheme, unit=chosen, seed=seed, progress=progress
        )
    intervals = result.intervals(level, kind)
    return _finish(result, intervals, view_bootstrap(result, intervals), output)


@opt.command()
def sample(
    source: str = SOURCE,
    data: tuple[Path, ...] = opt.data("[DATA...]", required=False),
    count: int = opt.option(
        "Number of draws.",
        of="loopcal.diagnose.intervals:sample_posterior",
        type=opt.Count("DRAWS", 100),
    ),
    region: bool = opt.flag(
        "Instead of drawing, show linear intervals that hold for several parameters at once, and "
        "the joint region of parameters selected by -p."
    ),
    names: tuple[str, ...] = opt.option(
        "Parameter for --region, or a pattern such as 'leg1.*'. Repeatable.  [default: all]",
        "-p",
        "--parameter",
        multiple=True,
        metavar="NAME",
    ),
    rule: Any = opt.option(
        "How --region makes intervals that hold together. maximum gives the narrowest.",
        of="loopcal.diagnose.intervals:compute_simultaneous_intervals",
        type=opt.Words("loopcal.diagnose.intervals:Rule"),
    ),
    level: float = LEVEL,
    seed: int = opt.seed("the random draws", "loopcal.diagnose.intervals:sample_posterior"),
    output: Path | None = DRAWS,
    force: bool = opt.force("the output file"),
    fit_options: lc.FitOptions = opt.FIT,
    allowed: dict[str, bool] = opt.ALLOWED,
) -> Output:
    """Draw parameters from the exact posterior of a calibration, and compare its intervals with the
    linear ones. With --region, show intervals that hold for all selected parameters at once.

    RUN is a run folder, and the command repeats its fit. Or give a ROBOT and DATA, and the options
    of the fit.

    Examples:
      loopcal sample run
      loopcal sample run --count 20000 -o draws.csv
      loopcal sample linear-delta measurements.csv --method map
      loopcal sample run --region -p radius -p 'tower*.angle'
    """
    from loopcal.io.core.outputs import refuse_outputs
    from loopcal.report.validation_view import view_posterior, view_region

    if region:
        opt.refuse_given(("count", "seed", "output", "force"), "with --region")
        if data:
            posterior = load_fit(source, data, fit_options, allowed)[0].posterior
        else:
            opt.refuse_given(FIT_NAMES, "with a run folder")
            posterior = lc.load_run(source).load_posterior()
        together = lc.compute_simultaneous_intervals(posterior, names or None, level, rule)
        joint = lc.compute_joint_region(posterior, names, level) if names else None
        return Output(
            {"intervals": together.to_dict(), "region": None if joint is None else joint.to_dict()},
            lambda: view_region(joint, together, posterior.robot),
        )
    opt.refuse_given(("names", "rule"), "without --region")
    refuse_outputs((output,), (Path(source), *data), force)
    fit, measurements = load_fit(source, data, fit_options, allowed)
    with terminal.TerminalProgress() as progress:
        result = lc.sample_posterior(fit, measurements, count, seed=seed, progress=progress)
    intervals = result.intervals(level)
    return _finish(result, intervals, view_posterior(result, intervals), output)


def _finish(
    result: lc.Bootstrap | lc.PosteriorSample,
    intervals: lc.Intervals,
    page: list[Block],
    output: Path | None,
) -> Output:
    """Write the draws, where a file is named, and return what to print."""
    from loopcal.io.core.text_file import write_text
    from loopcal.io.runs.result_files import format_draws

    if output is not None:
        factors, units = result.fit.free_parameters.display()
        weight = getattr(result, "weight", None)
        names, draws = result.fit.names, result.draws
        write_text(output, format_draws(names, units, factors, draws, weight))
        page = [*page, "", f"Written to {output}"]
    return Output({**result.to_dict(), "intervals": intervals.to_dict()}, lambda: page)
