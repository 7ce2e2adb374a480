# SPDX-License-Identifier: Apache-2.0
"""What repeating a paper yields: tables, verdicts and figures, all as data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from loopcal.papers.printed import Comparison, Table

ASKED_HERE = "not a statement of the paper, asked here"


@dataclass(frozen=True)
class Verdict:
    """One statement, judged.

    Attributes
    ----------
    claim : what is stated. agrees : whether what was computed bears it out; None where it cannot be
        judged, see `why`.
    why : the evidence in a sentence or two, with the numbers of this run.
    where : its place in the paper; ASKED_HERE for what the paper does not state.
    """

    claim: str
    agrees: bool | None
    why: str
    where: str

    @property
    def word(self) -> str:
        """The judgement."""
        return "Open" if self.agrees is None else "Agrees" if self.agrees else "Does not agree"


@dataclass(frozen=True)
class Series:
    """A line of a figure: points x, y."""

    label: str
    x: tuple[float, ...]
    y: tuple[float, ...]


@dataclass(frozen=True)
class Figure:
    """A figure as data.

    Attributes
    ----------
    name : of its file. title, x_label, y_label, caption : text, with units on the axes and numbers
        of cases in the caption.
    series : the lines. levels : horizontal lines by label. log : axes that are logarithmic, "", "y"
        or "xy".
    joined : whether points of a series are joined by lines; not where their order along x means
        nothing.
    """

    name: str
    title: str
    x_label: str
    y_label: str
    caption: str
    series: tuple[Series, ...]
    levels: Mapping[str, float] = field(default_factory=dict)
    log: str = "y"
    joined: bool = True


@dataclass(frozen=True)
class Reproduction:
    """A paper repeated.

    Attributes
    ----------
    paper, title, source : which. about : what was done, a paragraph each. settings : seed and sizes
        of this run.
    comparisons : published beside computed numbers, one for each table of the paper.
    tables : what was computed beyond them. verdicts : what agrees and what does not, and why.
        figures : as data.
    """

    paper: str
    title: str
    source: str
    about: tuple[str, ...]
    settings: Mapping[str, Any]
    comparisons: tuple[Comparison, ...]
    tables: tuple[Table, ...]
    verdicts: tuple[Verdict, ...]
    figures: tuple[Figure, ...]

    def summary(self) -> Table:
        """How many numbers of each published table agree to one unit of their last printed digit."""
        return Table(
            "summary",
            "Published beside computed",
            (
                "table",
                "numbers",
                "within one unit of the last digit",
                "largest difference [units of the last digit]",
            ),
            tuple(
                (c.title, c.count, c.agreeing, float((abs(c.difference) / c.step).max()))
                for c in self.comparisons
            ),
            formats=("", "d", "d", ".2g"),
        )

    def to_dict(self) -> dict[str, Any]:
        """Return everything by attribute name, for JSON."""
        parts = {
            name: getattr(self, name)
            for name in ("paper", "title", "source", "about", "settings", "verdicts", "figures")
        }
        parts["summary"] = self.summary().to_dict()
        parts["comparisons"] = [c.table().to_dict() for c in self.comparisons]
        return parts | {"tables": [table.to_dict() for table in self.tables]}
