# SPDX-License-Identifier: Apache-2.0
"""Quality gates of a calibration: each of these findings makes the verdict "not calibrated"."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from loopcal.findings.finding import Severity
from loopcal.findings.wording import Entry, fill_template

ENDINGS = {
    "out_of_iterations": "The fit did not converge within the allowed number of iterations.",
    "no_descent": "The fit did not converge: every further step leaves the reach of the mechanism.",
    "bad_start": "The fit could not begin: the start values give no finite residuals. Check units "
    "and readings.",
    "running": "The fit was stopped before it converged.",
}


def _word_not_converged(data: Mapping[str, Any]) -> str:
    return ENDINGS.get(data["status"], "The fit did not converge.")


def _word_errors_grew(data: Mapping[str, Any]) -> str:
    template = (
        "The {quantity} error on held-out poses is {times} times larger after calibration (rms). "
        "The fit does not generalize: do not use it."
    )
    if data["quantity"] == "weighted":
        template = template.replace("{quantity} error", "error divided by sigma")
    return fill_template(template, **data)


ENTRIES = (
    Entry(
        "gates.not-converged",
        Severity.FAILURE,
        _word_not_converged,
        "The iteration of the fit ended without convergence.",
        "Check units, frames and outliers, or begin closer to the true geometry.",
        example={"status": "out_of_iterations"},
    ),
    Entry(
        "gates.poses-unreachable",
        Severity.FAILURE,
        "The calibrated geometry could not be validated: {reason}",
        "No pose could be predicted with the fitted geometry.",
        "Do not use the result. Check frames, units and stated noise.",
    ),
    Entry(
        "gates.residuals-exceed-noise",
        Severity.FAILURE,
        "The residuals are {ratio} times the stated noise. Sigma is too small, rows are wrong, or "
        "the model lacks a parameter.",
        "The chi-square of the residuals is too large for the stated noise (probability below "
        "0.001).",
        "Check outliers first, then the stated sigma, then free more parameters.",
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
