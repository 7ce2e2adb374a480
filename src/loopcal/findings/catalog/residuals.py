# SPDX-License-Identifier: Apache-2.0
"""Residuals: repeated poses, start values, correlated estimates, prediction, stored geometry."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from loopcal.findings.finding import Severity
from loopcal.findings.wording import Entry, fill_template, list_names, round_to_digits


def _correlated(data: Mapping[str, Any]) -> str:
    """Word a group of correlated parameters; of more than two the strongest pair is named."""
    pair = "" if len(data["names"]) == 2 else f" between {' and '.join(data['pair'])}"
    return (
        f"{list_names(data['names'])} are strongly correlated ({data['correlation']:+.2f}{pair}): "
        "judge them together."
    )


def _ratio(data: Mapping[str, Any]) -> str:
    """Word how much larger the residuals of the start are than those of the fit."""
    if data["ratio"] is None:
        return "the fit leaves no residual"
    return f"its residuals are {round_to_digits(data['ratio'])} times the fitted ones"


def _start(template: str) -> Any:
    return lambda data: fill_template(template, ratio=_ratio(data))


def _moved_parameters(data: Mapping[str, Any]) -> str:
    moved = [
        f"{name} {stored:.4f} -> {best:.4f} {unit}" for name, stored, best, unit in data["moved"]
    ]
    return fill_template(
        "The stored geometry is not the optimum of the firmware's cost: {stored:.4f} mm^2 instead "
        "of {best:.4f} mm^2 ({moved:list}). It was changed afterwards or fitted to other probes; "
        "calibrate again before using it.",
        stored=data["stored"],
        best=data["best"],
        moved=moved,
    )


_RATIO = {"ratio": 71.9}

ENTRIES = (
    Entry(
        "residuals.lack-of-fit",
        Severity.WARNING,
        "Residuals are {ratio} times the repeatability: the geometric model does not explain these "
        "data. Free more parameters, or look for effects such as load, temperature or backlash.",
        when="Repeated poses agree much better with each other than with the fit.",
        action="Free more parameters, or look for effects that are not geometric.",
    ),
    Entry(
        "residuals.explained",
        Severity.INFO,
        "The geometric model explains the data within their repeatability.",
        when="Repeated poses differ from each other as much as from the fit.",
    ),
    Entry(
        "residuals.repeatability-larger",
        Severity.WARNING,
        "Repeated poses differ by {scale} times the stated sigma. Check the stated noise.",
        when="Repeated poses scatter more than the stated noise explains.",
        action="State a larger sigma, or find out why the poses do not repeat.",
    ),
    Entry(
        "residuals.repeatability-smaller",
        Severity.INFO,
        "Repeated poses differ by only {scale} of the stated sigma, which is probably too large.",
        when="Repeated poses scatter less than the stated noise.",
        action="State a smaller sigma if it is that of the instrument and the machine together.",
    ),
    Entry(
        "residuals.no-repeats",
        Severity.INFO,
        "No pose was measured twice, so an error of the model cannot be separated from noise. "
        "Repeat some poses.",
        when="The data contain no repeated pose.",
        action="Repeat some poses in the next measurement.",
    ),
    Entry(
        "residuals.repeats-with-uncertain-readings",
        Severity.INFO,
        "Repeated poses cannot be compared: the actuator readings are uncertain, so equal readings "
        "do not mean equal poses.",
        when="The actuator readings have a sigma.",
    ),
    Entry(
        "residuals.repeats-with-weights",
        Severity.INFO,
        "The model cannot be tested against repeated poses, because a robust loss changed the "
        "weights. Fit without a loss for this test.",
        when="A robust loss gave poses less weight.",
        action="Exclude wrong poses and fit without a loss.",
    ),
    Entry(
        "residuals.repeats-only",
        Severity.INFO,
        "The model cannot be tested against repeated poses: no degree of freedom remains besides "
        "the repeats, or the repeats are identical. Measure more different poses.",
        when="All degrees of freedom are repeats, or repeats are equal to the last digit.",
        action="Measure more different poses.",
    ),
    Entry(
        "residuals.start-not-comparable",
        Severity.INFO,
        "The nominal geometry cannot be compared with a best fit, because the iteration did not "
        "converge.",
        when="The fit did not converge.",
    ),
    Entry(
        "residuals.start-is-best",
        Severity.INFO,
        "The nominal geometry is already the best fit to these data.",
        when="The fit did not reduce the residuals of the geometry in the robot file.",
    ),
    Entry(
        "residuals.start-not-calibrated",
        Severity.INFO,
        _start("The nominal geometry does not match these data within the noise: {ratio}."),
        when="The fit reduced the residuals by more than the noise explains.",
        action="Use the calibrated geometry.",
        example=_RATIO,
    ),
    Entry(
        "residuals.start-needs-sigma",
        Severity.INFO,
        _start(
            "The nominal geometry cannot be compared with the fit ({ratio}): too few degrees of "
            "freedom remain to estimate the noise. State the sigma of the instrument, or measure "
            "more poses."
        ),
        when="Too few degrees of freedom estimate the noise.",
        action="State the sigma of the instrument, or measure more poses.",
        example=_RATIO,
    ),
    Entry(
        "residuals.start-undecided",
        Severity.INFO,
        _start(
            "The nominal geometry cannot be compared with the fit ({ratio}): the residuals of both "
            "contradict the stated noise. Check the stated noise and outliers first."
        ),
        when="The residuals of the fit contradict the stated noise.",
        action="Resolve the contradiction with the noise first.",
        example=_RATIO,
    ),
    Entry(
        "residuals.start-within-noise",
        Severity.INFO,
        _start(
            "The nominal geometry matches these data as well as the fit does, within the noise "
            "({ratio})."
        ),
        when="The gain of the fit over the geometry in the robot file is within the noise.",
        action="Measure with a better instrument or at more poses to improve on it.",
        example={"ratio": 1.12},
    ),
    Entry(
        "residuals.correlated-parameters",
        Severity.INFO,
        _correlated,
        when="Errors of estimated parameters are correlated by more than 0.9.",
        action="Judge these parameters together, or measure poses that separate them.",
        example={
            "names": ("leg1.base.z", "leg1.length"),
            "pair": ("leg1.base.z", "leg1.length"),
            "correlation": 0.94,
        },
    ),
    Entry(
        "residuals.no-rows-to-predict",
        Severity.REFUSAL,
        "The held-out data contain no usable row: every row is absent or has weight 0. Fill in the "
        "measured values.",
        when="The held-out data contain no usable row.",
        action="Fill in the measured values.",
    ),
    Entry(
        "residuals.readings-missing",
        Severity.REFUSAL,
        "None of the {poses:count pose} has all readings from which {robot} can be predicted. Give "
        "the readings with a finite sigma.",
        when="The actuator readings that determine a pose are missing or have an infinite sigma.",
        action="Give the readings with a finite sigma.",
    ),
    Entry(
        "residuals.poses-out-of-reach",
        Severity.REFUSAL,
        "{robot} reaches none of the {poses:count pose}. Check the readings and their units.",
        when="The forward kinematics of the geometry before calibration fails at every pose.",
        action="Check the readings and their units.",
    ),
    Entry(
        "residuals.calibrated-out-of-reach",
        Severity.REFUSAL,
        "No pose of {robot} is reached by both geometries. With these readings the geometry before "
        "calibration reaches {before} of {poses:count pose}, the calibrated one {after}. Do not "
        "use this calibration; check the stated frames and the noise.",
        when="No pose is reached by both geometries.",
        action="Do not use this calibration; check the stated frames and the noise.",
    ),
    Entry(
        "residuals.stored-is-optimum",
        Severity.INFO,
        "The stored geometry is the optimum of the firmware's cost ({stored:.4g} mm^2).",
        when="The geometry that a delta printer stored minimizes the cost of its firmware.",
        example={"stored": 0.0123, "best": 0.0123},
    ),
    Entry(
        "residuals.stored-not-optimum",
        Severity.WARNING,
        _moved_parameters,
        when="Another geometry has a smaller cost on the stored probes.",
        action="Calibrate again before using the stored geometry.",
        example={"stored": 0.0512, "best": 0.0123, "moved": (("radius", 101.2, 101.5, "mm"),)},
    ),
)
