# SPDX-License-Identifier: Apache-2.0
"""Phrases of the catalog that no template can express: `{name()}` in a text calls one of them.

Each takes the data of the finding and returns words.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from loopcal.findings.catalog import find_entry, word_phrase
from loopcal.findings.wording import choose_symbol, fill_template, list_names

Data = Mapping[str, Any]

MACHINE = "the machine"
"""Subject of a change where no limb is freed."""

MOST_PARTS, MOST_WEAK_PARTS = 8, 4
"""Parameters of a combination that a sentence lists, and of one that is only hardly observable."""

MINOR_PART = 0.05
"""Part of a combination, in spreads and relative to its largest, that a sentence only counts."""

SHOWN_REASONS = 3
"""Violated constraints that a sentence lists, most frequent first."""

EQUAL = 1e-6
"""Relative difference up to which two changes are equal."""


def changes(data: Data, most: int = MOST_PARTS) -> str:
    """Return the parameters of a combination, each with its change: `a +1 mm and b -0.5 mm`.

    Equal changes in one unit are `a, b and minus c, in equal parts`.
    """
    if len(set(data["units"])) == 1 and all(abs(abs(c) - 1.0) < EQUAL for c in data["changes"]):
        pairs = zip(data["names"], data["changes"], strict=True)
        signed = [name if change > 0.0 else f"minus {name}" for name, change in pairs]
        return f"{list_names(signed, most)}, in equal parts"
    sizes = [abs(weight) for weight in data.get("weights", ())]
    large = sum(size >= MINOR_PART * max(sizes) for size in sizes) or most
    return _list_changes(data["names"], data, min(most, large))


def largest_changes(data: Data) -> str:
    """Return the first parameters of a combination that is hardly observable."""
    return changes(data, MOST_WEAK_PARTS)


def effect(data: Data, most: int = MOST_PARTS) -> str:
    """Return the effect of a merged parameter in terms of the kept ones, at most `most` of them."""
    if not data["into"]:
        return "it changes no measurement"
    return f"1 {data['unit']} of it is equivalent to {_list_changes(data['into'], data, most)}"


def _list_changes(names: Sequence[str], data: Data, most: int) -> str:
    zipped = zip(names, data["changes"], data["units"], strict=True)
    return list_names([f"{name} {change:+.4g} {unit}" for name, change, unit in zipped], most)


def inflated_tolerances(data: Data) -> str:
    """Return by which factors expected spreads, or parts of them, are inflated."""
    wide = "the expected spreads of {names:list} {factor} times as wide"
    shift = "a common deviation of {names:list} ({factor} expected spreads)"
    changes = [fill_template(shift if p["kind"] == "shift" else wide, **p) for p in data["parts"]]
    if data["factor"] > 1.0 or not changes:
        others = "the other spreads" if changes else "expected spreads"
        is_near_one = 1.0 < data["factor"] < 1.005  # it would read "1 times"
        wider = "less than 0.5 % wider" if is_near_one else "{factor} times as wide"
        changes.append(fill_template(f"{others} {wider}", **data))
    return list_names(changes, len(changes))


def strongest_pair(data: Data) -> str:
    """Return which two of more than two correlated parameters are correlated most."""
    return "" if len(data["names"]) == 2 else f" between {' and '.join(data['pair'])}"


def best_or_near(data: Data) -> str:
    """Return how well a chosen model predicts held-out poses, compared with the best one."""
    if data["chosen"] == data["best"]:
        return "best"
    return fill_template(
        "within one standard error of the set {best} ({best_parameters:count parameter})", **data
    )


SOURCES = {
    "instrument": "instrument",
    "readings": "actuator readings",
    "setup": "setup parameters",
    "common": "common errors",
    "tolerances": "expected spreads",
    "earlier": "earlier calibration",
    "repeatability": "repeatability in use",
    "discrepancy": "model discrepancy",
    "other": "other errors",
}
"""Source of an expected error -> words."""


def error_sources(data: Data) -> str:
    """Return expected errors of position and orientation, each with its sources."""
    words = dict(SOURCES)
    if data["tolerances_assumed"]:
        words["tolerances"] += " (assumed)"
    sentences = []
    for name in ("position", "orientation"):
        if not data[name]:
            continue
        total, sources = data[name]
        shares = [f"{words[key]} {sources[key]}" for key in words if key in sources]
        sentences.append(f"{name} {total} ({', '.join(shares)})")
    return "; ".join(sentences) or "none"


def other_measurements(data: Data) -> str:
    """Return the suggested measurements after the first."""
    return list_names([other["words"] for other in data["measurements"][1:]], shown=4)


def correction(data: Data) -> str:
    """Return what to correct where the data fit in another interpretation; the header of a session
    is that of its sheet.
    """
    if data.get("is_session"):
        return word_phrase("session_correction", data)
    slip = data["interpretation"]
    return " ".join(
        fill_template(find_entry(part["code"]).action, **part)
        for part in slip.get("parts", (slip,))
    )


def times_larger(data: Data) -> str:
    """Return a wrong unit's factor, such as `1000 times larger`."""
    factor = data["factor"]
    times = max(factor, 1.0 / factor)
    digits = 4 if times > 100.0 else 3
    return f"{times:.{digits}g} times {'larger' if factor > 1.0 else 'smaller'}"


def units_written(data: Data) -> str:
    """Return the mistake that causes a wrong unit's factor."""
    return word_phrase("unit_mistake", {"factor": f"{data['dimension']} {data['factor']:.3g}"})


def violations(data: Data) -> str:
    """Return violated constraints with their counts, such as `tilt above 12 deg (34)`."""
    reasons = data["reasons"]
    words = [word_phrase("violation", reason) for reason in reasons[:SHOWN_REASONS]]
    return "; ".join([*words, "..."][: len(reasons)])


def machines(data: Data) -> str:
    """Return a share of machines, such as `9 of 10 machines`."""
    tenths = 10.0 * data["share"]
    is_whole = abs(tenths - round(tenths)) < EQUAL
    return (
        f"{tenths:.0f} of 10 machines"
        if is_whole
        else fill_template("{share:percent} of machines", **data)
    )


def compared_errors(data: Data) -> str:
    """Return expected errors before calibration and with random poses."""
    cases = (("before", "before calibration"), ("random", f"with as many random {data['counted']}"))
    return ", ".join(
        f"{list_names(data[name]) or 'none'} {words}"
        for name, words in cases
        if data[name] is not None
    )


def reduction(data: Data) -> str:
    """Return how much smaller the error of a plan is than that of random poses, if it is."""
    if not (data["reduction"] or 0.0) > 0.0:
        return ""
    return fill_template(" ({target} error {reduction:percent} below random)", **data)


def joints_to_free(data: Data) -> str:
    """Return the lines to write behind joints, and the alternatives."""
    alternatives = []
    for chosen in data["proposals"]:
        lines: dict[str, list[str]] = {}
        for added in chosen:
            lines.setdefault(f"{added['limb']}.{added['joint']}", []).append(added["line"])
        instructions = [f"behind {place} write `{'` and `'.join(x)}`" for place, x in lines.items()]
        alternatives.append(list_names(instructions))
    return "; or ".join(alternatives)


ALMOST_CERTAIN = 0.999
"""Probability beyond which a statement gives a bound only."""

LARGEST_SKEW = 0.1
"""Distance of the center of an interval from the estimate, as a share of half its width, up to
which +/- describes it."""


CAUSES = {
    "noise": "noise alone",
    "larger-noise": "a noise larger than stated",
    "outliers": "wrong rows of few poses",
    "pose": "an error that the targets of a pose share",
    "target": "an error of each target",
    "session": "an error of each session",
    "block": "an error of each block of poses",
    "walk": "a slow motion of instrument or frame",
    "order": "a drift in the order of the rows",
    "time": "a drift in time",
    "temperature": "a dependence on a temperature",
    "reading": "a dependence on a reading",
    "smooth": "a model error that varies slowly with the pose",
    "rough": "an error of each pose that its repeats share",
    "drives": "errors of the drives at single poses",
    "backlash": "backlash",
    "moved-board": "a board that moved",
    "zoomed-picture": "a picture with another focal length",
    "moving-picture": "a picture of a moving machine",
}
"""What may cause residuals."""

NAMED_CAUSES = {
    "temperature": "the temperature {name}",
    "reading": "a dependence on the reading {name}",
    "zoomed-picture": "the picture of pose {name}, which has another focal length",
    "moving-picture": "the picture of pose {name}, during which the machine moved",
}
"""Those of them of which a finding states the name."""


def cause_words(data: Data) -> str:
    """Return the most probable cause of residuals."""
    return NAMED_CAUSES.get(data["cause"], CAUSES[data["cause"]]).format(name=data["name"])


def second_words(data: Data) -> str:
    """Return the second cause, which has no name."""
    return CAUSES[data["second"]]


def conformity_probability(data: Data) -> str:
    """Return the bounds of a probability as per cent, and what is close to certain as one bound."""
    return _format_probability(float(data["probability"]), float(data["most_probable"]))


def better_probability(data: Data) -> str:
    """Return the probability that values are better, as per cent."""
    return _format_probability(float(data["probability"]), float(data["probability"]))


def _format_probability(lowest: float, highest: float) -> str:
    if lowest > ALMOST_CERTAIN:
        return f"more than {100.0 * ALMOST_CERTAIN:g} %"
    if highest < 1.0 - ALMOST_CERTAIN:
        return f"less than {100.0 * (1.0 - ALMOST_CERTAIN):.1g} %"
    low, high = (
        f"{100.0 * min(max(p, 1.0 - ALMOST_CERTAIN), ALMOST_CERTAIN):.{3 if p > 0.99 else 2}g}"
        for p in (lowest, highest)
    )
    return f"{low} %" if low == high else f"{low} to {high} %"


def largest_error(data: Data) -> str:
    """Return the largest true error with its expanded uncertainty, as the subject of a sentence.

    An interval that is not centered on the estimate is stated by its bounds: an error has no values
    below zero, and estimate plus half the interval would be below its upper bound.
    """
    stated = [data[name] for name in ("estimate", "expanded", "low", "high")]
    unit, factor = choose_symbol(stated[1].value or stated[0].value, stated[0].unit)
    estimate, expanded, low, high = (factor * quantity.value for quantity in stated)
    value, uncertainty, places = f"{estimate:.3g}", f"{expanded:.2g}", 0
    if expanded > 0.0:
        places = max(0, 1 - math.floor(math.log10(expanded)))
        value, uncertainty = (f"{x:.{places}f}" for x in (estimate, expanded))
    template = (
        "Largest {is_volume:if|{quantity} error in the volume|of {count} {quantity} errors, "
        "without the noise of the measurement}: "
    )
    subject = f"{fill_template(template, **data)}{value} {unit}"
    if abs(high + low - 2.0 * estimate) <= LARGEST_SKEW * (high - low):
        return f"{subject} +/- {uncertainty} {unit} (95 %)"
    return f"{subject} (95 % interval {low:.{places}f} {unit} to {high:.{places}f} {unit})"
