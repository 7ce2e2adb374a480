# SPDX-License-Identifier: Apache-2.0
"""The fit: how the iteration ended, what the data determine, which poses count, what is refused."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from loopcal.findings.finding import Severity
from loopcal.findings.wording import Entry, fill_template, list_names

MOST_PARTS, MOST_WEAK_PARTS = 8, 4
"""Parameters of a combination that a sentence lists, and of one that is only hardly observable."""

EQUAL = 1e-6
"""Relative difference up to which two changes are equal."""


def list_changes(
    names: Sequence[str], changes: Sequence[float], units: Sequence[str], most: int = MOST_PARTS
) -> str:
    """Return the parameters of a combination, each with its change: `a +1 mm and b -0.5 mm`.

    Equal changes in one unit are `a, b and minus c, in equal parts`.
    """
    if len(set(units)) == 1 and all(abs(abs(change) - 1.0) < EQUAL for change in changes):
        signed = [n if c > 0.0 else f"minus {n}" for n, c in zip(names, changes, strict=True)]
        return f"{list_names(signed, most)}, in equal parts"
    zipped = zip(names, changes, units, strict=True)
    return list_names([f"{n} {c:+.4g} {u}" for n, c, u in zipped], most)


def _unidentifiable(data: Mapping[str, Any]) -> str:
    if len(data["names"]) == 1:
        text = f"The data cannot determine {data['names'][0]}: it changes no measured value."
    else:
        parts = list_changes(data["names"], data["changes"], data["units"])
        text = f"The data cannot determine a combination of parameters: {parts}."
    if data["meaning"]:
        text += f" {data['meaning'][0].upper()}{data['meaning'][1:].rstrip('.')}."
    if data["nuisance"]:
        text += f" It cannot be separated from {list_names(data['nuisance'])}."
    return text


def _hardly_observable(data: Mapping[str, Any]) -> str:
    names, sigma = data["names"], data["singular_value"]
    if len(names) == 1:
        template = "A change of {name} by its tolerance is only {sigma:.2g} sigma of the noise: "
        return fill_template(template + "hardly observable.", name=names[0], sigma=sigma)
    parts = list_changes(names, data["changes"], data["units"], MOST_WEAK_PARTS)
    template = "A change of one tolerance along {parts} is only {sigma:.2g} sigma of the noise: "
    return fill_template(template + "hardly observable.", parts=parts, sigma=sigma)


def _too_few_equations(data: Mapping[str, Any]) -> str:
    kind = "parameters without a tolerance" if data["has_prior"] else "parameters"
    setup = "a setup parameter" if data["nuisance"] == 1 else "setup parameters"
    setup = f", {{nuisance}} of them {setup} (frames, targets, surfaces, offsets)"
    return fill_template(
        "{equations:count equation} from {poses:count pose} cannot determine {unknowns} "
        + kind
        + (setup if data["nuisance"] else "")
        + ". Measure at least {poses_needed} poses like these (better twice as many), fix "
        "parameters, or state their tolerances and use a method with a prior (MAP).",
        **data,
    )


def _low_weights(data: Mapping[str, Any]) -> str:
    which = "this pose" if data["count"] == 1 else "these poses"
    return fill_template(
        "{loss} reduced the weight of {count} of {total} poses to less than half: {poses:list}. "
        f"Check {which}.",
        **data,
    )


_COMBINATION = {
    "names": ("leg1.base.x", "leg2.base.x"),
    "changes": (1.0, -0.5),
    "units": ("mm", "mm"),
    "singular_value": 0.0,
    "meaning": "Equivalent to shifting the base frame along x",
    "nuisance": ("tracker",),
}

ENTRIES = (
    Entry(
        "fit.converged",
        Severity.INFO,
        "The iteration converged in {iterations:count step}.",
        when="Every fit that converged.",
    ),
    Entry(
        "fit.out-of-iterations",
        Severity.FAILURE,
        "The iteration did not converge in {iterations:count step}, so these values are no "
        "estimate. Allow more steps or start closer to the solution.",
        when="The iteration used all allowed steps.",
        action="Allow more steps, start closer to the solution, or use a method with a prior.",
    ),
    Entry(
        "fit.no-descent",
        Severity.FAILURE,
        "The iteration did not converge: after {iterations:count step} no further step stays "
        "within the reach of the mechanism. Check for wrong rows or start closer to the solution.",
        when="Every shortened step leads to poses that the robot cannot reach.",
        action="Check for wrong rows, or start closer to the solution.",
    ),
    Entry(
        "fit.bad-start",
        Severity.FAILURE,
        "The iteration did not start: the residuals at the start are not finite. Check the units "
        "of the readings and the dimensions of the robot.",
        when="The robot cannot reach some poses at the start values.",
        action="Check units and readings, or start from other values.",
    ),
    Entry(
        "fit.few-equations",
        Severity.INFO,
        "{equations} equations for {parameters} parameters: at least {directions:count direction} "
        "of the parameter space are known from tolerances alone.",
        when="A method with a prior fits fewer equations than parameters.",
        action="Measure more poses to depend less on the tolerances.",
    ),
    Entry(
        "fit.unidentifiable",
        Severity.WARNING,
        _unidentifiable,
        when="A combination of parameters changes no measured value.",
        action="Nothing, if only accuracy relative to a frame that moves with the combination "
        "matters. Otherwise fix one of the parameters, or measure what determines it.",
        example=_COMBINATION,
    ),
    Entry(
        "fit.hardly-observable",
        Severity.SUGGESTION,
        _hardly_observable,
        when="A combination of parameters changes the measured values by less than the noise.",
        action="Measure more poses, poses that are further apart, or with a better instrument.",
        example=_COMBINATION | {"singular_value": 0.22, "meaning": "", "nuisance": ()},
    ),
    Entry(
        "fit.full-weights",
        Severity.INFO,
        "{loss}: every pose has at least half of its weight.",
        when="A fit with a loss in which no pose lies far from the others.",
        example={"loss": "Huber(k=1.345)", "total": 30},
    ),
    Entry(
        "fit.low-weights",
        Severity.WARNING,
        _low_weights,
        when="A loss reduced the weight of poses that lie far from the others.",
        action="Check what went wrong at these poses; correct or exclude them.",
        example={"loss": "Huber(k=1.345)", "count": 2, "total": 30, "poses": ("6", "9")},
    ),
    Entry(
        "fit.excluded-poses",
        Severity.INFO,
        "Excluded from the fit as requested: {poses:list}.",
        when="The options exclude poses.",
    ),
    Entry(
        "fit.beyond-tolerance",
        Severity.WARNING,
        "The estimate of {names:list} is up to {factor} stated tolerances from nominal. Check rows "
        "and tolerances; a method with a prior (MAP) keeps parameters that the data do not "
        "determine near nominal.",
        when="A fit without a prior leaves the stated tolerances by more than a factor of ten.",
        action="Check rows and tolerances, or use a method with a prior (MAP).",
    ),
    Entry(
        "fit.no-prior",
        Severity.SUGGESTION,
        "A method with a prior (MAP) keeps parameters that the data do not determine near nominal; "
        "without one the iteration may diverge.",
        when="A fit without a prior did not converge although tolerances are stated.",
        action="Use a method with a prior (MAP).",
    ),
    Entry(
        "fit.default-tolerances",
        Severity.INFO,
        "No tolerances given for {count} of {total} parameters: {assumed:list} assumed.",
        when="Free parameters have no tolerance. A thousandth of the robot's size, of a radian or "
        "of one is assumed. These tolerances are no prior; they scale the parameters.",
        action="State the tolerances of manufacturing and assembly in the robot file.",
    ),
    Entry(
        "fit.no-free-parameter",
        Severity.REFUSAL,
        "{robot} has no free parameter. Free at least one of its {total:count parameter}.",
        when="All parameters of the robot are fixed.",
        action="Free the parameters to be identified in the robot file.",
    ),
    Entry(
        "fit.no-measured-value",
        Severity.REFUSAL,
        "The data contain no usable measured value: every row is absent or has weight 0. Fill in "
        "values, or exclude fewer poses.",
        when="The data contain no usable row.",
        action="Fill in the measured values, or exclude fewer poses.",
    ),
    Entry(
        "fit.too-few-equations",
        Severity.REFUSAL,
        _too_few_equations,
        when="A method without a prior has fewer equations than unknowns.",
        action="Measure more poses, fix parameters, or use a method with a prior (MAP).",
        example={
            "equations": 30,
            "poses": 5,
            "unknowns": 48,
            "nuisance": 6,
            "has_prior": False,
            "poses_needed": 8,
        },
    ),
    Entry(
        "fit.no-equation-left",
        Severity.REFUSAL,
        "The measured values are all needed to determine {poses:count pose}, because the readings "
        "are uncertain. No equation remains for {unknowns:count parameter}. Measure more values at "
        "each pose, or state exact readings (sigma 0).",
        when="Readings have a sigma and each pose has no more measured values than coordinates.",
        action="Measure more at each pose, or state readings that can be trusted as exact.",
    ),
    Entry(
        "fit.residuals-not-finite",
        Severity.REFUSAL,
        "The residuals are not finite, or too large to be squared, at poses {poses:list}. Correct "
        "these rows.",
        when="A measured value is absurdly large, or its sigma absurdly small.",
        action="Correct these rows: value, unit and sigma.",
    ),
    Entry(
        "fit.poses-out-of-reach",
        Severity.REFUSAL,
        "The robot cannot reach {count} of {total} poses with the readings given there (poses "
        "{poses:list}). Correct the readings, their unit or the dimensions of the robot, or give "
        "these rows weight 0.",
        when="The forward kinematics has no solution at the start values.",
        action="Correct the readings, their unit or the dimensions of the robot.",
    ),
)
