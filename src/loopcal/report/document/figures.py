# SPDX-License-Identifier: Apache-2.0
"""The figures of the report, drawn from a record; each function yields a picture or a sentence."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from loopcal.apply.accuracy import AccuracyMap, accuracy_map
from loopcal.apply.volume_accuracy import Volume, bound_errors
from loopcal.errors import LoopcalError
from loopcal.estimate.result import KindResiduals
from loopcal.measure.kinds.joints import ActuatorReadings
from loopcal.numerics.statistics import choose_evenly
from loopcal.report.document.elements import CalibrationRecord, Element, Picture
from loopcal.report.figures import fit_figures, result_figures
from loopcal.report.pictures import inline_figure
from loopcal.report.scene.scene import (
    Motion,
    Scene,
    choose_rows,
    compute_motion,
    compute_pose_errors,
    draw_scene,
    format_scene,
)
from loopcal.report.words import say
from loopcal.units import Dimension, find_unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_ROWS, MOST_PARAMETERS = 3000, 120
"""Rows that the figures of a report show, and parameters up to which it draws them."""

MOST_MOTIONS = 20  # undetermined combinations that the 3-D view can show

MAP_POSES, SEED = 200, 0
"""Poses of the accuracy map, and the seed of their draw."""

Draw = Callable[[CalibrationRecord], Iterator[Element]]
FIGURES: dict[Draw, str] = {}  # function -> name of the section that shows its figure


def report_figure(section: str) -> Callable[[Draw], Draw]:
    """Return a decorator of a function that yields a figure for a section of the report."""

    def add(draw: Draw) -> Draw:
        FIGURES[draw] = section
        return draw

    return add


def draw_figures(section: str, record: CalibrationRecord) -> Iterator[Element]:
    """Yield the figures of a section."""
    for draw, of_section in FIGURES.items():
        if of_section == section:
            yield from draw(record)


def show_figure(
    figure: Figure, name: str, scene: str = "", words: str = "", **data: Any
) -> Picture:
    """Return a figure as a picture with the words of this or another name, filled with data."""
    words = words or name
    caption, description = (say(f"{words}.{key}", **data) for key in ("caption", "description"))
    return Picture(name, inline_figure(figure, name), caption, description, scene)


@report_figure("residuals")
def draw_residual_picture(record: CalibrationRecord) -> Iterator[Element]:
    """Yield the residuals, of many rows some, evenly spread over the order of measurement."""
    if not record.converged:
        return
    count = sum(len(rows.raw) for rows in record.residuals)
    residuals = [thin_rows(rows, count) for rows in record.residuals]
    if count > MOST_ROWS:
        shown = sum(len(rows.raw) for rows in residuals)
        yield say("residual-figure.part", shown=shown, count=count)
    setup = [row["name"] for row in record.result["fit"]["local"]]
    yield show_figure(
        fit_figures.draw_residual_rows(record.robot, residuals, setup),
        "residual-figure",
        has_readings=any(rows.kind == ActuatorReadings.name for rows in residuals),
    )


@report_figure("residuals")
def draw_arrow_picture(record: CalibrationRecord) -> Iterator[Element]:
    """Yield the residuals of pictures, of many corners some, as arrows."""
    seen = [rows for rows in record.residuals if set(rows.dimensions) == {Dimension.PIXEL}]
    if seen and record.converged:
        count = sum(len(rows.raw) for rows in seen)
        drawn = fit_figures.draw_residual_arrows(
            record.robot.name, [thin_rows(rows, count) for rows in seen]
        )
        yield show_figure(drawn, "arrow-figure")


def thin_rows(rows: KindResiduals, count: int) -> KindResiduals:
    """Return residuals with at most their share of MOST_ROWS rows, evenly spread; count : number of
    the rows of all kinds.
    """
    if count <= MOST_ROWS:
        return rows
    kept = choose_evenly(len(rows.raw), max(1, MOST_ROWS * len(rows.raw) // count))
    return replace(
        rows,
        poses=tuple(rows.poses[i] for i in kept),
        raw=rows.raw[kept],
        whitened=rows.whitened[kept],
        measured=rows.measured[kept],
        context={name: values[kept] for name, values in rows.context.items()},
        readings=rows.readings[kept],
    )


@report_figure("errors")
def draw_validation_picture(record: CalibrationRecord) -> Iterator[Element]:
    """Yield the errors at held-out poses before and after; of many rows none."""
    errors = record.validation
    if errors is not None and errors.quantities:
        yield _show_poses(errors, result_figures.draw_validation, "validation-figure")


@report_figure("heights")
def draw_height_picture(record: CalibrationRecord) -> Iterator[Element]:
    """Yield the errors of heights over x and y before and after; of many heights none."""
    if record.heights is not None:
        yield _show_poses(record.heights, result_figures.draw_height_errors, "height-figure")


def _show_poses(result: Any, draw: Callable[[Any], Figure], name: str) -> Element:
    """Return the figure of a result at poses; of many poses a sentence."""
    if (count := len(result.poses)) > MOST_ROWS:
        return say(f"{name}.many", count=count)
    return show_figure(draw(result), name)


@report_figure("budget")
def draw_budget_picture(record: CalibrationRecord) -> Iterator[Element]:
    """Yield the sources of the expected error as bars."""
    budget = record.result.get("expected_error")
    if budget and budget["sources"]:
        yield show_figure(result_figures.draw_budget_sources(budget), "budget-figure")


@report_figure("budget")
def draw_volume_picture(record: CalibrationRecord) -> Iterator[Element]:
    """Yield the stated volume in the colors of the error at each of its points."""
    if stated := record.result.get("volume"):
        volume, frame = Volume(**stated["volume"]), record.result["options"]["frame"]
        accuracy = bound_errors(record.posterior, volume, frame)
        data = accuracy.findings[0].data
        yield show_figure(result_figures.draw_volume(accuracy), "volume-figure", **data)


@report_figure("workspace")
def draw_scene_picture(record: CalibrationRecord) -> Iterator[Element]:
    """Yield the robot at home with the measured poses and the errors that calibration removes."""
    readings = record.readings
    if not record.converged:
        yield say("scene-figure.not-converged")
        return
    if readings is None or not len(readings):
        yield say("scene-figure.no-readings")
        return
    accuracy = compute_accuracy(record)
    accuracy = None if isinstance(accuracy, str) else accuracy
    rows, count = choose_evenly(len(readings), MOST_ROWS), len(readings)
    if len(rows) < count:
        yield say("scene-figure.part", shown=len(rows), count=count)
    shown = tuple(record.arrays["poses"][rows].tolist())
    poses = compute_pose_errors(record.robot, record.initial, readings[rows], shown)
    scene = Scene(record.robot, poses, accuracy, tuple(_list_motions(record)))
    in_space = len(choose_rows(record.robot, len(poses.tool)))
    if in_space < len(poses.tool):
        yield say("scene-figure.robots", shown=in_space)
    yield show_figure(
        draw_scene(scene),
        "scene-figure",
        format_scene(scene),
        magnification=poses.magnification,
        has_map=accuracy is not None,
    )


def _list_motions(record: CalibrationRecord) -> Iterator[Motion]:
    """Yield how the robot at home moves by its errors before calibration, and by each combination
    of parameters that the data do not determine.
    """
    robot = record.robot
    names = list(robot.parameters.names)
    error = record.initial.values - robot.values
    changes = [(error, "before calibration", say("scene-figure.before"))]
    for row in record.result["fit"].get("unidentifiable", ()):
        change = np.zeros(len(names))
        for name, value, unit in zip(row["names"], row["changes"], row["units"], strict=True):
            if name in names:
                change[names.index(name)] = value * find_unit(unit).factor_to_si
        changes.append((change, f"not determined: {', '.join(row['names'][:3])}", row["sentence"]))
    for change, name, text in changes[: MOST_MOTIONS + 1]:
        if (motion := compute_motion(robot, change, name, text)) is not None:
            yield motion


@report_figure("workspace")
def draw_accuracy_picture(record: CalibrationRecord) -> Iterator[Element]:
    """Yield the uncertainty of poses over the workspace, and the sentence that sums it up."""
    accuracy = compute_accuracy(record)
    if isinstance(accuracy, str):
        yield accuracy
        return
    is_part = record.readings is not None and len(record.readings) > MOST_ROWS
    yield say(
        "accuracy-figure.summary",
        poses=len(accuracy.coordinates),
        less=int(accuracy.extrapolated.sum()),
        compared=is_part and MOST_ROWS,
        frame=accuracy.uncertainty.frame,
    )
    yield show_figure(result_figures.draw_accuracy_map(accuracy), "accuracy-figure")


@lru_cache(maxsize=1)  # two figures use it
def compute_accuracy(record: CalibrationRecord) -> AccuracyMap | str:
    """Return the uncertainty of poses over the workspace, or the sentence why it is not known."""
    budget, readings = record.result.get("expected_error"), record.readings
    if readings is None or not budget:
        return say("accuracy-figure.unknown")
    measured = readings[choose_evenly(len(readings), MOST_ROWS)]
    try:
        return accuracy_map(record.posterior, measured, MAP_POSES, SEED, frame=budget["frame"])
    except LoopcalError as error:
        return say("accuracy-figure.failed", error=error)


@report_figure("parameters")
def draw_parameter_picture(record: CalibrationRecord) -> Iterator[Element]:
    """Yield shifts and uncertainties of the parameters in spreads, and their correlations."""
    rows = record.result["fit"]["parameters"]
    if not record.converged:
        return
    if len(rows) > MOST_PARAMETERS:
        yield say("parameter-figure.many", count=len(rows))
        return
    yield show_figure(fit_figures.draw_parameter_rows(record.robot.name, rows), "parameter-figure")
    if len(rows) > 1:
        names, covariance = [row["name"] for row in rows], record.arrays["covariance"]
        matrix = fit_figures.draw_correlation_matrix(record.robot.name, names, covariance)
        yield show_figure(matrix, "correlation-figure")
