# SPDX-License-Identifier: Apache-2.0
"""Several calibrations side by side: parameters with their intervals, shifts, held-out errors."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from loopcal.apply import RunComparison
from loopcal.report.figures.style import (
    COLORS,
    DARK,
    DOT,
    LINE,
    MARKERS,
    PALE,
    REFERENCE,
    SMALL,
    THIN,
    add_legend,
    finish_figure,
    label_axes,
    shorten,
    start_figure,
)
from loopcal.report.run_comparison_view import find_shift
from loopcal.units import Unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_ROWS = 60
"""Parameters that a figure shows."""


def draw_run_parameters(comparison: RunComparison) -> Figure:
    """Draw the estimate of each run with its 95 % interval, as difference from the first run that
    identified the parameter, in half-widths of that run's interval.
    """
    from matplotlib.lines import Line2D

    names = [name for name in comparison.parameters if _find_reference(comparison, name)]
    shown = names[:MOST_ROWS]
    figure = start_figure(7.2, 1.8 + 0.22 * max(len(shown), 1))
    axes: Any = figure.add_subplot()
    handles, count = [], len(comparison.runs)
    for k, run in enumerate(comparison.runs):
        color, marker = COLORS[k % len(COLORS)], MARKERS[k % len(MARKERS)]
        offset = 0.6 * (k + 0.5) / count - 0.3
        for row, name in enumerate(shown):
            value, half = run.estimates.get(name), run.plus_minus.get(name)
            if value is None or half is None:
                continue
            center, unit = _find_reference(comparison, name) or (0.0, 1.0)
            axes.errorbar(
                (value - center) / unit, row + offset, xerr=half / unit, color=color,
                marker=marker, ms=DOT + 0.5, lw=LINE, capsize=2.0,
            )  # fmt: skip
        handles.append(Line2D([], [], color=color, marker=marker, lw=LINE, label=shorten(run.name)))
    axes.axvline(0.0, color=REFERENCE, lw=THIN)
    axes.set_yticks(range(len(shown)), [shorten(name) for name in shown])
    axes.set_ylim(len(shown) - 0.4, -0.6)
    first = shorten(comparison.runs[0].name)
    label_axes(axes, f"difference from {first} [half-widths of its 95 % interval]", "")
    add_legend(figure, handles)
    more = len(names) - len(shown)
    part = f" (the first {len(shown)} of {len(names)} parameters)" if more > 0 else ""
    return finish_figure(figure, f"Estimates with their 95 % intervals{part}")


def _find_reference(comparison: RunComparison, name: str) -> tuple[float, float] | None:
    """Return estimate and half-width of the first run with an interval above 0; None without."""
    for run in comparison.runs:
        value, half = run.estimates.get(name), run.plus_minus.get(name)
        if value is not None and half is not None and half > 0.0:
            return value, half
    return None


def draw_run_errors(comparison: RunComparison, show_unit: Callable[[str], Unit]) -> Figure:
    """Draw rms (bar) and largest (dot) error of each run after calibration, by quantity.

    Parameters
    ----------
    show_unit : quantity ("position", ...) -> the unit of its errors.
    """
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    has_common = comparison.common_poses > 0
    errors = [run.common if has_common else run.own for run in comparison.errors]
    quantities = tuple(dict.fromkeys(name for of_run in errors for name in of_run))
    figure = start_figure(7.2, 1.4 + 2.6 * max(len(quantities), 1))
    panels: Any = figure.subplots(max(len(quantities), 1), 1, squeeze=False)[:, 0]
    x = np.arange(len(errors))
    for axes, quantity in zip(panels, quantities, strict=False):
        unit = show_unit(quantity)
        for k, of_run in enumerate(errors):
            error = of_run.get(quantity)
            if error is not None:
                axes.bar(k, error.rms / unit.factor_to_si, 0.5, color=COLORS[k % len(COLORS)])
                axes.plot(k, error.largest / unit.factor_to_si, "o", color="0.2", ms=DOT + 1.0)
        labels = [shorten(run.run) for run in comparison.errors]
        axes.set_xticks(x, labels, fontsize=SMALL)
        axes.set_xlim(-0.6, len(errors) - 0.4)
        axes.set_ylim(bottom=0.0)
        label_axes(axes, "", f"{quantity} error [{unit.symbol}]")
    add_legend(
        figure,
        [
            Patch(color=REFERENCE, label="root mean square"),
            Line2D([], [], ls="none", marker="o", color="0.2", label="largest"),
        ],
    )
    poses = (
        f"{comparison.common_poses} common poses" if has_common else "held-out poses of each run"
    )
    return finish_figure(figure, f"Errors after calibration at the {poses}")


def draw_run_shifts(comparison: RunComparison) -> Figure:
    """Draw the shift of each parameter from the first run, in standard deviations, while all others
    may have changed, too; a significant shift is filled. What is not determined or not tested has
    no marker.
    """
    from matplotlib.lines import Line2D

    names = comparison.parameters[:MOST_ROWS]
    figure = start_figure(7.2, 1.8 + 0.2 * len(names))
    axes: Any = figure.add_subplot()
    handles, y = [], np.arange(len(names))
    for k, pair in enumerate(comparison.pairs, 1):  # the first run has color and marker 0
        color, marker = COLORS[k % len(COLORS)], MARKERS[k % len(MARKERS)]
        shifts = [find_shift(pair, name) for name in names]
        size = np.array([shift / sd if sd > 0.0 else np.nan for shift, sd, _ in shifts])
        significant = np.array([flag for _, _, flag in shifts])
        offset = 0.5 * k / (len(comparison.pairs) + 1) - 0.25
        for chosen, face in ((significant, color), (~significant, "white")):
            axes.plot(size[chosen], (y + offset)[chosen], marker, color=color, mfc=face, ms=DOT + 2)
        handles.append(
            Line2D([], [], color=color, marker=marker, ls="none", label=shorten(pair.second))
        )
    axes.axvspan(-1.96, 1.96, color=PALE, alpha=0.35, lw=0.0, zorder=0)
    axes.axvline(0.0, color=REFERENCE, lw=THIN)
    axes.set_yticks(y, [shorten(name) for name in names])
    axes.set_ylim(len(names) - 0.4, -0.6)
    first = comparison.runs[0].name
    label_axes(axes, f"shift from {shorten(first)} [standard deviations]", "")
    handles.append(Line2D([], [], color=PALE, lw=6, alpha=0.5, label="95 % of a single shift"))
    handles.append(
        Line2D([], [], color=DARK, marker="o", ls="none", label="filled: significant at 5 % of all")
    )
    add_legend(figure, handles)
    return finish_figure(figure, _describe_changes(comparison))


def _describe_changes(comparison: RunComparison) -> str:
    """Return the outcome of each pair in a few words, and what explains a change."""
    words = {True: "has changed", False: "no change", None: "not tested"}
    lines = []
    for pair in comparison.pairs:
        line = f"{shorten(pair.second)}: {words[pair.moved]}"
        if pair.moved and pair.cause.names:
            line += f"; a change of {' and '.join(pair.cause.names)} alone explains it"
        lines.append(line)
    more = len(comparison.parameters) - MOST_ROWS
    if more > 0:
        lines.append(f"the first {MOST_ROWS} of {len(comparison.parameters)} parameters")
    return "\n".join(lines)
