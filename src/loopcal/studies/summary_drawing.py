# SPDX-License-Identifier: Apache-2.0
"""Pictures of a summary: a score against a factor, with the intervals of the number of trials."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from loopcal.checks import check_choice
from loopcal.errors import DataError
from loopcal.report.figures.style import (
    COLORS,
    DARK,
    DASHED,
    GRID,
    LABEL,
    LINE,
    SMALL,
    add_legend,
    finish_figure,
    scale_logarithmically,
    start_figure,
)
from loopcal.report.pictures import render_figure
from loopcal.report.words import say
from loopcal.results.tables import choose_unit
from loopcal.studies import specification
from loopcal.studies.specification import ScoreColumn, Study
from loopcal.studies.study_result import UNITS, CellSummary, Interval, StudySummary, find_columns
from loopcal.units import Unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Stands for a factor: the words in which levels along the axis differ, beside their number.
CHAIN = ""
LETTERS = 60  # letters that fit below a panel, side by side
MOST_PANELS = 12  # largest number of panels of a figure
# Statistic -> marker and line, and its words.
STYLES = {"median": ("o-", "median"), "high": ("^:", "95 % of machines"), "mean": ("o-", "mean")}

OFFSET, SPREAD = 0.16, 0.6
"""Shift between two colors at levels without numbers, and that of all of them at most, in steps
between levels.
"""

COVERAGE = 0.95  # what shares of coverage should be
WIDE = 5.0  # ratio of the ends of an axis from which it is logarithmic
# Beginning of the names of scores that a frame of errors belongs to.
IN_FRAME = ("position", "orientation", "covered_position", "covered_orientation")


@dataclass(frozen=True)
class Layout:
    """Which factor is along the axis, has colors, and has panels.

    axis : factor along the axis. label : with its unit. places : level -> place, in the unit of the
        label or as a count. is_numeric : whether places are numbers of the levels.
    chains : level -> words in which it differs from other levels with the same number, which are
        the levels of the factor `CHAIN`; empty where numbers alone distinguish the levels.
    color : factor with colors; None without one. panels : the other varied factors.
    """

    axis: str
    label: str
    places: Mapping[str, float]
    is_numeric: bool
    chains: Mapping[str, str]
    color: str | None
    panels: tuple[str, ...]

    def find_level(self, cell: CellSummary, factor: str | None) -> str:
        """Return the level of a factor in a cell; empty without one."""
        if factor is None:
            return ""
        return self.chains[cell.levels[self.axis]] if factor == CHAIN else cell.levels[factor]

    def group(self, cells: Sequence[CellSummary]) -> dict[str, list[CellSummary]]:
        """Return title of a panel -> its cells."""
        groups: dict[str, list[CellSummary]] = {}
        for cell in cells:
            levels = (f"{name} {self.find_level(cell, name)}".strip() for name in self.panels)
            groups.setdefault(", ".join(levels), []).append(cell)
        return groups


def choose_layout(study: Study, factor: str | None = None) -> Layout:
    """Return which factor goes where; the axis is `factor`, by default the varied one with the most
    levels that have an order.

    Raises DataError: an unknown factor.
    """
    factors, varied = tuple(study.levels), study.varied_factors
    if factor is not None:
        check_choice("factor", factor, factors, DataError)

    def count_ordered(name: str) -> int:
        return max(len(c.levels) * bool(c.quantity) for c in specification.list_chains(study, name))

    axis = factor or max(varied, key=count_ordered, default=factors[0])
    chains = specification.list_chains(study, axis)
    first, label, words = chains[0], axis, dict[str, str]()
    is_numeric = bool(first.quantity) and len({(c.quantity, c.unit) for c in chains}) == 1
    is_numeric &= len(chains) == 1 or any(len(chain.levels) > 1 for chain in chains)
    if is_numeric:
        unit = UNITS[first.unit]
        places = {
            level: float(value or 0.0) / unit.factor_to_si
            for chain in chains
            for level, value in zip(chain.levels, chain.values, strict=True)
        }
        if len(chains) > 1:
            words = {level: chain.label for chain in chains for level in chain.levels}
        if first.quantity not in ("count", "factor"):
            label = f"{axis}: {first.quantity}"
        label = f"{label} [{unit.symbol}]" if first.unit != "1" else label
    else:
        names = dict.fromkeys(level for chain in chains for level in chain.levels)
        places = {level: float(i) for i, level in enumerate(names)}
    counts = {CHAIN: len(set(words.values()))} if words else {}
    counts |= {name: len(study.levels[name]) for name in varied if name != axis}
    # the factor with the most levels that have a color each, so that panels are few
    usable = [name for name, count in counts.items() if count <= len(COLORS)]
    color = max(usable, key=counts.__getitem__, default=None)
    panels = tuple(name for name in counts if name != color)
    return Layout(axis, label, places, is_numeric, words, color, panels)


def draw_score(
    study: Study, summary: StudySummary, score: str, factor: str | None = None
) -> Figure:
    """Draw the medians and the 95 % quantiles (or the means of shares) of a score against a factor.

    Bars are 95 % intervals by the number of trials; an arrow is an end that the trials do not
    bound. The second varied factor has colors, and all others have panels. A line is the limit of a
    question of the study.

    factor : along the axis; default: the varied one with the most levels that have an order.

    Raises DataError: an unknown score or factor, or more than `MOST_PANELS` panels.
    """
    (place,) = find_columns(study, [score])
    layout = choose_layout(study, factor)
    groups = layout.group(summary.cells)
    if len(groups) > MOST_PANELS:
        raise DataError(
            f"the figure of {score} would have {len(groups)} panels. Allowed: at most "
            f"{MOST_PANELS}. Draw it from summary.csv"
        )
    column = study.columns[place]
    levels = dict.fromkeys(layout.find_level(cell, layout.color) for cell in summary.cells)
    colors = dict(zip(levels, COLORS, strict=False))  # the same in all panels
    asked = [question for question in study.questions.values() if question.score == score]
    limits = dict.fromkeys(specification.check_question(study, question) for question in asked)
    found = {kind: _list_values(summary.cells, score, kind) for kind in STYLES}
    kinds = [kind for kind in STYLES if found[kind]]
    ends = [interval.value for kind in kinds for _, interval in found[kind]]
    unit = choose_unit(UNITS[column.unit], [np.median(ends)] if ends else [])
    lines = {limit / unit.factor_to_si: "limit of the question" for limit in limits}
    lines |= {COVERAGE: ""} if "mean" in kinds else {}

    columns = min(len(groups), 3)
    rows = -(-len(groups) // columns)
    figure = start_figure(1.4 + 4.2 * columns, 1.2 + 3.4 * rows)
    axes_grid: Any = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for axes, (title, cells) in zip(axes_grid.flat, groups.items(), strict=False):
        axes.set_title(title, fontsize=LABEL)
        axes.grid(visible=True, lw=GRID)
        for number, (level, color) in enumerate(colors.items()):
            chosen = [cell for cell in cells if layout.find_level(cell, layout.color) == level]
            shift = (number - (len(colors) - 1) / 2.0) * min(OFFSET, SPREAD / len(colors))
            for kind in kinds:
                _draw_points(
                    axes, layout, _list_values(chosen, score, kind), shift, unit, kind, color
                )
        for y, label in lines.items():
            axes.axhline(y, **DASHED, label=label, zorder=1)
    for axes in axes_grid.flat[len(groups) :]:
        axes.set_visible(False)
    if ends and min(ends) > 0.0 and max(ends) > WIDE * min(ends) and "mean" not in kinds:
        scale_logarithmically(axes_grid[0, 0].yaxis)
    _label_places(axes_grid, layout)
    for axes in axes_grid[:, 0]:
        axes.set_ylabel(f"{score.replace('_', ' ')} [{unit.symbol}]", fontsize=LABEL)
        axes.tick_params(axis="y", labelsize=SMALL)
    for level, color in colors.items() if layout.color is not None else ():
        axes_grid[0, 0].plot([], [], color=color, lw=2.0, label=f"{layout.color} {level}".strip())
    for style, words in (STYLES[kind] for kind in kinds):
        axes_grid[0, 0].plot([], [], style, color=DARK, ms=4.0, label=words)
    add_legend(figure, 3 if columns == 1 else 5)
    return finish_figure(figure, "\n".join(_list_titles(study, summary, column, 70 * columns)))


def render_figures(
    study: Study, summary: StudySummary, scores: Sequence[str], factor: str | None = None
) -> dict[str, bytes]:
    """Return name of a file -> its figure, of each score; none of a study with too many cells for a
    figure, unless the factor is stated.

    Raises DataError: see `draw_score`.
    """
    panels = choose_layout(study, factor).group(summary.cells)
    if factor is None and len(panels) > MOST_PANELS:
        return {}
    return {
        f"{score}.png": render_figure(draw_score(study, summary, score, factor), ".png")
        for score in scores
    }


def _list_values(
    cells: Sequence[CellSummary], score: str, kind: str
) -> list[tuple[CellSummary, Interval]]:
    """Return the cells that have a statistic of a score, with it; means are those of shares."""
    found = []
    for cell in cells:
        summary = cell.find_score(score)
        if summary is not None and (kind != "mean" or summary.median is None):
            found.append((cell, getattr(summary, kind)))
    return [(cell, interval) for cell, interval in found if interval is not None]


def _draw_points(
    axes: Any,
    layout: Layout,
    values: Sequence[tuple[CellSummary, Interval]],
    shift: float,
    unit: Unit,
    kind: str,
    color: str,
) -> None:
    """Draw values with their intervals; an end without a bound is an arrow."""
    if not values:
        return
    places = [layout.places[cell.levels[layout.axis]] for cell, _ in values]
    order, style = np.argsort(places, kind="stable"), STYLES[kind][0]
    x = np.array(places)[order]
    if not layout.is_numeric:
        x, style = x + shift, style[0]
    y, low, high = (
        np.array([getattr(interval, name) for _, interval in values])[order] / unit.factor_to_si
        for name in ("value", "low", "high")
    )
    is_open_below, is_open_above = ~np.isfinite(low), ~np.isfinite(high)
    below, above = np.where(is_open_below, 0.0, y - low), np.where(is_open_above, 0.0, high - y)
    # the value of a quantile is interpolated, so that it can lie just outside of its interval
    bars = np.maximum([below, above], 0.0)
    axes.errorbar(x, y, bars, fmt=style, color=color, ms=6.0, lw=LINE, elinewidth=1.0, capsize=2.5)
    arrow = {"arrowstyle": "<-", "color": color, "lw": 1.0}
    for is_open, length in ((is_open_above, 14), (is_open_below, -14)):
        for point in zip(x[is_open], y[is_open], strict=True):
            axes.annotate("", point, (0, length), textcoords="offset points", arrowprops=arrow)


def _label_places(axes_grid: Any, layout: Layout) -> None:
    """Write the levels along the axis, with lines that are short enough to lie side by side."""
    style = {}
    if layout.is_numeric:
        ticks = {place: f"{place:g}" for place in sorted(set(layout.places.values()))}
        if min(ticks) > 0.0 and max(ticks) > WIDE * min(ticks):
            axes_grid[0, 0].set_xscale("log")
    else:
        width = max(LETTERS // len(layout.places) - 1, 1)
        ticks = {
            place: textwrap.fill(level, width, break_long_words=False)
            for level, place in layout.places.items()
        }
        longest = max(len(word) for level in layout.places for word in level.split())
        if (longest + 1) * len(ticks) > LETTERS:  # they would overlap, even with a word a line
            style = {"rotation": 30, "ha": "right"}
    for axes in axes_grid.flat:
        axes.set_xticks(list(ticks), list(ticks.values()), fontsize=SMALL, **style)
        axes.minorticks_off()
        if not layout.is_numeric:
            axes.set_xlim(-0.5, len(ticks) - 0.5)
    for axes in axes_grid[-1]:
        axes.set_xlabel(layout.label, fontsize=LABEL)


def _list_titles(study: Study, summary: StudySummary, column: ScoreColumn, width: int) -> list[str]:
    """Return the lines above all panels: what is drawn, in which frame, of how many trials."""
    counts = [cell.trials - sum(cell.failed.values()) for cell in summary.cells]
    low, high = min(counts), max(counts)
    trials = f"{low}" if low == high else f"{low} to {high}"
    lines = [summary.title, column.meaning[0].upper() + column.meaning[1:]]
    if column.name.startswith(IN_FRAME):
        frame = study.scores.frame
        if frame == "both":
            frame = "base" if column in specification.read_columns()["base"] else "fitted"
        lines += textwrap.wrap(say(f"study.frame-{frame}"), width)
    return [*lines, f"n = {trials} trials of each cell that did not fail; bars are 95 % intervals"]
