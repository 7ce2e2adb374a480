# SPDX-License-Identifier: Apache-2.0
"""Judge a claim in every draw, or in groups of machines, by the rules of text.yaml.

The numbers are called `most_..` where the largest of all situations decides, and `least_..` where
the smallest does.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from loopcal.papers.reproduction import Verdict
from loopcal.papers.tsvd_2016.draw_tables import DIVERGED
from loopcal.papers.tsvd_2016.draws import Draws
from loopcal.papers.wording import Wording, judge_numbers
from loopcal.typing import FloatArray

Numbers = Mapping[str, FloatArray]
"""Numbers (t,) of the machines by the names that the rules of text.yaml use."""

Ratio = tuple[str, str]
"""Method and the one it is divided by."""


def judge_groups(
    words: Wording,
    claim: str,
    draws: tuple[Draws, ...],
    pairs: Mapping[str, list[Ratio]],
    **data: Any,
) -> Verdict:
    """Judge ratios of medians in each group of machines.

    A number is the largest of its ratios, of all structures, in position and angle; one whose name
    ends in `angle` in the angle alone.
    """
    groups = []
    for members in zip(*(draw.list_groups() for draw in draws), strict=True):
        numbers = {}
        for name, compared in pairs.items():
            first = 1 if name.endswith("angle") else 0
            of_pairs = [
                group.compute_ratio(*pair)[first:2] for group in members for pair in compared
            ]
            numbers[name] = float(np.max(of_pairs))
        groups.append(numbers)
    return words.judge(claim, draws=groups, groups=len(groups), trials=len(draws[0]), **data)


def judge_machines(
    words: Wording, claim: str, places: Mapping[str, Numbers], **data: Any
) -> Verdict:
    """Judge a claim in each draw; it holds where it holds in all places, see the module."""
    shares = []
    for label, numbers in places.items():
        rows = _list_rows(numbers)
        confirmed_count = sum(judge_numbers(words.claims[claim], row) is True for row in rows)
        shares.append({"name": label, "count": confirmed_count, "of": len(rows)})
    names = next(iter(places.values()))
    combined = {
        name: (np.max if name.startswith("most") else np.min)(
            [numbers[name] for numbers in places.values()], axis=0
        )
        for name in names
    }
    return words.judge(claim, draws=_list_rows(combined), shares=shares, **data)


def _list_rows(numbers: Numbers) -> list[dict[str, float]]:
    return [
        dict(zip(numbers, map(float, row), strict=True))
        for row in zip(*numbers.values(), strict=True)
    ]


def format_all(**errors: FloatArray) -> dict[str, str]:
    """Return errors in position and angle as text."""
    return {
        name: f"{e[0]:.2g} mm / {e[1]:.2g} deg" if np.isfinite(e[:2]).all() else DIVERGED
        for name, e in errors.items()
    }


def format_pair(values: FloatArray) -> str:
    """Return ratios in position and angle as text."""
    return " and ".join(map(format_ratio, values[:2]))


def format_ratio(value: float) -> str:
    """Return a ratio as text; one that is not finite belongs to a fit that diverged."""
    return f"{value:.2f}" if np.isfinite(value) else DIVERGED
