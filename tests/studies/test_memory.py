# SPDX-License-Identifier: Apache-2.0
"""The memory of a driver does not grow with the number of trials."""

from __future__ import annotations

import gc
import tracemalloc
from collections.abc import Callable, Generator, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from loopcal.studies.executors import Answer, Serial
from loopcal.studies.files.store import StudySource, open_study
from loopcal.studies.running import run_blocks
from loopcal.studies.simulation.block import PosesTask
from loopcal.studies.simulation.machines import CellPoses
from loopcal.typing import FloatArray
from tests.studies.studies import make_study

BLOCK = 50
ALLOWED = 150_000
"""Bytes, of statements that SQLite and Python keep; the scores of 90,000 more trials would take
14 MB.
"""


def make_scores(task: Any) -> FloatArray | CellPoses:
    """Return scores that cost nothing, in place of `compute_task`."""
    if isinstance(task, PosesTask):
        return CellPoses([[0.0, 0.3]] * 12, [[0.0, 0.3]] * 5)
    return np.zeros((BLOCK, 20))


class Cheap:
    """This process, with scores that cost nothing."""

    def map_blocks(
        self, function: Callable[[Any], Any], tasks: Iterable[Any]
    ) -> Generator[Answer[Any, Any], None, None]:
        yield from Serial().map_blocks(make_scores, tasks)


def empty_free_lists(done: int, _total: int, _what: str) -> None:
    """Let the interpreter return its free lists, which keep up to 2,000 tuples of each length."""
    if done % 500 == 0:
        gc.collect()


def measure_peak(folder: Path, replicates: int) -> int:
    """Return the largest memory [bytes] of a driver that stores this many trials of one cell."""
    study = make_study("five-bar", replicates=replicates, block=BLOCK)
    with open_study(folder, StudySource(study), resume=True) as store:
        tracemalloc.start()
        try:
            report = run_blocks(study, store, Cheap(), progress=empty_free_lists)
            assert report.is_complete
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()


def test_memory_of_a_driver_is_that_of_a_tenth_of_the_trials(tmp_path) -> None:
    measure_peak(tmp_path / "first", 2 * BLOCK)  # what is loaded once
    few = measure_peak(tmp_path / "few", 10_000)
    many = measure_peak(tmp_path / "many", 100_000)
    assert many < few + ALLOWED, (few, many)


def test_memory_of_a_driver_that_continues_does_not_grow_with_what_is_stored(tmp_path) -> None:
    measure_peak(tmp_path / "study", 2 * BLOCK)
    few = measure_peak(tmp_path / "study", 10_000)
    measure_peak(tmp_path / "study", 150_000)
    last = measure_peak(tmp_path / "study", 150_000 + BLOCK)
    assert last < few + ALLOWED, (few, last)
