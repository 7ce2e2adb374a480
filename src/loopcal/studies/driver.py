# SPDX-License-Identifier: Apache-2.0
"""The driver of a study: it gives blocks to workers and stores what they return."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial

from loopcal.findings import Finding, report_finding
from loopcal.studies.execution import Executor
from loopcal.studies.execution.interface import MOST_LOSSES
from loopcal.studies.files.store import StudyStore
from loopcal.studies.schedule import Blocks, MissingBlock, Schedule
from loopcal.studies.simulation.poses import CellPoses
from loopcal.studies.simulation.tasks import BlockResult, PosesTask, compute_task
from loopcal.studies.specification.cells import Cell
from loopcal.studies.specification.keys import compute_key, describe_block
from loopcal.studies.specification.study import Study
from loopcal.typing import Progress, report_no_progress

MOST_NAMED = 5
"""Blocks that were given up and are named in a finding."""

LISTED = 200
"""Blocks whose keys are read at once, so that memory does not grow with the number of blocks."""


@dataclass(frozen=True)
class Share:
    """One of several equal parts of the blocks of a study, for jobs that run at once.

    A study with at least as many cells as jobs is divided by cells, others by the blocks of each
    cell.

    Parameters
    ----------
    part : from 1. of : their number.
    """

    part: int = 1
    of: int = 1

    def select_cells(self, study: Study) -> Sequence[Cell]:
        """Return the cells of this part."""
        return study.cells[self.part - 1 :: self.of] if self._by_cells(study) else study.cells

    def select_blocks(self, study: Study) -> range:
        """Return the blocks of this part in each of its cells."""
        step = 1 if self._by_cells(study) else self.of
        return range(0 if step == 1 else self.part - 1, study.blocks, step)

    def _by_cells(self, study: Study) -> bool:
        return len(study.cells) >= self.of


@dataclass(frozen=True)
class RunReport:
    """What a driver did.

    Attributes
    ----------
    total : blocks of the study, or of the share that was asked for. before : of these, stored when
        it began. computed : stored by it.
    given_up : blocks that stopped every worker, and cells whose poses did, by name.
    trials : that it stored. losses : workers that were lost, as far as is known.
    seconds : from start to end. worker_seconds : of computation, the sum over all workers.
    """

    total: int
    before: int
    computed: int
    trials: int
    given_up: tuple[str, ...]
    losses: int
    seconds: float
    worker_seconds: float

    @property
    def is_complete(self) -> bool:
        """Return whether all blocks are stored."""
        return self.before + self.computed == self.total

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What happened to workers."""
        findings = []
        if self.losses:
            findings.append(report_finding("workers.lost", losses=self.losses))
        if self.given_up:
            named = self.given_up[:MOST_NAMED]
            code, count = "workers.blocks-given-up", len(self.given_up)
            findings.append(report_finding(code, count=count, losses=MOST_LOSSES, blocks=named))
        return tuple(findings)


WHOLE = Share()
"""All blocks."""


def run_blocks(
    study: Study,
    store: StudyStore,
    executor: Executor,
    share: Share = WHOLE,
    progress: Progress = report_no_progress,
    threads: int = 1,
) -> RunReport:
    """Compute and store the blocks of a study that are missing in its store.

    Every block is stored as soon as it is there. Work that is stopped, in whatever way, loses only
    the blocks in flight. `threads` compute a block, in each worker.

    Raises
    ------
    FileError : a block cannot be stored. StudyError, LoopcalError : see `Executor.map_blocks` and
        `compute_block`.
    """
    begin = time.perf_counter()
    total = count_blocks(study, share)
    before = count_stored(study, store, share)
    computed = trials = losses = 0
    seconds, given_up = 0.0, []
    progress(before, total, "computing blocks")
    schedule = Schedule(_list_missing(study, store, share))
    compute = compute_task if threads == 1 else partial(compute_task, threads=threads)
    with closing(executor.map_blocks(compute, schedule)) as answers:
        for answer in answers:
            task, result = answer.task, answer.result
            losses, seconds = losses + answer.losses, seconds + answer.seconds
            if isinstance(task, PosesTask):
                if isinstance(result, CellPoses):
                    schedule.add_poses(task, result)
                else:
                    given_up += [f"cell {cell}, poses" for cell in schedule.give_up(task)]
                continue
            if not isinstance(result, BlockResult):
                given_up.append(f"cell {task.cell}, block {task.block}")
                continue
            levels, values = study.cells[task.cell].levels, result.values
            if store.add_block(task.key, levels, task.block, values, answer.seconds):
                computed, trials = computed + 1, trials + len(values)
            progress(before + computed, total, "computing blocks")
    wall = time.perf_counter() - begin
    return RunReport(total, before, computed, trials, tuple(given_up), losses, wall, seconds)


def count_blocks(study: Study, share: Share = WHOLE) -> int:
    """Return the number of blocks of a study, or of a part of it."""
    return len(share.select_cells(study)) * len(share.select_blocks(study))


def count_stored(study: Study, store: StudyStore, share: Share = WHOLE) -> int:
    """Return how many of these blocks are stored."""
    blocks = share.select_blocks(study)
    return sum(store.count_blocks(cell.levels, blocks) for cell in share.select_cells(study))


def _list_missing(study: Study, store: StudyStore, share: Share) -> Iterator[Blocks]:
    """Yield, for one cell after the other, its blocks that are not stored."""
    blocks = share.select_blocks(study)
    for cell in share.select_cells(study):
        if store.count_blocks(cell.levels, blocks) < len(blocks):
            yield _list_blocks(study, store, cell, blocks)


def _list_blocks(study: Study, store: StudyStore, cell: Cell, blocks: range) -> Blocks:
    """Yield the blocks of a cell that are not stored."""
    for first in range(0, len(blocks), LISTED):
        listed = blocks[first : first + LISTED]
        stored = store.list_keys(cell.levels, listed)
        for block in listed:
            content = describe_block(study, cell, block)
            key = compute_key(content)
            if key not in stored:
                yield MissingBlock(key, cell.number, content)
