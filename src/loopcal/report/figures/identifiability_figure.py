# SPDX-License-Identifier: Apache-2.0
"""What measurements determine: singular values with the gap, and the combinations left open."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from loopcal.diagnose import Identifiability
from loopcal.report.figures.style import (
    COLORS,
    DARK,
    DIVERGING,
    DOT,
    LABEL,
    REFERENCE,
    SMALL,
    THIN,
    add_legend,
    finish_figure,
    label_axes,
    shorten,
    start_figure,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from loopcal.estimate import Combination

MOST_COMBINATIONS, MOST_NAMES = 14, 48
"""Combinations and parameters that the picture of combinations shows."""

FLOOR = 1e-18
"""Share of the largest singular value at which a smaller one is drawn."""

COUNTED, CUT = COLORS[0], COLORS[1]
"""Colors of singular values that count and of those that count as zero."""


def draw_identifiability(analysis: Identifiability) -> Figure:
    """Draw the singular values with the rank and the gap, and the null vectors and weak directions
    as weights of the parameters.
    """
    combinations = (*analysis.unidentifiable, *analysis.weak)[:MOST_COMBINATIONS]
    names = _list_names(combinations)
    width = 5.2 + (2.2 + 0.42 * len(combinations) + 0.8 if combinations else 0.0)
    figure = start_figure(width, max(4.7, 2.2 + 0.17 * len(names)))
    if not combinations:
        _draw_spectrum(figure.add_subplot(), analysis)
    else:
        panels: Any = figure.subplots(1, 2, width_ratios=[5.0, width - 5.0])
        _draw_spectrum(panels[0], analysis)
        _draw_combinations(figure, panels[1], analysis, combinations, names)
    add_legend(figure, figure.axes[0].get_legend_handles_labels()[0])
    robot = analysis.free_parameters.robot.name
    rank = f"rank {analysis.rank} of {analysis.n_parameters}"
    return finish_figure(figure, f"{robot}: {rank}, {analysis.n_equations} equations")


def _draw_spectrum(axes: Axes, analysis: Identifiability) -> None:
    """Draw the singular values: those that count, those that do not, and the limits."""
    s, rank = analysis.singular_values, analysis.rank
    number = np.arange(1, len(s) + 1)
    floor = FLOOR * float(s[0]) if len(s) and s[0] > 0.0 else FLOOR
    drawn = np.maximum(s, floor)
    axes.plot(number[:rank], drawn[:rank], "o", color=COUNTED, ms=DOT + 0.5, label="determined")
    if rank < len(s):
        axes.plot(
            number[rank:],
            drawn[rank:],
            "v",
            color=CUT,
            mfc="none",
            ms=DOT + 1.5,
            label="counts as zero",
        )
    axes.axhline(1.0, color=REFERENCE, lw=THIN, ls="--", label="known as well as the tolerance")
    if rank < len(s):
        limit = max(analysis.tolerance * float(s[0]), floor)
        axes.axhline(limit, color=DARK, lw=THIN, ls=":", label="limit of the rank")
    axes.set_yscale("log")
    _set_powers(axes)
    if 0 < rank < len(s):
        _mark_gap(axes, analysis, drawn)
    from matplotlib.ticker import MaxNLocator

    axes.set_xlim(0.4 - 0.02 * len(s), len(s) + 0.6 + 0.02 * len(s))
    axes.xaxis.set_major_locator(MaxNLocator(10, integer=True, min_n_ticks=1))
    label_axes(axes, "direction [1]", "singular value [sigma per tolerance]", "singular values")


def _set_powers(axes: Axes) -> None:
    """Write some powers of ten."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    low, high = axes.get_ylim()
    axes.set_ylim(low, high * 3.0)
    axes.yaxis.set_major_locator(LogLocator(numticks=10))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_locator(NullLocator())


def _mark_gap(axes: Axes, analysis: Identifiability, drawn: np.ndarray) -> None:
    """Draw an arrow over the gap between the values that count and those that do not."""
    rank = analysis.rank
    x = rank + 0.5
    ends = (x, float(drawn[rank - 1])), (x, float(drawn[rank]))
    axes.annotate("", *ends, arrowprops={"arrowstyle": "<->", "color": DARK, "lw": THIN})
    axes.annotate(
        f"gap {analysis.gap:.2g}" if np.isfinite(analysis.gap) else "infinite gap",
        (x, float(np.sqrt(drawn[rank - 1] * drawn[rank]))),
        xytext=(-4, 0),
        textcoords="offset points",
        ha="right",
        va="center",
        fontsize=SMALL,
    )


def _list_names(combinations: tuple[Combination, ...]) -> list[str]:
    """Return the parameters of the combinations, at most so many."""
    names = dict.fromkeys(name for c in combinations for name in c.names)
    return list(names)[:MOST_NAMES]


def _draw_combinations(
    figure: Figure,
    axes: Axes,
    analysis: Identifiability,
    combinations: tuple[Combination, ...],
    names: list[str],
) -> None:
    """Draw the weight of each parameter in each combination as a color."""
    weights = np.zeros((len(names), len(combinations)))
    for column, combination in enumerate(combinations):
        for name, weight in zip(combination.names, combination.weights, strict=True):
            if name in names:
                weights[names.index(name), column] = weight
    weights /= np.maximum(np.abs(weights).max(axis=0), 1e-300)
    image = axes.imshow(weights, cmap=DIVERGING, vmin=-1.0, vmax=1.0, aspect="auto")
    null = len(analysis.unidentifiable)
    labels = [
        f"null {i + 1}" if i < null else f"weak {i + 1 - null}" for i in range(len(combinations))
    ]
    axes.set_xticks(range(len(combinations)), labels, rotation=90)
    axes.set_yticks(range(len(names)), [shorten(name) for name in names])
    if 0 < null < len(combinations):
        axes.axvline(null - 0.5, color=DARK, lw=THIN)
    shown = len(combinations) < null + len(analysis.weak)
    more = f" (first {len(combinations)})" if shown else ""
    label_axes(axes, "", "", f"null vectors and weak directions{more}", grid=False)
    total = len(dict.fromkeys(n for c in combinations for n in c.names))
    if total > len(names):
        axes.set_xlabel(f"and {total - len(names)} more parameters", fontsize=SMALL)
    bar = figure.colorbar(image, ax=axes, aspect=25, shrink=0.8)
    bar.set_label("weight in tolerances, largest = 1 [1]", fontsize=LABEL)
    bar.ax.tick_params(labelsize=SMALL)
