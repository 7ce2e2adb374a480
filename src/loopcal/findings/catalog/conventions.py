# SPDX-License-Identifier: Apache-2.0
"""Conventions of measurements: units, orders, signs and columns that are not what the file states.

Every slip has a phrase ("lengths are 1000 times larger ...") and a correction. A check of
conventions reports the slips whose correction fits the data far better.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from loopcal.findings.finding import Severity
from loopcal.findings.wording import Entry, fill_template, list_names

UNITS_WRITTEN: Mapping[tuple[str, str], str] = {
    ("length", "1e+03"): "m written as mm, or mm as um",
    ("length", "0.001"): "mm written as m, or um as mm",
    ("length", "25.4"): "inches written as mm",
    ("length", "0.0394"): "mm written as inches",
    ("length", "10"): "cm written as mm",
    ("length", "0.1"): "mm written as cm",
    ("angle", "57.3"): "rad written as deg",
    ("angle", "0.0175"): "deg written as rad",
    ("angle", "1e+03"): "rad written as mrad",
    ("angle", "0.001"): "mrad written as rad",
    ("angle", "17.5"): "deg written as mrad",
    ("angle", "0.0573"): "mrad written as deg",
    ("angle", "60"): "deg written as arcmin",
    ("angle", "0.0167"): "arcmin written as deg",
    ("angle", "0.9"): "gon written as deg",
    ("angle", "1.11"): "deg written as gon",
}
"""From dimension and factor to the slip that causes it."""

SLIPS: Mapping[str, tuple[str, str, Mapping[str, Any]]] = {
    "unit": (
        "{quantity}{of} {times} ({written})",
        "Correct the unit in the header.",
        {"quantity": "lengths", "dimension": "length", "factor": 1e-3},
    ),
    "scalar-last": ("quaternions{of} with the scalar last", "Write the scalar first.", {}),
    "orientation-form": (
        "rotations{of} read as {form}",
        "Write 'orientation: {form}' in the settings of the data file.",
        {"form": "euler-zyx"},
    ),
    "inverted-rotations": (
        "rotations{of} inverted",
        "Write rotations of the tool in the frame, not of the frame in the tool.",
        {},
    ),
    "inverted-poses": (
        "poses{of} inverted",
        "Write poses of the tool in the frame, not of the frame in the tool.",
        {},
    ),
    "left-handed-frame": (
        "a left-handed frame{of} ({axis} reversed)",
        "Reverse the {axis} axis of the instrument's frame.",
        {"axis": "y"},
    ),
    "sign": (
        "{column}{of} with the opposite sign",
        "Reverse the sign of {column}.",
        {"column": "z"},
    ),
    "angle-signs": ("all angles{of} with the opposite sign", "Reverse the sign of the angles.", {}),
    "zenith-angles": (
        "elevations{of} read as zenith angles",
        "Write elevations above the horizontal.",
        {},
    ),
    "swapped-columns": (
        "columns {columns:list}{of} swapped",
        "Swap their headers.",
        {"columns": ("x", "y")},
    ),
    "swapped-targets": (
        "targets {targets:list}{of} swapped",
        "Swap their headers.",
        {"targets": ("a", "b")},
    ),
    "reading-sign": (
        "readings of {actuators:list} with the opposite sign",
        "Reverse the sign of these readings, or the direction of the actuator in the robot file.",
        {"actuators": ("q1",)},
    ),
    "swapped-readings": (
        "readings of {actuators:list} swapped",
        "Swap their headers.",
        {"actuators": ("q1", "q2")},
    ),
    "reversed-readings": (
        "readings in the opposite order",
        "Reverse the order of their headers.",
        {},
    ),
    "shifted-readings": (
        "readings taken from the row {neighbor}",
        "Move the columns of the readings by one row.",
        {"neighbor": "below"},
    ),
}
"""From a slip to its phrase, its correction, and data of one case."""


def word_slip(slip: str, data: Mapping[str, Any]) -> str:
    """Return the phrase of a slip, such as `lengths 1000 times larger (m written as mm)`."""
    details = dict(data)
    details["of"] = f" of {data['source']}" if data.get("source") else ""
    if slip == "unit":
        factor = data["factor"]
        larger, times = ("larger", factor) if factor > 1.0 else ("smaller", 1.0 / factor)
        details["times"] = (
            f"{times:.4g} times {larger}" if times > 100.0 else (f"{times:.3g} times {larger}")
        )
        details["written"] = UNITS_WRITTEN[data["dimension"], f"{factor:.3g}"]
    return fill_template(SLIPS[slip][0], **details)


def _word_slip_of(code: Mapping[str, Any]) -> str:
    """Return the phrase of a slip from its data with its code."""
    return word_slip(code["code"].removeprefix("conventions."), code)


def _misfit(residuals: Sequence[Any], misfit: float) -> str:
    """Word residuals, and how they compare with tolerances and noise."""
    remain = list_names(residuals)
    return f"{remain} (rms), {_times(misfit)} times what tolerances and noise allow"


def _times(factor: float) -> str:
    """Return a factor with two digits, or in full where it is large."""
    return f"{factor:.2g}" if factor < 100.0 or factor >= 1e6 else f"{factor:.0f}"


def _stated(data: Mapping[str, Any]) -> str:
    """Word the misfit of the data as they are written."""
    if data["reached"] is not None:
        return fill_template(
            "the robot reaches only {reached} of {poses} tested poses with these readings", **data
        )
    return f"residuals are {_misfit(data['residuals'], data['misfit'])}"


def _other_interpretation(data: Mapping[str, Any]) -> str:
    slip = data["interpretation"]
    text = f"The data do not fit robot {data['robot']!r} as written: {_stated(data)}."
    others = ""
    if data["alternatives"]:
        others = (
            f" Equally good: {list_names([_word_slip_of(a) for a in data['alternatives']], 2)}."
        )
    phrase = _word_slip_of(slip)
    if data["is_consistent"]:
        remain = list_names(data["other_residuals"])
        correction = SLIPS[slip["code"].removeprefix("conventions.")][1]
        return (
            f"{text} With {phrase} they fit: residuals are {remain}, as tolerances and noise allow."
            f"{others} {fill_template(correction, **slip)}"
        )
    return (
        f"{text} The best other interpretation tested, {phrase}, leaves "
        f"{_misfit(data['other_residuals'], data['other_misfit'])}, so there is another error as "
        f"well.{others} Check the conventions of these columns first."
    )


def _unexplained(data: Mapping[str, Any]) -> str:
    return (
        f"The data do not fit robot {data['robot']!r}: {_stated(data)}. No tested change of one "
        "unit, order, sign or column fits far better. Check the noise, the tolerances and "
        "dimensions of the robot, and that the data belong to this robot."
    )


def _contradiction(data: Mapping[str, Any]) -> str:
    values = [
        fill_template("{name} at {estimated}, not at {stated} ({certainty})", **value)
        for value in data["values"]
    ]
    remain = list_names(data["residuals"])
    fit = (
        f"{remain}, as tolerances and noise allow"
        if data["is_consistent"]
        else _misfit(data["residuals"], data["other_misfit"])
    )
    return fill_template(
        "The data contradict the stated setup parameters: they put {values:list}. As stated, "
        "residuals are {times} times what tolerances and noise allow; with {names:list} "
        "estimated from the data they are {fit}. Correct or remove the statement.",
        **{
            **data,
            "values": values[:3] + ["others"] * (len(values) > 3),
            "fit": fit,
            "times": _times(data["misfit"]),
        },
    )


_STATED = {
    "robot": "hexapod-42",
    "misfit": 1230.0,
    "residuals": ("190 mm",),
    "reached": None,
    "poses": 40,
}
_VALUE = {"name": "frame.x", "estimated": "100 mm", "stated": "1500 mm", "certainty": "sd 1 mm"}


def _slip_entry(slip: str) -> Entry:
    _, correction, example = SLIPS[slip]
    return Entry(
        f"conventions.{slip}",
        Severity.SUGGESTION,
        lambda data: word_slip(slip, data),
        when="The data fit far better when they are read in this way.",
        action=fill_template(correction, **example),
        example={"source": "", **example},
    )


ENTRIES = (
    Entry(
        "conventions.other-interpretation",
        Severity.REFUSAL,
        _other_interpretation,
        when="The data contradict the robot as written, and fit far better in another unit, order, "
        "sign or column.",
        action="Correct the file as the message says.",
        example=_STATED
        | {
            "interpretation": {
                "code": "conventions.unit",
                "source": "",
                "quantity": "lengths",
                "dimension": "length",
                "factor": 1e-3,
            },
            "alternatives": (),
            "other_misfit": 1.1,
            "other_residuals": ("0.19 mm",),
            "is_consistent": True,
        },
    ),
    Entry(
        "conventions.unexplained",
        Severity.WARNING,
        _unexplained,
        when="The data contradict the robot as written, and no tested interpretation fits far "
        "better.",
        action="Check the noise, the robot and whether the data belong to it.",
        example=_STATED,
    ),
    Entry(
        "conventions.rows-far-off",
        Severity.WARNING,
        "{count} of {rows} compared rows are far off the others (poses {poses:list}). Check their "
        "units, signs and readings; they are still part of the data.",
        when="A few rows contradict all others before any fit.",
        action="Check these rows; correct or exclude them.",
    ),
    Entry(
        "conventions.stated-values-contradicted",
        Severity.WARNING,
        _contradiction,
        when="Frames, targets or surfaces have stated values or standard deviations that the data "
        "contradict.",
        action="Correct or remove the statement.",
        example={
            "values": (_VALUE,),
            "names": ("frame.x",),
            "misfit": 340.0,
            "other_misfit": 1.1,
            "residuals": ("0.19 mm",),
            "is_consistent": True,
        },
    ),
    Entry(
        "conventions.target-never-moves",
        Severity.REFUSAL,
        "{target!r} of kind {kind!r} never moves: its readings stay within {moved}, but the robot "
        "moves it by {expected}. Check that the target is mounted on the platform and that the "
        "column contains its readings.",
        when="The readings of a target stay within the noise although the robot moves it.",
        action="Check that the target is mounted on the platform and that the column contains its "
        "readings.",
    ),
    *(_slip_entry(slip) for slip in SLIPS),
)
