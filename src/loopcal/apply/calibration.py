# SPDX-License-Identifier: Apache-2.0
"""Calibrate a robot from measurements: split, choose the model, fit, validate, examine, judge."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from loopcal.apply import calibration_report
from loopcal.apply.calibration_options import CalibrationOptions, DataSplit, split_data
from loopcal.apply.error_budget import compute_error_budget
from loopcal.apply.height_errors import map_height_errors
from loopcal.apply.validation import Validation, validate
from loopcal.apply.volume_accuracy import VolumeAccuracy, as_volume, bound_errors
from loopcal.checks import check_choice
from loopcal.diagnose import error_causes
from loopcal.diagnose.adjusted_uncertainty import (
    SHARED,
    add_shared_errors,
    adjust_uncertainty,
    is_explainable,
)
from loopcal.diagnose.conventions.convention_check import ConventionCheck, check_conventions
from loopcal.diagnose.error_frames import BASE, FITTED, RELATIVE
from loopcal.diagnose.fit_examination import check_start_values, compute_reading_errors, examine_fit
from loopcal.diagnose.gauge_freedoms import interpret_fit
from loopcal.diagnose.measured_points import compare_shapes, report_base_targets
from loopcal.diagnose.model_discrepancy import find_dense_regions
from loopcal.diagnose.outliers import find_outliers
from loopcal.diagnose.residual_patterns import CAUSE, POSE, linearize_examined
from loopcal.diagnose.value_comparison import compare_with_values
from loopcal.engine import collect_versions
from loopcal.errors import DataError, EstimationError
from loopcal.estimate import determinable_setup, information
from loopcal.estimate.fit_linearization import FitLinearization
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.estimate.identification import exclude_poses, identify
from loopcal.estimate.penalties import LeastSquares
from loopcal.estimate.posterior import DISCREPANCY
from loopcal.estimate.prior import refuse_reused_rows
from loopcal.estimate.problem import problem_of
from loopcal.estimate.result import Identification
from loopcal.findings import Finding, Severity, report_finding, sort_by_importance
from loopcal.measure.data_checks import check_duplicates
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import SEVERAL_DAYS, check_instruments
from loopcal.measure.readings import fill_in_reading_sigma
from loopcal.mechanism.model import Mechanism
from loopcal.results.deferred import later
from loopcal.typing import Progress, StepCounter, report_no_progress

if TYPE_CHECKING:
    from loopcal.diagnose.cross_validation import ModelChoice
    from loopcal.estimate.recalibration import Change

# Codes of data that a geometry cannot reach.
OUT_OF_REACH = ("residuals.poses-out-of-reach", "residuals.calibrated-out-of-reach")
# Codes of data that leave nothing to compare: all values locate the poses, or the initial
# geometry reaches none of these.
NOTHING_TO_COMPARE = (
    "residuals.readings-missing",
    "residuals.no-rows-to-predict",
    "validation.setup-undetermined",
    "residuals.before-out-of-reach",
)
# Steps that the progress callback counts: conventions, model, fit, what the residuals add to the
# uncertainty, validation, examination, suggestions.
STEPS = 7
# Standard deviations (rms) by which targets on the base contradict each other or their stated
# places, above which their unit, order or places are wrong: one that was hit moves by less.
GROSS = 1000.0
ENOUGH_ROWS = 4  # fitted values for each parameter from which the fitted poses show a wrong one


def calibrate(
    robot: Mechanism,
    data: Measurements,
    options: CalibrationOptions | None = None,
    progress: Progress = report_no_progress,
) -> calibration_report.CalibrationReport:
    """Identify the free parameters of a robot, validate the result and judge it.

    Parameters
    ----------
    robot : the nominal robot, or the geometry to start from. data : the measurements.
    options : see `CalibrationOptions`; the default fits all poses and holds none out.
    progress : receives the steps that are done.

    Returns
    -------
    CalibrationReport. A calibration that is not good enough is not an error: see its `verdict`.

    Raises
    ------
    DataError, EstimationError : the data belong to another robot, contain too few values, fit far
        better in another unit, order, sign or column, or the options contradict them.

    Examples
    --------
    >>> import loopcal as lc
    >>> robot = lc.load_robot("hexapod-42")
    >>> data = lc.load_measurements("examples/hexapod-42/measurements.csv", robot)
    >>> report = lc.calibrate(robot, data, lc.CalibrationOptions(hold_out=0.25))
    >>> report.verdict
    <Verdict.CALIBRATED: 'calibrated'>
    """
    options = CalibrationOptions() if options is None else options
    data = determinable_setup.fix_undetermined_setup(robot, data)
    instruments = (name for name, *_ in information.list_instrument_frames(data))
    check_choice("frame", options.frame, (FITTED, BASE, RELATIVE, *instruments))
    if options.volume is not None:  # before the fit: what the nominal robot does not reach
        next(as_volume(options.volume).list_grids(robot))
    kept = exclude_poses(data, options.fit.excluded_poses)
    if options.prior is not None:
        filled = exclude_poses(fill_in_reading_sigma(robot, data), options.fit.excluded_poses)
        refuse_reused_rows(options.prior, filled)
    split = split_data(kept, options.hold_out, options.seed, options.held_out)
    is_limited = (options.limit_position, options.limit_angle) != (None, None)
    if is_limited and split.held_out is None:
        raise DataError.of("workflow.limit-needs-held-out-poses")
    if options.check_conventions:
        # no pose can be reached from a frame that does not fit, and a fit would blame the robot
        for shape in compare_shapes(data):
            if shape.chi_square > GROSS**2 * shape.degrees:
                raise DataError(shape.finding)
    # after wrong units, in which repeats seem to agree too well
    check_duplicates(kept, allow=options.allow_duplicates)
    count = StepCounter(progress, STEPS)
    count.begin("checking conventions")
    allowed = {"allow_still": options.allow_still}
    allowed["allow_implausible"] = not options.check_conventions
    conventions = check_conventions(robot, data, **allowed)
    # every fold without the far rows would be fitted well and predict them badly, and every fit
    # with them takes all of its iterations
    finding = conventions.finding
    if options.choose_model and finding is not None and finding.code == "conventions.rows-far-off":
        raise DataError.of("model.rows-far-off", poses=finding.data["poses"])
    redundant = robot.redundancy is not None  # then readings are measurements, too
    if not split.fitted.n_rows and not redundant:
        raise DataError.of("data.no-measured-value")
    if split.held_out is not None and not split.held_out.n_rows and not redundant:
        raise DataError.of("data.no-held-out-value")
    held_out = 0 if split.held_out is None else split.held_out.n_poses
    fit, choice, change = _fit(robot, split.fitted, options, count, held_out)
    count.begin("testing the residuals for patterns and slow errors")
    fit, again, explain, linear = _explain_residuals(fit, split)
    fitting = replace(options, choose_model=False)
    by_region = _fit_by_region(fit, kept, fitting, count) if split.share else None
    if by_region is not None:
        split, plain, change = by_region
        shown = min(f.data["p_value"] for f in fit.findings if f.code == DISCREPANCY)
        fit, again, explain, linear = _explain_residuals(plain, split, shown)
    if again is not split:
        refit, _, change = _fit(fit.initial, again.fitted, fitting, count, held_out)
        if refit.converged:
            split, fit, linear = again, adjust_uncertainty(explain(refit), again.fitted), None
    outliers = _search_before_split(fit, split, kept, options)
    return _report(fit, choice, change, split, conventions, options, count, outliers, linear)


def _fit_by_region(
    fit: Identification, data: Measurements, options: CalibrationOptions, count: StepCounter
) -> tuple[DataSplit, Identification, Change | None] | None:
    """Hold out regions of poses whose slow errors are alike, and fit again; None without any."""
    regions = find_dense_regions(fit, data)
    if regions is None:
        return None
    split = split_data(data, options.hold_out, options.seed, regions=regions)
    again, _, change = _fit(fit.initial, split.fitted, options, count)
    finding = report_finding("workflow.regions-held-out", count=int(regions.max()) + 1)
    return split, replace(again, findings=(*again.findings, finding)), change


def _explain_residuals(
    fit: Identification, split: DataSplit, slow_p_value: float = 1.0
) -> tuple[
    Identification, DataSplit, Callable[[Identification], Identification], FitLinearization | None
]:
    """Return the fit with the uncertainty that its residuals show; the data with noise that
    includes errors of drives or poses where these cause them, else as they are; how a fit of these
    data states the causes; and the linearized fit. `slow_p_value` : see `adjust_uncertainty`.
    """
    linear, drives, explained, pictures = None, None, None, list[Finding]()
    if is_explainable(fit):
        linear = linearize_examined(fit, split.fitted)
        explained = error_causes.explain_residuals(linear)
        drives = error_causes.measure_drive_errors(linear, explained)
        pictures = [
            *error_causes.measure_picture_errors(linear, explained),
            *error_causes.find_print_scale(fit, split.fitted),
        ]
        fit = replace(fit, findings=(*fit.findings, *pictures))
    fit = adjust_uncertainty(fit, split.fitted, linear, explained, slow_p_value)
    findings = [*(f for f in fit.findings if f.code == CAUSE), *pictures]
    for found in [f for f in fit.findings if f.code == SHARED and f.data["cause"] == POSE]:
        findings.append(found)
        split = split.change(partial(add_shared_errors, finding=found))
    if drives is not None:
        split = split.change(drives.add_to_readings)

    def explain(refit: Identification) -> Identification:
        """Return a fit of these data that states the causes."""
        refit = replace(refit, findings=(*refit.findings, *findings))
        return refit if drives is None else drives.add_to(refit)

    return fit, split, explain, linear


def _fit(
    robot: Mechanism,
    data: Measurements,
    options: CalibrationOptions,
    count: StepCounter,
    held_out: int = 0,
) -> tuple[Identification, ModelChoice | None, Change | None]:
    """Return the fit from the spreads, or with an earlier calibration as the prior; the choice
    of its parameters; and the comparison with the earlier calibration.
    """
    excluded = tuple(p for p in options.fit.excluded_poses if p in data.labels)
    fit_options = replace(options.fit, excluded_poses=excluded)
    count.begin("choosing the parameters" if options.choose_model else "preparing")
    if options.prior is not None:
        from loopcal.estimate.recalibration import recalibrate

        count.begin("fitting")
        how = {"options": fit_options, "progress": count.progress}
        fit, change = recalibrate(robot, data, options.prior, options.free_limb, **how)
        return fit, None, change
    choice = None
    if options.choose_model:
        from loopcal.diagnose.cross_validation import choose_model

        choice = choose_model(robot, data, options=fit_options, progress=count.progress)
        if not choice.chosen.parameters:
            left_out = choice.finding.data["not_compared"]
            raise DataError.of("workflow.no-parameter-chosen", not_compared=left_out)
    chosen = robot if choice is None else choice.robot
    free, available = int(chosen.parameters.free.sum()), information.count_equations(chosen, data)
    if fit_options.method is None and available < free:
        problem = problem_of(select_free_parameters(chosen), data)
        z = problem.free.deviation(chosen.values[None])
        if not information.has_equations_to_spare(problem, z, LeastSquares()):
            from loopcal.diagnose.identifiable_parameters import describe_missing_equations

            missing = describe_missing_equations(chosen, data) or ""
            counts: dict[str, Any] = {"equations": available, "parameters": free}
            counts |= {"held_out": held_out, "suggestions": missing}
            raise DataError.of("workflow.too-few-equations", **counts)
    count.begin(f"fitting {free} parameters")
    fit = identify(chosen, data, options=fit_options, progress=count.progress)
    return fit, choice, None


def _report(
    fit: Identification,
    choice: ModelChoice | None,
    change: Change | None,
    split: DataSplit,
    conventions: ConventionCheck,
    options: CalibrationOptions,
    count: StepCounter,
    outliers: Sequence[Finding],
    linear: FitLinearization | None,
) -> calibration_report.CalibrationReport:
    """Validate and examine a fit, and return the report. `linear` : see `linearize_fit`."""
    fit, fitted, held_out = interpret_fit(fit), split.fitted, split.held_out
    count.begin("predicting the held-out poses" if held_out is not None else "computing errors")
    errors, impossible = _validate(fit, fitted if held_out is None else held_out, options)
    count.begin("examining the residuals")
    examination, budget, given = None, None, (fit, fitted)
    if fit.converged:
        if fit.residual_test.intervals:
            linear = linearize_examined(*given, linear)
        examination = examine_fit(*given, count.progress, options.frame, linear)
        is_whole = linear is None or linear.data.n_poses == fitted.n_poses
        whole = linear if is_whole else None
        budget = later(lambda: compute_error_budget(*given, options.frame, whole))
    volume, of_volume = _bound_volume(fit, errors if held_out is not None else None, options)
    count.begin("looking for further measurements")
    suggestions = None
    if fit.converged and fit.unidentifiable:
        from loopcal.diagnose.identifiable_parameters import identifiability, suggest_measurements

        analysis = identifiability(fit.robot, fitted, fit.options.rank_tolerance)
        listed = suggest_measurements(analysis)
        suggestions = tuple(s for s in listed if not s.combination.is_harmless)
    start = check_start_values(fit)
    heights = map_height_errors(fit, fitted, held_out) if fit.converged else None
    comparison = None
    if options.compare_with is not None:
        comparison = compare_with_values(fit, options.compare_with)
    examined = () if examination is None else examination.findings
    doubts = () if conventions.finding is None else (conventions.finding,)
    if outliers:  # that none were found among fewer poses says nothing then
        examined = tuple(finding for finding in examined if finding.code != "outliers.none")
    repeats = tuple(f"pose {label}" for label in split.repeats)
    is_failed = fit.residual_test.failed
    findings = [
        # fit and validation answer doubts about conventions
        *(replace(finding, severity=Severity.INFO) for finding in doubts),
        *(
            s
            for f in doubts
            for s in error_causes.find_swapped_pictures(fit, fitted, f.data.get("poses", ()))
        ),
        *calibration_report.report_fit(fit),
        *calibration_report.report_unexplained(fit, examined),
        *(  # the machine may have changed between days
            replace(f, severity=Severity.WARNING) if is_failed and f.code == SEVERAL_DAYS else f
            for f in check_instruments(split.list_observations())
        ),
        *impossible,
        *(
            calibration_report.report_validation(errors, held_out is not None)
            if fit.converged
            else ()
        ),
        *of_volume,
        *([report_finding("workflow.held-out-repeats", names=repeats)] if repeats else []),
        *calibration_report.report_freedoms(fit, fitted),
        *determinable_setup.report_fixed_setup(fitted),
        *error_causes.report_picture_scale(fit.robot, fitted),
        *(determinable_setup.report_equal_setup(fit, fitted) if fit.converged else ()),
        *calibration_report.report_heights(fit, fitted, heights),
        *report_base_targets(fitted),
        start.finding,
        *outliers,
        *examined,
        *(() if choice is None else (choice.finding,)),
        *(() if comparison is None else (comparison.outcome,)),
    ]
    count.begin("done")
    return calibration_report.CalibrationReport(
        options=options,
        split=split,
        identification=fit,
        start=start,
        conventions=conventions,
        validation=None if held_out is None else errors,
        fitted_errors=errors if held_out is None else None,
        height_errors=heights,
        findings=sort_by_importance(findings),
        budget=budget,
        examination=examination,
        suggestions=suggestions,
        reading_errors=compute_reading_errors(fit, fitted) if fit.converged else None,
        model_choice=choice,
        change=change,
        comparison=comparison,
        volume=volume,
        provenance=calibration_report.Provenance(
            collect_versions(), {"hold_out": options.seed}, options.to_dict()
        ),
    )


def _bound_volume(
    fit: Identification, errors: Validation | None, options: CalibrationOptions
) -> tuple[VolumeAccuracy | None, list[Finding]]:
    """Return the largest position error in the volume of the options, with the decision on its
    limit, unless held-out errors exceed that anyway; or the finding why there is none.
    """
    if options.volume is None or not fit.converged:
        return None, []
    if not (fit.residual_test.intervals and calibration_report.explains_residuals(fit)):
        return None, [report_finding("accuracy.volume-open", reason="noise")]
    missed = errors is not None and any(
        f.code in calibration_report.LIMIT_MISSED and f.data["quantity"] == "position"
        for f in errors.findings
    )
    limit = None if missed else options.limit_position
    try:
        stated = bound_errors(fit, options.volume, options.frame, limit=limit)
    except EstimationError as error:
        reason = str(error).split(";")[0]
        return None, [report_finding("accuracy.volume-open", reason=reason)]
    return stated, [] if limit is None else [stated.findings[-1]]


def _search_before_split(
    fit: Identification, split: DataSplit, data: Measurements, options: CalibrationOptions
) -> list[Finding]:
    """Return the outliers among all poses, fitted and held out, where the fitted ones are few.

    A wrong pose that is fitted hides among few others, and one that is held out is compared with a
    fit of few. The level is low, because fitted and held-out poses are searched again alone.
    """
    has_few = (
        split.fitted.n_rows < ENOUGH_ROWS * len(fit.names)
        and data.n_poses <= calibration_report.FEW_POSES
    )
    if split.held_out is None or options.prior is not None or not has_few:
        return []
    together = replace(data, is_held_out=np.zeros(data.n_poses, dtype=bool))
    whole = identify(fit.initial, together, options=options.fit)
    if not (fit.converged and whole.converged):
        return []
    check = find_outliers(whole, together, level=calibration_report.SEARCH_LEVEL)
    if not check.names:
        return []
    return [report_finding(calibration_report.ALL_POSES, poses=check.names, blocks=check.blocks)]


def _validate(
    fit: Identification, data: Measurements, options: CalibrationOptions
) -> tuple[Validation | None, list[Finding]]:
    """Return errors on poses, or why there are none.

    A geometry that reaches no pose is a failure. Held-out data without anything to compare leave
    the verdict open. Values of a fit that did not converge are no estimate, and have no errors.
    """
    if not fit.converged:
        return None, []
    try:
        limits = (options.limit_position, options.limit_angle)
        return validate(fit, data, *limits, are_rows_known=True), []
    except DataError as error:
        if error.code in OUT_OF_REACH:
            return None, [report_finding("gates.poses-unreachable", reason=str(error))]
        if error.code in NOTHING_TO_COMPARE:
            return None, [report_finding("workflow.nothing-to-validate", reason=str(error))]
        raise
