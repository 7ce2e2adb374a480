# SPDX-License-Identifier: Apache-2.0
"""The figures of the report, drawn from a record; each function yields a picture or a sentence."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from loopcal.apply.accuracy import AccuracyMap, accuracy_map
from loopcal.errors import LoopcalError
from loopcal.estimate.result import KindResiduals
from loopcal.measure.kinds.joints import ActuatorReadings
from loopcal.numerics.statistics import choose_evenly
from loopcal.report.document.elements import CalibrationRecord, Element, Picture
from loopcal.report.figures.fit_figures import (
    draw_correlation_matrix,
    draw_parameter_rows,
    draw_residual_rows,
)
from loopcal.report.figures.result_figures import (
    draw_accuracy_map,
    draw_budget_sources,
    draw_height_errors,
    draw_validation,
)
from loopcal.report.figures.robot_figure import draw_scene
from loopcal.report.pictures import inline_figure
from loopcal.report.scene.scene import (
    Motion,
    Scene,
    choose_rows,
    compute_motion,
    compute_pose_errors,
    format_scene,
)
from loopcal.units import find_unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_ROWS, MOST_PARAMETERS = 3000, 120
"""Rows that the figures of a report show, and parameters up to which it draws them."""

MOST_MOTIONS = 20
"""Undetermined combinations that the 3-D view can show."""

MAP_POSES, SEED = 200, 0
"""Poses of the accuracy map, and the seed of their draw."""

Draw = Callable[[CalibrationRecord], Iterator[Element]]
FIGURES: dict[Draw, str] = {}
"""Function -> name of the section that shows its figure."""


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


def make_picture(
    figure: Figure, name: str, caption: str, description: str, scene: str = ""
) -> Picture:
    """Return a figure as a picture; see `Picture` for the arguments."""
    return Picture(name, inline_figure(figure, name), caption, description, scene)


@report_figure("residuals")
def draw_residual_picture(record: CalibrationRecord) -> Iterator[Element]:
    """Yield the residuals, of many rows some, evenly spread over the order of measurement."""
    if not record.converged:
        return
    if not record.residuals:
        yield (
            "This run folder was written by an earlier version and does not contain the labels of "
            "its residuals. Repeat the calibration to see them."
        )
        return
    count = sum(len(rows.raw) for rows in record.residuals)
    residuals = [thin_rows(rows, count) for rows in record.residuals]
    if count > MOST_ROWS:
        yield f"The figure shows {sum(len(r.raw) for r in residuals):,} of {count:,} rows."
    shrinkage = "The fit follows its data, so residuals of few rows are smaller than their errors."
    if any(rows.kind == ActuatorReadings.name for rows in residuals):
        shrinkage = (
            "The actuator readings are uncertain, so every pose is estimated too and follows its "
            "measured values. Residuals far below one sigma are therefore normal. Chi-square "
            "above allows for that."
        )
    setup = [row["name"] for row in record.result["fit"].get("local") or ()]
    yield make_picture(
        draw_residual_rows(record.robot, residuals, setup),
        "residual-figure",
        "Residuals of the fitted rows.",
        "The panels show the residuals in the order of the poses, by component, as "
        "histogram and normal plot, and against readings and recorded quantities. Whitened "
        "residuals "
        "are divided by their sigma. Of errors with the stated noise 95 % lie between the dashed "
        f"lines. {shrinkage}",
    )


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
        context={name: values[kept] for name, values in rows.context.items()},
        readings=rows.readings[kept],
    )


@report_figure("errors")
def draw_validation_picture(record: CalibrationRecord) -> Iterator[Element]:
    """Yield the errors at held-out poses before and after; of many rows none."""
    errors = record.validation
    if errors is None or not errors.quantities:
        return
    if len(errors.poses) > MOST_ROWS:
        yield f"The errors of {len(errors.poses):,} rows are too many for a figure."
        return
    yield make_picture(
        draw_validation(errors),
        "validation-figure",
        "Errors at held-out poses before and after calibration.",
        "For each held-out pose the figure shows the size of the error before and after "
        "calibration, with the noise floor.",
    )


@report_figure("heights")
def draw_height_picture(record: CalibrationRecord) -> Iterator[Element]:
    """Yield the errors of heights over x and y before and after; of many heights none."""
    heights = record.heights
    if heights is None:
        return
    if len(heights.poses) > MOST_ROWS:
        yield f"The errors of {len(heights.poses):,} heights are too many for a figure."
        return
    yield make_picture(
        draw_height_errors(heights),
        "height-figure",
        "Height errors over x and y before and after calibration.",
        "Each point is a measured height at its place x, y. Its color is the error, "
        "predicted minus measured, in one scale before and after calibration. The fit used the "
        "circles and held out the squares.",
    )


@report_figure("budget")
def draw_budget_picture(record: CalibrationRecord) -> Iterator[Element]:
    """Yield the sources of the expected error as bars."""
    budget = record.result.get("expected_error")
    if budget and budget.get("sources"):
        yield make_picture(
            draw_budget_sources(budget),
            "budget-figure",
            "Expected error by source.",
            "A bar is the part of a source in the root mean square error. A diamond is the error "
            "of all sources if the sigma of this one were half as large.",
        )


@report_figure("workspace")
def draw_scene_picture(record: CalibrationRecord) -> Iterator[Element]:
    """Yield the robot at home with the measured poses and the errors that calibration removes."""
    readings = record.readings
    if not record.converged:
        yield "The fit did not converge, so the calibrated geometry is missing."
        return
    if readings is None or not len(readings):
        yield "The run lacks the readings of its poses, so the picture omits them."
        return
    accuracy = compute_accuracy(record)
    accuracy = None if isinstance(accuracy, str) else accuracy
    rows, count = choose_evenly(len(readings), MOST_ROWS), len(readings)
    if len(rows) < count:
        yield f"The figure shows {len(rows):,} of {count:,} fitted poses."
    labels = record.fitted_labels
    if len(labels) != count:  # an older version wrote the run
        labels = tuple(str(i + 1) for i in range(count))
    shown = tuple(labels[i] for i in rows)
    poses = compute_pose_errors(record.robot, record.initial, readings[rows], shown)
    scene = Scene(record.robot, poses, accuracy, tuple(_list_motions(record)))
    in_space = len(choose_rows(record.robot, len(poses.tool)))
    if in_space < len(poses.tool):
        yield f"The 3-D view can show the robot at {in_space:,} of these poses, evenly spread."
    of_map = " Pale squares show the standard uncertainty of positions over the workspace by color."
    yield make_picture(
        draw_scene(scene),
        "scene-figure",
        "The robot at home, and the tool point at the fitted poses.",
        "A point is the tool at a fitted pose. The line from it is the position error of the "
        f"geometry before calibration there, {poses.magnification:g} times magnified: its "
        "predicted position minus that of the calibrated geometry at the same readings, in the "
        f"base frame of the robot file.{'' if accuracy is None else of_map}",
        format_scene(scene),
    )


def _list_motions(record: CalibrationRecord) -> Iterator[Motion]:
    """Yield how the robot at home moves by its errors before calibration, and by each combination
    of parameters that the data do not determine.
    """
    robot = record.robot
    names = list(robot.parameters.names)
    changes = [
        (
            record.initial.values - robot.values,
            "before calibration",
            "The second robot is the geometry before calibration at the same readings.",
        )
    ]
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
    less = int(accuracy.extrapolated.sum())
    is_part = record.readings is not None and len(record.readings) > MOST_ROWS
    count = f" of the {MOST_ROWS:,} that are compared" if is_part else ""
    yield (
        f"The standard uncertainty of the pose was computed at {len(accuracy.coordinates)} poses "
        f"of the workspace. {less} of these poses are less certain than every measured pose"
        f"{count}. Frame: {accuracy.uncertainty.frame}."
    )
    yield make_picture(
        draw_accuracy_map(accuracy),
        "accuracy-figure",
        "Standard uncertainty of poses over the workspace.",
        "Slices of the workspace show the standard uncertainty of the pose by color. Circles mark "
        "extrapolated poses, which are less certain than every measured pose.",
    )


@lru_cache(maxsize=1)  # two figures use it
def compute_accuracy(record: CalibrationRecord) -> AccuracyMap | str:
    """Return the uncertainty of poses over the workspace, or the sentence why it is not known."""
    budget, readings = record.result.get("expected_error"), record.readings
    if record.posterior is None or readings is None or not budget:
        return "Without intervals, the accuracy over the workspace is unknown."
    measured, frame = (
        readings[choose_evenly(len(readings), MOST_ROWS)],
        budget.get("frame", "fitted"),
    )
    try:
        return accuracy_map(record.posterior, measured, MAP_POSES, SEED, frame=frame)
    except LoopcalError as error:
        return f"The accuracy over the workspace cannot be computed: {error}"


@report_figure("parameters")
def draw_parameter_picture(record: CalibrationRecord) -> Iterator[Element]:
    """Yield shifts and uncertainties of the parameters in tolerances, and their correlations."""
    rows = record.result["fit"]["parameters"]
    if not record.converged:
        return
    if len(rows) > MOST_PARAMETERS:
        yield f"{len(rows)} parameters are too many for a figure."
        return
    yield make_picture(
        draw_parameter_rows(record.robot.name, rows),
        "parameter-figure",
        "Shift and uncertainty of the parameters in tolerances.",
        "For each parameter the figure shows the estimate minus the nominal value with its 95 % "
        "interval, and the half-width of that interval.",
    )
    if len(rows) > 1:
        names = [row["name"] for row in rows]
        yield make_picture(
            draw_correlation_matrix(record.robot.name, names, record.arrays["covariance"]),
            "correlation-figure",
            "Correlations of the parameters.",
            "The matrix shows the correlation of each pair of parameters by color.",
        )
