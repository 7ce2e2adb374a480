# SPDX-License-Identifier: Apache-2.0
"""The calibration workflow: what decides the verdict beside the gates, and the next step."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from loopcal.findings.finding import Severity
from loopcal.findings.wording import Entry, fill_template


def _word_frame_freedoms(data: Mapping[str, Any]) -> str:
    moves = "moves" if data["count"] == 1 else "move"
    frames = "frame" if len(data["frames"]) == 1 else "frames"
    return fill_template(
        "{count:count parameter combination} only "
        f"{moves} the {{frames:list}} {frames} as a whole. This is harmless: the accuracy relative "
        "to the fitted frames does not depend on it.",
        **data,
    )


def _word_undetermined(data: Mapping[str, Any]) -> str:
    one = data["count"] == 1
    keep = "It keeps its prior value" if one else "They keep their prior values"
    fix = "it, or fix one of its parameters" if one else "them, or fix one parameter of each"
    return fill_template(
        "These data cannot determine {count:count parameter combination} that "
        f"{'changes' if one else 'change'} poses (of {{names:list}}). {keep}, so other poses may "
        f"be less accurate. Measure what determines {fix}.",
        **data,
    )


def _word_too_few_equations(data: Mapping[str, Any]) -> str:
    template = (
        "{equations} equations cannot determine {parameters} parameters: measure more poses, fix "
        "parameters, or choose a method with the tolerances as prior (MAP)."
    )
    suggestions = str(data["suggestions"]).lstrip("; ")
    return fill_template(template, **data) + (f" {suggestions}" if suggestions else "")


ENTRIES = (
    Entry(
        "workflow.limit-needs-held-out-poses",
        Severity.REFUSAL,
        "A limit is checked on held-out poses, and none are held out: hold out a share of the "
        "poses, such as 0.25.",
        "A limit is stated without held-out poses.",
        "Hold out a share of the poses.",
    ),
    Entry(
        "workflow.free-limb-needs-prior",
        Severity.REFUSAL,
        "{limb} can only be freed with an earlier calibration that determines the other limbs. "
        "State that calibration as the prior.",
        "A limb is to be freed without a prior.",
        "Give the earlier calibration.",
    ),
    Entry(
        "workflow.option-excludes-prior",
        Severity.REFUSAL,
        "{option} cannot be combined with an earlier calibration as the prior. Remove one of the "
        "two.",
        "A method, loss or choice of parameters is stated beside a prior.",
        "Remove the option or the prior.",
    ),
    Entry(
        "workflow.too-few-equations",
        Severity.REFUSAL,
        _word_too_few_equations,
        "The data give fewer equations than there are free parameters, and no method was chosen.",
        "Measure more poses, fix parameters, or use a method with a prior (MAP).",
        example={"equations": 30, "parameters": 42, "suggestions": ""},
    ),
    Entry(
        "workflow.no-parameter-chosen",
        Severity.REFUSAL,
        "No set of free parameters predicts held-out poses better than the robot as it is: keep "
        "its geometry, or calibrate all parameters without choosing.",
        "The choice of parameters finds that calibration gains nothing.",
        "Keep the geometry, or measure with a better instrument.",
    ),
    Entry(
        "workflow.no-held-out-poses",
        Severity.WARNING,
        "No poses were held out, so the accuracy at other poses is not known.",
        "A calibration was made without validation.",
        "Hold out a share of the poses, for example a quarter, or validate with other "
        "measurements.",
    ),
    Entry(
        "workflow.few-held-out-poses",
        Severity.WARNING,
        "{count:count held-out row} cannot support a verdict; at least {needed} are needed.",
        "Fewer rows were held out than an error statistic needs.",
        "Hold out more poses, or validate with other measurements.",
    ),
    Entry(
        "workflow.undetermined-combinations",
        Severity.WARNING,
        _word_undetermined,
        "The data do not determine parameter combinations that move the platform relative to the "
        "base.",
        "Follow the suggested measurements, or fix one parameter of each combination.",
        example={"count": 2, "names": ("leg1.length", "leg2.length")},
    ),
    Entry(
        "workflow.frame-freedoms",
        Severity.INFO,
        _word_frame_freedoms,
        "The only undetermined parameter combinations are rigid motions of the base or platform "
        "frame.",
        example={"count": 6, "frames": ("base",)},
    ),
    Entry(
        "workflow.home-exceeds-limits",
        Severity.WARNING,
        "The home pose exceeds {names:list}: correct home, lengths, strokes or limits.",
        "A reading or joint at home is outside its limits.",
        "Correct home, lengths, strokes or limits in the robot file.",
    ),
    Entry(
        "workflow.robot-of-other-name",
        Severity.INFO,
        "{file} names the robot {stated!r}, but {used!r} is calibrated.",
        "The measurement file names another robot.",
        "Check that the file belongs to this robot.",
    ),
    Entry(
        "workflow.next-use-result",
        Severity.SUGGESTION,
        "Use the calibrated geometry, and validate it with new measurements from time to time.",
        "The verdict is calibrated.",
    ),
    Entry(
        "workflow.next-resolve-warnings",
        Severity.SUGGESTION,
        "Resolve the warnings or accept them, then validate with measurements that were not "
        "fitted.",
        "The verdict is calibrated with reservations.",
    ),
    Entry(
        "workflow.next-hold-out",
        Severity.SUGGESTION,
        "Repeat the calibration with a quarter of the poses held out, or validate the result with "
        "other measurements.",
        "The verdict is undecided.",
    ),
    Entry(
        "workflow.next-check-outliers",
        Severity.SUGGESTION,
        "Check the measurements of {poses:list}. Correct or exclude them, or fit with a robust "
        "loss.",
        "The verdict is not calibrated, and outliers were found.",
    ),
    Entry(
        "workflow.next-check-noise",
        Severity.SUGGESTION,
        "Check the stated sigma and the frames. If they are right, free more parameters or "
        "estimate the noise from the residuals.",
        "The verdict is not calibrated because of the residuals, and no outlier was found.",
    ),
    Entry(
        "workflow.next-check-data",
        Severity.SUGGESTION,
        "Check units, frames and joint readings of the data; then look at the identifiability of "
        "the parameters.",
        "The verdict is not calibrated because the fit did not converge or diverged.",
    ),
    Entry(
        "workflow.next-measure-more",
        Severity.SUGGESTION,
        "Measure more poses, free fewer parameters, or use a better instrument.",
        "The verdict is not calibrated because errors grew or exceed a limit.",
    ),
)
