# SPDX-License-Identifier: Apache-2.0
"""The results of a study, read from its folder."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from loopcal.errors import DataError, suggest_names
from loopcal.presentation import TableResult
from loopcal.studies.execution.optional_packages import import_optional
from loopcal.studies.files.store import StudyStore, read_store
from loopcal.studies.files.study_folder import load_specification, read_study
from loopcal.studies.specification.cells import Cell, list_factors
from loopcal.studies.specification.levels import Question
from loopcal.studies.specification.study import Study
from loopcal.typing import FloatArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from loopcal.studies.results.questions import AnsweredQuestion
    from loopcal.studies.results.summary import StudySummary


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

    def _repr_html_(self) -> str:
        """Return the summary of all cells as HTML."""
        from loopcal.report.notebook import render_html
        from loopcal.studies.results.summary_view import list_shown, view_summary

        summary = self.summarize()
        shown = list_shown(self.study, summary)
        return render_html(view_summary(self.study, summary, shown))

    def to_frame(self) -> Any:
        """Return all trials as a pandas DataFrame; see `to_pandas`."""
        return self.to_pandas()

    def to_dataset(self) -> Any:
        """Return all trials as an xarray Dataset; see `to_xarray`."""
        return self.to_xarray()

    def summarize(self) -> StudySummary:
        """Return medians, quantiles and coverage of all cells, with intervals."""
        from loopcal.studies.results.summary import summarize_study

        with read_store(self.folder) as store:
            return summarize_study(load_specification(store), store)

    def answer_questions(self) -> tuple[AnsweredQuestion, ...]:
        """Return the answers to the questions of the study file."""
        from loopcal.studies.results.questions import answer_all

        with read_store(self.folder) as store:
            return answer_all(load_specification(store), store)

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
        from loopcal.studies.results.summary_drawing import draw_score

        return draw_score(self.study, self.summarize(), score, factor)

    def _ask(self, question: Question) -> AnsweredQuestion:
        """Return the answers to a question."""
        from loopcal.studies.results.questions import answer_question

        with read_store(self.folder) as store:
            return answer_question(load_specification(store), store, question)

    def read_scores(self, cell: Cell | int, columns: Sequence[str] | None = None) -> FloatArray:
        """Return the scores of the stored trials of a cell: (t, s), SI.

        Parameters
        ----------
        cell : or its number. columns : names of scores; default: all, as `study.columns`.

        Raises
        ------
        DataError : a score that the study does not have.
        """
        chosen = self.study.cells[cell] if isinstance(cell, int) else cell
        places = find_columns(self.study, columns)
        with read_store(self.folder) as store:
            return read_trials(self.study, store, chosen, places)[1]

    def to_pandas(self) -> Any:
        """Return all trials as a pandas DataFrame: factors, trial, and scores in SI.

        Raises
        ------
        StudyError : pandas is not installed.
        """
        pandas = import_optional("pandas", "tables")
        study, names = self.study, list_factors(self.study)
        with read_store(self.folder) as store:
            read = [(cell, *read_trials(study, store, cell)) for cell in study.cells]
        counts = [len(trials) for _, trials, _ in read]
        factors = {
            name: pandas.Categorical(
                np.repeat([cell.levels[name] for cell, _, _ in read], counts),
                list(dict.fromkeys(cell.levels[name] for cell in study.cells)),
            )
            for name in names
        }
        trials = np.concatenate([trials for _, trials, _ in read])
        scores = np.concatenate([scores for _, _, scores in read])
        columns = {column.name: scores[:, i] for i, column in enumerate(study.columns)}
        return pandas.DataFrame({**factors, "trial": trials, **columns})

    def to_xarray(self) -> Any:
        """Return all trials as an xarray Dataset: a variable for each score, with its unit, whose
        dimensions are the factors and the trial, as in `data.position.sel({"poses": "12"})`.
        Trials that are not stored are NaN.

        Raises
        ------
        StudyError : xarray is not installed.
        """
        xarray = import_optional("xarray", "tables")
        study, names = self.study, list_factors(self.study)
        levels = {n: list(dict.fromkeys(cell.levels[n] for cell in study.cells)) for n in names}
        shape = (*(len(level) for level in levels.values()), study.replicates)
        scores = np.full((*shape, len(study.columns)), np.nan)
        with read_store(self.folder) as store:
            for cell in study.cells:
                place = tuple(levels[name].index(cell.levels[name]) for name in names)
                trials, values = read_trials(study, store, cell)
                scores[(*place, trials)] = values
        return xarray.Dataset(
            {
                column.name: ((*names, "trial"), scores[..., i], {"units": column.unit})
                for i, column in enumerate(study.columns)
            },
            coords={**levels, "trial": np.arange(study.replicates)},
            attrs={"title": study.title},
        )


def find_columns(study: Study, names: Sequence[str] | None = None) -> tuple[int, ...]:
    """Return the places of scores by their names; of all by default.

    Raises
    ------
    DataError : a score that the study does not have.
    """
    known = [column.name for column in study.columns]
    for name in names or ():
        if name not in known:
            hint = suggest_names(name, known)
            raise DataError(f"{name!r} is not a score{hint}; scores: {', '.join(known)}")
    return tuple(range(len(known)) if names is None else (known.index(name) for name in names))


def iterate_trials(study: Study, store: StudyStore, cell: Cell) -> Iterator[tuple[int, FloatArray]]:
    """Yield the first trial and the scores (t, s) of each stored block of a cell.

    Trials beyond the replicates of the study, which fill its last block, are left out.
    """
    for block, scores in store.read_blocks(cell.levels):
        count = study.count_trials(block)
        if count > 0:
            yield block * study.block, scores[:count]


def read_trials(
    study: Study, store: StudyStore, cell: Cell, columns: Sequence[int] | None = None
) -> tuple[np.ndarray, FloatArray]:
    """Return the numbers (t,) and scores (t, s) of the stored trials of a cell.

    Memory is that of the result and of one block.
    """
    places = list(find_columns(study) if columns is None else columns)
    with store.keep_state():
        most = min(store.count_cell(cell.levels).trials, study.replicates)
        numbers, scores, done = np.empty(most, dtype=np.int64), np.empty((most, len(places))), 0
        for first, block in iterate_trials(study, store, cell):
            last = done + len(block)
            numbers[done:last] = np.arange(first, first + len(block))
            scores[done:last] = block[:, places]
            done = last
    return numbers[:done], scores[:done]
