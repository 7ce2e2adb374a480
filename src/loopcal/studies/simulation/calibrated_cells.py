# SPDX-License-Identifier: Apache-2.0
"""The calibrations of a cell in memory: the machines of `compute_block`, before they are scored."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np

from loopcal.mechanism import Mechanism
from loopcal.studies.simulation.block import CalibratedBlock, calibrate_block
from loopcal.studies.simulation.fits import DIVERGED
from loopcal.studies.simulation.tasks import list_tasks
from loopcal.studies.specification.study import Study
from loopcal.typing import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class CalibratedCell:
    """t calibrated machines.

    Attributes
    ----------
    levels : factor -> level. robot : nominal. readings : (n, a) [SI] of the controller.
    truth, values : (t, p) [SI] true and estimated parameters; values are NaN where there are none.
    measured : of each sensor (t, r, c) [SI]. outcome : (t,) numbers of OUTCOMES before held-out
        poses are looked at. iterations : (t,).
    """

    levels: Mapping[str, str]
    robot: Mechanism
    readings: FloatArray
    truth: FloatArray
    values: FloatArray
    measured: tuple[FloatArray, ...]
    outcome: IntArray
    iterations: IntArray

    @property
    def is_converged(self) -> BoolArray:
        """(t,) which fits converged."""
        return self.outcome == 0

    @property
    def is_diverged(self) -> BoolArray:
        """(t,) which fits have no values because they diverged."""
        return self.outcome == DIVERGED


def calibrate_cells(study: Study, cells: Sequence[int] | None = None) -> Iterator[CalibratedCell]:
    """Yield the calibrations of these cells, of all by default, one cell after the other."""
    if not study.scores.verdict:  # held-out poses are not looked at
        study = replace(study, scores=replace(study.scores, held_out=1, frame="base"))
    for number, tasks in groupby(list_tasks(study, cells), lambda task: task.cell):
        blocks = [calibrate_block(json.loads(task.content)) for task in tasks]
        yield _join_blocks(study.cells[number].levels, blocks, study.replicates)


def find_cells(study: Study, **levels: str) -> tuple[int, ...]:
    """Return the numbers of the cells with these levels, factor=level."""
    return tuple(
        cell.number
        for cell in study.cells
        if all(cell.levels[factor] == level for factor, level in levels.items())
    )


def set_size(study: Study, seed: int, trials: int) -> Study:
    """Return a study with another seed and so many trials in each cell; machine i of its first
    block is the same for any number of trials.
    """
    return replace(study, seed=seed, replicates=trials, block=min(trials, study.block))


def _join_blocks(
    levels: Mapping[str, str], blocks: Sequence[CalibratedBlock], count: int
) -> CalibratedCell:
    """Return the first `count` trials of blocks."""
    trials, fits = [block.trials for block in blocks], [block.fits for block in blocks]

    def join(arrays: Sequence[np.ndarray]) -> np.ndarray:
        return np.concatenate(arrays)[:count]

    iterations = np.nan_to_num(join([f.iterations for f in fits]))
    return CalibratedCell(
        levels,
        blocks[0].cell.robot,
        trials[0].readings,
        join([t.truth for t in trials]),
        join([f.values for f in fits]),
        tuple(join(measured) for measured in zip(*(t.measured for t in trials), strict=True)),
        join([f.outcome for f in fits]),
        iterations.astype(np.int64),
    )
