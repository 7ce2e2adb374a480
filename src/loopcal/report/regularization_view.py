# SPDX-License-Identifier: Apache-2.0
"""Regularization curves as tables."""

from __future__ import annotations

import numpy as np

from loopcal.diagnose import RegularizationCurve, RegularizationCurves
from loopcal.report.numbers import (
    ABSENT,
    format_number,
    format_uncertainty,
    format_with_uncertainty,
)
from loopcal.report.tables import Column, Table, word_column
from loopcal.report.text_page import Block

SCORE = (
    "Held-out error: mean square of residuals over sigma at poses that were left out; 1 is noise."
)
WORDS = {"lam": ("Ridge", "lam"), "k": ("Truncated SVD", "k")}
"""Name of a curve -> the method in words, and its number."""

ROWS = 9
"""Values of a curve that the table contains beside those that rules choose."""


def view_regularization(curves: RegularizationCurves) -> list[Block]:
    """Return the page of regularization curves: what rules choose, then the curves."""
    left_out = (
        "each pose was left out in turn, to first order"
        if curves.scheme == "leave-one-out"
        else f"{curves.left_out} folds of poses were left out and fitted again"
    )
    page: list[Block] = [
        f"{curves.robot}: {curves.poses} poses, {curves.parameters} parameters; {left_out}.",
        f"{SCORE} lam is (sigma per tolerance)^2: lam = 1 uses the tolerances as a prior.",
    ]
    if curves.assumed:
        page.append(
            f"{curves.assumed} parameters have no stated tolerance; assumed ones scale them."
        )
    if curves.scheme == "folds":
        page.append(
            "Frames, targets and surfaces of held-out poses are estimated from these poses, which "
            "lowers all values alike."
        )
    return [
        *page,
        tabulate_choices(curves),
        tabulate_curve(curves.ridge),
        tabulate_curve(curves.truncation),
    ]


def tabulate_choices(curves: RegularizationCurves) -> Table:
    """Return a table of the chosen values of both methods, and of the given robot."""
    rows = [("given robot", "", "", *_format_score(*curves.nominal))]
    for curve in (curves.ridge, curves.truncation):
        method, number = WORDS[curve.name]
        rows += [
            (method, c.rule, f"{number} = {c.value:.4g}", *_format_score(*curve.score_at(c.value)))
            for c in curve.chosen
        ]
    columns = (word_column("method"), word_column("chosen by"), word_column("value"))
    return Table(
        "Chosen values", (*columns, Column("held-out error"), Column("standard error")), tuple(rows)
    )


def tabulate_curve(curve: RegularizationCurve) -> Table:
    """Return a table of some values of a curve."""
    method, number = WORDS[curve.name]
    count = len(curve.values)
    score, error = curve.score.tolist(), curve.standard_error.tolist()
    places = np.unique(np.linspace(0, count - 1, min(ROWS, count)).round().astype(int))
    rows = tuple((f"{curve.values[i]:.4g}", *_format_score(score[i], error[i])) for i in places)
    columns = (Column(number), Column("held-out error"), Column("standard error"))
    return Table(method, columns, rows)


def tabulate_points(curves: RegularizationCurves) -> Table:
    """Return all points of both curves, for programs."""
    columns = [Column(name) for name in ("value", "score", "standard error")]
    rows = tuple(
        (curve.name, *(repr(float(x)) if np.isfinite(x) else "" for x in point))
        for curve in (curves.ridge, curves.truncation)
        for point in zip(curve.values, curve.score, curve.standard_error, strict=True)
    )
    return Table("", (word_column("parameter"), *columns), rows)


def _format_score(score: float, error: float) -> tuple[str, str]:
    """Return a score and its standard error."""
    if not np.isfinite(score):
        return "not determined", ABSENT
    if not np.isfinite(error):
        return format_number(score, 4), ABSENT
    return format_with_uncertainty(score, error), format_uncertainty(error)
