# SPDX-License-Identifier: Apache-2.0
"""Regularization curves as a picture."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from loopcal.diagnose import RegularizationCurves
from loopcal.report.figures.style import COLORS, label_logarithmic, show_names, start_figure
from loopcal.report.regularization_view import WORDS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MARKERS = {
    "GCV": ("v", COLORS[1]),
    "marginal likelihood": ("s", COLORS[2]),
    "lowest held-out error": ("o", COLORS[3]),
    "one standard error": ("D", COLORS[4]),
}
"""Rule -> marker and color of the value that it chooses."""


def draw_regularization(curves: RegularizationCurves) -> Figure:
    """Draw the held-out error against lam and against k, with bands of one standard error, and mark
    what rules choose.
    """
    figure = start_figure(10.0, 4.6)
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
