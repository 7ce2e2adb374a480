# SPDX-License-Identifier: Apache-2.0
"""Use of a calibration: validation, reuse of fitted data, accuracy of poses, compensation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from loopcal.findings.finding import Severity
from loopcal.findings.wording import Entry, fill_template

POINTS = {"tool": "tool point", "platform": "platform origin"}


def _word_setup_moved(data: Mapping[str, Any]) -> str:
    single = len(data["names"]) == 1
    was, it_is, it = ("was", "it is", "it") if single else ("were", "they are", "them")
    return fill_template(
        f"{{names:list}} apparently {was} moved after the calibration: the errors are {{times}} "
        f"times smaller when {it_is} fitted to these data. Fit {it} again.",
        **data,
    )


def _word_few_rows(data: Mapping[str, Any]) -> str:
    measure = "measures" if data["count"] == 1 else "measure"
    return fill_template(
        f"Only {{count:count row}} {measure} {{quantity}}: too few to estimate its error.", **data
    )


def _word_reused_rows(data: Mapping[str, Any]) -> str:
    poses = "pose" if len(data["poses"]) == 1 else "poses"
    return fill_template(
        f"The calibration used {{count}} of {{total:count row}} ({poses} {{poses:list}}), so this "
        "is not an independent validation. Validate with other measurements.",
        **data,
    )


def _word_frame(data: Mapping[str, Any]) -> str:
    text = f"{POINTS[data['point']]}, {data['axes']} axes"
    count, frames = data["count"], data["frames"]
    if not count:
        return f"{text}, in the base frame of the robot file"
    which = fill_template("{frames:list}", frames=frames)
    frame = "frame" if len(frames) == 1 else "frames"
    combination = "combination" if count == 1 else "combinations"
    return (
        f"{text}, relative to the fitted {which} {frame}; {count} parameter {combination} that "
        f"only {'moves' if count == 1 else 'move'} {'this' if len(frames) == 1 else 'these'} "
        f"{frame} {'is' if count == 1 else 'are'} excluded"
    )


ENTRIES = (
    Entry(
        "validation.unreachable-poses",
        Severity.WARNING,
        "Not validated: {names:list}. With these readings the geometry before or after calibration "
        "cannot be assembled. Check the readings.",
        "Some poses are outside the reach of the geometry before or after calibration.",
        "Check the readings of these poses.",
    ),
    Entry(
        "validation.missing-readings",
        Severity.INFO,
        "{names:list} not validated: a reading is missing or has an infinite sigma.",
        "The pose cannot be predicted from the readings that exist.",
    ),
    Entry(
        "validation.few-rows",
        Severity.INFO,
        _word_few_rows,
        "Fewer than five rows measure position or orientation.",
        "Measure more poses for validation.",
        example={"count": 3, "quantity": "position"},
    ),
    Entry(
        "validation.setup-kept",
        Severity.INFO,
        "{names:list}: kept from the fit.",
        "Frames, targets or surfaces have the values that the calibration found.",
    ),
    Entry(
        "validation.setup-fitted",
        Severity.INFO,
        "{names:list}: fitted to these data, so the errors are optimistic.",
        "Frames, targets or surfaces are not known from the calibration.",
    ),
    Entry(
        "validation.setup-fitted-before",
        Severity.INFO,
        "Errors before calibration: {names:list} fitted to these data, so they are optimistic.",
        "The calibration keeps these values only for the calibrated geometry.",
    ),
    Entry(
        "validation.setup-moved",
        Severity.WARNING,
        _word_setup_moved,
        "Errors fall by a factor of three or more when a kept frame, target or surface is fitted "
        "again.",
        "Fit the named frame, target or surface again.",
        example={"names": ("tracker",), "times": 5.2},
    ),
    Entry(
        "validation.rows-reused",
        Severity.REFUSAL,
        _word_reused_rows,
        "Data for validation contain rows that the calibration used; half of them or more are "
        "refused.",
        "Validate with other measurements.",
        example={"count": 8, "total": 8, "poses": ("1", "2", "3")},
    ),
    Entry(
        "validation.file-reused",
        Severity.REFUSAL,
        "{file} contains the measurements of this calibration, so this is not an independent "
        "validation. Validate with other measurements.",
        "A file for validation is one of the files that the calibration used.",
        "Validate with other measurements.",
    ),
    Entry(
        "accuracy.frame",
        Severity.INFO,
        _word_frame,
        "Every statement of pose uncertainty: its point, axes and frame.",
        example={"point": "tool", "axes": "base", "count": 6, "frames": ("base",)},
    ),
    Entry(
        "compensation.reached", Severity.INFO, "reached in full", "The machine reaches the target."
    ),
    Entry(
        "compensation.reached-in-part",
        Severity.INFO,
        "{names:list} reached; the actuators cannot correct the remaining {position} and "
        "{orientation}",
        "The machine has fewer actuators than the target has coordinates.",
    ),
    Entry(
        "compensation.not-converged",
        Severity.FAILURE,
        "the shifted commands did not converge; allow more steps, or use readings in place of "
        "commands",
        "The fixed-point iteration of the commands did not reduce the distance tenfold.",
        "Allow more steps, or use readings instead of commands.",
    ),
    Entry(
        "compensation.outside-limits",
        Severity.FAILURE,
        "outside the machine's limits: {limit}",
        "The target needs a stroke or joint angle beyond its limit.",
        "Change the target, or correct the limits in the robot file.",
    ),
    Entry(
        "compensation.unreachable",
        Severity.FAILURE,
        "cannot be reached: {reason}",
        "Inverse or forward kinematics fails at the target.",
        "Change the target.",
    ),
)
