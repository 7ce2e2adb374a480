# SPDX-License-Identifier: Apache-2.0
"""Claims of a paper, and our own checks, judged by the numbers of a run.

The file text.yaml of a paper states each claim as a record:

    NAME:
      claim: a sentence
      where: place in the paper; a claim without it is a check of our own
      agrees: [[quantity, relation, limit], ...]
      disagrees: the same; optional
      evidence: sentences that show the numbers

A limit is a number or the name of another quantity. The claim agrees if all comparisons of `agrees`
hold. Otherwise it does not agree; with comparisons `disagrees` it does not agree if all of those
hold, and else is undecided. A claim about random numbers is judged in each of several draws. Braces
hold numbers in the formats of `loopcal.findings.wording`.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from string import Formatter
from typing import Any

import numpy as np

from loopcal.findings.wording import fill_template

OWN_CHECK = "our own check, not a statement of the paper"
"""Place of a claim that the paper does not make."""

RELATIONS: Mapping[str, Callable[[Any, Any], Any]] = {
    "below": operator.lt, "at most": operator.le, "equals": operator.eq,
    "differs from": operator.ne, "at least": operator.ge, "above": operator.gt,
}  # fmt: skip


@dataclass(frozen=True)
class Verdict:
    """The judgement of one claim."""

    claim: str
    # whether the numbers support it; None if they cannot decide, or if draws differ
    agrees: bool | None
    why: str  # the evidence in a sentence or two, with the numbers of this run
    where: str  # place in the paper, or OWN_CHECK
    name: str = ""  # in text.yaml
    # whether each repeated draw of a random study supports the claim (None: cannot decide)
    draws: tuple[bool | None, ...] = ()

    @property
    def is_own_check(self) -> bool:
        """Whether the claim is a check of ours and not a statement of the paper."""
        return self.where == OWN_CHECK

    @property
    def word(self) -> str:
        """The judgement as a word: a claim of the paper agrees, a check of ours is confirmed."""
        if len(set(self.draws)) > 1:
            return "Depends on the draw"
        if self.agrees is None:
            return "Undecided"
        if self.is_own_check:
            return "Confirmed" if self.agrees else "Not confirmed"
        return "Agrees" if self.agrees else "Does not agree"

    @property
    def reason(self) -> str:
        """How many of the repeated draws support the claim, and the evidence."""
        if not self.draws:
            return self.why
        return f"True in {sum(map(bool, self.draws))} of {len(self.draws)} draws. {self.why}"


@dataclass(frozen=True)
class Claim:
    """A claim of text.yaml: its name and its record."""

    name: str
    record: Mapping[str, Any]

    def decide(self, data: Mapping[str, Any]) -> bool | None:
        """Return whether numbers support the claim; None if they cannot decide.

        Examples
        --------
        >>> record = {"agrees": [["n", "equals", "all"]], "disagrees": [["n", "equals", 0]]}
        >>> [Claim("lower", record).decide({"n": n, "all": 4}) for n in (4, 0, 1)]
        [True, False, None]
        """
        for key, answer in (("agrees", True), ("disagrees", False)):
            comparisons = self.record.get(key, ())
            if all(RELATIONS[how](_find(a, data), _find(b, data)) for a, how, b in comparisons):
                return answer
        return None

    def judge(self, draws: Sequence[Mapping[str, Any]] = (), /, **data: Any) -> Verdict:
        """Return the verdict; draws : numbers of each repeated draw, which replace those of `data`
        in the comparisons.
        """
        decided = [self.decide({**data, **drawn}) for drawn in draws]
        return self._word(decided, data, self.decide(data) if not draws else None)

    def judge_everywhere(self, places: Mapping[str, Mapping[str, Any]], /, **data: Any) -> Verdict:
        """Return the verdict on a claim that holds in a draw if it holds there in all places.

        places : label -> quantity -> (t,) its number in each draw.
        """
        held, shares = [], []
        for label, quantities in places.items():
            columns = [np.asarray(numbers).tolist() for numbers in quantities.values()]
            rows = (dict(zip(quantities, row, strict=True)) for row in zip(*columns, strict=True))
            held.append([self.decide(row) is True for row in rows])
            shares.append({"name": label, "count": sum(held[-1]), "of": len(held[-1])})
        draws = [all(draw) for draw in zip(*held, strict=True)]
        return self._word(draws, {"shares": shares, **data})

    def _word(
        self, draws: Sequence[bool | None], data: Mapping[str, Any], decided: bool | None = None
    ) -> Verdict:
        if draws:
            decided = draws[0] if len(set(draws)) == 1 else None
        claim, why = (fill_template(self.record[key], **data) for key in ("claim", "evidence"))
        where = self.record.get("where", OWN_CHECK)
        return Verdict(claim, decided, why, where, self.name, tuple(draws))


def _find(term: Any, data: Mapping[str, Any]) -> Any:
    """Return a number, or the value of a name in the data, such as `best.formula` or `sd[full]`."""
    return Formatter().get_field(term, (), data)[0] if isinstance(term, str) else term
