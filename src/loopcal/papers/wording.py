# SPDX-License-Identifier: Apache-2.0
"""The words of a repeated paper: claims, evidence, tables and figures, read from its text.yaml.

The modules of a paper compute numbers. Its text.yaml states the claims and gives the sentences in
which the numbers are shown:

    about: paragraphs at the beginning of the page
    claims:
      NAME: {claim: ..., where: place in the paper, agrees: [...], disagrees: [...],
             evidence: sentence}
    tables:
      NAME: {title: ..., columns: [...], formats: [...], note: ...}
    figures:
      NAME: {title: ..., x: label, y: label, caption: ..., log: y}

A claim without `where` is not a statement of the paper but a check of our own. `agrees` lists
comparisons of the numbers with each other or with limits, such as "ratio < 1.1". The claim agrees
where all of them hold. Otherwise it does not agree; if it lists comparisons `disagrees`, too, it
does not agree where all of those hold, and is undecided elsewhere. So every verdict follows from
numbers. A claim about random numbers is judged in each of several draws; its verdict says in how
many it holds. Braces hold numbers in the formats of `loopcal.findings.wording`.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from string import Formatter
from typing import Any

from loopcal.findings.wording import fill_template
from loopcal.papers.printed import Cell, Comparison, Printed, Table
from loopcal.papers.reproduction import OWN_CHECK, Figure, Series, Verdict
from loopcal.typing import FloatArray

RELATIONS: Mapping[str, Callable[[Any, Any], Any]] = {
    "<": operator.lt, "<=": operator.le, "==": operator.eq, "!=": operator.ne, ">=": operator.ge,
    ">": operator.gt,
}  # fmt: skip


@dataclass(frozen=True)
class Wording:
    """The content of a text.yaml.

    Attributes
    ----------
    paragraphs : of `about`. claims, tables, figures : by name.
    """

    paragraphs: tuple[str, ...]
    claims: Mapping[str, Mapping[str, Any]]
    tables: Mapping[str, Mapping[str, Any]]
    figures: Mapping[str, Mapping[str, Any]]

    def about(self, **data: Any) -> tuple[str, ...]:
        """Return the paragraphs at the beginning of the page."""
        return tuple(fill_template(text, **data) for text in self.paragraphs)

    def judge(
        self,
        claim: str,
        evidence: str = "",
        /,
        *,
        draws: Sequence[Mapping[str, Any]] = (),
        **data: Any,
    ) -> Verdict:
        """Return the verdict on a claim.

        Parameters
        ----------
        claim : its name. evidence : which of several texts `evidence_NAME` of the claim to use.
        draws : the numbers of each repeated draw of a random study, which replace those of `data`
            in the comparisons. data : the numbers.
        """
        text = self.claims[claim]
        judged = tuple(judge_numbers(text, {**data, **drawn}) for drawn in draws)
        if judged:
            decided = judged[0] if len(set(judged)) == 1 else None
        else:
            decided = judge_numbers(text, data)
        return Verdict(
            claim=fill_template(text["claim"], **data),
            agrees=decided,
            why=fill_template(text[f"evidence_{evidence}" if evidence else "evidence"], **data),
            where=text.get("where", OWN_CHECK),
            name=claim,
            draws=judged,
        )

    def table(
        self, name: str, rows: Iterable[Sequence[Cell]], file_name: str = "", /, **data: Any
    ) -> Table:
        """Return a table of computed rows.

        Parameters
        ----------
        name : in text.yaml. rows : of cells. file_name : of the written table; default `name`.
        data : numbers in title, columns and note.
        """
        text = self.tables[name]
        return Table(
            name=file_name or name,
            title=fill_template(text["title"], **data),
            columns=tuple(fill_template(column, **data) for column in text["columns"]),
            rows=tuple(tuple(row) for row in rows),
            formats=tuple(text["formats"]),
            note=fill_template(text.get("note", ""), **data),
            shown=text.get("shown"),
        )

    def compare(
        self,
        name: str,
        published: Printed,
        computed: FloatArray,
        yardstick: FloatArray | None = None,
        /,
        **data: Any,
    ) -> Comparison:
        """Return printed numbers beside computed ones (r, c).

        Parameters
        ----------
        name : of the table. yardstick : (r, c) difference within which numbers agree; default one
            unit of the last printed digit. data : numbers in the note.
        """
        text = self.tables[name]
        return Comparison(
            name=name,
            title=text["title"],
            columns=tuple(text["columns"]),
            published=published,
            computed=computed,
            note=fill_template(text.get("note", ""), **data),
            yardstick=yardstick,
        )

    def figure(
        self,
        name: str,
        series: Iterable[Series],
        levels: Mapping[str, float] | None = None,
        file_name: str = "",
        /,
        **data: Any,
    ) -> Figure:
        """Return a figure.

        Parameters
        ----------
        name : in text.yaml. series : its lines. levels : horizontal lines by label.
        file_name : of the written figure; default `name`. data : numbers in its texts.
        """
        text = self.figures[name]
        title, x, y, caption = (
            fill_template(text[key], **data) for key in ("title", "x", "y", "caption")
        )
        lines = levels or {}
        log = text.get("log", "y")
        return Figure(file_name or name, title, x, y, caption, tuple(series), lines, log)


def judge_numbers(claim: Mapping[str, Any], data: Mapping[str, Any]) -> bool | None:
    """Return whether numbers support a claim of text.yaml; None where they cannot decide.

    Examples
    --------
    >>> claim = {"agrees": ["lower == all"], "disagrees": ["lower == 0"]}
    >>> [judge_numbers(claim, {"lower": n, "all": 4}) for n in (4, 0, 1)]
    [True, False, None]
    """
    if all(compare_numbers(rule, data) for rule in claim["agrees"]):
        return True
    return False if all(compare_numbers(r, data) for r in claim.get("disagrees", ())) else None


def compare_numbers(rule: str, data: Mapping[str, Any]) -> bool:
    """Return whether a comparison holds for these data.

    Examples
    --------
    >>> compare_numbers("ratio < 1.1", {"ratio": 1.0}), compare_numbers("a == b", {"a": 1, "b": 2})
    (True, False)
    """
    relation = next(word for word in rule.split() if word in RELATIONS)
    first, second = (_evaluate(side.strip(), data) for side in rule.split(relation))
    return bool(RELATIONS[relation](first, second))


def _evaluate(term: str, data: Mapping[str, Any]) -> Any:
    """Return a number, or the value of a name in the data, such as `best.formula` or `sd[full]`."""
    try:
        return float(term)
    except ValueError:
        return Formatter().get_field(term, (), data)[0]


@cache
def read_wording(module: str) -> Wording:
    """Return the content of the text.yaml beside a module (its `__file__`)."""
    from loopcal.io.core.yaml_file import read_yaml

    content: dict[str, Any] = read_yaml(
        Path(module).with_name("text.yaml"), "file of claims and captions", has_names=False
    ).content
    return Wording(
        paragraphs=tuple(content["about"]),
        claims=content["claims"],
        tables=content.get("tables", {}),
        figures=content.get("figures", {}),
    )
