# SPDX-License-Identifier: Apache-2.0
"""Pictures of a summary: a score against a factor, with the intervals of the number of trials."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from loopcal.errors import DataError, suggest_names
from loopcal.report.figures.style import (
    COLORS,
    GRID,
    LABEL,
    REFERENCE,
    SMALL,
    THIN,
    add_legend,
    finish_figure,
    label_logarithmic,
    start_figure,
)
from loopcal.report.pictures import render_figure
from loopcal.studies.results.questions import FRAMES, UNITS
from loopcal.studies.results.study_result import CellSummary, Interval, StudySummary, find_columns
from loopcal.studies.specification.levels import LevelChain, list_chains
from loopcal.studies.specification.scores import BASE_COLUMNS, ScoreColumn, check_question
from loopcal.studies.specification.study import Study
from loopcal.units import Unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure


CHAIN = ""
"""Stands for a factor: the words in which levels along the axis differ, beside their number."""

LETTERS = 60
"""Letters that fit below a panel, side by side."""


@dataclass(frozen=True)
class Axis:
    """Where levels are along the axis.

    Attributes
    ----------
    places : level -> place, in the unit of the label or as a count. label : with the unit.
    is_numeric : whether places are numbers of the levels.
    chains : level -> words in which it differs from other levels with the same number; empty where
        numbers alone distinguish the levels.
    """

    places: Mapping[str, float]
    label: str
    is_numeric: bool
    chains: Mapping[str, str]

    def list_ticks(self) -> dict[float, str]:
        """Return place -> its label, with lines that are short enough to lie side by side."""
        if self.is_numeric:
            return {place: f"{place:g}" for place in sorted(set(self.places.values()))}
        width = max(LETTERS // len(self.places) - 1, 1)
        return {
            place: textwrap.fill(level, width, break_long_words=False)
            for level, place in self.places.items()
        }

    @property
    def is_crowded(self) -> bool:
        """Whether labels side by side would overlap, even with a word a line."""
        longest = max(len(word) for label in self.list_ticks().values() for word in label.split())
        return not self.is_numeric and (longest + 1) * len(self.places) > LETTERS


@dataclass(frozen=True)
class Layout:
    """Which factor is along the axis, has colors, and has panels; None and empty without them.

    `CHAIN` is the factor of the words in `along.chains`.
    """

    axis: str
    color: str | None
    panels: tuple[str, ...]
    along: Axis

    def find_level(self, cell: CellSummary, factor: str | None) -> str:
        """Return the level of a factor in a cell; empty without one."""
        if factor is None:
            return ""
        level = cell.levels[factor or self.axis]
        return level if factor else self.along.chains[level]

    def place(self, cell: CellSummary) -> float:
        """Return where a cell is along the axis."""
        return self.along.places[cell.levels[self.axis]]


def choose_layout(study: Study, factor: str | None = None) -> Layout:
    """Return which factor goes where; the axis is `factor`, by default the varied one with the most
    levels that have an order.

    Raises DataError: an unknown factor.
    """
    factors = tuple(study.levels)
    if factor is not None and factor not in factors:
        hint = suggest_names(factor, factors)
        raise DataError(f"{factor!r} is not a factor{hint}; factors: {', '.join(factors)}")
    varied = study.varied_factors
    lengths = {
        name: max(len(c.levels) * bool(c.quantity) for c in list_chains(study, name))
        for name in varied
    }  # largest number of levels that have an order; 0 without any
    axis = factor or max(varied, key=lengths.__getitem__, default=factors[0])
    along = _place_levels(list_chains(study, axis), axis)
    counts = {CHAIN: len(set(along.chains.values()))} if along.chains else {}
    counts |= {name: len(study.levels[name]) for name in varied if name != axis}
    # the factor with the most levels that have a color each, so that panels are few
    usable = [name for name, count in counts.items() if count <= len(COLORS)]
    color = max(usable, key=counts.__getitem__, default=None)
    return Layout(axis, color, tuple(name for name in counts if name != color), along)


def _place_levels(chains: Sequence[LevelChain], factor: str) -> Axis:
    """Return where the levels of a factor are along the axis."""
    quantities = {(chain.quantity, chain.unit) for chain in chains}
    first = chains[0]
    is_numeric = len(quantities) == 1 and bool(first.quantity)
    if is_numeric and (len(chains) == 1 or any(len(chain.levels) > 1 for chain in chains)):
        unit = UNITS[first.unit]
        places = {
            level: float(value or 0.0) / unit.factor_to_si
            for chain in chains
            for level, value in zip(chain.levels, chain.values, strict=True)
        }
        words = {level: chain.label for chain in chains for level in chain.levels}
        symbol = "1" if first.unit == "1" else unit.symbol
        name = f"{factor}: {first.quantity}"
        name = factor if first.quantity in ("count", "factor") else name
        return Axis(places, f"{name} [{symbol}]", True, words if len(chains) > 1 else {})
    levels = dict.fromkeys(level for chain in chains for level in chain.levels)
    return Axis({level: float(i) for i, level in enumerate(levels)}, factor, False, {})


MOST_PANELS = 12
"""Largest number of panels of a figure."""

STYLES = {"median": ("o-", "median"), "high": ("^:", "95 % of machines"), "mean": ("o-", "mean")}
"""Statistic -> marker and line, and its words."""

OFFSET, SPREAD = 0.16, 0.6
"""Shift between two colors at levels without numbers, and that of all of them at most, in steps
between levels.
"""

COVERAGE = 0.95
"""What shares of coverage should be."""

WIDE = 5.0
"""Ratio of the ends of an axis from which it is logarithmic."""

IN_FRAME = ("position", "orientation", "covered_position", "covered_orientation")
"""Beginning of the names of scores that a frame of errors belongs to."""


@dataclass(frozen=True)
class Drawing:
    """A figure of one score.

    Attributes
    ----------
    layout : which factor is where. column : the score. unit : of its axis. colors : level -> color.
    limits : of the score, which the questions of the study state [SI].
    """

    summary: StudySummary
    layout: Layout
    column: ScoreColumn
    unit: Unit
    colors: Mapping[str, str]
    limits: tuple[float, ...]

    def find_interval(self, cell: CellSummary, kind: str) -> Interval | None:
        """Return a statistic of a cell; None without one. Means are those of shares only."""
        summary = cell.find_score(self.column.name)
        if summary is None or (kind == "mean" and summary.median is not None):
            return None
        return getattr(summary, kind)

    @property
    def kinds(self) -> dict[str, list[Interval]]:
        """Statistic -> those of the cells that have it, for the statistics that some cell has."""
        found = {k: [self.find_interval(c, k) for c in self.summary.cells] for k in STYLES}
        kept = {kind: [x for x in intervals if x is not None] for kind, intervals in found.items()}
        return {kind: intervals for kind, intervals in kept.items() if intervals}


def draw_score(
    study: Study, summary: StudySummary, score: str, factor: str | None = None
) -> Figure:
    """Draw the medians and the 95 % quantiles (or the means of shares) of a score against a factor.

    Bars are 95 % intervals by the number of trials; an arrow is an end that the trials do not
    bound. The second varied factor has colors, and all others have panels. A line is the limit of a
    question of the study.

    Parameters
    ----------
    factor : along the axis; default: the varied one with the most levels that have an order.

    Raises DataError: an unknown score or factor, or more than `MOST_PANELS` panels.
    """
    (place,) = find_columns(study, [score])
    layout = choose_layout(study, factor)
    groups = _group(summary, layout)
    if len(groups) > MOST_PANELS:
        raise DataError(
            f"the figure of {score} would have {len(groups)} panels, but at most {MOST_PANELS} are "
            "drawn; draw it from summary.csv"
        )
    column = study.columns[place]
    asked = [question for question in study.questions.values() if question.score == score]
    limits = tuple(dict.fromkeys(check_question(study, question) for question in asked))
    levels = dict.fromkeys(layout.find_level(cell, layout.color) for cell in summary.cells)
    colors = dict(zip(levels, COLORS, strict=False))  # the same in all panels
    drawing = Drawing(summary, layout, column, UNITS[column.unit], colors, limits)
    columns = min(len(groups), 3)
    rows = -(-len(groups) // columns)
    figure = start_figure(1.4 + 4.2 * columns, 1.2 + 3.4 * rows)
    axes_grid: Any = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for axes, (title, cells) in zip(axes_grid.flat, groups.items(), strict=False):
        _draw_panel(axes, cells, drawing)
        axes.set_title(title, fontsize=LABEL)
    for axes in axes_grid.flat[len(groups) :]:
        axes.set_visible(False)
    _scale_axes(axes_grid, drawing)
    add_legend(figure, _label(axes_grid, drawing), 3 if columns == 1 else 5)
    return finish_figure(figure, "\n".join(_list_titles(study, drawing, columns)))


def render_figures(
    study: Study, summary: StudySummary, scores: Sequence[str], factor: str | None = None
) -> dict[str, bytes]:
    """Return name of a file -> its figure, of each score; none of a study with too many cells for a
    figure, unless the factor is stated.

    Raises DataError: see `draw_score`.
    """
    is_too_large = len(_group(summary, choose_layout(study, factor))) > MOST_PANELS
    if factor is None and is_too_large:
        return {}
    return {
        f"{score}.png": render_figure(draw_score(study, summary, score, factor), ".png")
        for score in scores
    }


def _group(summary: StudySummary, layout: Layout) -> dict[str, list[CellSummary]]:
    """Return title of a panel -> its cells."""
    groups: dict[str, list[CellSummary]] = {}
    for cell in summary.cells:
        levels = {name: layout.find_level(cell, name) for name in layout.panels}
        title = ", ".join(f"{factor} {level}".strip() for factor, level in levels.items())
        groups.setdefault(title, []).append(cell)
    return groups


def _draw_panel(axes: Any, cells: Sequence[CellSummary], drawing: Drawing) -> None:
    """Draw the cells of a panel: a line for each color and statistic."""
    layout, colors = drawing.layout, drawing.colors
    is_numeric = layout.along.is_numeric
    offset = 0.0 if is_numeric else min(OFFSET, SPREAD / len(colors))
    for number, (name, color) in enumerate(colors.items()):
        shift = (number - (len(colors) - 1) / 2.0) * offset
        chosen = [cell for cell in cells if layout.find_level(cell, layout.color) == name]
        chosen.sort(key=layout.place)
        for kind, (style, _) in STYLES.items():
            points = [
                (layout.place(cell) + shift, interval)
                for cell in chosen
                if (interval := drawing.find_interval(cell, kind))
            ]
            if points:
                _draw_points(axes, points, drawing.unit, style if is_numeric else style[0], color)
    for limit in drawing.limits:
        axes.axhline(limit / drawing.unit.factor_to_si, color=REFERENCE, lw=THIN, ls="--", zorder=1)
    axes.grid(visible=True, lw=GRID)


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


def _scale_axes(axes_grid: Any, drawing: Drawing) -> None:
    """Choose the scales and the ticks of the axes."""
    kinds, along = drawing.kinds, drawing.layout.along
    ends = [interval.value for intervals in kinds.values() for interval in intervals]
    if ends and min(ends) > 0.0 and max(ends) > WIDE * min(ends) and "mean" not in kinds:
        axes_grid[0, 0].set_yscale("log")
        label_logarithmic(axes_grid[0, 0].yaxis)
    ticks = along.list_ticks()
    if along.is_numeric and min(ticks) > 0.0 and max(ticks) > WIDE * min(ticks):
        axes_grid[0, 0].set_xscale("log")
    for axes in axes_grid.flat:
        if "mean" in kinds:
            axes.axhline(COVERAGE, color=REFERENCE, lw=THIN, ls="--", zorder=1)
        style = {"rotation": 30, "ha": "right"} if along.is_crowded else {}
        axes.set_xticks(list(ticks), list(ticks.values()), fontsize=SMALL, **style)
        axes.minorticks_off()
        if not along.is_numeric:
            axes.set_xlim(-0.5, len(ticks) - 0.5)


def _label(axes_grid: Any, drawing: Drawing) -> list[Any]:
    """Write the labels of axes; return the entries of the legend."""
    from matplotlib.lines import Line2D

    layout, column, unit = drawing.layout, drawing.column, drawing.unit
    for axes in axes_grid[-1]:
        axes.set_xlabel(layout.along.label, fontsize=LABEL)
    for axes in axes_grid[:, 0]:
        axes.set_ylabel(f"{column.name.replace('_', ' ')} [{unit.symbol}]", fontsize=LABEL)
        axes.tick_params(axis="y", labelsize=SMALL)
    names = {} if layout.color is None else drawing.colors
    handles = [
        Line2D([], [], color=color, lw=2.0, label=f"{layout.color or ''} {level}".strip())
        for level, color in names.items()
    ]
    handles += [
        Line2D([], [], color="0.3", marker=style[0], ls=style[1:], ms=4.0, label=words)
        for kind, (style, words) in STYLES.items()
        if kind in drawing.kinds
    ]
    if drawing.limits:
        words = "limit of the question"
        handles.append(Line2D([], [], color=REFERENCE, ls="--", lw=THIN, label=words))
    return handles


def _list_titles(study: Study, drawing: Drawing, columns: int) -> list[str]:
    """Return the lines above all panels: what is drawn, in which frame, of how many trials."""
    column, summary = drawing.column, drawing.summary
    counts = [cell.trials - sum(cell.failed.values()) for cell in summary.cells]
    low, high = min(counts), max(counts)
    trials = f"{low}" if low == high else f"{low} to {high}"
    lines = [summary.title, column.meaning[0].upper() + column.meaning[1:]]
    if column.name.startswith(IN_FRAME):
        frame = study.scores.frame
        if frame == "both":
            frame = "base" if column in BASE_COLUMNS else "fitted"
        lines += textwrap.wrap(FRAMES[frame], 70 * columns)
    return [*lines, f"n = {trials} converged trials of each cell; bars are 95 % intervals"]
