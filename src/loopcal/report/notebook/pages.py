# SPDX-License-Identifier: Apache-2.0
"""Which text and which tables show a result in a notebook."""

from __future__ import annotations

from functools import singledispatch

from loopcal.apply import (
    AccuracyMap,
    AccuracySimulation,
    Compensation,
    Conformity,
    HeightErrors,
    RunComparison,
    Validation,
)
from loopcal.apply.repeatability_result import Repeatability
from loopcal.diagnose import (
    CrossValidation,
    FitExamination,
    Identifiability,
    ModelChoice,
    RegularizationCurves,
    ValueComparison,
)
from loopcal.estimate import Identification
from loopcal.estimate.recalibration import Change
from loopcal.mechanism import Solution
from loopcal.presentation import TableResult
from loopcal.report.calibration_view import build_model_table, view_calibration, view_fit
from loopcal.report.compensation_view import view_compensation
from loopcal.report.height_view import view_heights
from loopcal.report.notebook.html import render_html
from loopcal.report.notebook.records import collect_records
from loopcal.report.notebook.tables import build_main_table
from loopcal.report.regularization_view import view_regularization
from loopcal.report.repeatability_view import view_repeatability
from loopcal.report.run_comparison_view import find_error_units, view_comparison
from loopcal.report.sampling_view import view_bootstrap, view_posterior
from loopcal.report.text_page import Block
from loopcal.report.validation_view import view_validation
from loopcal.sampling import Bootstrap, PosteriorSample
from loopcal.workflow import CalibrationReport


def render_result(result: object) -> str:
    """Return a result as HTML for a notebook."""
    return render_html(write_page(result))


@singledispatch
def write_page(result: object) -> list[Block]:
    """Return the page of a result: its text, and its main table where it has one."""
    if isinstance(result, TableResult):
        return [str(result), build_main_table(collect_records(result))]
    return [str(result)]


def _with_table(text: str, result: object, caption: str = "") -> list[Block]:
    """Return a page with a text and the main table."""
    return [text, build_main_table(collect_records(result), caption)]


@write_page.register
def write_fit(result: Identification) -> list[Block]:
    """Return the page of a fit, and its findings."""
    return [*view_fit(result), *(f"{f.severity.value}: {f}" for f in result.findings)]


@write_page.register
def write_report(result: CalibrationReport) -> list[Block]:
    """Return the page that the command line prints."""
    return view_calibration(result)


@write_page.register
def write_validation(result: Validation) -> list[Block]:
    """Return the page that the command line prints."""
    return view_validation(result, with_before=True, verbose=False)


@write_page.register
def write_heights(result: HeightErrors) -> list[Block]:
    """Return the table that the command line prints."""
    return view_heights(result, verbose=False)


@write_page.register
def write_compensation(result: Compensation) -> list[Block]:
    """Return the targets, and the findings of those that are not reached."""
    return [str(result), *view_compensation(result)]


@write_page.register
def write_identifiability(result: Identifiability) -> list[Block]:
    """Return the findings and the parameters."""
    return _with_table("\n".join(str(finding) for finding in result.findings), result)


@write_page.register
def write_model_choice(result: ModelChoice) -> list[Block]:
    """Return the comparison of parameter sets and the choice."""
    return [build_model_table(result), str(result.finding)]


@write_page.register
def write_curves(result: RegularizationCurves) -> list[Block]:
    """Return the page that the command line prints."""
    return view_regularization(result)


@write_page.register
def write_bootstrap(result: Bootstrap) -> list[Block]:
    """Return findings and intervals."""
    return view_bootstrap(result, result.intervals())


@write_page.register
def write_sample(result: PosteriorSample) -> list[Block]:
    """Return findings and intervals."""
    return view_posterior(result, result.intervals())


@write_page.register
def write_comparison(result: ValueComparison) -> list[Block]:
    """Return the outcome of the test and the differences."""
    return _with_table(str(result.outcome), result, "Estimate minus given value")


@write_page.register
def write_examination(result: FitExamination) -> list[Block]:
    """Return the findings."""
    return ["\n".join(f"{f.severity.value}: {f}" for f in result.findings) or "no findings"]


@write_page.register
def write_cross_validation(result: CrossValidation) -> list[Block]:
    """Return the score and the folds."""
    text = f"Held-out score {result.score:.4g} +/- {result.standard_error:.2g} sigma^2"
    poses = f"{len(result.poses)} rows in {len(result.fold)} folds"
    return _with_table(f"{text}, {poses}; 1 is noise alone.", result)


@write_page.register
def write_map(result: AccuracyMap) -> list[Block]:
    """Return medians and maxima, and the poses."""
    return _with_table(str(result), result, "Poses of the map")


@write_page.register
def write_simulation(result: AccuracySimulation) -> list[Block]:
    """Return predicted and observed errors."""
    counts = f"{result.trials} trials, {result.failed} did not converge"
    return _with_table(f"{counts}; {result.predicted.frame}", result)


@write_page.register
def write_solution(result: Solution) -> list[Block]:
    """Return counts and the poses; readings are in m or rad."""
    return _with_table(repr(result), result)


@write_page.register
def write_runs(result: RunComparison) -> list[Block]:
    """Return the page that the command line prints."""
    return view_comparison(result, find_error_units(result).__getitem__)


@write_page.register
def write_change(result: Change) -> list[Block]:
    """Return whether the machine changed."""
    return [str(result.finding)]


@write_page.register
def write_conformity(result: Conformity) -> list[Block]:
    """Return the decision with its probability; numbers are in m or rad."""
    error = f"error {result.estimate:.4g} (95 %: {result.low:.4g} to {result.high:.4g})"
    decision = f"{result.decision.value} with a probability of {100.0 * result.probability:.3g} %"
    return [f"{error} against a limit of {result.limit:.4g}, all in m or rad: {decision}"]


@write_page.register
def write_repeatability(result: Repeatability) -> list[Block]:
    """Return the page that the command line prints, in mm and deg."""
    return view_repeatability(result)
