# SPDX-License-Identifier: Apache-2.0
# size: a table of messages, one entry after the other
"""Wording of findings about plans: content, certificate, expected errors, and refusals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from loopcal.findings.finding import Severity
from loopcal.findings.wording import Entry, Quantity, fill_template, list_names

SHOWN_REASONS = 3
"""Reasons that a sentence lists, most frequent first."""

REASONS = {
    "loops-open": "the loops cannot be closed",
    "limit-exceeded": "{limit} exceeded",
    "beyond-singularity": "beyond a singularity",
    "near-singularity": "near a singularity (margin below {min_margin} of the median)",
    "tilt-exceeded": "tilt above {max_tilt_deg:.4g} deg",
    "distance-out-of-range": "instrument too near or too far",
    "target-faces-away": "target faces away from the instrument",
    "branch-changed": "the path ends on another branch than the commanded pose",
}
"""Code of a violated constraint -> words."""


def word_reasons(reasons: Sequence[Mapping[str, Any]]) -> str:
    """Return violated constraints with their counts, such as `tilt above 12 deg (34)`."""
    words = []
    for reason in reasons[:SHOWN_REASONS]:
        text = fill_template(REASONS[reason["code"]], **reason)
        place = "no straight path from home: " if reason["on_path"] else ""
        words.append(f"{place}{text} ({reason['count']})")
    return "; ".join([*words, *(["..."] if len(reasons) > SHOWN_REASONS else [])])


def _with_reasons(template: str) -> Any:
    """Return the text of an entry whose template has the field `why` for violated constraints."""

    def text(data: Mapping[str, Any]) -> str:
        return fill_template(template, why=word_reasons(data["reasons"]), **data)

    return text


def _poses(data: Mapping[str, Any]) -> str:
    if data["counted"] == "poses":
        return fill_template(
            "{fitted:count pose} of {robot} for calibration and {held_out} for validation "
            "({kinds:list}).",
            **data,
        )
    return fill_template(
        "{fitted} {counted} for calibration and {held_out} for validation, made of {poses:count "
        "pose} of {robot} ({kinds:list}).",
        **data,
    )


def _path(data: Mapping[str, Any]) -> str:
    via = fill_template("; {via_home:count section} via home", **data) if data["via_home"] else ""
    return f"Path from home through all poses: {data['length']}{via}."


def _certificate(data: Mapping[str, Any]) -> str:
    if data["shortfall"] == 0.0:
        return fill_template(
            "No better choice of {chosen} of the {considered} candidate {counted} exists "
            "(criterion {criterion}).",
            **data,
        )
    return fill_template(
        "The plan is within {shortfall:.1f} % of the best possible choice of {chosen} of the "
        "{considered} candidate {counted} (criterion {criterion}).",
        **data,
    )


def _errors(data: Mapping[str, Any]) -> str:
    parts = [
        f"{list_names(data[name]) or 'none'} {words}"
        for name, words in (
            ("before", "before calibration"),
            ("random", f"with as many random {data['counted']}"),
            ("after", "with this plan"),
        )
        if data[name] is not None
    ]
    gain = ""
    if data["reduction"] is not None and data["reduction"] > 0.0:
        gain = fill_template(" ({target} error {reduction:percent} below random)", **data)
    return f"Expected error over the workspace (rms): {', '.join(parts)}{gain}."


def _curve(data: Mapping[str, Any]) -> str:
    points = "; ".join(
        f"{point['number']}: {' and '.join(map(str, point['errors'])) or 'none'}"
        for point in data["points"]
    )
    return f"Expected errors by number of {data['counted']} (rms): {points}."


def _goal(data: Mapping[str, Any]) -> str:
    text = "{number} {counted} reach an expected {target} error of {goal} (rms). "
    if data["decided_by_equations"]:
        text += "Fewer give fewer equations than there are unknowns."
    else:
        text += "No choice of fewer than {at_least} of the {considered} candidate {counted} can."
    return fill_template(text, **data)


def _candidates(data: Mapping[str, Any]) -> str:
    why = f"; excluded: {word_reasons(data['reasons'])}" if data["reasons"] else ""
    return fill_template("{allowed} of {total} candidate poses are allowed{why}.", why=why, **data)


def _frames(data: Mapping[str, Any]) -> str:
    return fill_template(
        "This instrument does not determine the absolute {frames:list} {noun}. Expected errors are "
        "relative to the frame that the calibration defines.",
        noun="frame" if len(data["frames"]) == 1 else "frames",
        **data,
    )


def _equations(data: Mapping[str, Any]) -> str:
    earlier = " and {earlier} were measured already" if data["earlier"] else ""
    instrument = ", the others of the instrument" if data["unknowns"] > data["parameters"] else ""
    return fill_template(
        "{poses:count pose} give {equations} equations" + earlier + ", but there are {unknowns} "
        "unknowns ({parameters} parameters of {robot}" + instrument + "); plan at least {needed} "
        "poses, or fix parameters of the robot",
        **data,
    )


def _surfaces(data: Mapping[str, Any]) -> str:
    via = fill_template("; {via_home:count section} via home", **data) if data["via_home"] else ""
    return fill_template(
        "{groups:count plane} with a perpendicular line, {points} points each: {poses} poses of "
        "{robot}{via}.",
        via=via,
        **data,
    )


def _target(data: Mapping[str, Any]) -> str:
    moves, other = (
        ("turn", "position")
        if data["target"] == "orientation"
        else ("move its tool", "orientation")
    )
    return fill_template(
        "no {target} error can be predicted: {robot} does not {moves}, or this instrument does not "
        "determine by how much; state the goal for the {other}, or choose another kind of "
        "measurement",
        moves=moves,
        other=other,
        **data,
    )


_TILTED = ({"code": "tilt-exceeded", "max_tilt_deg": 12.0, "on_path": False, "count": 34},)
"""Reasons of the examples."""

INFO, SUGGESTION, REFUSAL = Severity.INFO, Severity.SUGGESTION, Severity.REFUSAL

REPORTS = (
    Entry(
        "plan.poses",
        INFO,
        _poses,
        "Every plan: how many poses it has and for what.",
        example={
            "counted": "poses",
            "fitted": 30,
            "held_out": 8,
            "poses": 38,
            "robot": "hexapod-42",
            "kinds": ("pose",),
        },
    ),
    Entry(
        "plan.path",
        INFO,
        _path,
        "Every plan. A section goes via home where the straight path between two poses is not "
        "allowed.",
        example={"length": Quantity(9.4, "m"), "via_home": 2},
    ),
    Entry(
        "plan.certificate",
        INFO,
        _certificate,
        "Every plan whose efficiency is at least 50 % by the bound of the relaxation. The number "
        "is rounded up.",
        example={
            "shortfall": 1.5,
            "chosen": 30,
            "considered": 800,
            "counted": "poses",
            "criterion": "I",
        },
    ),
    Entry(
        "plan.weak-certificate",
        SUGGESTION,
        "The plan is only guaranteed to be within {shortfall:.1f} % of the best possible choice of "
        "{chosen} of the {considered} candidate {counted} (criterion {criterion}). A much better "
        "plan may exist: try another seed, or more poses.",
        "The bound of the relaxation guarantees an efficiency below 50 %.",
        "Plan with another seed or with more poses and compare the expected errors.",
    ),
    Entry(
        "plan.expected-errors",
        INFO,
        _errors,
        "Every plan: predicted errors over the workspace, from tolerances and noise.",
        example={
            "before": (Quantity(1.59, "mm"),),
            "random": (Quantity(0.61, "mm"),),
            "after": (Quantity(0.463, "mm"),),
            "reduction": 0.24,
            "target": "position",
            "counted": "poses",
        },
    ),
    Entry(
        "plan.error-curve",
        INFO,
        _curve,
        "A curve was requested: expected errors of good plans with fewer and more poses.",
        example={
            "counted": "poses",
            "points": (
                {"number": 20, "errors": (Quantity(0.61, "mm"),)},
                {"number": 40, "errors": (Quantity(0.41, "mm"),)},
            ),
        },
    ),
    Entry(
        "plan.goal-reached",
        INFO,
        _goal,
        "A plan for an accuracy goal: the smallest number found, and a number below which no "
        "choice reaches the goal.",
        example={
            "number": 24,
            "counted": "poses",
            "target": "position",
            "goal": Quantity(0.5, "mm"),
            "decided_by_equations": False,
            "at_least": 22,
            "considered": 800,
        },
    ),
    Entry(
        "plan.candidates",
        INFO,
        _candidates,
        "Every plan: poses that satisfy all constraints, and what excluded the others.",
        "Relax the constraint that excludes most where more poses are needed.",
        example={"allowed": 766, "total": 800, "reasons": _TILTED},
    ),
    Entry(
        "plan.tolerances-missing",
        SUGGESTION,
        "{missing} of {parameters} parameters have no stated tolerance; the plan assumes nothing "
        "about them beforehand.",
        "Parameters of the robot file have no tolerance.",
        "State tolerances in the robot file: known parameters need fewer poses.",
    ),
    Entry(
        "plan.frames-undetermined",
        INFO,
        _frames,
        "The instrument cannot determine rigid motions of a frame.",
        example={"frames": ("base", "platform")},
    ),
    Entry(
        "plan.unobservable",
        INFO,
        "{count} of {parameters} parameter combinations cannot be determined by this instrument at "
        "any pose.",
        "The measurements of all candidates together leave combinations undetermined.",
        "Look at the identifiability for their names, or add a kind of measurement.",
    ),
    Entry(
        "plan.surfaces",
        INFO,
        _surfaces,
        "Every plan of planes and lines: how many poses it has.",
        example={"groups": 3, "points": 5, "poses": 24, "robot": "hexapod-42", "via_home": 0},
    ),
    Entry(
        "plan.surface-information",
        INFO,
        "The groups determine {rank} parameter combinations to {sd_last} of a tolerance (rms); "
        "the random start determined them to {sd_first}.",
        "Every plan of planes and lines.",
    ),
    Entry(
        "plan.readings-are-measured",
        INFO,
        "The actuator readings are the measurement: at each point, move the machine until the "
        "coordinates in the sheet's column 'hold' agree with the sheet. Then record the readings "
        "in the data file.",
        "Every plan of planes and lines.",
    ),
)

REFUSALS = (
    Entry(
        "plan.no-free-parameter",
        REFUSAL,
        "{robot} has no free parameter, so there is nothing to plan for; free one in its file",
        "All parameters of the robot are fixed.",
        "Free the parameters that calibration should identify.",
    ),
    Entry(
        "plan.nothing-observable",
        REFUSAL,
        "measurements of kind {kinds:list} determine none of the {parameters} free parameters of "
        "{robot} at any of {poses} poses; choose another kind",
        "The rows of all candidates are zero up to rounding.",
        "Choose a kind of measurement that depends on the parameters.",
    ),
    Entry(
        "plan.target-unobservable",
        REFUSAL,
        _target,
        "The goal or target is an error that does not occur or cannot be predicted.",
        "Choose another target or another kind of measurement.",
        example={"target": "orientation", "robot": "linear-delta"},
    ),
    Entry(
        "plan.prediction-unobservable",
        REFUSAL,
        "the prediction depends on no observable direction; choose other weights",
        "The weights of criterion I have no part in the directions that the candidates determine.",
        "Predict something that the candidates determine.",
    ),
    Entry(
        "plan.too-few-equations",
        REFUSAL,
        _equations,
        "The requested poses give fewer equations than there are unknowns.",
        "Plan more poses, or fix parameters.",
        example={
            "poses": 5,
            "equations": 30,
            "earlier": 0,
            "unknowns": 48,
            "parameters": 42,
            "robot": "hexapod-42",
            "needed": 8,
        },
    ),
    Entry(
        "plan.design-too-small",
        REFUSAL,
        "{requested} groups give {equations} equations for {unknowns} unknowns; choose at least "
        "{needed}, or state tolerances as prior knowledge",
        "A design has fewer rows than the prior leaves unknowns.",
        "Choose more groups.",
    ),
    Entry(
        "plan.design-singular",
        REFUSAL,
        "the search found no choice of {chosen} of the {available} allowed candidates that "
        "determines all {unknowns} unknowns; ask for more poses, or state tolerances in the robot "
        "file",
        "Every design that the search tried leaves directions undetermined.",
        "Ask for more poses, or state tolerances.",
    ),
    Entry(
        "plan.no-candidate-allowed",
        REFUSAL,
        "none of the {total} candidates is allowed; relax a constraint, or widen the workspace",
        "The constraints exclude every candidate.",
        "Relax a constraint.",
    ),
    Entry(
        "plan.no-direction-observable",
        REFUSAL,
        "the candidates depend on no free parameter; choose another kind of measurement",
        "The rows of all candidates and the prior are zero.",
        "Choose another kind of measurement.",
    ),
    Entry(
        "plan.too-few-candidates",
        REFUSAL,
        "{requested} {what} requested, but only {available} are left to choose from; ask for "
        "fewer, hold out fewer, or relax a constraint",
        "More poses are requested than candidates are allowed.",
        "Ask for fewer poses, draw more candidates, or relax a constraint.",
    ),
    Entry(
        "plan.too-few-held-out",
        REFUSAL,
        "{requested} {counted} for validation requested, but the {candidates} allowed poses give "
        "{available}; hold out fewer, or relax a constraint",
        "There are too few evenly drawn candidates for validation.",
        "Hold out fewer poses.",
    ),
    Entry(
        "plan.goal-unreachable",
        REFUSAL,
        "an expected {target} error of {goal} (rms) is out of reach: {number} {counted} give "
        "{best}, and no choice of so many of the {considered} candidates gives less than {bound}; "
        "use a better instrument, allow more candidates, or relax the goal",
        "Even the largest number of poses does not reach the accuracy goal.",
        "Use a better instrument, or a less demanding goal.",
    ),
    Entry(
        "plan.goal-missed",
        REFUSAL,
        "{number} {counted} chosen by criterion {criterion} do not reach the goal, although "
        "{expected} would suffice by criterion I without held-out poses; hold out fewer, or use "
        "criterion I",
        "Validation poses or criterion D cost so much that the goal is not reached.",
        "Hold out fewer poses, or use criterion I.",
    ),
    Entry(
        "plan.target-impossible",
        REFUSAL,
        "no choice of {size} of the {available} allowed candidates reaches {target:.6g} in "
        "criterion {criterion}: the best possible value is {best:.6g}; allow more groups, a less "
        "demanding target or a better instrument",
        "The bound of the relaxation shows that no design meets the target.",
        "Allow more groups, or relax the target.",
    ),
    Entry(
        "plan.target-not-reached",
        REFUSAL,
        "the search found no choice of {size} of the {available} allowed candidates that reaches "
        "{target:.6g} in criterion {criterion}: the best has {best:.6g}; allow more groups or a "
        "less demanding target",
        "The search found no design that meets the target, although the bound does not exclude it.",
        "Allow more groups, or relax the target.",
    ),
    Entry(
        "plan.listed-poses-excluded",
        REFUSAL,
        _with_reasons(
            "none of the {total} poses listed for {robot} is allowed: {why}; correct the poses, or "
            "relax a constraint"
        ),
        "The constraints exclude every listed pose.",
        "Correct the poses, or relax a constraint.",
        example={"total": 34, "robot": "hexapod-42", "reasons": _TILTED},
    ),
    Entry(
        "plan.home-excluded",
        REFUSAL,
        _with_reasons(
            "home of {robot} is not allowed, and every path starts there: {why}; choose another "
            "home in the robot file, or relax the constraint"
        ),
        "Home itself violates a constraint.",
        "Choose another home, or relax the constraint.",
        example={"robot": "hexapod-42", "reasons": _TILTED},
    ),
    Entry(
        "plan.home-isolated",
        REFUSAL,
        _with_reasons(
            "no pose of {robot} can be reached from home on an allowed straight path: {why}; relax "
            "a constraint, or choose another home in the robot file"
        ),
        "Every straight path from home violates a constraint.",
        "Relax a constraint, or choose another home.",
        example={"robot": "hexapod-42", "reasons": _TILTED},
    ),
    Entry(
        "plan.workspace-excluded",
        REFUSAL,
        _with_reasons(
            "the constraints exclude the workspace of {robot}: {allowed} of {total} poses drawn "
            "from it are allowed; excluded: {why}; relax one of these"
        ),
        "Hardly any pose of the workspace satisfies the constraints.",
        "Relax the constraint that excludes most.",
        example={"robot": "hexapod-42", "allowed": 2, "total": 36, "reasons": _TILTED},
    ),
    Entry(
        "plan.measured-empty",
        REFUSAL,
        "the earlier measurements contain no measured value; fill them in, or leave them out",
        "Measurements that should count as prior information are empty.",
        "Fill in the data file.",
    ),
    Entry(
        "plan.measured-pose-unreachable",
        REFUSAL,
        "{robot} does not reach the measured pose {pose!r} with its readings; correct the "
        "readings, or plan with the calibrated robot",
        "The loops of an earlier measured pose do not close.",
        "Correct the readings of that pose.",
    ),
    Entry(
        "plan.surfaces-not-followed",
        REFUSAL,
        "{robot} is not controlled in {missing:list}, so its tool cannot follow a plane "
        "and a line along the axes of the base; plan for another instrument",
        "Planes and lines need x, y and z among the controlled coordinates.",
        "Plan for another instrument.",
    ),
    Entry(
        "plan.surfaces-out-of-reach",
        REFUSAL,
        "{robot} reaches no group of {points} points on a plane and a line; narrow its workspace, "
        "or plan fewer points in a group",
        "No drawn group is within reach, even near the middle of the workspace.",
        "Narrow the workspace in the robot file, or plan fewer points.",
    ),
    Entry(
        "plan.too-few-groups",
        REFUSAL,
        "{groups:count group} of {points} points give {equations} equations, but {rank} parameter "
        "combinations can be determined; plan at least {needed} groups, or more points",
        "The planes and lines give fewer equations than unknowns.",
        "Plan more groups, or more points in each.",
    ),
    Entry(
        "plan.groups-excluded",
        REFUSAL,
        _with_reasons(
            "the constraints allow only {allowed} of {total} groups of {points} points ({why}); "
            "relax one, narrow the workspace in the robot file, or ask for fewer points"
        ),
        "The constraints exclude almost every group on a plane and a line.",
        "Relax a constraint, or ask for fewer points.",
        example={"allowed": 1, "total": 35, "points": 5, "reasons": _TILTED},
    ),
    Entry(
        "plan.points-isolated",
        REFUSAL,
        _with_reasons(
            "no straight path leads from home to {isolated} of {points} planned points: {why}; "
            "relax a constraint, or plan with another seed"
        ),
        "A planned point on a plane or line cannot be approached from home.",
        "Relax a constraint, or plan with another seed.",
        example={"isolated": 3, "points": 5, "reasons": _TILTED},
    ),
)

ENTRIES = (*REPORTS, *REFUSALS)
