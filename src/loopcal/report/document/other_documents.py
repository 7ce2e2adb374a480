# SPDX-License-Identifier: Apache-2.0
"""Several calibrations side by side as a document: result, parameters, shifts, held-out errors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from loopcal.apply.run_comparison import RunComparison
from loopcal.engine import collect_versions
from loopcal.findings import sort_by_importance
from loopcal.mechanism.model import Mechanism
from loopcal.report.document.calibration_document import build_head, describe_maker
from loopcal.report.document.elements import (
    CalibrationRecord,
    Document,
    Element,
    Listing,
    Picture,
    Section,
)
from loopcal.report.document.figures import (
    compute_accuracy,
    draw_scene_picture,
    make_picture,
    show_figure,
)
from loopcal.report.figures.result_figures import (
    draw_run_errors,
    draw_run_parameters,
    draw_run_shifts,
)
from loopcal.report.figures.robot_figure import draw_scene
from loopcal.report.scene.scene import Scene, format_scene
from loopcal.report.validation_view import build_errors, build_estimates, build_runs, build_shifts
from loopcal.report.words import say

HEADS: Mapping[bool | None, str] = {True: "not_calibrated", False: "calibrated", None: "undecided"}
"""Whether a machine has changed -> the color of the head, as of a verdict."""
SUMMARIES: Mapping[bool | None, str] = {True: "changed", False: "equal", None: "untested"}
"""The same -> the name of the sentence below the title."""


def build_comparison_document(comparison: RunComparison, made_by: str) -> Document:
    """Return a comparison as a document; made_by : program and version."""
    names, first = ", ".join(run.name for run in comparison.runs), comparison.runs[0].name
    result: list[Element] = [say("comparison.meaning")]
    if findings := sort_by_importance(comparison.findings):  # the most important first
        result.append(Listing(tuple((f.severity.value, str(f)) for f in findings)))
    estimates = show_figure(draw_run_parameters(comparison), "estimates-figure")
    shifts: list[Element] = [say("comparison.no-shift")]
    if any(pair.moved is not None for pair in comparison.pairs):
        figure = show_figure(draw_run_shifts(comparison), "shift-figure")
        shifts = [figure, build_shifts(comparison)]
    errors: list[Element] = [build_errors(comparison)]
    if any(run.common or run.own for run in comparison.errors):
        errors.append(show_figure(draw_run_errors(comparison), "errors-figure"))
    sections: dict[tuple[str, str], list[Element]] = {
        ("result", "Changes of the machine"): [*result, build_runs(comparison)],
        ("parameters", "Parameters side by side"): [build_estimates(comparison), estimates],
        ("shifts", "Shifts in standard deviations"): shifts,
        ("errors", "Held-out errors"): errors,
    }
    return Document(
        title=f"Comparison of calibrations: {names}",
        verdict=HEADS[comparison.moved],
        summary=say(f"comparison.{SUMMARIES[comparison.moved]}", first=first),
        made_by=made_by,
        sections=tuple(Section(*named, tuple(each)) for named, each in sections.items()),
    )


# The page of `loopcal view`: a robot in space, of a calibration with its poses and errors.


def build_robot_view(robot: Mechanism) -> Document:
    """Return the view of a robot at home."""
    return Document(
        title=f"3-D view: {robot.name}",
        verdict="",
        summary=f"{robot.name} at its home pose.",
        made_by=describe_maker(collect_versions()),
        sections=(Section("view", "The robot", (_draw_home(robot),)),),
    )


def build_calibration_view(record: CalibrationRecord) -> Document:
    """Return the view of a calibration; of a fit that did not converge, the robot before it."""
    elements = [*draw_scene_picture(record)]
    if record.converged and isinstance(reason := compute_accuracy(record), str):
        elements.append(reason)
    if all(isinstance(element, str) for element in elements):
        elements.append(_draw_home(record.robot if record.converged else record.initial))
    section = Section("view", "The robot and its measured poses", tuple(elements))
    title = f"3-D view: {record.robot.name}"
    return replace(build_head(record), title=title, sections=(section,))


def _draw_home(robot: Mechanism) -> Picture:
    """Return a robot at home."""
    scene = Scene(robot)
    return make_picture(
        draw_scene(scene),
        "scene-figure",
        say("home-figure.caption"),
        say("home-figure.description"),
        format_scene(scene),
    )
