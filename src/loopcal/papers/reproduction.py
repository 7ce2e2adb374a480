# SPDX-License-Identifier: Apache-2.0
"""The result of repeating a paper: tables, verdicts and figures, all as data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from loopcal.papers.printed import Comparison, Table

OWN_CHECK = "our own check, not a statement of the paper"
"""Place of a claim that the paper does not make."""


@dataclass(frozen=True)
class Verdict:
    """The judgement of one claim.

    Attributes
    ----------
    claim : the statement. agrees : whether the computed numbers support it; None where they cannot
        decide, or where the draws of a random study differ.
    why : the evidence in a sentence or two, with the numbers of this run.
    where : place of the claim in the paper; OWN_CHECK for a check of ours.
    name : of the claim in text.yaml.
    draws : whether each repeated draw of a random study supports the claim (None: cannot decide);
        empty where nothing was drawn again.
    """

    claim: str
    agrees: bool | None
    why: str
    where: str
    name: str = ""
    draws: tuple[bool | None, ...] = ()

    @property
    def is_own_check(self) -> bool:
        """Whether the claim is a check of ours and not a statement of the paper."""
        return self.where == OWN_CHECK

    @property
    def depends_on_draw(self) -> bool:
        """Whether repeated draws lead to different answers."""
        return len(set(self.draws)) > 1

    @property
    def word(self) -> str:
        """The judgement as a word: a claim of the paper agrees, a check of ours is confirmed."""
        if self.depends_on_draw:
            return "Depends on the draw"
        if self.agrees is None:
            return "Undecided"
        if self.is_own_check:
            return "Confirmed" if self.agrees else "Not confirmed"
        return "Agrees" if self.agrees else "Does not agree"

    @property
    def stability(self) -> str:
        """How many of the repeated draws support the claim, as a sentence; else ""."""
        if not self.draws:
            return ""
        return f"True in {sum(map(bool, self.draws))} of {len(self.draws)} draws."


@dataclass(frozen=True)
class Series:
    """A line of a figure: points x, y. A label that begins with _ is not in the legend."""

    label: str
    x: tuple[float, ...]
    y: tuple[float, ...]

    @property
    def is_named(self) -> bool:
        """Whether the legend names the line."""
        return not self.label.startswith("_")


@dataclass(frozen=True)
class Figure:
    """A figure as data.

    Attributes
    ----------
    name : of its file. title, x_label, y_label, caption : texts, with units on the axes and the
        number of cases in the caption.
    series : the lines. levels : horizontal lines by label. log : logarithmic axes: "", "y" or "xy".
    joined : whether lines join the points of a series. They do not where the order along x means
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


Content = tuple[tuple[Comparison, ...], tuple[Table, ...], tuple[Verdict, ...], tuple[Figure, ...]]
"""What a study shows: comparisons, further tables, verdicts, figures."""


@dataclass(frozen=True)
class Reproduction:
    """A repeated paper.

    Attributes
    ----------
    paper, title, source : which one. about : paragraphs on what was done.
    settings : seed and sizes of this run.
    comparisons : published beside computed numbers, one for each table of the paper.
    tables : further computed numbers. verdicts : the judged claims, those of the paper and our own
        checks. figures : as data.
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

    @property
    def verdict_groups(self) -> dict[str, tuple[tuple[int, Verdict], ...]]:
        """Verdicts with their numbers on a page, by title: statements of the paper, own checks."""
        ordered = sorted(self.verdicts, key=lambda verdict: verdict.is_own_check)
        groups: dict[str, tuple[tuple[int, Verdict], ...]] = {}
        for number, verdict in enumerate(ordered, 1):
            title = "Our own checks" if verdict.is_own_check else "Statements of the paper"
            groups[title] = (*groups.get(title, ()), (number, verdict))
        return groups

    def summary(self) -> Table:
        """Return how many numbers of each published table agree to one unit of their last digit."""
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
        """Return all content by attribute name, for JSON."""
        names = ("paper", "title", "source", "about", "settings", "verdicts", "figures")
        return {
            **{name: getattr(self, name) for name in names},
            "summary": self.summary().to_dict(),
            "comparisons": [c.table().to_dict() for c in self.comparisons],
            "tables": [table.to_dict() for table in self.tables],
        }
