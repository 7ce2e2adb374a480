# SPDX-License-Identifier: Apache-2.0
"""Tables of a summary: for the screen, and with every factor as a column for files."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from loopcal.findings import report_finding
from loopcal.findings.catalog import find_entry
from loopcal.io.core.json_text import to_json
from loopcal.io.core.text_file import write_bytes, write_text
from loopcal.report.numbers import ABSENT, format_number
from loopcal.report.tables import Column, Table, word_column
from loopcal.report.text_page import Block
from loopcal.studies.results.questions import AnsweredQuestion
from loopcal.studies.results.study_result import find_columns
from loopcal.studies.results.summary import CellSummary, Interval, StudySummary
from loopcal.studies.specification.cells import list_factors, list_varied_factors
from loopcal.studies.specification.study import Study
from loopcal.units import Unit, find_unit

JSON, CSV = "summary.json", "summary.csv"
"""Files of a summary in the folder of its study."""

NO_FIGURES: Mapping[str, bytes] = {}

NOTE = (
    "Medians of the converged trials, and their 95 % intervals by the number of trials. Shares of "
    "coverage should be 0.95."
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

    Raises
    ------
    DataError : a score that the study does not have.
    """
    find_columns(study, names)
    return tuple(names or (name for name in SHOWN if _is_shown(summary, name)))


def view_summary(study: Study, summary: StudySummary, shown: Sequence[str]) -> list[Block]:
    """Return the page of a summary with the named scores."""
    total = study.replicates * len(study.cells)
    state = "" if summary.is_complete else f" (of {total}; the study is not complete)"
    plural = "s" if len(study.cells) > 1 else ""
    page: list[Block] = [
        f"{study.title}: {len(study.cells)} cell{plural}, {summary.trials} trials{state}",
        f"{NOTE} {FRAMES[study.scores.frame]}",
        tabulate_medians(study, summary, shown),
    ]
    counts: dict[str, int] = {}
    for cell in summary.cells:
        for code, count in cell.failed.items():
            counts[code] = counts.get(code, 0) + count
    return [*page, *explain_failures(counts, summary.trials)]


def explain_failures(counts: Mapping[str, int], trials: int) -> list[Block]:
    """Return a line for each code of failed trials (code -> trials): what it means, what to do."""
    return [
        f"Failed trials: {count} of {trials}. {report_finding(code)} {find_entry(code).action}"
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
    table = tabulate_all(study, summary)
    text = to_json(build_document(summary, answered))
    write_text(folder / JSON, text)
    write_text(folder / CSV, table.to_csv())
    for name, content in figures.items():
        write_bytes(folder / name, content)


def tabulate_medians(study: Study, summary: StudySummary, names: Sequence[str]) -> Table:
    """Return a table of the varied factors, and of the medians or mean shares of some scores."""
    factors = list_varied_factors(study) or list_factors(study)[:1]
    units = {column.name: UNITS[column.unit] for column in study.columns}
    columns = [word_column(factor, wraps=True) for factor in factors]
    columns += [Column("trials"), Column("failed")]
    columns += [
        Column(name.replace("_", " "), "" if units[name].symbol == "1" else units[name].symbol)
        for name in names
    ]
    rows = tuple(
        (
            *(cell.levels[factor] for factor in factors),
            str(cell.trials),
            str(sum(cell.failed.values())),
            *(_format_score(cell, name, units[name]) for name in names),
        )
        for cell in summary.cells
    )
    return Table("", tuple(columns), rows)


def tabulate_all(study: Study, summary: StudySummary) -> Table:
    """Return a table of all factors and all scores in SI, with intervals, for programs."""
    factors = list_factors(study)
    columns = [word_column(factor) for factor in factors]
    columns += [Column(name) for name in ("trials", "failed", "converged")]
    suffixes = ("", " low", " high")
    names = [c for c in study.columns[1:] if any(x.find_score(c.name) for x in summary.cells)]
    kinds = ("median", "high", "mean")
    present = [
        (c, kind)
        for c in names
        for kind in kinds
        if any(getattr(x.find_score(c.name), kind, None) for x in summary.cells)
    ]
    words = {"median": " median", "high": " 95 %", "mean": " mean"}
    columns += [
        Column(f"{c.name}{words[kind]}{suffix}", "" if c.unit == "1" else c.unit)
        for c, kind in present
        for suffix in suffixes
    ]
    rows = []
    for cell in summary.cells:
        row = [*(cell.levels[factor] for factor in factors), str(cell.trials)]
        row += [str(sum(cell.failed.values())), _write(cell.converged.value)]
        for c, kind in present:
            interval = getattr(cell.find_score(c.name), kind, None)
            ends = (
                (math.nan,) * 3
                if interval is None
                else (interval.value, interval.low, interval.high)
            )
            row += [_write(end) for end in ends]
        rows.append(tuple(row))
    return Table("", tuple(columns), tuple(rows))


def _is_shown(summary: StudySummary, name: str) -> bool:
    """Return whether a score is more than rounding in some cell."""
    scores = [score for cell in summary.cells if (score := cell.find_score(name))]
    return any(score.median is None or score.median.value > 1e-12 for score in scores)


def _format_score(cell: CellSummary, name: str, unit: Unit) -> str:
    """Return `value (low to high)` of a cell."""
    score = cell.find_score(name)
    interval = None if score is None else score.median or score.mean
    return ABSENT if interval is None else format_interval(interval, unit)


def format_interval(interval: Interval, unit: Unit) -> str:
    """Return `value (low to high)` in a unit."""
    value, low, high = (
        format_number(number / unit.factor_to_si, 3)
        for number in (interval.value, interval.low, interval.high)
    )
    return f"{value} ({low} to {high})"


def _write(value: float) -> str:
    """Return a number that a program reads back; nothing where it is not finite."""
    return repr(float(value)) if math.isfinite(value) else ""
