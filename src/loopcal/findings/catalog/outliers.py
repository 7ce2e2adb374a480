# SPDX-License-Identifier: Apache-2.0
"""Outliers: poses whose measurements do not fit those of the others.

Poses that share rows (pairs, or groups measured together) are tested together; `blocks` counts
these sets, and is the number of poses where nothing is shared.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from loopcal.findings.finding import Severity
from loopcal.findings.wording import Entry, fill_template, list_names

NOUN = "{blocks:count pose}"
"""Blocks are called poses where each block is one pose, and sets of poses otherwise."""


def _blocks(template: str, one: str | None = None) -> Any:
    """Return a template in which `poses` means poses, or sets of poses that share rows.

    `one` is the template for a `count` of 1, where it differs.
    """

    def word(data: Mapping[str, Any]) -> str:
        sets = not data["single_poses"]
        chosen = one if one is not None and data["count"] == 1 else template
        text = chosen.replace(
            ":count pose}", ":count set of poses/sets of poses}" if sets else ":count pose}"
        )
        return fill_template(text.replace("<poses>", "sets of poses" if sets else "poses"), **data)

    return word


def _outlier(data: Mapping[str, Any]) -> str:
    which = (
        f"Pose {data['poses'][0]} does"
        if len(data["poses"]) == 1
        else (f"Poses {list_names(data['poses'])} do")
    )
    return fill_template(
        which
        + " not fit the others: the deviation is {factor} times the expected noise "
        + "({residuals:count residual}).",
        **data,
    )


def _conflict(data: Mapping[str, Any]) -> str:
    names = [
        str(block[0]) if len(block) == 1 else f"({list_names(block)})" for block in data["poses"]
    ]
    return fill_template(
        "Poses {names:list} contradict each other by {factor} times the noise. The data cannot "
        "determine which of them is wrong. Measure more poses, or repeat these.",
        names=names,
        factor=data["factor"],
    )


_ALL = {"blocks": 30, "single_poses": True}

ENTRIES = (
    Entry(
        "outliers.none",
        Severity.INFO,
        _blocks("No outliers among {blocks:count pose} (false-alarm rate {level:percent})."),
        when="Every pose fits what the others predict.",
        example=_ALL | {"level": 0.05},
    ),
    Entry(
        "outliers.none-but-misfit",
        Severity.INFO,
        _blocks(
            "None of {blocks:count pose} is an outlier, although the residuals exceed the noise: "
            "the misfit is spread over all of them. Check the stated noise and the model."
        ),
        when="The residuals contradict the stated noise, but no single pose exceeds its limit.",
        action="Check the stated noise, and whether the model has all necessary parameters.",
        example=_ALL,
    ),
    Entry(
        "outliers.some",
        Severity.WARNING,
        _blocks(
            "Outliers: {count} of {blocks:count pose} (false-alarm rate {level:percent}). Check "
            "them; then exclude them from the fit or use a robust loss.",
            one="Outliers: {count} of {blocks:count pose} (false-alarm rate {level:percent}). "
            "Check it; then exclude it from the fit or use a robust loss.",
        ),
        when="At least one pose does not fit what the others predict.",
        action="Check these poses; then exclude them from the fit or use a robust loss.",
        example=_ALL | {"count": 2, "level": 0.05},
    ),
    Entry(
        "outliers.ambiguous",
        Severity.WARNING,
        _blocks(
            "{count} of {blocks:count pose} contradict each other. The data cannot determine which "
            "of them are wrong. Measure more poses, or repeat these."
        ),
        when="Excluding one pose resolves a contradiction as well as excluding another.",
        action="Measure more poses, or repeat the contradicting ones.",
        example=_ALL | {"count": 7},
    ),
    Entry(
        "outliers.search-not-converged",
        Severity.WARNING,
        _blocks(
            "The search for outliers did not converge: suspicion alternates among {count} of "
            "{blocks:count pose}. Check these <poses>, or measure more.",
            one="The search for outliers did not converge: {count} of {blocks:count pose} is "
            "suspected in every other step. Check it, or measure more <poses>.",
        ),
        when="Outliers hide each other, so that the search returns to an earlier state.",
        action="Measure more poses, or check the suspected ones.",
        example=_ALL | {"count": 2},
    ),
    Entry(
        "outliers.not-testable",
        Severity.INFO,
        "Outliers cannot be detected: every pose determines parameters that no other pose "
        "determines. Measure more poses.",
        when="No pose is redundant.",
        action="Measure more poses.",
    ),
    Entry(
        "outliers.single-block",
        Severity.INFO,
        "Outliers cannot be detected: all rows belong to one set of poses that share rows. Measure "
        "another set.",
        when="All rows are linked, so there are no others to compare them with.",
        action="Measure another set of poses.",
    ),
    Entry(
        "outliers.unknown-noise",
        Severity.INFO,
        "Outliers cannot be detected: one degree of freedom determines either the noise or a wrong "
        "row. State sigma, or measure more poses.",
        when="The noise is estimated from a single degree of freedom.",
        action="State sigma, or measure more poses.",
    ),
    Entry(
        "outliers.pose",
        Severity.WARNING,
        _outlier,
        when="A pose does not fit what the others predict.",
        action="Check its reading, its target and its row in the file.",
        example={"poses": ("6",), "factor": 12.3, "residuals": 6, "p_value": 1e-9},
    ),
    Entry(
        "outliers.conflict",
        Severity.WARNING,
        _conflict,
        when="Some poses contradict each other, and any one of them may be the wrong one.",
        action="Measure more poses, or repeat these.",
        example={"poses": (("1",), ("2",), ("5",)), "factor": 9.1},
    ),
)
