# SPDX-License-Identifier: Apache-2.0
"""Summaries of the trials of a study, each with the interval that its number of trials leaves.

Quantiles have intervals by order statistics, which hold for any distribution. Shares have intervals
of Clopper and Pearson. The shares of one trial belong together (the parameters of one fit, the
poses of one machine), so the number of independent ones is estimated from the scatter between
trials; Korn and Graubard, "Confidence intervals for proportions with small expected number of
positive counts estimated from survey data", Survey Methodology 24 (1998) 193-201.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from loopcal.studies.files.store import StudyStore
from loopcal.studies.results.study_result import read_trials
from loopcal.studies.simulation.fits import OUTCOMES
from loopcal.studies.specification.cells import Cell
from loopcal.studies.specification.scores import ScoreColumn
from loopcal.studies.specification.study import Study
from loopcal.typing import FloatArray

LEVEL = 0.95
"""Of all intervals."""

HIGH = 0.95
"""The quantile beside the median: 95 % of the machines are better."""

SHARE = "covered_"
"""Beginning of the names of scores that are shares; they have no quantiles."""

MEMORY = 2**26
"""Bytes of scores that are held at once."""


@dataclass(frozen=True)
class Interval:
    """An estimate from the trials, and its 95 % interval, which the number of trials leaves."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class ScoreSummary:
    """One score of the converged trials of a cell [SI].

    Attributes
    ----------
    name, unit : of the score. median, high : quantiles 0.5 and 0.95; None of a share.
    mean : with its Monte-Carlo interval. What does not exist is None.
    """

    name: str
    unit: str
    median: Interval | None = None
    high: Interval | None = None
    mean: Interval | None = None


@dataclass(frozen=True)
class CellSummary:
    """The stored trials of one cell.

    Attributes
    ----------
    levels : factor -> level. trials : that are stored. failed : code -> trials.
    converged : share of the trials. scores : of those that converged.
    """

    levels: Mapping[str, str]
    trials: int
    failed: Mapping[str, int]
    converged: Interval
    scores: tuple[ScoreSummary, ...]

    def find_score(self, name: str) -> ScoreSummary | None:
        """Return the summary of a score; None where no trial has it."""
        return next((score for score in self.scores if score.name == name), None)


@dataclass(frozen=True)
class StudySummary:
    """All cells of a study.

    Attributes
    ----------
    title, seed, replicates : of the study. trials : that are stored. cells : in its order.
    """

    title: str
    seed: int
    replicates: int
    trials: int
    cells: tuple[CellSummary, ...]

    @property
    def is_complete(self) -> bool:
        """Return whether every cell has all its trials."""
        return all(cell.trials == self.replicates for cell in self.cells)


def summarize_study(study: Study, store: StudyStore) -> StudySummary:
    """Return the summary of the stored trials."""
    with store.keep_state():
        cells = tuple(summarize_cell(study, store, cell) for cell in study.cells)
    trials = sum(cell.trials for cell in cells)
    return StudySummary(study.title, study.seed, study.replicates, trials, cells)


def summarize_cell(study: Study, store: StudyStore, cell: Cell) -> CellSummary:
    """Return the summary of the stored trials of a cell; memory is bounded by `MEMORY`."""
    outcome = read_trials(study, store, cell, [0])[1][:, 0].astype(int)
    is_good, columns = outcome == 0, study.columns
    failed = {OUTCOMES[i]: int((outcome == i).sum()) for i in sorted(set(outcome.tolist()) - {0})}
    at_once = max(MEMORY // (8 * max(len(outcome), 1)), 1)
    scores: list[ScoreSummary] = []
    for first in range(1, len(columns), at_once):
        places = range(first, min(first + at_once, len(columns)))
        values = read_trials(study, store, cell, places)[1][is_good]
        scores += [summarize_score(columns[i], values[:, j]) for j, i in enumerate(places)]
    share = estimate_share(is_good.astype(float))
    kept = tuple(score for score in scores if score.median or score.mean)
    return CellSummary(cell.levels, len(outcome), failed, share, kept)


def summarize_score(column: ScoreColumn, values: FloatArray) -> ScoreSummary:
    """Return the summary of a score of converged trials (t,); NaN are trials without it."""
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
    from loopcal.numerics.special_functions import bdtr

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
    from loopcal.numerics.special_functions import stdtrit

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
    from loopcal.numerics.special_functions import betaincinv

    if number <= 0.0:
        return Interval(np.nan, 0.0, 1.0)
    tail = (1.0 - confidence) / 2.0
    low = betaincinv(count, number - count + 1.0, tail) if count > 0.0 else 0.0
    high = betaincinv(count + 1.0, number - count, 1.0 - tail) if count < number else 1.0
    return Interval(count / number, float(low), float(high))
