# SPDX-License-Identifier: Apache-2.0
"""The figures of the report, drawn from a record; each function yields a picture or a sentence."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from loopcal.apply import AccuracyMap, accuracy_map
from loopcal.errors import LoopcalError
from loopcal.estimate.residuals import KindResiduals
from loopcal.measure.kinds.joints.actuator_readings import ActuatorReadings
from loopcal.report.document.elements import Element
from loopcal.report.document.inline_svg import make_picture
from loopcal.report.document.record import CalibrationRecord
from loopcal.report.document.stored_fit import restore_fit
from loopcal.report.figures import (
    draw_accuracy_map,
    draw_correlation,
    draw_height_errors,
    draw_parameters,
    draw_residual_rows,
    draw_scene,
    draw_validation,
)
from loopcal.report.scene.scene import Scene, compute_pose_errors
from loopcal.report.scene.scene_data import choose_rows, format_scene
from loopcal.typing import FloatArray, IntArray

MAP_SENTENCE = (
    " Pale squares show the standard uncertainty of positions over the workspace by color."
)

MOST_ROWS = 3000
"""Rows that the figures of a report show."""

MOST_PARAMETERS = 120
"""Parameters up to which the report draws them."""

MAP_POSES, SEED = 200, 0
"""Poses of the accuracy map, and the seed of their draw."""


def draw_residual_picture(record: CalibrationRecord) -> Iterator[Element]:
    """Yield the residuals, of many rows some, evenly spread over the order of measurement."""
    count = sum(len(rows.raw) for rows in record.residuals)
    residuals = [thin_rows(rows, count) for rows in record.residuals]
    if count > MOST_ROWS:
        yield f"The figure shows {sum(len(r.raw) for r in residuals):,} of {count:,} rows."
    setup = [row["name"] for row in record.result["fit"].get("local") or ()]
    yield make_picture(
        draw_residual_rows(record.robot, residuals, setup),
        "residual-figure",
        "Residuals of the fitted rows.",
        "The panels show the residuals in the order of the poses, by component, as a histogram and "
        "normal plot, and against actuator readings and recorded quantities. Whitened residuals "
        "are divided by their sigma; of errors with the stated noise 95 % lie between the dashed "
        f"lines. {_describe_shrinkage(record.residuals)}",
    )


def _describe_shrinkage(residuals: Sequence[KindResiduals]) -> str:
    """Return why fitted residuals are smaller than the noise, and what to judge the noise by."""
    if all(rows.kind != ActuatorReadings.name for rows in residuals):
        return "The fit follows its data, so residuals of few rows are smaller than their errors."
    return (
        "The actuator readings are uncertain, so every pose is estimated too and follows its "
        "measured values: residuals far below one sigma do not show that sigma is too large. "
        "Chi-square above allows for that."
    )


def thin_rows(rows: KindResiduals, count: int) -> KindResiduals:
    """Return residuals with at most their share of MOST_ROWS rows, evenly spread.

    Parameters
    ----------
    count : number of the rows of all kinds.
    """
    if count <= MOST_ROWS:
        return rows
    share = max(1, MOST_ROWS * len(rows.raw) // count)
    kept = np.unique(np.linspace(0, len(rows.raw) - 1, share).astype(np.intp))
    return replace(
        rows,
        poses=tuple(rows.poses[i] for i in kept),
        raw=rows.raw[kept],
        whitened=rows.whitened[kept],
        context={name: values[kept] for name, values in rows.context.items()},
        readings=rows.readings[kept],
    )


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
        "Each point is a measured height at its place x, y; its color is the error, "
        "predicted minus measured, with the same scale before and after calibration. Circles were "
        "used in the fit, squares were held out.",
    )


def draw_scene_picture(
    record: CalibrationRecord, accuracy: AccuracyMap | None
) -> Iterator[Element]:
    """Yield the robot at home with the measured poses and the errors that calibration removes."""
    readings = record.readings
    if not record.converged:
        yield "The fit did not converge, so there is no calibrated geometry to draw."
        return
    if readings is None or not len(readings):
        yield "The run does not contain the readings of its poses, so they are not drawn."
        return
    rows = _spread_rows(len(readings))
    if len(rows) < len(readings):
        yield f"The figure shows {len(rows):,} of {len(readings):,} fitted poses."
    labels = _label_rows(record, rows)
    poses = compute_pose_errors(record.robot, record.initial, readings[rows], labels)
    scene = Scene(record.robot, poses, accuracy)
    shown = len(choose_rows(record.robot, len(poses.tool)))
    if shown < len(poses.tool):
        yield f"The 3-D view can show the robot at {shown:,} of these poses, evenly spread."
    yield make_picture(
        draw_scene(scene),
        "scene-figure",
        "The robot at home, and the tool point at the fitted poses.",
        "A point is the tool at a fitted pose. The line from it is the position error of the "
        f"geometry before calibration there, {poses.magnification:g} times magnified: its "
        "predicted position minus that of the calibrated geometry at the same readings, in the "
        f"base frame of the robot file.{MAP_SENTENCE if accuracy is not None else ''}",
        format_scene(scene),
    )


def _label_rows(record: CalibrationRecord, rows: IntArray) -> tuple[str, ...]:
    """Return the labels of fitted poses; their numbers where an older version wrote the run."""
    labels, count = (
        record.fitted_labels,
        len(record.readings if record.readings is not None else ()),
    )
    return tuple(labels[i] if len(labels) == count else str(i + 1) for i in rows)


def _spread_rows(count: int) -> IntArray:
    """Return at most MOST_ROWS of so many rows, evenly spread."""
    return np.unique(np.linspace(0, count - 1, MOST_ROWS).astype(np.intp))


def _describe_count(readings: FloatArray | None) -> str:
    """Return how many of the measured poses are compared, where these are not all."""
    count = 0 if readings is None else len(readings)
    return f" of the {MOST_ROWS:,} that are compared" if count > MOST_ROWS else ""


def compute_accuracy(record: CalibrationRecord) -> AccuracyMap | str:
    """Return the uncertainty of poses over the workspace, or the sentence why it is not known."""
    budget, readings = record.result.get("expected_error"), record.readings
    if record.posterior is None or readings is None or not budget:
        return "This run has no intervals, so the accuracy over the workspace is not known."
    try:
        return accuracy_map(
            record.posterior,
            readings[_spread_rows(len(readings))],
            MAP_POSES,
            SEED,
            frame=budget.get("frame", "fitted"),
        )
    except LoopcalError as error:
        return f"The accuracy over the workspace cannot be computed: {error}"


def draw_accuracy_picture(record: CalibrationRecord, accuracy: AccuracyMap) -> Iterator[Element]:
    """Yield the uncertainty of poses over the workspace, and the sentence that sums it up."""
    less = int(accuracy.extrapolated.sum())
    yield (
        f"The standard uncertainty of the pose was computed at {len(accuracy.coordinates)} poses "
        f"of the workspace, {accuracy.uncertainty.frame}. {less} of these poses are less certain "
        f"than every measured pose{_describe_count(record.readings)}."
    )
    yield make_picture(
        draw_accuracy_map(accuracy),
        "accuracy-figure",
        "Standard uncertainty of poses over the workspace.",
        "Slices of the workspace show the standard uncertainty of the pose by color. Circles mark "
        "extrapolated poses, which are less certain than every measured pose.",
    )


def draw_parameter_picture(record: CalibrationRecord) -> Iterator[Element]:
    """Yield shifts and uncertainties of the parameters in tolerances."""
    if (count := len(record.result["fit"]["parameters"])) > MOST_PARAMETERS:
        yield f"{count} parameters are too many for a figure."
        return
    fit = restore_fit(record.result["fit"], record.arrays, record.robot)
    yield make_picture(
        draw_parameters(fit),
        "parameter-figure",
        "Shift and uncertainty of the parameters in tolerances.",
        "For each parameter the figure shows the estimate minus the nominal value with its 95 % "
        "interval, and the half-width of that interval.",
    )


def draw_correlation_picture(record: CalibrationRecord) -> Iterator[Element]:
    """Yield the correlations of the parameters."""
    if not 1 < len(record.result["fit"]["parameters"]) <= MOST_PARAMETERS:
        return
    fit = restore_fit(record.result["fit"], record.arrays, record.robot)
    yield make_picture(
        draw_correlation(fit),
        "correlation-figure",
        "Correlations of the parameters.",
        "The matrix shows the correlation of each pair of parameters by color. The findings of the "
        "residuals name the pairs that are strongly correlated.",
    )
