# SPDX-License-Identifier: Apache-2.0
"""Pictures of a summary: a score against a factor, with the intervals of the number of trials."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from loopcal.errors import DataError, suggest_names
from loopcal.report.figures.style import COLORS, label_logarithmic, show_names, start_figure
from loopcal.report.pictures import render_figure
from loopcal.studies.results.study_result import find_columns
from loopcal.studies.results.summary import CellSummary, Interval, StudySummary
from loopcal.studies.results.summary_view import UNITS
from loopcal.studies.specification.cells import list_factors, list_varied_factors
from loopcal.studies.specification.level_chains import list_chains
from loopcal.studies.specification.study import Study
from loopcal.units import Unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_PANELS = 12
"""Largest number of panels of a figure."""

STYLES = {"median": ("o-", "median"), "high": ("^:", "95 % of machines"), "mean": ("o-", "mean")}
"""Statistic -> marker and line, and its words."""

OFFSET = 0.06
"""Shift between two colors at levels without numbers, in steps between levels."""

COVERAGE = 0.95
"""What shares of coverage should be."""

WIDE = 5.0
"""Ratio of the ends of an axis from which it is logarithmic."""


@dataclass(frozen=True)
class Layout:
    """Which factor is along the axis, has colors, and has panels; None and empty without them."""

    axis: str
    color: str | None
    panels: tuple[str, ...]


@dataclass(frozen=True)
class Axis:
    """Where levels are along the axis: level -> place, in the unit of the label or as a count."""

    places: Mapping[str, float]
    label: str
    is_numeric: bool


def draw_score(
    study: Study, summary: StudySummary, score: str, factor: str | None = None
) -> Figure:
    """Draw the medians and the 95 % quantiles (or the means of shares) of a score against a factor.

    Bars are 95 % intervals by the number of trials; an arrow is an end that the trials do not
    bound. The second varied factor has colors, and all others have panels.

    Parameters
    ----------
    factor : along the axis; default: the varied one with the most levels that have an order.

    Raises
    ------
    DataError : an unknown score or factor, or more than `MOST_PANELS` panels.
    """
    (place,) = find_columns(study, [score])
    layout = choose_layout(study, factor)
    groups = _group(summary, layout)
    if len(groups) > MOST_PANELS:
        raise DataError(
            f"the figure of {score} would have {len(groups)} panels, but at most {MOST_PANELS} are "
            "drawn; draw it from summary.csv"
        )
    unit = UNITS[study.columns[place].unit]
    columns = min(len(groups), 3)
    rows = -(-len(groups) // columns)
    figure = start_figure(1.4 + 4.2 * columns, 0.9 + 3.4 * rows)
    every: Any = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    colors, along = _list_colors(summary, layout), _place_levels(study, layout.axis)
    for axes, (title, cells) in zip(every.flat, groups.items(), strict=False):
        _draw_panel(axes, cells, layout, along, score, unit, colors)
        axes.set_title(title, fontsize=9)
    for axes in every.flat[len(groups) :]:
        axes.set_visible(False)
    _label(figure, every, summary, layout, along, score, unit, colors)
    return show_names(figure)


def render_figures(
    study: Study, summary: StudySummary, scores: Sequence[str], factor: str | None = None
) -> dict[str, bytes]:
    """Return name of a file -> its figure, of each score; none of a study with too many cells for a
    figure, unless the factor is stated.

    Raises
    ------
    DataError : see `draw_score`.
    """
    is_too_large = len(_group(summary, choose_layout(study, factor))) > MOST_PANELS
    if factor is None and is_too_large:
        return {}
    return {
        f"{score}.png": render_figure(draw_score(study, summary, score, factor), ".png")
        for score in scores
    }


def choose_layout(study: Study, factor: str | None = None) -> Layout:
    """Return which factor goes where; the axis is `factor`."""
    factors = list_factors(study)
    if factor is not None and factor not in factors:
        hint = suggest_names(factor, factors)
        raise DataError(f"{factor!r} is not a factor{hint}; factors: {', '.join(factors)}")
    varied = list_varied_factors(study)
    lengths = {name: _count_ordered(study, name) for name in varied}
    axis = factor or max(varied, key=lengths.__getitem__, default=factors[0])
    others = [name for name in varied if name != axis]
    # the factor with the most levels that have a color each, so that panels are few
    usable = [name for name in others if _count_levels(study, name) <= len(COLORS)]
    color = max(usable, key=lambda name: _count_levels(study, name), default=None)
    return Layout(axis, color, tuple(name for name in others if name != color))


def _count_ordered(study: Study, factor: str) -> int:
    """Return the largest number of levels of a factor that have an order; 0 without any."""
    return max(len(chain.levels) * bool(chain.quantity) for chain in list_chains(study, factor))


def _count_levels(study: Study, factor: str) -> int:
    return len({cell.levels[factor] for cell in study.cells})


def _group(summary: StudySummary, layout: Layout) -> dict[str, list[CellSummary]]:
    """Return title of a panel -> its cells."""
    groups: dict[str, list[CellSummary]] = {}
    for cell in summary.cells:
        title = ", ".join(f"{name} {cell.levels[name]}" for name in layout.panels)
        groups.setdefault(title, []).append(cell)
    return groups


def _list_colors(summary: StudySummary, layout: Layout) -> dict[str, str]:
    """Return level -> color, the same in all panels."""
    if layout.color is None:
        return {"": COLORS[0]}
    levels = dict.fromkeys(cell.levels[layout.color] for cell in summary.cells)
    return dict(zip(levels, COLORS, strict=False))


def _place_levels(study: Study, factor: str) -> Axis:
    """Return where the levels of a factor are along the axis."""
    chains = list_chains(study, factor)
    if len(chains) == 1 and chains[0].quantity:
        (chain,) = chains
        unit = UNITS[chain.unit]
        values = [float(value or 0.0) / unit.factor_to_si for value in chain.values]
        symbol = "1" if chain.unit == "1" else unit.symbol
        name = factor if chain.quantity in ("count", "factor") else f"{factor}: {chain.quantity}"
        return Axis(dict(zip(chain.levels, values, strict=True)), f"{name} [{symbol}]", True)
    levels = dict.fromkeys(level for chain in chains for level in chain.levels)
    return Axis({level: float(i) for i, level in enumerate(levels)}, factor, False)


def _draw_panel(
    axes: Any,
    cells: Sequence[CellSummary],
    layout: Layout,
    along: Axis,
    score: str,
    unit: Unit,
    colors: Mapping[str, str],
) -> None:
    """Draw the cells of a panel: a line for each color and statistic."""
    for number, (name, color) in enumerate(colors.items()):
        shift = 0.0 if along.is_numeric else (number - (len(colors) - 1) / 2.0) * OFFSET
        chosen = [c for c in cells if layout.color is None or c.levels[layout.color] == name]
        chosen.sort(key=lambda cell: along.places[cell.levels[layout.axis]])
        for kind, (style, _) in STYLES.items():
            points = [
                (along.places[cell.levels[layout.axis]] + shift, interval)
                for cell in chosen
                if (interval := _find_interval(cell, score, kind))
            ]
            if points:
                _draw_points(axes, points, unit, style if along.is_numeric else style[0], color)
    if not along.is_numeric:
        axes.set_xticks(list(along.places.values()), list(along.places))
        axes.set_xlim(-0.5, len(along.places) - 0.5)
    axes.grid(visible=True, lw=0.3)


def _draw_points(
    axes: Any, points: Sequence[tuple[float, Interval]], unit: Unit, style: str, color: str
) -> None:
    """Draw values with their intervals; an end without a bound is an arrow."""
    x = np.array([place for place, _ in points])
    y, low, high = (
        np.array([getattr(interval, name) for _, interval in points]) / unit.factor_to_si
        for name in ("value", "low", "high")
    )
    is_open_below, is_open_above = ~np.isfinite(low), ~np.isfinite(high)
    below, above = np.where(is_open_below, 0.0, y - low), np.where(is_open_above, 0.0, high - y)
    # the value of a quantile is interpolated, so that it can lie just outside of its interval
    bars = np.maximum([below, above], 0.0)
    axes.errorbar(x, y, bars, fmt=style, color=color, ms=4.0, lw=1.0, elinewidth=1.0, capsize=2.0)
    for is_open, (dx, dy) in ((is_open_above, (0, 14)), (is_open_below, (0, -14))):
        for place, value in zip(x[is_open], y[is_open], strict=True):
            axes.annotate(
                "",
                (place, value),
                (dx, dy),
                textcoords="offset points",
                arrowprops={"arrowstyle": "<-", "color": color, "lw": 1.0},
            )


def _find_interval(cell: CellSummary, score: str, kind: str) -> Interval | None:
    """Return a statistic of a cell; None without one. Means are those of shares only."""
    summary = cell.find_score(score)
    if summary is None or (kind == "mean" and summary.median is not None):
        return None
    return getattr(summary, kind)


def _label(
    figure: Figure,
    every: Any,
    summary: StudySummary,
    layout: Layout,
    along: Axis,
    score: str,
    unit: Unit,
    colors: Mapping[str, str],
) -> None:
    """Write labels, the legend and the title, and choose the scales of the axes."""
    from matplotlib.lines import Line2D

    kinds = [
        kind
        for kind in STYLES
        if any(_find_interval(cell, score, kind) is not None for cell in summary.cells)
    ]
    ends = [
        interval.value
        for kind in kinds
        for cell in summary.cells
        if (interval := _find_interval(cell, score, kind)) is not None
    ]
    if ends and min(ends) > 0.0 and max(ends) > WIDE * min(ends) and "mean" not in kinds:
        every[0, 0].set_yscale("log")
        label_logarithmic(every[0, 0].yaxis)
    if "mean" in kinds:
        for axes in every.flat:
            axes.axhline(COVERAGE, color="0.5", lw=1.0, ls="--", zorder=1)
    if along.is_numeric:
        places = list(along.places.values())
        if min(places) > 0.0 and max(places) > WIDE * min(places):
            every[0, 0].set_xscale("log")
        for axes in every.flat:
            axes.set_xticks(places, [f"{place:g}" for place in places])
            axes.minorticks_off()
    for axes in every[-1]:
        axes.set_xlabel(along.label, fontsize=9)
    for axes in every[:, 0]:
        axes.set_ylabel(f"{score.replace('_', ' ')} [{unit.symbol}]", fontsize=9)
    handles = [
        Line2D([], [], color=color, lw=2.0, label=f"{layout.color} {level}")
        for level, color in (colors.items() if layout.color else ())
    ]
    handles += [
        Line2D([], [], color="0.3", marker=style[0], ls=style[1:], ms=4.0, label=words)
        for kind, (style, words) in STYLES.items()
        if kind in kinds
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False, fontsize=8)
    counts = [cell.trials - sum(cell.failed.values()) for cell in summary.cells]
    low, high = min(counts), max(counts)
    trials = f"{low}" if low == high else f"{low} to {high}"
    figure.suptitle(
        f"{summary.title}\nn = {trials} converged trials of each cell; bars are 95 % intervals",
        fontsize=10,
    )
