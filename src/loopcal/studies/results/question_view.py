# SPDX-License-Identifier: Apache-2.0
"""Answers of a study as sentences and tables."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

from loopcal.report.tables import Table, word_column
from loopcal.report.text_page import Block
from loopcal.studies.results.questions import Answer, AnsweredQuestion, LevelShare
from loopcal.units import find_unit

NOTE = (
    "Shares of the simulated machines within the limit; failed trials count as outside. The "
    "intervals of one row hold together with 95 % probability. Levels between those of the study "
    "were not simulated."
)

EXTEND = "More machines decide an answer that is not certain (loopcal study extend)."

SHOWN_UNITS = {"m": "um", "rad": "urad", "1": ""}
"""SI symbol of a score -> unit of its limit on the screen."""


def view_answers(answered: Sequence[AnsweredQuestion]) -> list[Block]:
    """Return the page of answered questions; empty without any."""
    page: list[Block] = []
    for item in answered:
        page += [state_question(item), tabulate_answers(item), ""]
    if any(answer.certainty == "between" for item in answered for answer in item.answers):
        return [*page, f"{NOTE} {EXTEND}"]
    return [*page, NOTE] if page else []


def state_question(answered: AnsweredQuestion) -> str:
    """Return a question as a heading."""
    question = answered.question
    symbol = SHOWN_UNITS[answered.score_unit]
    number = answered.limit / (find_unit(symbol).factor_to_si if symbol else 1.0)
    limit = f"{number:.6g} {symbol}".strip()
    name = f"{answered.name}: " if answered.name else ""
    score = question.score.replace("_", " ")
    return (
        f"{name}{question.wanted} level of {question.factor} with {score} up to {limit} on "
        f"{_percent(question.share)} % of machines"
    )


def describe_answers(answered: AnsweredQuestion) -> str:
    """Return a question as text, and one line for each answer with the shares that decide it."""
    lines = [f"{state_question(answered)}:"]
    for answer in answered.answers:
        levels = [f"{factor} {level}" for factor, level in answer.levels.items()]
        named = ", ".join([*levels, *([answer.chain] if answer.chain else [])])
        said = say_answer(answer, answered.question.wanted)
        shares = "; ".join(_say_share(share) for share in list_deciding_shares(answer))
        lines.append(f"  {named}: {said} ({shares})" if named else f"  {said} ({shares})")
    return "\n".join(lines)


def tabulate_answers(answered: AnsweredQuestion) -> Table:
    """Return a row for each combination of the other factors: the answer, and the shares that
    decide it.
    """
    first = answered.answers[0]
    others = list(first.levels)
    has_chains = any(answer.chain for answer in answered.answers)
    columns = [word_column(factor, wraps=True) for factor in others]
    columns += [word_column(answered.question.factor, wraps=True)] if has_chains else []
    columns += [word_column("answer", wraps=True), word_column("shares", wraps=True)]
    rows = tuple(
        (
            *(answer.levels[factor] for factor in others),
            *([answer.chain] if has_chains else []),
            say_answer(answer, answered.question.wanted),
            "; ".join(_say_share(share) for share in list_deciding_shares(answer)),
        )
        for answer in answered.answers
    )
    return Table("", tuple(columns), rows)


def say_answer(answer: Answer, wanted: str) -> str:
    """Return the answer in words, such as `20`, `not certain: 20 or 40`, or `no level`."""
    names = answer.candidates
    first = answer.shares[0 if wanted == "smallest" else -1].level
    if answer.certainty == "unknown":
        return "no trials with this score"
    if answer.certainty == "none":
        return "no level"
    if answer.certainty == "certain":
        return f"{names[0]}, the {wanted} of the study" if names[0] == first else names[0]
    if not answer.may_be_none:
        return (
            f"not certain: {' or '.join(names)}"
            if len(names) < 3
            else (f"not certain: between {names[0]} and {names[-1]}")
        )
    return (
        f"not certain: {' or '.join(names)}, or no level"
        if len(names) < 3
        else (f"not certain: one from {names[0]} to {names[-1]}, or no level")
    )


def list_deciding_shares(answer: Answer) -> list[LevelShare]:
    """Return the shares of the candidates, and of the levels beside them; of all where there are
    no candidates.
    """
    chosen = {share.level for share in answer.shares if share.level in answer.candidates}
    if not chosen:
        return list(answer.shares)
    for level, next_level in pairwise(share.level for share in answer.shares):
        if (level in answer.candidates) != (next_level in answer.candidates):
            chosen |= {level, next_level}
    return [share for share in answer.shares if share.level in chosen]


def _say_share(share: LevelShare) -> str:
    interval = share.share
    if not share.trials:
        return f"{share.level}: no trials"
    low, high = _percent(interval.low), _percent(interval.high)
    return f"{share.level}: {_percent(interval.value)} % ({low} to {high})"


def _percent(share: float) -> str:
    return f"{100.0 * share:.3g}"
