# SPDX-License-Identifier: Apache-2.0
"""The prior: stated tolerances against the data, and an earlier calibration against a later one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from loopcal.findings.finding import Severity
from loopcal.findings.wording import Entry, fill_template

MACHINE = "the machine"
"""Subject of a change where no limb is freed."""


def _conflict(data: Mapping[str, Any]) -> str:
    text = fill_template(
        "The data contradict the stated tolerances: the deviations from nominal are {ratio} times "
        "as large as these allow",
        **data,
    )
    pairs = zip(data["names"], data["deviations"], strict=True)
    far = ", ".join(f"{name} {deviation:+.3g}" for name, deviation in pairs)
    return f"{text} (largest, in tolerances: {far})." if far else f"{text}."


def _inflated(data: Mapping[str, Any]) -> str:
    done = " This fit uses tolerances inflated by a factor of {inflation}."
    return _conflict(data) + fill_template(done, **data)


def _too_narrow(data: Mapping[str, Any]) -> str:
    return (
        f"{_conflict(data)} The estimate is pulled too close to nominal. State wider tolerances or "
        "let the fit inflate them, as the default method does."
    )


def _changed(data: Mapping[str, Any]) -> str:
    text = fill_template(
        "Since the earlier calibration {subject} has changed: chi-square {chi_square:.4g}, "
        "compared with {degrees:.0f} expected from noise.",
        **data,
    )
    if data["parameter"]:
        alone = " A change of {parameter} alone, by {change}, explains most of it."
        text += fill_template(alone, **data)
    elif data["tried"]:
        text += " No single parameter explains the change."
    if data["subject"] != MACHINE:
        return text
    return f"{text} Free the limb that was repaired, or calibrate without the earlier run."


_CONFLICT = {
    "ratio": 4.1,
    "names": ("leg1.length", "leg2.base.x"),
    "deviations": (12.3, -4.5),
    "inflation": 4.3,
    "p_value": 1e-12,
}
_CHANGE = {"subject": MACHINE, "chi_square": 312.4, "degrees": 7.0, "p_value": 1e-12}

ENTRIES = (
    Entry(
        "prior.consistent",
        Severity.INFO,
        "The data agree with the stated tolerances.",
        when="The test of the prior accepts the tolerances.",
    ),
    Entry(
        "prior.untested",
        Severity.INFO,
        "The stated tolerances cannot be tested: the data determine no parameter that has one.",
        when="The test of the prior has no degree of freedom.",
    ),
    Entry(
        "prior.tolerances-inflated",
        Severity.WARNING,
        _inflated,
        when="The data contradict the stated tolerances (p < 0.001), and the method inflates them.",
        action="Check the units and the nominal values of the named parameters, then the "
        "tolerances.",
        example=_CONFLICT,
    ),
    Entry(
        "prior.tolerances-too-narrow",
        Severity.WARNING,
        _too_narrow,
        when="The data contradict the stated tolerances (p < 0.001), and the method keeps them.",
        action="State wider tolerances, or use the default method.",
        example=_CONFLICT | {"inflation": 1.0},
    ),
    Entry(
        "prior.machine-changed",
        Severity.WARNING,
        _changed,
        when="New data contradict an earlier calibration (p < 0.001).",
        action="Free the limb that was repaired or has changed, or calibrate without the earlier "
        "run.",
        example=_CHANGE | {"tried": True, "parameter": "leg3.length", "change": "+0.05 mm"},
    ),
    Entry(
        "prior.machine-unchanged",
        Severity.INFO,
        "Since the earlier calibration {subject} has not changed beyond the noise: chi-square "
        "{chi_square:.4g}, compared with {degrees:.0f} expected from noise.",
        when="New data agree with an earlier calibration.",
        example=_CHANGE | {"chi_square": 6.2, "p_value": 0.5},
    ),
    Entry(
        "prior.change-not-observable",
        Severity.INFO,
        "The new data cannot show whether {subject} has changed since the earlier calibration: "
        "they determine none of its parameters.",
        when="The new data determine none of the parameters in question.",
        action="Measure poses that depend on these parameters.",
    ),
    Entry(
        "prior.change-not-converged",
        Severity.WARNING,
        "The new data cannot show whether {subject} has changed since the earlier calibration: the "
        "fits that compare the two did not converge.",
        when="A fit of the comparison with an earlier calibration did not converge.",
        action="Look for wrong rows in the new data.",
    ),
    Entry(
        "prior.no-uncertainty",
        Severity.REFUSAL,
        "The earlier calibration has no uncertainty (it did not converge, or had too few degrees "
        "of freedom to estimate the noise), so it cannot be a prior. Repeat it with the sigma of "
        "the instrument until it converges.",
        when="An earlier calibration without intervals is used as a prior.",
        action="Repeat the earlier calibration with the sigma of the instrument.",
    ),
    Entry(
        "prior.no-posterior",
        Severity.REFUSAL,
        "The earlier run does not contain a posterior ({array} is missing). Repeat it with this "
        "version.",
        when="A run folder of an old version is used as a prior.",
        action="Repeat the earlier calibration.",
    ),
    Entry(
        "prior.other-count",
        Severity.REFUSAL,
        "The earlier run identified {identified:count parameter}, but its robot file has {free} "
        "free ones. Restore the file or repeat the run.",
        when="The robot file of a run folder was edited.",
        action="Restore the robot file of the run, or repeat the run.",
    ),
    Entry(
        "prior.other-parameters",
        Severity.REFUSAL,
        "{name} is free only in {place}, so the two do not describe the same robot. Free the same "
        "parameters in both.",
        when="An earlier calibration of other parameters is used as a prior.",
        action="Free the same parameters in the robot file and in the earlier run.",
    ),
)
