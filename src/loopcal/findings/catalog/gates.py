# SPDX-License-Identifier: Apache-2.0
"""Quality gates of a calibration: each of these findings makes the verdict "not calibrated".

Two more gates are findings of the fit: an iteration that did not converge (`fit.*`), and residuals
that contradict the stated noise (`noise.residuals-too-large`), which a calibration raises to a
failure.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from loopcal.findings.finding import Severity
from loopcal.findings.wording import Entry, fill_template


def _word_errors_grew(data: Mapping[str, Any]) -> str:
    template = (
        "The {quantity} error on held-out poses grew by a factor of {times} (rms). Do not use this "
        "calibration. Measure more poses, or free fewer parameters."
    )
    if math.isinf(data["times"]):
        template = template.replace("by a factor of {times}", "from zero")
    if data["quantity"] == "weighted":
        template = template.replace("{quantity} error", "error divided by sigma")
    return fill_template(template, **data)


ENTRIES = (
    Entry(
        "gates.poses-unreachable",
        Severity.FAILURE,
        "The calibrated geometry could not be validated: {reason}",
        "No pose could be predicted with the fitted geometry.",
        "Do not use the result. Check frames, units and stated noise.",
    ),
    Entry(
        "gates.errors-grew",
        Severity.FAILURE,
        _word_errors_grew,
        "The rms error on held-out poses grew by more than 10 %.",
        "Do not use the result. Measure more poses or free fewer parameters.",
        example={"quantity": "position", "times": 1.4},
    ),
    Entry(
        "gates.limit-exceeded",
        Severity.FAILURE,
        "The {quantity} error at pose {pose} is {error}; the limit is {limit}.",
        "The largest prediction error is above a stated limit.",
        "Compare the limit with the noise floor; measure more poses or use a better instrument.",
    ),
    Entry(
        "gates.limit-not-measured",
        Severity.FAILURE,
        "The {quantity} limit cannot be checked: no row measures {quantity}.",
        "A limit was stated for something that the validation data do not contain.",
        "Remove the limit or measure it.",
    ),
)
