# SPDX-License-Identifier: Apache-2.0
"""Several calibrations side by side as a document: result, parameters, shifts, held-out errors."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from loopcal.apply.run_comparison import RunComparison
from loopcal.engine import collect_versions
from loopcal.findings import sort_by_importance
from loopcal.mechanism.model import Mechanism
from loopcal.report.document.calibration_document import describe_maker, summarize
from loopcal.report.document.elements import CalibrationRecord, Document, Element, Listing, Section
from loopcal.report.document.figures import compute_accuracy, draw_scene_picture, make_picture
from loopcal.report.figures.result_figures import (
    draw_run_errors,
    draw_run_parameters,
    draw_run_shifts,
)
from loopcal.report.figures.robot_figure import draw_scene
from loopcal.report.scene.scene import Scene, format_scene
from loopcal.report.validation_view import (
    build_errors,
    build_estimates,
    build_runs,
    build_shifts,
    find_error_units,
)

HEADS: Mapping[bool | None, str] = {True: "not_calibrated", False: "calibrated", None: "undecided"}
"""Whether a machine has changed -> the color of the head, as of a verdict."""
SUMMARIES: Mapping[bool | None, str] = {
    True: "A machine differs from that of {first}, beyond the noise.",
    False: "The machines do not differ from that of {first} beyond the noise.",
    None: "Whether a machine has changed was not tested.",
}
MEANING = (
    "The first run is the reference of all others. A change is tested where the data of two runs "
    "are independent, in the directions that both data sets determine. If nothing has changed, a "
    "change is reported in 5 % of cases, for all runs together."
)
NO_SHIFTS = (
    "The data of the runs are not independent, or have no direction in common, so no shift was "
    "tested."
)


def build_comparison_document(comparison: RunComparison, made_by: str) -> Document:
    """Return a comparison as a document.

    Parameters
    ----------
    made_by : program and version.
    """
    names = ", ".join(run.name for run in comparison.runs)
    summary = SUMMARIES[comparison.moved].format(first=comparison.runs[0].name)
    sections = (
        _build_result(comparison),
        _build_parameters(comparison),
        _build_shifts(comparison),
        _build_errors(comparison),
    )
    return Document(
        title=f"Comparison of calibrations: {names}",
        verdict=HEADS[comparison.moved],
        summary=summary,
        made_by=made_by,
        sections=sections,
    )


def _build_result(comparison: RunComparison) -> Section:
    """Return the findings, the most important first, and the runs."""
    findings = sort_by_importance(comparison.findings)
    listed = Listing(tuple((finding.severity.value, str(finding)) for finding in findings))
    elements: list[Element] = [MEANING, *([listed] if findings else []), build_runs(comparison)]
    return Section("result", "Whether and where the machine changed", tuple(elements))


def _build_parameters(comparison: RunComparison) -> Section:
    """Return estimates with intervals, side by side."""
    picture = make_picture(
        draw_run_parameters(comparison),
        "estimates-figure",
        "Estimates of all runs with their 95 % intervals.",
        "For each parameter the figure shows the estimate of each run minus that of the first run, "
        "with its interval, in half-widths of the first run's interval. The table has the numbers.",
    )
    elements = (build_estimates(comparison), picture)
    return Section("parameters", "Parameters side by side", elements)


def _build_shifts(comparison: RunComparison) -> Section:
    """Return the tested shifts in standard deviations."""
    title = "Shifts in standard deviations"
    if all(pair.moved is None for pair in comparison.pairs):
        return Section("shifts", title, (NO_SHIFTS,))
    picture = make_picture(
        draw_run_shifts(comparison),
        "shift-figure",
        "Shift of each parameter from the first run.",
        "For each parameter the figure shows the shift in standard deviations while all others may "
        "have changed, too. Filled markers are significant at 5 % for all parameters and runs "
        "together. A parameter without a marker is not determined by both data sets.",
    )
    return Section("shifts", title, (picture, build_shifts(comparison)))


def _build_errors(comparison: RunComparison) -> Section:
    """Return the errors after calibration, at common poses or at those of each run."""
    units = find_error_units(comparison)
    table = build_errors(comparison, units.__getitem__)
    elements: list[Element] = [table]
    if any(run.common or run.own for run in comparison.errors):
        picture = make_picture(
            draw_run_errors(comparison, units.__getitem__),
            "errors-figure",
            "Errors of each run after calibration.",
            "Bars are root mean squares and dots are the largest errors of each run. Errors at "
            "poses that are not common to all runs also differ because the poses do.",
        )
        elements.append(picture)
    return Section("errors", "Held-out errors", tuple(elements))


# --- The page of `loopcal view`: a robot in space, of a calibration with its poses and errors.


def build_robot_view(robot: Mechanism) -> Document:
    """Return the view of a robot at home."""
    return Document(
        title=f"3-D view: {robot.name}",
        verdict="",
        summary=f"{robot.name} at its home pose.",
        made_by=describe_maker(collect_versions()),
        sections=(Section("view", "The robot", tuple(_draw_home(robot))),),
    )


def build_calibration_view(record: CalibrationRecord) -> Document:
    """Return the view of a calibration; of a fit that did not converge, the robot before it."""
    accuracy = compute_accuracy(record)
    reason = [accuracy] if isinstance(accuracy, str) and record.converged else []
    scene = draw_scene_picture(record, None if isinstance(accuracy, str) else accuracy)
    elements: list[Element] = [*scene, *reason]
    if all(isinstance(element, str) for element in elements):
        elements += _draw_home(record.robot if record.converged else record.initial)
    return Document(
        title=f"3-D view: {record.robot.name}",
        verdict=record.verdict.name.lower(),
        summary=summarize(record),
        made_by=describe_maker((record.result.get("made_by") or {}).get("versions", {})),
        sections=(Section("view", "The robot and its measured poses", tuple(elements)),),
    )


def _draw_home(robot: Mechanism) -> Iterator[Element]:
    """Yield a robot at home."""
    scene = Scene(robot)
    yield make_picture(
        draw_scene(scene),
        "scene-figure",
        "The robot at home.",
        "The picture shows limbs, joints, rods, platform and tool, in space and from above.",
        format_scene(scene),
    )
