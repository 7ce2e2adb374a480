# SPDX-License-Identifier: Apache-2.0
"""Which factor of a study is along the axis of a figure, has colors, and has panels."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from loopcal.errors import DataError, suggest_names
from loopcal.report.figures.style import COLORS
from loopcal.studies.results.summary import CellSummary, StudySummary
from loopcal.studies.results.summary_view import UNITS
from loopcal.studies.specification.cells import list_factors, list_varied_factors
from loopcal.studies.specification.level_chains import LevelChain, list_chains
from loopcal.studies.specification.study import Study

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

    def find_level(self, cell: CellSummary, factor: str) -> str:
        """Return the level of a factor in a cell."""
        level = cell.levels[factor or self.axis]
        return level if factor else self.along.chains[level]

    def name_level(self, factor: str, level: str) -> str:
        """Return a level with its factor."""
        return f"{factor} {level}".strip()

    def place(self, cell: CellSummary) -> float:
        """Return where a cell is along the axis."""
        return self.along.places[cell.levels[self.axis]]


def choose_layout(study: Study, factor: str | None = None) -> Layout:
    """Return which factor goes where; the axis is `factor`, by default the varied one with the most
    levels that have an order.

    Raises
    ------
    DataError : an unknown factor.
    """
    factors = list_factors(study)
    if factor is not None and factor not in factors:
        hint = suggest_names(factor, factors)
        raise DataError(f"{factor!r} is not a factor{hint}; factors: {', '.join(factors)}")
    varied = list_varied_factors(study)
    lengths = {name: _count_ordered(study, name) for name in varied}
    axis = factor or max(varied, key=lengths.__getitem__, default=factors[0])
    along = _place_levels(list_chains(study, axis), axis)
    counts = {CHAIN: len(set(along.chains.values()))} if along.chains else {}
    counts |= {
        name: len({cell.levels[name] for cell in study.cells}) for name in varied if name != axis
    }
    # the factor with the most levels that have a color each, so that panels are few
    usable = [name for name, count in counts.items() if count <= len(COLORS)]
    color = max(usable, key=counts.__getitem__, default=None)
    return Layout(axis, color, tuple(name for name in counts if name != color), along)


def list_colors(summary: StudySummary, layout: Layout) -> dict[str, str]:
    """Return level -> color, the same in all panels."""
    if layout.color is None:
        return {"": COLORS[0]}
    levels = dict.fromkeys(layout.find_level(cell, layout.color) for cell in summary.cells)
    return dict(zip(levels, COLORS, strict=False))


def _count_ordered(study: Study, factor: str) -> int:
    """Return the largest number of levels of a factor that have an order; 0 without any."""
    return max(len(chain.levels) * bool(chain.quantity) for chain in list_chains(study, factor))


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
