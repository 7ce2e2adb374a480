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

import itertools
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np

from loopcal.findings import report_finding
from loopcal.findings.catalog import find_entry
from loopcal.io.core.text_file import to_json, write_bytes, write_text
from loopcal.results.tables import (
    ABSENT,
    Block,
    Column,
    Table,
    build_table,
    format_number,
    word_column,
)
from loopcal.studies.files.store import StudyStore
from loopcal.studies.results.study_result import (
    BEFORE,
    LEVEL,
    CellSummary,
    Interval,
    StudySummary,
    compute_binomial_interval,
    find_columns,
    iterate_trials,
)
from loopcal.studies.simulation.block import OUTCOMES, STEPS_REMAIN, has_result
from loopcal.studies.specification import Cell, Question, Study, check_question, list_chains
from loopcal.units import Unit, find_unit

Certainty = Literal["certain", "between", "none", "unknown"]
State = Literal["yes", "no", "open"]


@dataclass(frozen=True)
class LevelShare:
    """How many machines of one level are within the limit.

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
    state: State


@dataclass(frozen=True)
class Answer:
    """The answer to a question, for one combination of the levels of the other factors.

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
    """A question with answers; `name` in the file, `limit` in SI, `score_unit` of its score."""

    name: str
    question: Question
    limit: float
    score_unit: str
    answers: tuple[Answer, ...]

    @property
    def title(self) -> str:
        """The question as a heading."""
        asked, symbol = self.question, SHOWN_UNITS[self.score_unit]
        number = self.limit / (find_unit(symbol).factor_to_si if symbol else 1.0)
        limit = f"{number:.6g} {symbol}".strip()
        name = f"{self.name}: " if self.name else ""
        score = asked.score.replace("_", " ")
        return (
            f"{name}{asked.wanted} level of {asked.factor} with {score} up to {limit} on "
            f"{_percent(asked.share)} % of machines"
        )

    def __str__(self) -> str:
        """Return the question, and one line for each answer with the shares that decide it."""
        lines = [f"{self.title}:"]
        for answer in self.answers:
            levels = [f"{factor} {level}" for factor, level in answer.levels.items()]
            named = ", ".join([*levels, *([answer.chain] if answer.chain else [])])
            said = f"{say_answer(answer, self.question.wanted)} ({say_deciding_shares(answer)})"
            lines.append(f"  {named}: {said}" if named else f"  {said}")
        return "\n".join(lines)


def answer_question(
    study: Study, store: StudyStore, question: Question, name: str = ""
) -> AnsweredQuestion:
    """Return the answers of the stored trials, one for each combination of the other factors.

    Raises DataError: see `check_question`.
    """
    limit, factor = check_question(study, question), question.factor
    chains = list_chains(study, factor)
    (place,) = find_columns(study, [question.score])
    varied = [other for other in study.varied_factors if other != factor]
    groups: dict[tuple[str, ...], dict[str, Cell]] = {}
    for cell in study.cells:
        others = tuple(cell.levels[other] for other in varied)
        groups.setdefault(others, {})[cell.levels[factor]] = cell
    answers = []
    with store.keep_state():
        for others, cells in groups.items():
            counts = {
                level: _count_reached(study, store, cell, place, limit)
                for level, cell in cells.items()
            }
            for chain in chains:
                chosen = {level: counts[level] for level in chain.levels}
                decided = decide(chosen, question.share, question.wanted)
                certainty, candidates, may_be_none, states = decided
                shares = tuple(
                    LevelShare(level, value, *chosen[level], *states[level])
                    for level, value in zip(chain.levels, chain.values, strict=True)
                )
                best = None if may_be_none else candidates[-1]
                named = dict(zip(varied, others, strict=True)), chain.label, chain.quantity
                end = certainty, best, candidates, may_be_none, shares
                answers.append(Answer(*named, chain.unit, *end))
    unit = study.columns[place].unit
    return AnsweredQuestion(name, question, limit, unit, tuple(answers))


def decide(
    counts: Mapping[str, tuple[int, int]],
    share: float,
    wanted: Literal["smallest", "largest"] = "smallest",
    confidence: float = LEVEL,
) -> tuple[Certainty, tuple[str, ...], bool, Mapping[str, tuple[Interval, State]]]:
    """Decide which level is the smallest or largest that reaches a demanded share.

    counts : level -> (machines within the limit, machines), levels in increasing order.
    confidence : with which all intervals hold together.

    Returns certainty, candidates, may_be_none as in `Answer`, and level -> (interval, state).
    Candidates begin at the end of the levels that is asked for; where a level reaches the share for
    certain, it is the last of them.
    """
    each = 1.0 - (1.0 - confidence) / max(len(counts), 1)
    states: dict[str, tuple[Interval, State]] = {}
    for level, (reached, trials) in counts.items():
        interval = compute_binomial_interval(reached, trials, each)
        state: State = "yes" if interval.low >= share else "no" if interval.high < share else "open"
        states[level] = interval, state
    candidates: list[str] = []
    is_reached = False
    for level in counts if wanted == "smallest" else reversed(list(counts)):
        if not is_reached and states[level][1] != "no":
            candidates.append(level)
            is_reached = states[level][1] == "yes"
    certainty: Certainty = "certain" if is_reached and len(candidates) == 1 else "between"
    if not candidates:
        certainty = "none"
    if not any(trials for _, trials in counts.values()):
        certainty = "unknown"
    return certainty, tuple(candidates), not is_reached, states


def _count_reached(
    study: Study, store: StudyStore, cell: Cell, place: int, limit: float
) -> tuple[int, int]:
    """Return how many trials of a cell have a score up to the limit, and all trials; none where no
    trial with a result has the score, such as a rotation error of a platform that only moves.
    """
    reached = trials = counted = defined = 0
    for _, scores in iterate_trials(study, store, cell):
        values = scores[has_result(scores[:, 0]), place]
        reached += int((values <= limit).sum())
        defined += int((~np.isnan(values)).sum())
        trials, counted = trials + len(scores), counted + len(values)
    return (0, 0) if counted and not defined else (reached, trials)


NOTE = (
    "Shares of the simulated machines within the limit; failed trials count as outside. The "
    "intervals of one row hold together with 95 % probability. The study contains no levels "
    "between these."
)

EXTEND = "More machines decide an answer that is not certain (loopcal study extend)."

SHOWN_UNITS = {"m": "um", "rad": "urad", "1": ""}
"""SI symbol of a score -> unit of its limit on the screen."""


def view_answers(answered: Sequence[AnsweredQuestion]) -> list[Block]:
    """Return the page of answered questions; empty without any."""
    page: list[Block] = []
    for item in answered:
        page += [item.title, tabulate_answers(item), ""]
    if any(answer.certainty == "between" for item in answered for answer in item.answers):
        return [*page, f"{NOTE} {EXTEND}"]
    return [*page, NOTE] if page else []


def tabulate_answers(answered: AnsweredQuestion) -> Table:
    """Return a row for each combination of other factors: the answer, and shares behind it."""
    answers, asked = answered.answers, answered.question
    columns = {factor: [a.levels[factor] for a in answers] for factor in answers[0].levels}
    if any(answer.chain for answer in answers):
        columns[asked.factor] = [answer.chain for answer in answers]
    columns["answer"] = [say_answer(answer, asked.wanted) for answer in answers]
    columns["shares"] = list(map(say_deciding_shares, answers))
    headings = tuple(word_column(title, wraps=True) for title in columns)
    return Table("", headings, tuple(zip(*columns.values(), strict=True)))


def say_answer(answer: Answer, wanted: str) -> str:
    """Return the answer in words, such as `20`, `not certain: 20 or 40`, or `no level`."""
    names, few = answer.candidates, len(answer.candidates) < 3
    if answer.certainty == "unknown":
        return "no trials with this score"
    if answer.certainty == "none":
        return "no level"
    if answer.certainty == "certain":
        first = answer.shares[0 if wanted == "smallest" else -1].level
        return f"{names[0]}, the {wanted} of the study" if names[0] == first else names[0]
    if not answer.may_be_none:
        words = " or ".join(names) if few else f"between {names[0]} and {names[-1]}"
        return f"not certain: {words}"
    words = " or ".join(names) if few else f"one from {names[0]} to {names[-1]}"
    return f"not certain: {words}, or no level"


def say_deciding_shares(answer: Answer) -> str:
    """Return shares of candidates and of levels beside them; of all without candidates."""
    chosen = {share.level for share in answer.shares if share.level in answer.candidates}
    for level, next_level in pairwise(share.level for share in answer.shares):
        if (level in answer.candidates) != (next_level in answer.candidates):
            chosen |= {level, next_level}
    said = []
    for level, share in ((s.level, s) for s in answer.shares if s.level in chosen or not chosen):
        value, low, high = map(_percent, (share.share.value, share.share.low, share.share.high))
        said.append(
            f"{level}: {value} % ({low} to {high})" if share.trials else f"{level}: no trials"
        )
    return "; ".join(said)


def _percent(share: float) -> str:
    return f"{100.0 * share:.3g}"


JSON, CSV = "summary.json", "summary.csv"
"""Files of a summary in the folder of its study."""

NO_FIGURES: Mapping[str, bytes] = {}

SUMMARY_NOTE = (
    "Medians of the trials that did not fail, before calibration of all trials, and their 95 % "
    "intervals by the number of trials. Shares of coverage should be 0.95."
)
FRAMES = {
    "fitted": "Pose errors are stated without motions of frames that the measurements do not fix.",
    "base": "Pose errors are in the base frame.",
    "both": "Pose errors are stated without motions of frames that the measurements do not fix; "
    "those whose names contain 'base' are in the base frame.",
}
"""Frame of the scores of a study -> what the page says about it."""

SHOWN = ("position", "orientation", "position_base", "covered_parameters")
"""Scores of the table on the screen by default."""

UNITS = {"m": find_unit("mm"), "rad": find_unit("mrad"), "1": find_unit("1")}
"""SI symbol -> unit on the screen."""


def list_shown(study: Study, summary: StudySummary, names: Sequence[str] = ()) -> tuple[str, ...]:
    """Return the scores to show: those with these names, or `SHOWN` as far as they differ from 0.

    Raises DataError: a score that the study does not have.
    """
    find_columns(study, names)

    def is_shown(name: str) -> bool:
        """Return whether a score is more than rounding in some cell."""
        scores = [score for cell in summary.cells if (score := cell.find_score(name))]
        return any(score.median is None or score.median.value > 1e-12 for score in scores)

    return tuple(names or filter(is_shown, SHOWN))


def view_summary(study: Study, summary: StudySummary, shown: Sequence[str]) -> list[Block]:
    """Return the page of a summary with the named scores."""
    total = study.replicates * len(study.cells)
    state = "" if summary.is_complete else f" (of {total}; the study is not complete)"
    plural = "s" if len(study.cells) > 1 else ""
    page: list[Block] = [
        f"{study.title}: {len(study.cells)} cell{plural}, {summary.trials} trials{state}",
        f"{SUMMARY_NOTE} {FRAMES[study.scores.frame]}",
        tabulate_medians(study, summary, shown),
    ]
    counts = sum((Counter(cell.failed) for cell in summary.cells), Counter[str]())
    counts[OUTCOMES[STEPS_REMAIN]] = sum(cell.unfinished for cell in summary.cells)
    return [*page, *explain_failures(+counts, summary.trials)]


def explain_failures(counts: Mapping[str, int], trials: int) -> list[Block]:
    """Return a line for each code of failed trials (code -> trials): what it means, what to do."""
    unfinished = {OUTCOMES[STEPS_REMAIN]: "Trials at their limit of steps"}
    return [
        f"{unfinished.get(code, 'Failed trials')}: {count} of {trials}. {report_finding(code)} "
        f"{find_entry(code).action}"
        for code, count in counts.items()
    ]


def build_document(
    summary: StudySummary, answered: Sequence[AnsweredQuestion]
) -> dict[str, object]:
    """Return the content of summary.json."""
    return {**vars(summary), "questions": list(answered)}


def write_summary(
    folder: Path,
    study: Study,
    summary: StudySummary,
    answered: Sequence[AnsweredQuestion] = (),
    figures: Mapping[str, bytes] = NO_FIGURES,
) -> None:
    """Write summary.json, with the answered questions, summary.csv, and figures (name -> content)
    into the folder of a study.
    """
    write_text(folder / JSON, to_json(build_document(summary, answered)))
    write_text(folder / CSV, tabulate_all(study, summary).to_csv())
    for name, content in figures.items():
        write_bytes(folder / name, content)


def tabulate_medians(study: Study, summary: StudySummary, names: Sequence[str]) -> Table:
    """Return a table of the varied factors, the failed trials by reason, and the medians or mean
    shares of some scores, those of pose errors beside the medians before calibration.
    """
    units = {column.name: UNITS[column.unit] for column in study.columns}
    columns: list[tuple[Column, Callable[[CellSummary], str]]] = [
        (word_column(factor, wraps=True), lambda cell, factor=factor: cell.levels[factor])
        for factor in study.varied_factors or tuple(study.levels)[:1]
    ]
    columns.append((Column("trials"), lambda cell: str(cell.trials)))
    columns.append((word_column("failed", wraps=True), lambda cell: say_failures(cell.failed)))
    if any(cell.unfinished for cell in summary.cells):
        columns.append((Column("at step limit"), lambda cell: str(cell.unfinished)))
    for name in names:
        kind = "_max" * name.endswith("_max")
        before = f"{name.removesuffix('_max')}{BEFORE}{kind}"
        for shown in (each for each in (before, name) if each in units):
            unit, has_ends = units[shown], shown == name

            def show(
                cell: CellSummary, shown: str = shown, unit: Unit = unit, has_ends: bool = has_ends
            ) -> str:
                score = cell.find_score(shown)
                interval = None if score is None else score.median or score.mean
                if interval is None:
                    return ABSENT
                ends = (interval.value, interval.low, interval.high)
                value, low, high = (format_number(end / unit.factor_to_si, 3) for end in ends)
                return f"{value} ({low} to {high})" if has_ends else value

            symbol = "" if unit.symbol == "1" else unit.symbol
            columns.append((Column(shown.replace("_", " "), symbol), show))
    return build_table("", summary.cells, *columns)


def say_failures(failed: Mapping[str, int]) -> str:
    """Return the numbers of failed trials by reason (code -> trials), such as `2 diverged`."""
    words = [f"{count} {name_outcome(code)}" for code, count in failed.items()]
    return ", ".join(words) or "0"


def name_outcome(code: str) -> str:
    """Return the outcome of a code in words, such as `out of iterations`."""
    return code.partition(".")[2].replace("-", " ")


def tabulate_all(study: Study, summary: StudySummary) -> Table:
    """Return a table of all factors and all scores in SI, with intervals, for programs."""
    kinds = {"median": " median", "high": " 95 %", "mean": " mean"}
    reasons = dict.fromkeys(code for cell in summary.cells for code in cell.failed)
    columns: list[tuple[Column, Callable[[CellSummary], str]]] = [
        *((word_column(f), lambda cell, f=f: cell.levels[f]) for f in study.levels),
        (Column("trials"), lambda cell: str(cell.trials)),
        (Column("failed"), lambda cell: str(sum(cell.failed.values()))),
        (Column("unfinished"), lambda cell: str(cell.unfinished)),
        *((Column(name_outcome(c)), lambda cell, c=c: str(cell.failed.get(c, 0))) for c in reasons),
        (Column("converged"), lambda cell: show(cell.converged.value)),
    ]

    def show(number: float) -> str:
        return repr(float(number)) if math.isfinite(number) else ""

    for score, kind in itertools.product(study.columns[1:], kinds):

        def find(cell: CellSummary, end: str, score: str = score.name, kind: str = kind) -> str:
            interval = getattr(cell.find_score(score), kind, None)
            return show(getattr(interval, end, math.nan))

        if any(find(cell, "value") for cell in summary.cells):
            for end, suffix in (("value", ""), ("low", " low"), ("high", " high")):
                title = f"{score.name}{kinds[kind]}{suffix}"
                heading = Column(title, "" if score.unit == "1" else score.unit)
                columns.append((heading, partial(find, end=end)))
    return build_table("", summary.cells, *columns)
