# SPDX-License-Identifier: Apache-2.0
"""Checks of measurements before they are fitted."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from loopcal.findings.finding import Severity
from loopcal.findings.wording import Entry, fill_template


def _word_outside_stroke(data: Mapping[str, Any]) -> str:
    text = fill_template(
        "pose {pose!r}: {actuator} reads {reading} {unit}, outside its stroke of {lower} to "
        "{upper} {unit}",
        **data,
    )
    count = data["count"]
    others = f" ({count} readings are outside)" if count > 1 else ""
    return f"{text}{others}; correct the reading, its unit, or the stroke"


def _word_duplicate(data: Mapping[str, Any]) -> str:
    places = data["places"]
    where = f" ({places[0]} and {places[1]})" if places else ""
    return fill_template(
        f"poses {{poses[0]!r}} and {{poses[1]!r}}{where} have the same readings and the same "
        "{kind} values to the last digit; remove one of them",
        **data,
    )


ENTRIES = (
    Entry(
        "data.wrong-actuator-count",
        Severity.REFUSAL,
        "the readings have {columns:count column}, but {robot!r} has {actuators_count:count "
        "actuator}: {actuators:list}; give one column for each actuator",
        "The number of columns of the readings is not that of the actuators.",
        "Give one reading for each actuator.",
    ),
    Entry(
        "data.outside-stroke",
        Severity.REFUSAL,
        _word_outside_stroke,
        "A reading is outside the stroke that the robot file states for its actuator.",
        "Correct the reading, its unit or the stroke.",
        example={
            "pose": "7",
            "actuator": "q2",
            "reading": "612.5",
            "lower": "300",
            "upper": "600",
            "unit": "mm",
            "count": 3,
        },
    ),
    Entry(
        "data.duplicate-rows",
        Severity.REFUSAL,
        _word_duplicate,
        "A row repeats another row to the last digit: readings, kind and values are the same.",
        "Remove one of the two rows.",
        example={"poses": ("3", "7"), "kind": "pose", "places": ("a.csv:4", "a.csv:8")},
    ),
)
