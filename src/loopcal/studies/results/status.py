# SPDX-License-Identifier: Apache-2.0
"""How much of a study is stored."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from loopcal.report.tables import Column, Table, word_column
from loopcal.report.text_page import Block
from loopcal.studies.files.store import is_driven, read_store
from loopcal.studies.files.study_folder import load_specification
from loopcal.studies.specification.cells import list_factors, list_varied_factors


@dataclass(frozen=True)
class CellStatus:
    """A cell. `blocks` : stored, of `total`. `seconds` : of computation."""

    number: int
    levels: Mapping[str, str]
    blocks: int
    total: int
    seconds: float


@dataclass(frozen=True)
class StudyStatus:
    """The state of a folder.

    Attributes
    ----------
    title : of the study. is_running : whether a driver computes it now. blocks, total : stored, and
        of the study. trials : stored. worker_seconds : of computation, the sum over all workers.
    remaining : estimate of the same for what is missing; None where nothing is known.
    factors : that have several levels. cells : in the order of the study.
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
        study = load_specification(store)
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
        list_varied_factors(study) or list_factors(study)[:1],
        cells,
    )


def view_status(state: StudyStatus, format_duration: Callable[[float], str]) -> list[Block]:
    """Return the page of a state."""
    running = "it is being computed now" if state.is_running else "no driver is running"
    page: list[Block] = [
        f"{state.title}: {state.blocks} of {state.total} blocks, {state.trials} trials; {running}"
    ]
    if state.remaining:
        page.append(
            f"Computed in {format_duration(state.worker_seconds)} of one worker; about "
            f"{format_duration(state.remaining)} remain, divided by the workers"
        )
    columns = (Column("cell"), *(word_column(name, wraps=True) for name in state.factors))
    rows = tuple(
        (
            str(cell.number),
            *(cell.levels[name] for name in state.factors),
            f"{cell.blocks} of {cell.total}",
        )
        for cell in state.cells
    )
    return [*page, Table("", (*columns, Column("blocks")), rows)]
