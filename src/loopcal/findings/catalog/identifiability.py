# SPDX-License-Identifier: Apache-2.0
"""Identifiability: what measurements determine before a fit, and which further ones would help."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from loopcal.findings.catalog.fit import list_changes
from loopcal.findings.finding import Severity
from loopcal.findings.wording import Entry, fill_template, list_names

MOST_ALTERNATIVES = 4
"""Alternative measurements that a sentence lists; the others are counted."""


def _frame_moves(data: Mapping[str, Any]) -> str:
    """Word a rigid motion of a frame: rotation, translation, or both about one axis."""
    frame, axis = data["frame"], data["axis"]
    if data["motion"] == "translation":
        effect = f"shifting the {frame} frame along {axis}"
    else:
        through = "" if data["through_origin"] else "an axis parallel to "
        effect = f"rotating the {frame} frame about {through}{axis}"
        effect += " and shifting it along that axis" if data["motion"] == "screw" else ""
    return f"Equivalent to {effect} (gauge freedom)"


def _compared(data: Mapping[str, Any]) -> str:
    if not data["excluded"]:
        return fill_template(
            "Errors of {parameters:count parameter}; the data determine all of them.", **data
        )
    excluded = [list_changes(c["names"], c["changes"], c["units"]) for c in data["excluded"]]
    return fill_template(
        "Errors of {parameters:count parameter} in the {compared:count direction} that the data "
        "determine; excluded because the data do not determine them: {excluded}.",
        **{**data, "excluded": "; ".join(excluded)},
    )


def _suggestion(data: Mapping[str, Any]) -> str:
    first = data["measurements"][0]
    text = fill_template(
        "Measure {words} as well to determine {names:list} ({name} to {left:.2g} of its tolerance "
        "from {poses} poses).",
        words=first["words"],
        names=data["names"],
        name=data["names"][0],
        left=first["left"],
        poses=data["poses"],
    )
    others = [one["words"] for one in data["measurements"][1:]]
    return f"{text} Alternatives: {list_names(others, MOST_ALTERNATIVES)}." if others else text


def _no_suggestion(data: Mapping[str, Any]) -> str:
    which = "it" if len(data["names"]) == 1 else "one of them"
    return (
        f"None of the tested kinds of measurement determines {list_names(data['names'])}: fix "
        f"{which} at its nominal value."
    )


def _missing_equations(data: Mapping[str, Any]) -> str:
    combinations = [
        list_changes(c["names"], c["changes"], c["units"]) for c in data["combinations"]
    ]
    text = f"The data do not determine: {'; '.join(combinations)}."
    if data["measurement"]:
        return f"{text} Measure {data['measurement']} as well."
    return f"{text} No single kind of measurement among those tested determines all of it."


_COMBINATION = {"names": ("a1y", "a2y"), "changes": (1.0, 1.0), "units": ("mm", "mm")}
_MOTION = {"frame": "platform", "motion": "rotation", "axis": "z", "through_origin": True}
_MEASUREMENTS = ({"words": "psi", "kind": "component", "left": 0.061},)

ENTRIES = (
    Entry(
        "identifiability.rank",
        Severity.INFO,
        "{equations:count equation} determine {rank} of {parameters:count parameter combination}.",
        when="Every analysis of identifiability.",
    ),
    Entry(
        "identifiability.spectrum",
        Severity.INFO,
        "Condition {condition}; singular values {largest} to {smallest} ({scaling}). Values below "
        "{tolerance:.0e} of the largest count as zero.",
        when="Every analysis of identifiability.",
    ),
    Entry(
        "identifiability.improved",
        Severity.INFO,
        "{improved} of {parameters:count direction} become better known than their tolerance.",
        when="Every analysis of identifiability.",
    ),
    Entry(
        "identifiability.gap",
        Severity.INFO,
        "Smallest singular values that count: {counted:list}. Largest that count as zero: "
        "{cut:list}, smaller by a factor of {gap:.1e}.",
        when="The data do not determine all parameter combinations.",
    ),
    Entry(
        "identifiability.more-weak-directions",
        Severity.INFO,
        "{count:count more direction is/more directions are} known no better than the tolerances.",
        when="More directions are weak than are listed.",
    ),
    Entry(
        "identifiability.no-motion",
        Severity.INFO,
        "No pose depends on it",
        when="A combination of parameters moves the platform at no pose.",
        action="Fix one of these parameters.",
    ),
    Entry(
        "identifiability.frame-moves",
        Severity.INFO,
        _frame_moves,
        when="A combination of parameters moves a frame rigidly and changes no dimension.",
        action="Nothing, if accuracy relative to that frame matters.",
        example=_MOTION,
    ),
    Entry(
        "identifiability.both-frames-move",
        Severity.INFO,
        "Equivalent to moving the base and platform frames (gauge freedom)",
        when="A combination of parameters is a rigid motion of both frames.",
        action="Nothing, if accuracy relative to these frames matters.",
    ),
    Entry(
        "identifiability.compared-with-truth",
        Severity.INFO,
        _compared,
        when="Estimated parameters are compared with true ones.",
        example={"parameters": 42, "compared": 41, "excluded": (_COMBINATION,)},
    ),
    Entry(
        "identifiability.measure-also",
        Severity.SUGGESTION,
        _suggestion,
        when="A further kind of measurement determines a combination that these data do not.",
        action="Add this measurement.",
        example={"names": ("a1y", "a2y"), "measurements": _MEASUREMENTS, "poses": 24},
    ),
    Entry(
        "identifiability.fix-one",
        Severity.SUGGESTION,
        _no_suggestion,
        when="No tested kind of measurement determines a combination that these data do not.",
        action="Fix one of the parameters at its nominal value.",
        example={"names": ("thB1z",)},
    ),
    Entry(
        "identifiability.known-frames-assumed",
        Severity.INFO,
        "Suggested measurements are assumed to be made in a known frame (a datum on the base) "
        "unless they are called unknown.",
        when="Further measurements are suggested.",
    ),
    Entry(
        "identifiability.missing-equations",
        Severity.SUGGESTION,
        _missing_equations,
        when="There are fewer equations than free parameters.",
        action="Measure more, or fix parameters.",
        example={"combinations": (_COMBINATION,), "measurement": "psi"},
    ),
)
