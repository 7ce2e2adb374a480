# SPDX-License-Identifier: Apache-2.0
"""Regularization curves as a table and as a picture."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from loopcal.diagnose import RegularizationCurve, RegularizationCurves
from loopcal.report.numbers import (
    ABSENT,
    format_number,
    format_uncertainty,
    format_with_uncertainty,
)
from loopcal.report.pictures import label_logarithmic, show_names
from loopcal.report.robot_drawing import COLORS
from loopcal.report.tables import Column, Table, word_column
from loopcal.report.text_page import Block

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SCORE = (
    "Held-out error: mean square of residuals over sigma at poses that were left out; 1 is noise."
)
WORDS = {"lam": ("Ridge", "lam"), "k": ("Truncated SVD", "k")}
"""Name of a curve -> the method in words, and its number."""

MARKERS = {
    "GCV": ("v", COLORS[1]),
    "marginal likelihood": ("s", COLORS[2]),
    "lowest held-out error": ("o", COLORS[3]),
    "one standard error": ("D", COLORS[4]),
}
"""Rule -> marker and color of the value that it chooses."""

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


def draw_regularization(curves: RegularizationCurves) -> Figure:
    """Draw the held-out error against lam and against k, with bands of one standard error, and mark
    what rules choose.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 4.6), layout="constrained")
    panels: Any = figure.subplots(1, 2, sharey=True)
    finite = [c.score[np.isfinite(c.score)] for c in (curves.ridge, curves.truncation)]
    positive = np.concatenate(finite)
    for axes, curve in zip(panels, (curves.ridge, curves.truncation), strict=True):
        x, y, error = curve.values, curve.score, np.nan_to_num(curve.standard_error)
        line = "-" if curve.name == "lam" else "o-"
        axes.plot(x, y, line, color=COLORS[0], ms=3.0, label="held-out error")
        low = np.maximum(y - error, 0.1 * positive.min())
        axes.fill_between(
            x, low, y + error, color=COLORS[0], alpha=0.2, lw=0.0, label="standard error"
        )
        for chosen in curve.chosen:
            marker, color = MARKERS[chosen.rule]
            axes.plot(
                [chosen.value],
                [curve.score_at(chosen.value)[0]],
                marker,
                color=color,
                ms=7.0,
                mfc="none",
                label=f"{chosen.rule}: {chosen.value:.3g}",
            )
        axes.axhline(1.0, color="0.5", lw=0.8, ls="--", label="noise alone")
        method, number = WORDS[curve.name]
        axes.set_title(method, fontsize=10)
        axes.set_xlabel(
            "lam [(sigma per tolerance)²]" if curve.name == "lam" else f"directions {number} [1]"
        )
        axes.grid(visible=True, lw=0.3)
        axes.legend(frameon=False, fontsize=8)
    panels[0].set_xscale("log")
    panels[0].set_yscale("log")
    ticks = np.unique(np.round(np.log10(curves.ridge.values[[0, -1]])))
    step = max(int(np.ceil((ticks[-1] - ticks[0]) / 7.0)), 1)
    powers = np.arange(np.ceil(ticks[0]), ticks[-1] + 1, step)
    panels[0].set_xticks(10.0**powers, [f"1e{int(power)}" for power in powers])
    panels[0].minorticks_off()
    panels[0].set_ylabel("held-out mean square over that of noise [1]")
    label_logarithmic(panels[0].yaxis)
    figure.suptitle(f"{curves.robot}: n = {curves.poses} poses", fontsize=10)
    return show_names(figure)


def _format_score(score: float, error: float) -> tuple[str, str]:
    """Return a score and its standard error."""
    if not np.isfinite(score):
        return "not determined", ABSENT
    if not np.isfinite(error):
        return format_number(score, 4), ABSENT
    return format_with_uncertainty(score, error), format_uncertainty(error)
