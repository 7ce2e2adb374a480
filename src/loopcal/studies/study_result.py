# SPDX-License-Identifier: Apache-2.0
"""The results of a study, read from its folder, and the answers to its questions.

A question is such as "the smallest number of poses that reaches 10 um on 95 % of machines". The
share of machines within the limit has an exact binomial interval at every level (Clopper and
Pearson, "The use of confidence or fiducial limits illustrated in the case of the binomial",
Biometrika 26 (1934) 404-413). The intervals of the levels of one answer hold together with 95 %
probability (Bonferroni). A level reaches the limit for certain where its interval lies above the
demanded share, and misses it for certain where it lies below. An answer that is called certain is
therefore wrong in at most 5 % of studies. A trial that failed is a machine that misses the limit.
"""

from __future__ import annotations

import csv
import itertools
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from loopcal.checks import check_choice
from loopcal.environment import import_optional
from loopcal.errors import DataError, StudyError
from loopcal.findings import report_finding
from loopcal.findings.catalog import find_entry
from loopcal.io.core.outputs import refuse_outputs, write_files
from loopcal.io.core.text_file import replace_file, to_json
from loopcal.report.words import say
from loopcal.results.description import Records, Variable
from loopcal.results.presenters import register
from loopcal.results.result import Result, TableResult
from loopcal.results.tables import (
    ABSENT,
    Block,
    Column,
    Table,
    build_table,
    format_number,
    word_column,
)
from loopcal.studies.files.store import StudyStore, is_driven, read_store, read_study
from loopcal.studies.simulation.block import OUTCOMES, STEPS_REMAIN, has_result
from loopcal.studies.specification import (
    Cell,
    Question,
    ScoreColumn,
    Study,
    check_question,
    list_chains,
)
from loopcal.typing import FloatArray, Progress, report_no_progress
from loopcal.units import Unit, find_unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class StudyResult(TableResult):
    """The results of a study in its folder; nothing is read before it is asked for.

    Parameters
    ----------
    folder : of the study.
    """

    folder: Path

    @cached_property
    def study(self) -> Study:
        """The study."""
        return read_study(self.folder)

    def page(self) -> list[Block]:
        """Return the summary of all cells."""
        summary = self.summarize()
        return view_summary(self.study, summary, list_shown(self.study, summary))

    def summarize(self) -> StudySummary:
        """Return medians, quantiles and coverage of all cells, with intervals."""
        with read_store(self.folder) as store:
            return summarize_study(store)

    def answer_questions(self) -> tuple[AnsweredQuestion, ...]:
        """Return the answers to the questions of the study file."""
        questions = read_study(self.folder).questions
        return tuple(self._ask(question, name) for name, question in questions.items())

    def find_smallest(
        self, factor: str, score: str, limit: str | float, share: float = 0.95
    ) -> AnsweredQuestion:
        """Return the smallest level of a factor with which a score stays within a limit on a share
        of the machines, for each combination of the other factors.

        Parameters
        ----------
        factor : such as "poses". score : such as "position". limit : with its unit, "10 um".
        share : of the machines.

        Raises
        ------
        DataError : a factor, a score or a limit that does not fit.
        """
        return self._ask(Question(factor, score, limit, share, "smallest"))

    def find_largest(
        self, factor: str, score: str, limit: str | float, share: float = 0.95
    ) -> AnsweredQuestion:
        """Return the largest level that still does; see `find_smallest`."""
        return self._ask(Question(factor, score, limit, share, "largest"))

    def draw(self, score: str = "position", factor: str | None = None) -> Figure:
        """Draw a score against a factor, with the intervals of the number of trials.

        Parameters
        ----------
        score : its name. factor : along the axis; default: that with the most ordered levels.

        Raises
        ------
        DataError : an unknown score or factor, or too many combinations for one figure.
        """
        from loopcal.studies.summary_drawing import draw_score

        return draw_score(self.study, self.summarize(), score, factor)

    def _ask(self, question: Question, name: str = "") -> AnsweredQuestion:
        """Return the answers to a question."""
        with read_store(self.folder) as store:
            return answer_question(store, question, name)

    def read_scores(self, cell: Cell | int, columns: Sequence[str] | None = None) -> FloatArray:
        """Return the scores of the stored trials of a cell: (t, s), SI.

        Parameters
        ----------
        cell : or its number. columns : names of scores; default: all, as `study.columns`.

        Raises
        ------
        DataError : a score that the study does not have.
        """
        chosen = self.study.cells[cell] if isinstance(cell, int | np.integer) else cell
        with read_store(self.folder) as store:
            return read_trials(store, chosen, columns)[1]

    def to_frame(self) -> Any:
        """Return all trials as a pandas DataFrame: factors, trial, and scores in SI.

        Raises
        ------
        StudyError : pandas is not installed.
        """
        pandas = import_optional("pandas", "tables", StudyError)
        study = self.study
        with read_store(self.folder) as store:
            read = [read_trials(store, cell) for cell in study.cells]
        counts = [len(trials) for trials, _ in read]
        factors = {}
        for name, levels in study.levels.items():
            words = np.repeat([cell.levels[name] for cell in study.cells], counts)
            factors[name] = pandas.Categorical(words, list(levels))
        trials, scores = (np.concatenate(part) for part in zip(*read, strict=True))
        columns = {column.name: scores[:, i] for i, column in enumerate(study.columns)}
        return pandas.DataFrame({**factors, "trial": trials, **columns})

    def records(self) -> Records:
        """Return an array for each score, whose dimensions are the factors and the trial; trials
        that are not stored are NaN.
        """
        study, levels = self.study, {name: list(of) for name, of in self.study.levels.items()}
        shape = *map(len, levels.values()), study.replicates  # the last factor varies fastest
        scores = np.full((len(study.columns), len(study.cells), study.replicates), np.nan)
        with read_store(self.folder) as store:
            for cell in study.cells:
                trials, values = read_trials(store, cell)
                scores[:, cell.number, trials] = values.T
        variables = tuple(
            Variable(column.name, (*levels, "trial"), of_score.reshape(shape), column.unit)
            for column, of_score in zip(study.columns, scores, strict=True)
        )
        return Records(variables, {**levels, "trial": range(study.replicates)})

    def to_dataset(self) -> Any:
        """Return all trials as an xarray Dataset: a variable for each score, with its unit, as in
        `data.position.sel({"poses": "12"})`; see `records`.

        Raises
        ------
        MissingPackageError : xarray is not installed.
        """
        return super().to_dataset().assign_attrs(title=self.study.title)


def find_columns(study: Study, names: Sequence[str] | None = None) -> tuple[int, ...]:
    """Return the places of scores by their names; of all by default.

    Raises DataError: a score that the study does not have.
    """
    known = [column.name for column in study.columns]
    for name in names or ():
        check_choice("score", name, known, DataError)
    return tuple(range(len(known)) if names is None else (known.index(name) for name in names))


def read_trials(
    store: StudyStore, cell: Cell, names: Sequence[str] | None = None
) -> tuple[np.ndarray, FloatArray]:
    """Return the numbers (t,) of the stored trials of a cell, and their scores (t, s) of these
    names, all by default.

    Trials beyond the replicates of the study, which fill its last block, are left out. Memory is
    that of the result and of one block.
    """
    study, places = store.study, list(find_columns(store.study, names))
    with store.keep_state():
        most = min(store.count_cell(cell.levels).trials, study.replicates)
        numbers, scores, done = np.empty(most, dtype=np.int64), np.empty((most, len(places))), 0
        for number, block in store.read_blocks(cell.levels):
            kept = block[: max(study.count_trials(number), 0), places]
            last = done + len(kept)
            numbers[done:last] = number * study.block + np.arange(len(kept))
            scores[done:last], done = kept, last
    return numbers[:done], scores[:done]


LEVEL = 0.95  # of all intervals
HIGH = 0.95  # the quantile beside the median: 95 % of the machines are better
BEFORE = "_before"  # part of the names of scores before calibration, which failed trials have, too
SHARE = "covered_"  # beginning of the names of scores that are shares; they have no quantiles
MEMORY = 2**26  # bytes of scores that are held at once


@dataclass(frozen=True)
class Interval:
    """An estimate from the trials, and its 95 % interval, which the number of trials leaves."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class ScoreSummary:
    """One score of the trials of a cell that did not fail [SI].

    median, high : quantiles 0.5 and 0.95. mean : also of shares. What does not exist is None.
    """

    name: str
    unit: str
    median: Interval | None = None
    high: Interval | None = None
    mean: Interval | None = None


@dataclass(frozen=True)
class CellSummary:
    """The stored trials of one cell.

    trials : their number. failed : code of a failure -> trials. unfinished : trials whose steps
    reached their limit, whose results count. converged : share. scores : of trials that did not
    fail; those before calibration of all trials.
    """

    levels: Mapping[str, str]
    trials: int
    failed: Mapping[str, int]
    unfinished: int
    converged: Interval
    scores: tuple[ScoreSummary, ...]

    def find_score(self, name: str) -> ScoreSummary | None:
        """Return the summary of a score; None where no trial has it."""
        return next((score for score in self.scores if score.name == name), None)


@dataclass(frozen=True)
class StudySummary:
    """All cells of a study in its order, and the number of stored trials."""

    title: str
    seed: int
    replicates: int
    trials: int
    cells: tuple[CellSummary, ...]

    @property
    def is_complete(self) -> bool:
        """Return whether every cell has all its trials."""
        return all(cell.trials == self.replicates for cell in self.cells)


def summarize_study(store: StudyStore) -> StudySummary:
    """Return the summary of the stored trials; memory is bounded by `MEMORY`."""
    study = store.study
    with store.keep_state():
        cells = tuple(_summarize_cell(store, cell) for cell in study.cells)
    trials = sum(cell.trials for cell in cells)
    return StudySummary(study.title, study.seed, study.replicates, trials, cells)


def _summarize_cell(store: StudyStore, cell: Cell) -> CellSummary:
    """Return the summary of the stored trials of a cell."""
    first, *columns = store.study.columns
    outcome = read_trials(store, cell, [first.name])[1][:, 0].astype(int)
    is_good = has_result(outcome)
    failed = {OUTCOMES[i]: int((outcome == i).sum()) for i in np.unique(outcome[~is_good])}
    at_once = max(MEMORY // (8 * max(len(outcome), 1)), 1)
    scores: list[ScoreSummary] = []
    for chosen in (columns[i : i + at_once] for i in range(0, len(columns), at_once)):
        values = read_trials(store, cell, [column.name for column in chosen])[1]
        for column, of_score in zip(chosen, values.T, strict=True):
            is_counted = is_good | (BEFORE in column.name)
            scores.append(summarize_score(column, of_score[is_counted]))
    share = estimate_share((outcome == 0).astype(float))
    kept = tuple(score for score in scores if score.median or score.mean)
    unfinished = int((outcome == STEPS_REMAIN).sum())
    return CellSummary(cell.levels, len(outcome), failed, unfinished, share, kept)


def summarize_score(column: ScoreColumn, values: FloatArray) -> ScoreSummary:
    """Return the summary of a score of trials (t,); NaN are trials without it."""
    values = values[np.isfinite(values)]
    if not len(values):
        return ScoreSummary(column.name, column.unit)
    if column.name.startswith(SHARE):
        return ScoreSummary(column.name, column.unit, mean=estimate_share(values))
    ordered = np.sort(values)
    median, high = (estimate_quantile(ordered, share) for share in (0.5, HIGH))
    return ScoreSummary(column.name, column.unit, median, high, estimate_mean(values))


def estimate_quantile(ordered: FloatArray, share: float) -> Interval:
    """Return a quantile of ordered values (t,), with the interval of two of these values.

    The number of values below the quantile is binomial, so the interval between the values of ranks
    l and h contains it with the probability of l <= number < h, at least `LEVEL`. Where the values
    are too few, an end is infinite.
    """
    from scipy.special import bdtr

    n = len(ordered)
    below = bdtr(np.arange(n + 1), n, share)  # P(number <= k)
    tail = (1.0 - LEVEL) / 2.0
    low = int(np.searchsorted(below, tail, side="right"))  # rank of the lower end, from 1
    high = int(np.searchsorted(below, 1.0 - tail, side="left")) + 1
    return Interval(
        float(np.quantile(ordered, share)),
        float(ordered[low - 1]) if low >= 1 else -np.inf,
        float(ordered[high - 1]) if high <= n else np.inf,
    )


def estimate_mean(values: FloatArray) -> Interval:
    """Return the mean of values (t,) of independent trials, with its interval by Student's t.

    The interval of a single value is infinite.
    """
    from scipy.special import stdtrit

    n, mean = len(values), float(np.mean(values))
    if n < 2:
        return Interval(mean, -np.inf, np.inf)
    reach = stdtrit(n - 1, 0.5 + LEVEL / 2.0) * float(np.std(values, ddof=1)) / np.sqrt(n)
    return Interval(mean, mean - reach, mean + reach)


def estimate_share(shares: FloatArray) -> Interval:
    """Return the mean of the shares (t,) of independent trials, with its interval.

    Shares of 0 and 1 alone give the interval of Clopper and Pearson.
    """
    n = len(shares)
    if n == 0:
        return Interval(np.nan, 0.0, 1.0)
    mean = float(np.mean(shares))
    variance = float(np.var(shares)) / n
    effective = mean * (1.0 - mean) / variance if variance > 0.0 else float(n)
    return compute_binomial_interval(mean * effective, effective)


def compute_binomial_interval(count: float, number: float, confidence: float = LEVEL) -> Interval:
    """Return the share of `count` in `number` trials, with the interval of Clopper and Pearson.

    Numbers that are not whole are effective ones.
    """
    from scipy.special import betaincinv

    if number <= 0.0:
        return Interval(np.nan, 0.0, 1.0)
    tail = (1.0 - confidence) / 2.0
    low = betaincinv(count, number - count + 1.0, tail) if count > 0.0 else 0.0
    high = betaincinv(count + 1.0, number - count, 1.0 - tail) if count < number else 1.0
    return Interval(count / number, float(low), float(high))


@dataclass(frozen=True)
class CellStatus:
    """Blocks of a cell that are stored, of all, and seconds of their computation."""

    number: int
    levels: Mapping[str, str]
    blocks: int
    total: int
    seconds: float


@dataclass(frozen=True)
class StudyStatus:
    """How much of the study of a folder is stored.

    is_running : whether a driver computes it now. worker_seconds : of computation, the sum over all
    workers. remaining : estimate of the same for what is missing; None where nothing is known.
    factors : that have several levels.
    """

    title: str
    is_running: bool
    blocks: int
    total: int
    trials: int
    worker_seconds: float
    remaining: float | None
    factors: tuple[str, ...]
    cells: tuple[CellStatus, ...]


def read_status(folder: Path) -> StudyStatus:
    """Return the state of the folder of a study, also while it runs."""
    with read_store(folder) as store:
        study = store.study
        counts = [store.count_cell(cell.levels) for cell in study.cells]
    cells = tuple(
        CellStatus(cell.number, cell.levels, count.blocks, study.blocks, count.seconds)
        for cell, count in zip(study.cells, counts, strict=True)
    )
    blocks, total = sum(cell.blocks for cell in cells), study.blocks * len(cells)
    seconds = sum(cell.seconds for cell in cells)
    return StudyStatus(
        study.title,
        is_driven(folder),
        blocks,
        total,
        sum(count.trials for count in counts),
        seconds,
        None if blocks == 0 else max(total - blocks, 0) * seconds / blocks,
        study.varied_factors or tuple(study.levels)[:1],
        cells,
    )


def view_status(state: StudyStatus, format_duration: Callable[[float], str]) -> list[Block]:
    """Return the page of a state."""
    running = "computation continues" if state.is_running else "no driver is running"
    page: list[Block] = [
        f"{state.title}: {state.blocks} of {state.total} blocks, {state.trials} trials; {running}"
    ]
    if state.remaining:
        page.append(
            f"Computed in {format_duration(state.worker_seconds)} of one worker; about "
            f"{format_duration(state.remaining)} remain, divided by the workers"
        )
    columns = [
        (Column("cell"), lambda cell: str(cell.number)),
        *((word_column(n, wraps=True), lambda cell, n=n: cell.levels[n]) for n in state.factors),
        (Column("blocks"), lambda cell: f"{cell.blocks} of {cell.total}"),
    ]
    return [*page, build_table("", state.cells, *columns)]


def export_trials(store: StudyStore, path: Path, progress: Progress = report_no_progress) -> int:
    """Write all stored trials as one table, and return their number.

    Columns are all factors, the trial, and the scores in SI. A CSV file has their units in its
    header; a Parquet file has them in the metadata of its columns.

    path : its ending decides the format. It is written whole or not at all.

    Raises DataError: another ending. FileError: it cannot be written. StudyError: pyarrow is
    missing.
    """
    ending = path.suffix.lower()
    if ending not in (".csv", ".parquet"):
        raise DataError(f"{path} must end in .csv or .parquet, which decides its format")
    begin, study, count = _begin_csv if ending == ".csv" else _begin_parquet, store.study, 0
    with replace_file(path) as temporary, store.keep_state(), begin(study, temporary) as write:
        for cell in study.cells:
            progress(cell.number, len(study.cells), "writing trials")
            trials, scores = read_trials(store, cell)
            if len(trials):
                write(list(cell.levels.values()), trials, scores)
            count += len(trials)
    return count


WriteTrials = Callable[[list[str], np.ndarray, FloatArray], None]
"""Write trials (t,) and scores (t, s) of a cell with these levels, in the order of the study."""


@contextmanager
def _begin_csv(study: Study, path: Path) -> Iterator[WriteTrials]:
    titles = [f"{c.name} [{c.unit}]" if c.unit != "1" else c.name for c in study.columns]
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow([*study.levels, "trial", *titles])

        def write(levels: list[str], trials: np.ndarray, scores: FloatArray) -> None:
            for trial, row in zip(trials, scores, strict=True):
                numbers = [value if math.isfinite(value) else "" for value in row.tolist()]
                writer.writerow([*levels, trial, *numbers])

        yield write


@contextmanager
def _begin_parquet(study: Study, path: Path) -> Iterator[WriteTrials]:
    arrow = import_optional("pyarrow", "tables", StudyError)
    parquet = import_optional("pyarrow.parquet", "tables", StudyError)
    word, number = arrow.dictionary(arrow.int32(), arrow.string()), arrow.float64()
    fields = [arrow.field(name, word) for name in study.levels]
    fields.append(arrow.field("trial", arrow.int64()))
    fields += [arrow.field(c.name, number, metadata={"unit": c.unit}) for c in study.columns]
    schema = arrow.schema(fields)
    with parquet.ParquetWriter(path, schema) as writer:
        yield lambda levels, trials, scores: writer.write_table(
            arrow.table([*([x] * len(trials) for x in levels), trials, *scores.T], schema=schema)
        )


# Questions and their answers.

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
class AnsweredQuestion(Result):
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


def answer_question(store: StudyStore, question: Question, name: str = "") -> AnsweredQuestion:
    """Return the answers of the stored trials, one for each combination of the other factors.

    Raises DataError: see `check_question`.
    """
    study, factor = store.study, question.factor
    limit, chains = check_question(study, question), list_chains(study, factor)
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
                level: _count_reached(store, cell, question.score, limit)
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


def _count_reached(store: StudyStore, cell: Cell, score: str, limit: float) -> tuple[int, int]:
    """Return how many trials of a cell have a score up to the limit, and all trials; none where no
    trial with a result has the score, such as a rotation error of a platform that only moves.
    """
    outcome, scores = read_trials(store, cell, [store.study.columns[0].name, score])[1].T
    values = scores[has_result(outcome)]
    is_undefined = len(values) > 0 and np.isnan(values).all()
    return (0, 0) if is_undefined else (int((values <= limit).sum()), len(scores))


# SI symbol of a score -> unit of its limit on the screen.
SHOWN_UNITS = {"m": "um", "rad": "urad", "1": ""}


def view_answers(answered: Sequence[AnsweredQuestion]) -> list[Block]:
    """Return the page of answered questions; empty without any."""
    page: list[Block] = []
    for item in answered:
        page += [item.title, tabulate_answers(item), ""]
    if any(answer.certainty == "between" for item in answered for answer in item.answers):
        return [*page, f"{say('study.shares')} {say('study.extend')}"]
    return [*page, say("study.shares")] if page else []


@register("page", AnsweredQuestion)
def _view_answer(answered: AnsweredQuestion) -> list[Block]:
    """Return the page of one answered question."""
    return view_answers((answered,))


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

# Scores of the table on the screen by default.
SHOWN = ("position", "orientation", "position_base", "covered_parameters")
# SI symbol -> unit on the screen.
UNITS = {"m": find_unit("mm"), "rad": find_unit("mrad"), "1": find_unit("1")}


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
        f"{say('study.medians')} {say(f'study.frame-{study.scores.frame}')}",
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
    return {"format": 1, **vars(summary), "questions": list(answered)}


def write_summary(
    folder: Path,
    study: Study,
    summary: StudySummary,
    answered: Sequence[AnsweredQuestion],
    figures: Mapping[str, bytes],
) -> None:
    """Write summary.json, with the answered questions, summary.csv, and figures (name -> content)
    into the folder of a study, or none of them.
    """
    texts = {JSON: to_json(build_document(summary, answered))}
    texts[CSV] = tabulate_all(study, summary).to_csv()
    files = {folder / name: content for name, content in {**texts, **figures}.items()}
    refuse_outputs(tuple(files), (), force=True)
    write_files(files)


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
