# SPDX-License-Identifier: Apache-2.0
"""Answers to questions such as "the smallest number of poses that reaches 10 um on 95 % of
machines".

The share of machines within the limit has an exact binomial interval at every level (Clopper and
Pearson, "The use of confidence or fiducial limits illustrated in the case of the binomial",
Biometrika 26 (1934) 404-413). The intervals of the levels of one answer hold together with 95 %
probability (Bonferroni). A level reaches the limit for certain where its interval lies above the
demanded share, and misses it for certain where it lies below. An answer that is called certain is
therefore wrong in at most 5 % of studies. A trial that failed is a machine that misses the limit.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from loopcal.studies.files.store import StudyStore
from loopcal.studies.results.study_result import find_columns, iterate_trials
from loopcal.studies.results.summary import LEVEL, Interval, compute_binomial_interval
from loopcal.studies.specification.cells import Cell, list_varied_factors
from loopcal.studies.specification.level_chains import LevelChain, list_chains
from loopcal.studies.specification.levels import Question
from loopcal.studies.specification.scores import check_question
from loopcal.studies.specification.study import Study

Certainty = Literal["certain", "between", "none", "unknown"]


@dataclass(frozen=True)
class LevelShare:
    """How many machines of one level are within the limit.

    Attributes
    ----------
    level : its name. value : its number [SI], None without one.
    reached, trials : machines within the limit, and all; 0 where none has the score.
    share : of the machines within the limit. state : whether this share is at least the demanded
        one: "yes" or "no" for certain, else "open".
    """

    level: str
    value: float | None
    reached: int
    trials: int
    share: Interval
    state: Literal["yes", "no", "open"]


@dataclass(frozen=True)
class Answer:
    """The answer to a question, for one combination of the levels of the other factors.

    Attributes
    ----------
    levels : the other varied factors -> level. chain : what distinguishes the levels that were
        compared; empty where all were. quantity, unit : of the numbers of the levels.
    certainty : "certain": `best` is the answer. "between": it is one of `candidates`. "none": no
        level reaches the limit. "unknown": no stored trial has the score.
    best : the smallest (or largest) level that reaches the limit for certain; None without one.
    candidates : levels that may be the answer. may_be_none : whether it is possible that no level
        reaches the limit.
    shares : of all levels, in increasing order.
    """

    levels: Mapping[str, str]
    chain: str
    quantity: str
    unit: str
    certainty: Certainty
    best: str | None
    candidates: tuple[str, ...]
    may_be_none: bool
    shares: tuple[LevelShare, ...]


@dataclass(frozen=True)
class AnsweredQuestion:
    """A question with its answers. `name` : in the study file. `limit` : in SI. `score_unit` : its
    unit.
    """

    name: str
    question: Question
    limit: float
    score_unit: str
    answers: tuple[Answer, ...]

    def __str__(self) -> str:
        """Return the question, and one line for each answer with the shares that decide it."""
        from loopcal.studies.results.question_view import describe_answers

        return describe_answers(self)


def answer_question(
    study: Study, store: StudyStore, question: Question, name: str = ""
) -> AnsweredQuestion:
    """Return the answers of the stored trials, one for each combination of the other factors.

    Raises
    ------
    DataError : see `check_question`.
    """
    limit = check_question(study, question)
    chains = list_chains(study, question.factor)
    (place,) = find_columns(study, [question.score])
    answers = []
    with store.keep_state():
        for others, cells in _group_cells(study, question.factor):
            counts = {
                level: _count_reached(study, store, cell, place, limit)
                for level, cell in cells.items()
            }
            answers += [_answer(question, others, chain, counts) for chain in chains]
    unit = study.columns[place].unit
    return AnsweredQuestion(name, question, limit, unit, tuple(answers))


def answer_all(study: Study, store: StudyStore) -> tuple[AnsweredQuestion, ...]:
    """Return the answers to the questions of a study."""
    return tuple(
        answer_question(study, store, question, name) for name, question in study.questions.items()
    )


def decide(
    counts: Mapping[str, tuple[int, int]],
    share: float,
    wanted: Literal["smallest", "largest"] = "smallest",
    confidence: float = LEVEL,
) -> tuple[Certainty, tuple[str, ...], bool, Mapping[str, tuple[Interval, str]]]:
    """Decide which level is the smallest or largest that reaches a demanded share.

    Parameters
    ----------
    counts : level -> (machines within the limit, machines), levels in increasing order.
    confidence : with which all intervals hold together.

    Returns
    -------
    certainty, candidates, may_be_none : as in `Answer`; candidates begin at the end of the levels
        that is asked for, and where a level reaches the share for certain, it is the last of them.
    states : level -> (interval, state).
    """
    each = 1.0 - (1.0 - confidence) / max(len(counts), 1)
    states: dict[str, tuple[Interval, str]] = {}
    for level, (reached, trials) in counts.items():
        interval = compute_binomial_interval(reached, trials, each)
        state = "yes" if interval.low >= share else "no" if interval.high < share else "open"
        states[level] = interval, state
    candidates: list[str] = []
    is_reached = False
    for level in counts if wanted == "smallest" else reversed(list(counts)):
        state = states[level][1]
        if state != "no":
            candidates.append(level)
        if state == "yes":
            is_reached = True
            break
    if not any(trials for _, trials in counts.values()):
        certainty: Certainty = "unknown"
    elif not candidates:
        certainty = "none"
    else:
        certainty = "certain" if is_reached and len(candidates) == 1 else "between"
    return certainty, tuple(candidates), not is_reached, states


def _answer(
    question: Question,
    others: Mapping[str, str],
    chain: LevelChain,
    counts: Mapping[str, tuple[int, int]],
) -> Answer:
    """Return the answer for the levels of a chain."""
    chosen = {level: counts[level] for level in chain.levels}
    certainty, candidates, may_be_none, states = decide(chosen, question.share, question.wanted)
    shares = tuple(
        LevelShare(level, value, *chosen[level], states[level][0], states[level][1])  # type: ignore[arg-type]
        for level, value in zip(chain.levels, chain.values, strict=True)
    )
    best = None if may_be_none else candidates[-1]
    return Answer(
        others,
        chain.label,
        chain.quantity,
        chain.unit,
        certainty,
        best,
        candidates,
        may_be_none,
        shares,
    )


def _group_cells(study: Study, factor: str) -> Iterator[tuple[dict[str, str], dict[str, Cell]]]:
    """Yield the other varied levels, and level of the factor -> cell."""
    groups: dict[tuple[tuple[str, str], ...], dict[str, Cell]] = {}
    varied = [name for name in list_varied_factors(study) if name != factor]
    for cell in study.cells:
        others = tuple((name, cell.levels[name]) for name in varied)
        groups.setdefault(others, {})[cell.levels[factor]] = cell
    for others, cells in groups.items():
        yield dict(others), cells


def _count_reached(
    study: Study, store: StudyStore, cell: Cell, place: int, limit: float
) -> tuple[int, int]:
    """Return how many converged trials of a cell have a score up to the limit, and all trials; none
    where no converged trial has the score, such as a rotation error of a platform that only moves.
    """
    reached = trials = converged = defined = 0
    for _, scores in iterate_trials(study, store, cell):
        values = scores[scores[:, 0] == 0.0, place]
        reached += int((values <= limit).sum())
        defined += int((~np.isnan(values)).sum())
        trials, converged = trials + len(scores), converged + len(values)
    return (0, 0) if converged and not defined else (reached, trials)
