# SPDX-License-Identifier: Apache-2.0
"""The model: which parameters are worth identifying, and the expected gain of a calibration."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from loopcal.findings.finding import Severity
from loopcal.findings.wording import Entry, Quantity, fill_template, list_names

NOT_COMPARED = "The gain of a calibration cannot be predicted"


def _expected(data: Mapping[str, Any]) -> str:
    """Word the expected errors before and after calibration, those that the robot can have."""
    pairs = (("position", data["position"]), ("orientation", data["orientation"]))
    errors = [
        fill_template(
            name + " {before} before calibration (from tolerances), {after} after",
            before=pair[0],
            after=pair[1],
        )
        for name, pair in pairs
        if pair is not None
    ]
    return f"Expected error at these poses (rms): {'; '.join(errors)}."


def _no_gain(data: Mapping[str, Any]) -> str:
    return (
        "Calibration with this instrument and these poses does not improve on the tolerances: use "
        f"a more accurate instrument or more poses. {_expected(data)}"
    )


def _simpler(data: Mapping[str, Any]) -> str:
    return fill_template(
        "A simpler model suffices: {chosen} ({parameters:count parameter}) predicts held-out poses "
        + _within(data)
        + ".",
        **data,
    )


def _nothing_gained(data: Mapping[str, Any]) -> str:
    return fill_template(
        "Calibration does not improve held-out poses: the nominal geometry predicts them "
        + _within(data)
        + ".",
        **data,
    )


def _within(data: Mapping[str, Any]) -> str:
    if data["chosen"] == data["best"]:
        return "best"
    return "within one standard error of {best} ({best_parameters:count parameter})"


_ERRORS = {"position": (Quantity(1.59, "mm"), Quantity(0.463, "mm")), "orientation": None}
_CHOICE = {"chosen": "lengths", "parameters": 6, "best": "ideal", "best_parameters": 42}

ENTRIES = (
    Entry(
        "model.expected-gain",
        Severity.INFO,
        _expected,
        when="The stated tolerances and the fit predict smaller errors after calibration.",
        example=_ERRORS,
    ),
    Entry(
        "model.no-expected-gain",
        Severity.WARNING,
        _no_gain,
        when="The noise of the measurements is as large as the effect of the tolerances.",
        action="Use a more accurate instrument, or measure more poses.",
        example=_ERRORS,
    ),
    Entry(
        "model.gain-needs-tolerances",
        Severity.INFO,
        f"{NOT_COMPARED}: {{missing:count parameter has/parameters have}} no tolerance. State the "
        "tolerances in the robot file.",
        when="Parameters without a tolerance have no expected error before calibration.",
        action="State the tolerances in the robot file.",
    ),
    Entry(
        "model.gain-needs-consistent-noise",
        Severity.INFO,
        f"{NOT_COMPARED}: the residuals contradict the stated noise.",
        when="The fit fails the test of the stated noise.",
        action="Resolve the contradiction with the noise first.",
    ),
    Entry(
        "model.gain-without-intervals",
        Severity.INFO,
        f"{NOT_COMPARED}: the fit gives no confidence intervals.",
        when="The method gives no covariance, or the robot reaches none of the poses.",
    ),
    Entry(
        "model.simpler-suffices",
        Severity.SUGGESTION,
        _simpler,
        when="Fewer free parameters predict held-out poses as well.",
        action="Free these parameters only.",
        example=_CHOICE,
    ),
    Entry(
        "model.all-needed",
        Severity.INFO,
        "Every simpler model predicts held-out poses worse: keep all "
        "{parameters:count parameter} ({chosen}).",
        when="No smaller set of free parameters predicts held-out poses within one standard error.",
        example=_CHOICE,
    ),
    Entry(
        "model.nothing-gained",
        Severity.WARNING,
        _nothing_gained,
        when="The nominal geometry predicts held-out poses as well as any set of free parameters.",
        action="Keep the nominal geometry, or use a more accurate instrument.",
        example=_CHOICE | {"chosen": "nothing", "parameters": 0},
    ),
    Entry(
        "model.reduced",
        Severity.INFO,
        "{kept} of {total} parameters contain all information of these measurements (condition "
        "{condition}).",
        when="Some parameters have the same effect as combinations of others.",
        action="Fix the others at their nominal values.",
    ),
    Entry(
        "model.not-reducible",
        Severity.INFO,
        "The measurements determine all {total:count parameter}; none can be fixed without loss.",
        when="No parameter has the same effect as a combination of others.",
    ),
    Entry(
        "model.merged-parameter",
        Severity.INFO,
        lambda data: f"Fix {data['name']}: {word_effect(data)}.",
        when="A parameter is left out of a minimal set.",
        action="Fix this parameter at its nominal value.",
        example={
            "name": "a2y",
            "unit": "mm",
            "into": ("a1y", "a3y"),
            "changes": (-1.0, -1.0),
            "units": ("mm", "mm"),
        },
    ),
)


def word_effect(data: Mapping[str, Any], most: int = 8) -> str:
    """Return the effect of a merged parameter in terms of the kept ones, at most `most` of them."""
    if not data["into"]:
        return "it has no effect on the measurements"
    zipped = zip(data["into"], data["changes"], data["units"], strict=True)
    effects = list_names([f"{name} {change:+.4g} {unit}" for name, change, unit in zipped], most)
    return f"1 {data['unit']} of it has the same effect as {effects}"
