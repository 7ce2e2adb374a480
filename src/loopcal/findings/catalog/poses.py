# SPDX-License-Identifier: Apache-2.0
"""Findings about poses, uncertain readings, setup parameters and the descent of a fit."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from loopcal.findings.finding import Severity
from loopcal.findings.wording import Entry, Quantity, fill_template, list_names

SHOWN_READINGS = 3
"""Readings that a sentence names before it counts the others."""


def _list_readings(data: Mapping[str, Any]) -> str:
    """Return `q1 at pose 7 (12.5 mm), ...` of estimated readings."""
    words = [f"{r['actuator']} at pose {r['pose']} ({r['value']})" for r in data["readings"]]
    return list_names(words, SHOWN_READINGS)


def _word_outside_stroke(data: Mapping[str, Any]) -> str:
    return fill_template(
        "Estimated readings lie outside the stroke: {shown}. Measure more at these poses, or "
        "exclude them from the fit.",
        shown=_list_readings(data),
    )


def _word_other_branch(data: Mapping[str, Any]) -> str:
    return fill_template(
        "Estimated readings lie on another branch than that of home: {shown}. Measurements at the "
        "platform fit both branches. If the machine was on the branch of home, state an "
        "approximate reading with an infinite sigma as a start.",
        shown=_list_readings(data),
    )


def _word_unobservable(data: Mapping[str, Any]) -> str:
    one = len(data["names"]) == 1
    return fill_template(
        "The measurements cannot determine {names:list}{separately}, even for a known robot. "
        "Measure more different poses, or state {which} in the data file.",
        names=data["names"],
        separately="" if one else " separately",
        which="this setup parameter" if one else "these setup parameters",
    )


ENTRIES: tuple[Entry, ...] = (
    Entry(
        "poses.undetermined",
        Severity.WARNING,
        "The measurements and readings do not determine {n:count pose}: {poses:list}. Measure more "
        "there, or exclude them from the fit.",
        "A pose of uncertain or missing readings has a direction that no measurement determines.",
        "Measure more at these poses, or exclude them.",
    ),
    Entry(
        "poses.not-converged",
        Severity.WARNING,
        "The estimation of poses and true readings did not converge. Check measurements and "
        "readings for gross errors.",
        "The iteration for the poses of uncertain readings ended without converging.",
        "Check measurements and readings for gross errors.",
    ),
    Entry(
        "poses.outside-stroke",
        Severity.WARNING,
        _word_outside_stroke,
        "The estimate of a reading that was not taken lies outside the stroke of its actuator.",
        "Measure more at these poses, or exclude them from the fit.",
        example={"readings": ({"actuator": "q1", "pose": "7", "value": Quantity(612.5, "mm")},)},
    ),
    Entry(
        "poses.other-branch",
        Severity.WARNING,
        _word_other_branch,
        "The estimate of a reading that was not taken belongs to another branch than home's.",
        "If the machine was on the branch of home, state an approximate reading with infinite "
        "sigma as a start.",
        example={"readings": ({"actuator": "q1", "pose": "7", "value": Quantity(12.5, "deg")},)},
    ),
    Entry(
        "poses.uneven-sigmas",
        Severity.WARNING,
        "The stated standard deviations differ by a factor of {ratio}. Information of the less "
        "precise measurements is lost in rounding and counts as not determined. Check the "
        "smallest sigma, that of {smallest}.",
        "Sigmas of measurements and readings differ by more than double precision resolves.",
        "Check the smallest sigma.",
    ),
    Entry(
        "poses.chain-too-long",
        Severity.REFUSAL,
        "Measurements link {poses:count pose} with uncertain readings to one chain with {unknowns} "
        "unknowns; at most {allowed} can be estimated together. Link fewer poses, or state these "
        "readings as exact (sigma 0).",
        "Measurements that compare poses form too long a chain of poses with uncertain readings.",
        "Link fewer poses, or state the readings as exact.",
    ),
    Entry(
        "poses.shared-actuators",
        Severity.REFUSAL,
        "{robot} has redundant actuators that drive several limbs each, so that noise of their "
        "readings cannot be estimated. Give each limb an actuator of its own.",
        "Readings of redundant actuators that drive several limbs are stated to be uncertain.",
        "Give each limb an actuator of its own.",
    ),
    Entry(
        "poses.closure-start-uncertain-readings",
        Severity.INFO,
        "The fit began with the kinematics: a start from linearized closure needs exact readings.",
        "A start from linearized closure was requested for uncertain readings.",
    ),
    Entry(
        "poses.closure-start-incomplete-poses",
        Severity.INFO,
        "The fit began with the kinematics: a start from linearized closure needs one kind that "
        "measures all poses in full, in a known frame, of a robot with six freedoms and no passive "
        "joints.",
        "A start from linearized closure was requested for data that do not allow it.",
    ),
    Entry(
        "setup.unobservable",
        Severity.WARNING,
        _word_unobservable,
        "Frames, targets, surfaces or offsets have a direction that no measurement determines, "
        "even for a known robot.",
        "Measure more different poses, or state these setup parameters in the data file.",
        example={"names": ("tracker", "target")},
    ),
)
