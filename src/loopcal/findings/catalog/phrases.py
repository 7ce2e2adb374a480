# SPDX-License-Identifier: Apache-2.0
"""Phrases of the catalog that no template can express. `{name()}` in a text calls one of them.

Each takes the data of the finding and returns words.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from loopcal.findings.catalog import find_entry
from loopcal.findings.wording import fill_template, list_names

Data = Mapping[str, Any]

MACHINE = "the machine"
"""Subject of a change where no limb is freed."""

MOST_PARTS, MOST_WEAK_PARTS = 8, 4
"""Parameters of a combination that a sentence lists, and of one that is only hardly observable."""

MINOR_PART = 0.05
"""Part of a combination, in tolerances and relative to its largest, that a sentence only counts."""

MOST_ALTERNATIVES = 4
"""Alternative measurements that a sentence lists."""

SHOWN_REASONS = 3
"""Violated constraints that a sentence lists, most frequent first."""
EQUAL = 1e-6
"""Relative difference up to which two changes are equal."""

MOTIONS = {
    "rx": "rotation about x",
    "ry": "rotation about y",
    "rz": "rotation about z",
    "x": "translation along x",
    "y": "translation along y",
    "z": "translation along z",
}

TRIED: Mapping[str, str] = {
    "unit": "unit/units",
    "gear-factor": "gear factor (2, 1.5 or inverse)/gear factors (2, 1.5 and inverses)",
    "scalar-last": "form of the rotation/forms of the rotation",
    "orientation-form": "form of the rotation/forms of the rotation",
    "inverted-rotations": "inversion/inversions",
    "inverted-poses": "inversion/inversions",
    "left-handed-frame": "mirrored frame/mirrored frames",
    "sign": "sign/signs",
    "angle-signs": "sign/signs",
    "reading-sign": "sign/signs",
    "zenith-angles": "zenith angle/zenith angles",
    "swapped-columns": "order of columns/orders of columns",
    "permuted-columns": "order of columns/orders of columns",
    "swapped-targets": "order of targets/orders of targets",
    "permuted-targets": "order of targets/orders of targets",
    "swapped-readings": "order of actuators/orders of actuators",
    "reversed-readings": "order of actuators/orders of actuators",
    "permuted-readings": "order of actuators/orders of actuators",
    "shifted-readings": "shift by one row/shifts by one row",
    "reading-zero": "zero of readings/zeros of readings",
    "undeclared-setup": "unknown setup item/unknown setup items",
}
"""Kind of a slip -> its name for one, and for several."""

CONSTRAINTS = {
    "loops-open": "the loops cannot be closed",
    "limit-exceeded": "{limit} exceeded",
    "near-stroke-end": "less than {needed} from the end of the {limit}",
    "other-mode": "in another mode than home",
    "near-singularity": "near a singularity (margin below {min_margin} of the median)",
    "tilt-exceeded": "tilt above {max_tilt_deg:.4g} deg",
    "distance-out-of-range": "instrument too near or too far",
    "target-faces-away": "target faces away from the instrument",
    "branch-changed": "the path ends on another branch than the commanded pose",
}
"""Code of a violated constraint -> words."""

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
"""From dimension and factor to the mistake that causes it."""


# parameters


def changes(data: Data, most: int = MOST_PARTS) -> str:
    """Return the parameters of a combination, each with its change: `a +1 mm and b -0.5 mm`.

    Equal changes in one unit are `a, b and minus c, in equal parts`.
    """
    if len(set(data["units"])) == 1 and all(abs(abs(c) - 1.0) < EQUAL for c in data["changes"]):
        pairs = zip(data["names"], data["changes"], strict=True)
        signed = [name if change > 0.0 else f"minus {name}" for name, change in pairs]
        return f"{list_names(signed, most)}, in equal parts"
    return _list_changes(data["names"], data, _count_large(data, most))


def _count_large(data: Data, most: int) -> int:
    """Return how many parts, largest first, are not minor; at most `most`, and all without
    `weights`.
    """
    sizes = [abs(weight) for weight in data.get("weights", ())]
    return min(most, sum(size >= MINOR_PART * max(sizes) for size in sizes) or most)


def largest_changes(data: Data) -> str:
    """Return the first parameters of a combination that is hardly observable."""
    return changes(data, MOST_WEAK_PARTS)


def effect(data: Data, most: int = MOST_PARTS) -> str:
    """Return the effect of a merged parameter in terms of the kept ones, at most `most` of them."""
    if not data["into"]:
        return "it has no effect on the measurements"
    return (
        f"1 {data['unit']} of it has the same effect as {_list_changes(data['into'], data, most)}"
    )


def _list_changes(names: Sequence[str], data: Data, most: int) -> str:
    zipped = zip(names, data["changes"], data["units"], strict=True)
    return list_names([f"{name} {change:+.4g} {unit}" for name, change, unit in zipped], most)


def open_gaps(data: Data) -> str:
    """Return which poses are open, and by how much, the widest first."""
    pairs = zip(data["poses"], data["gaps"], strict=True)
    return list_names([f"pose {pose} by {gap}" for pose, gap in pairs], SHOWN_GAPS)


SHOWN_GAPS = 5
"""Open poses that a sentence lists."""

RULES = {
    "GCV": "generalized cross-validation",
    "TruncationGCV": "generalized cross-validation",
    "MarginalLikelihood": "marginal likelihood",
}
"""Rule that chooses a regularization -> words."""


def regularization(data: Data) -> str:
    """Return the ridge parameter or truncation, its rule and the score that the rule minimizes."""
    value = data["value"]
    if data["parameter"] == "k":
        what = (
            f"Truncated SVD: {value:.0f} of the {data['rank']} directions that the data determine"
        )
    else:
        what = f"Ridge regression: lam = {value:.4g} (sigma per tolerance, squared)"
    if data["rule"] == "fixed":
        return f"{what}, as given"
    score = "" if data["score"] is None else f", score {data['score']:.6g}"
    return f"{what}, chosen by {RULES.get(data['rule'], data['rule'])}{score}"


def contradicted_tolerances(data: Data) -> str:
    """Return the sentences on the prior that the data contradict, and the largest deviations."""
    pairs = zip(data["names"], data["deviations"], strict=True)
    return fill_template(
        "The data contradict the stated tolerances (p = {p_value:.1g}; right tolerances are "
        "rejected in {level:percent} of data sets): {worst:if|{worst:plural|{worst[0]} deviates|"
        "{worst:list} together deviate} from nominal by {worst_statistic} standard deviations of "
        "what they predict|the deviations from nominal are {ratio} times as large as they allow}"
        "{far:if| (largest, in tolerances: {far})}.",
        far=", ".join(f"{name} {deviation:+.3g}" for name, deviation in pairs),
        **data,
    )


def inflated_tolerances(data: Data) -> str:
    """Return by which factors tolerances, or parts of them, are inflated."""
    wide = "the tolerances of {names:list} {factor} times as wide as stated"
    shift = "a common deviation of {names:list} ({factor} tolerances)"
    changes = [fill_template(shift if p["kind"] == "shift" else wide, **p) for p in data["parts"]]
    if data["factor"] > 1.0 or not changes:
        others = "the others" if changes else "tolerances"
        is_near_one = 1.0 < data["factor"] < 1.005  # it would read "1 times"
        wider = "less than 0.5 % wider than" if is_near_one else "{factor} times as wide as"
        changes.append(fill_template(f"{others} {wider} stated", **data))
    return list_names(changes, len(changes))


def strongest_pair(data: Data) -> str:
    """Return which two of more than two correlated parameters are correlated most."""
    return "" if len(data["names"]) == 2 else f" between {' and '.join(data['pair'])}"


def best_or_near(data: Data) -> str:
    """Return how well a chosen model predicts held-out poses, compared with the best one."""
    if data["chosen"] == data["best"]:
        return "best"
    return fill_template(
        "within one standard error of {best} ({best_parameters:count parameter})", **data
    )


def sets_not_compared(data: Data) -> str:
    """Return the sentence, if any, about sets of parameters that folds cannot determine."""
    if not data["not_compared"]:
        return ""
    return fill_template(
        " Not compared: {not_compared:list}. Without a fold of the poses too few equations remain, "
        "or the fit does not converge; measure more poses and check their rows.",
        **data,
    )


SOURCES = {
    "instrument": "instrument",
    "readings": "actuator readings",
    "setup": "set-up",
    "tolerances": "undetermined tolerances",
    "earlier": "earlier calibration",
    "repeatability": "repeatability",
    "discrepancy": "model discrepancy",
    "other": "other errors that the residuals show",
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
        shares = [f"{words[key]} {_quantity(sources[key])}" for key in words if key in sources]
        sentences.append(f"{name} {_quantity(total)} ({', '.join(shares)})")
    return "; ".join(sentences) or "none"


FITTED_POSES = {
    "measured": "the measured poses",
    "home": "poses about home",
    "predicted": "the workspace",
}
"""Poses over which frames are fitted -> words."""


def fitted_poses(data: Data) -> str:
    """Return over which poses frames are fitted."""
    return FITTED_POSES[data["over"]]


def _quantity(value: Any) -> str:
    """Return a quantity as the templates write it."""
    return fill_template("{value}", value=value)


# measurements


def residual_ratio(data: Data) -> str:
    """Return how much larger the residuals of the start are than those of the fit."""
    if data["ratio"] is None:
        return "the fit leaves no residual"
    return fill_template("its residuals are {ratio} times the fitted ones", **data)


def other_measurements(data: Data) -> str:
    """Return the suggested measurements after the first."""
    return list_names([other["words"] for other in data["measurements"][1:]], MOST_ALTERNATIVES)


def blocks(data: Data) -> str:
    """Return how many poses were tested, or sets of poses where poses share rows."""
    noun = "pose" if data["single_poses"] else "set of poses/sets of poses"
    return fill_template(f"{{blocks:count {noun}}}", **data)


def stated_misfit(data: Data) -> str:
    """Return the misfit of the data as they are written."""
    return fill_template(
        "{residuals:if|residuals are {residuals:list} (rms), {misfit:factor} times what tolerances "
        "and noise allow|the robot reaches only {reached} of {poses} tested poses with these "
        "readings}",
        **data,
    )


def interpretation(data: Data) -> str:
    """Return the other interpretation in which the data fit."""
    return find_entry(data["interpretation"]["code"]).word(data["interpretation"])


def equally_good(data: Data) -> str:
    """Return interpretations in which the data fit as well."""
    return list_names([find_entry(slip["code"]).word(slip) for slip in data["alternatives"]], 2)


def correction(data: Data) -> str:
    """Return what to correct where the data fit in another interpretation."""
    slip = data["interpretation"]
    return " ".join(
        fill_template(find_entry(part["code"]).action, **part)
        for part in slip.get("parts", (slip,))
    )


def combined_changes(data: Data) -> str:
    """Return the changes of an interpretation that makes several."""
    return " and ".join(find_entry(part["code"]).word(part) for part in data["parts"])


def tried_changes(data: Data) -> str:
    """Return the numbers of tested changes, by their kinds, and of pairs of them."""
    names = list(dict.fromkeys(TRIED[slip] for slip in data["tried"]))
    counts = [sum(n for slip, n in data["tried"].items() if TRIED[slip] == name) for name in names]
    words = [
        fill_template(f"{{n:count {name}}}", n=n) for name, n in zip(names, counts, strict=True)
    ]
    if data["pairs"]:
        words.append(fill_template("{pairs:count pair/pairs} of these", **data))
    return ", ".join(words)


def times_larger(data: Data) -> str:
    """Return a wrong unit's factor, such as `1000 times larger`."""
    factor = data["factor"]
    times = max(factor, 1.0 / factor)
    digits = 4 if times > 100.0 else 3
    return f"{times:.{digits}g} times {'larger' if factor > 1.0 else 'smaller'}"


def units_written(data: Data) -> str:
    """Return the mistake that causes a wrong unit's factor."""
    return UNITS_WRITTEN[data["dimension"], f"{data['factor']:.3g}"]


# mechanisms and plans


def motion(data: Data) -> str:
    """Return the motion in some freedoms, the largest component first."""
    return " with ".join(MOTIONS[freedom] for freedom in data["motion"])


def impossible_motions(data: Data) -> str:
    """Return the motions that the limbs prevent."""
    return ", ".join(motion({"motion": freedoms}) for freedoms in data["motions"])


def violations(data: Data) -> str:
    """Return violated constraints with their counts, such as `tilt above 12 deg (34)`."""
    words = []
    for reason in data["reasons"][:SHOWN_REASONS]:
        place = "no straight path from home: " if reason["on_path"] else ""
        violated = fill_template(CONSTRAINTS[reason["code"]], **reason)
        words.append(f"{place}{violated} ({reason['count']})")
    return "; ".join([*words, *(["..."] if len(data["reasons"]) > SHOWN_REASONS else [])])


def compared_errors(data: Data) -> str:
    """Return expected errors before and after calibration, and with random poses."""
    cases = (
        ("before", "before calibration"),
        ("random", f"with as many random {data['counted']}"),
        ("after", "with this plan"),
    )
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


def instrument_unknowns(data: Data) -> str:
    """Return whose the unknowns are that are no parameters of the robot."""
    return ", the others of the instrument" if data["unknowns"] > data["parameters"] else ""
