# SPDX-License-Identifier: Apache-2.0
"""What two worker processes gain in a study, and what its driver costs."""

import os
import tempfile
import time
from collections.abc import Callable, Generator, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import mean
from typing import Any

from benchmarks.harness import Metric
from loopcal.studies.executors import Answer, Executor, Processes, Serial
from loopcal.studies.running import RunReport, read_source, run_study
from loopcal.studies.simulation.block import BlockTask, PosesTask, compute_task
from loopcal.studies.simulation.machines import CellPoses
from loopcal.typing import FloatArray

STUDY = """\
format: 1
title: A benchmark
seed: 1
replicates: 1000
robots: [linear-delta]
poses: [30, 35, 40]
"""
"""60 blocks of the default size."""

WORKERS, REPEATS = 2, 3


@dataclass(frozen=True, eq=False)
class TimedResult:
    """Scores of a block. `processor` : seconds of processor time that it took."""

    scores: FloatArray
    processor: float


def compute_timed_task(task: BlockTask | PosesTask) -> TimedResult | CellPoses:
    """Compute a task, a block with its processor time."""
    begin = time.process_time()
    result = compute_task(task)
    if isinstance(result, CellPoses):
        return result
    return TimedResult(result, time.process_time() - begin)


@dataclass
class Timed:
    """Workers that note of each block when it came, its seconds and its processor seconds."""

    executor: Executor
    times: list[tuple[float, float]] = field(default_factory=list)
    processor: dict[str, float] = field(default_factory=dict)

    def map_blocks(
        self, function: Callable[[Any], Any], tasks: Iterable[Any]
    ) -> Generator[Answer[Any, Any], None, None]:
        """Compute tasks; see `Executor.map_blocks`."""
        for answer in self.executor.map_blocks(compute_timed_task, tasks):
            if isinstance(answer.result, TimedResult):
                self.times.append((time.perf_counter(), answer.seconds))
                self.processor[answer.task.key] = answer.result.processor
                answer = replace(answer, result=answer.result.scores)  # noqa: PLW2901
            yield answer

    @property
    def busy(self) -> float:
        """Mean number of workers that compute, without the first and the last block of each."""
        first, last = self.times[WORKERS][0], self.times[-WORKERS][0]
        return sum(
            max(min(when, last) - max(when - seconds, first), 0.0) for when, seconds in self.times
        ) / (last - first)


def _run(executor: Executor) -> tuple[Timed, RunReport]:
    """Run the study in a new folder."""
    timed = Timed(executor)
    with tempfile.TemporaryDirectory() as place:
        file = Path(place, "study.yaml")
        file.write_text(STUDY, encoding="utf-8")
        return timed, run_study(read_source(file), Path(place, "study"), timed)


def _best(runs: Sequence[Timed]) -> float:
    """Return the mean processor seconds of a block, the shortest of all runs of each."""
    return mean(min(run.processor[key] for run in runs) for key in runs[0].processor)


def bench_workers() -> list[Metric]:
    """Run a study in one process and by two in turns.

    The gain is the number of workers that compute at the same time, by the processor time of a
    block alone over that beside another worker. Both keep their values on a busy machine.
    """
    runs = [(_run(Serial()), _run(Processes(WORKERS))) for _ in range(REPEATS)]
    alone = _best([serial for (serial, _), _ in runs])
    two = _best([timed for _, (timed, _) in runs])
    busy = max(timed.busy for _, (timed, _) in runs)
    driver = min(report.seconds / report.worker_seconds for (_, report), _ in runs) - 1.0
    note = f"{busy:.2f} busy; a block {1e3 * alone:.3g} ms alone, {1e3 * two:.3g} ms beside another"
    return [
        Metric(
            "studies.two_processes_of_one",
            busy * alone / two,
            direction="higher",
            tolerance=0.1,
            limit=1.8,
            note=f"{note}; {os.cpu_count()} processors",
        ),
        Metric(
            "studies.driver_of_computation",
            driver,
            tolerance=None,
            limit=0.05,
            note="share of the computation; blocks of 50 trials; limit alone",
        ),
    ]
