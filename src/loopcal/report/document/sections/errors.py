# SPDX-License-Identifier: Apache-2.0
"""Errors at held-out poses, and the accuracy over the workspace."""

from __future__ import annotations

from loopcal.report.document.elements import Element, Section
from loopcal.report.document.figures import (
    compute_accuracy,
    draw_accuracy_picture,
    draw_height_picture,
    draw_scene_picture,
    draw_validation_picture,
)
from loopcal.report.document.record import CalibrationRecord
from loopcal.report.height_view import build_height_map, build_height_summary
from loopcal.report.validation_view import (
    READING_NOISE,
    describe_improvements,
    view_error_statistics,
    view_errors,
)

BASELINE = (
    "Before: the geometry before calibration, with frames, targets, surfaces and offsets fitted to "
    "the rows of the calibration. After: the calibrated geometry. Noise floor: the error that the "
    "stated noise of the measured values alone causes."
)
STATED_FRAME = "The stated frame is the one in which the measurement files state their values."

HEIGHTS = (
    "A height error is the height that a geometry predicts at the recorded readings minus the "
    "measured one: positive where the bed seems too high. Before: the geometry before calibration, "
    "with frames, surfaces and offsets fitted to the rows of the calibration. Errors at fitted "
    "points are optimistic, those at held-out points are not."
)

NOT_HELD_OUT = (
    "No pose was held out of this fit, so the report states no error at poses that were not fitted."
)
NOT_STORED = (
    "This run folder was written by an earlier version, whose errors at held-out poses cannot be "
    "shown here. Repeat the calibration to see them."
)


def build_error_section(record: CalibrationRecord) -> Section:
    """Return the errors at held-out poses before and after, with the noise floor."""
    errors = record.validation
    if errors is None:
        stored = record.result.get("validation")
        reason = NOT_HELD_OUT if not record.held_out_labels else NOT_STORED
        if record.held_out_labels and stored is None:
            reason = "The errors at the held-out poses could not be computed; see the findings."
        return Section("errors", "Errors at held-out poses", (reason,))
    explained = f"{BASELINE} {STATED_FRAME}" if "stated frame" in errors.frame else BASELINE
    if record.result.get("reading_errors"):
        explained = f"{explained} {READING_NOISE}"
    elements: list[Element] = [explained, *view_errors(errors, "held-out")]
    elements += [" ".join(describe_improvements(errors)), *draw_validation_picture(record)]
    elements += [table for table in view_error_statistics(errors) if not isinstance(table, str)]
    return Section("errors", "Errors at held-out poses", tuple(e for e in elements if e))


def build_height_section(record: CalibrationRecord) -> Section:
    """Return the errors of heights over x and y, where heights were measured."""
    heights, title = record.heights, "Height errors"
    if heights is None:
        return Section("heights", title, ())
    tables = (build_height_summary(heights), build_height_map(heights))
    return Section("heights", title, (HEIGHTS, tables[0], *draw_height_picture(record), tables[1]))


def build_workspace_section(record: CalibrationRecord) -> Section:
    """Return the robot with its measured poses, and the uncertainty over its workspace."""
    accuracy = compute_accuracy(record)
    if isinstance(accuracy, str):
        elements = (*draw_scene_picture(record, None), accuracy)
    else:
        elements = (*draw_scene_picture(record, accuracy), *draw_accuracy_picture(record, accuracy))
    return Section("workspace", "Measured poses and accuracy over the workspace", elements)
