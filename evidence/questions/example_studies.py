# SPDX-License-Identifier: Apache-2.0
"""Run a study of examples/studies, and return its answers, scores, tables and figures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import loopcal
from loopcal.report.pictures import render_figure
from loopcal.report.words import say
from loopcal.results.tables import Table
from loopcal.studies.study_result import (
    AnsweredQuestion,
    CellSummary,
    Interval,
    StudyResult,
    tabulate_answers,
    tabulate_medians,
)

STUDIES = Path(__file__).resolve().parents[2] / "examples" / "studies"


@dataclass(frozen=True)
class Shown:
    """What a page shows of a study.

    Attributes
    ----------
    tabulated, drawn : scores of the table, and of the figures. factor : along the axis of figures.
    levels : factor -> level of the cells in the table; all by default.
    """

    tabulated: tuple[str, ...]
    drawn: tuple[str, ...]
    factor: str | None = None
    levels: Mapping[str, str] | None = None

    def is_tabulated(self, cell: CellSummary) -> bool:
        """Return whether the table contains a cell."""
        return all(cell.levels[name] == level for name, level in (self.levels or {}).items())


def collect_study(name: str, shown: Shown, is_quick: bool) -> dict[str, Any]:
    """Run examples/studies/NAME.yaml or its quick tier in one process; return the content of its
    evidence file.
    """
    with TemporaryDirectory() as place:
        result = loopcal.study(STUDIES / f"{name}.yaml", Path(place) / "study", quick=is_quick)
        return describe_results(result, shown)


def describe_results(result: StudyResult, shown: Shown) -> dict[str, Any]:
    """Return the content of the evidence file of a study that was run."""
    study, summary, answered = result.study, result.summarize(), result.answer_questions()
    scores = tuple(dict.fromkeys((*shown.tabulated, *shown.drawn)))
    cells = tuple(cell for cell in summary.cells if shown.is_tabulated(cell))
    tables = {
        "scores": _to_columns(
            tabulate_medians(study, replace(summary, cells=cells), shown.tabulated)
        ),
        **{f"answers-{i}": _to_columns(tabulate_answers(item)) for i, item in enumerate(answered)},
    }
    return {
        "seed": study.seed,
        "replicates": study.replicates,
        "frame": say(f"study.frame-{study.scores.frame}"),
        "cells": [_describe_cell(cell, scores) for cell in summary.cells],
        "questions": [_describe_answers(item) for item in answered],
        "tables": tables,
        "figures": {
            f"{score}.png": render_figure(result.draw(score, shown.factor), ".png")
            for score in shown.drawn
        },
    }


def find_cell(document: Mapping[str, Any], **levels: str) -> dict[str, Any]:
    """Return the only cell of an evidence file with these levels."""
    (cell,) = (
        cell
        for cell in document["cells"]
        if all(cell["levels"][factor] == level for factor, level in levels.items())
    )
    return cell


def _describe_cell(cell: CellSummary, scores: Sequence[str]) -> dict[str, Any]:
    """Return the levels of a cell, its trials, and its scores as [value, low, high] in SI."""
    described = {}
    for name in scores:
        score = cell.find_score(name)
        kinds = ("median", "high") if score and score.median else ("mean",)
        described[name] = {kind: _list_ends(getattr(score, kind, None)) for kind in kinds}
    return {
        "levels": dict(cell.levels),
        "trials": cell.trials,
        "failed": sum(cell.failed.values()),
        "scores": described,
    }


def _describe_answers(answered: AnsweredQuestion) -> dict[str, Any]:
    """Return a question and its answers."""
    return {
        "name": answered.name,
        **asdict(answered.question),
        "limit_si": answered.limit,
        "answers": [
            {
                "levels": dict(answer.levels),
                "chain": answer.chain,
                "best": answer.best,
                "certainty": answer.certainty,
                "candidates": list(answer.candidates),
                "may_be_none": answer.may_be_none,
                "shares": {share.level: _list_ends(share.share) for share in answer.shares},
            }
            for answer in answered.answers
        ],
    }


def _list_ends(interval: Interval | None) -> list[float | None] | None:
    """Return value, low and high; None where an end does not exist."""
    if interval is None:
        return None
    ends = (interval.value, interval.low, interval.high)
    return [end if math.isfinite(end) else None for end in ends]


def _to_columns(table: Table) -> dict[str, Any]:
    """Return a table as evidence files contain it."""
    return {
        "columns": [column.heading for column in table.columns],
        "rows": [list(row) for row in table.rows],
    }
