# SPDX-License-Identifier: Apache-2.0
"""How many workers one driver and one dask scheduler can keep busy.

Measured on one computer: the bytes of tasks and results, the processor time of a trial, and that of
driver and scheduler for a block. The load of 1000 workers is computed from these. They are
processor times, not wall times, so that other programs on the computer change them little.
"""

from __future__ import annotations

import math
import pickle
import time
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from evidence.questions.empty_blocks import EmptyBlocks, leave_empty
from evidence.questions.example_studies import STUDIES
from loopcal.studies.executors import QUEUED, Dask, Executor, Serial
from loopcal.studies.files.store import NAME, StudySource, open_study
from loopcal.studies.files.study_file import load_study
from loopcal.studies.running import run_blocks
from loopcal.studies.simulation.block import compute_block, list_tasks
from loopcal.studies.specification import Study

NAMES = ("poses", "instruments", "methods")
BLOCKS = (50, 200, 1000)
"""Trials of a block."""

TIMED, REPEATS, CELLS = 300, 3, 4
"""Empty blocks that driver and scheduler are timed with; how often; cells of which trials are
timed.
"""

WORKERS, TESTED = 1000, 2
"""Workers of the calculation, and of the measurement."""

HOUR = 3600.0


@dataclass(frozen=True)
class Constants:
    """What one block costs.

    Attributes
    ----------
    task, result : sizes as they are sent [byte]. stored : bytes in the store.
    driver : processor time of the driver [s]; scheduler : of driver and scheduler together [s].
    """

    task: float
    result: float
    stored: float
    driver: float
    scheduler: float


def load_example(name: str, block: int) -> Study:
    """Return an example study with blocks of this size, and so many replicates that it has at least
    `TIMED` blocks.
    """
    study = load_study(STUDIES / f"{name}.yaml")
    return replace(study, block=block, replicates=block * -(-TIMED // len(study.cells)))


def measure_trial(name: str, block: int = 25) -> float:
    """Return the processor time of a trial [s], the mean over cells that are evenly spread."""
    study = load_example(name, block)
    total, count = 0.0, len(study.cells)
    for number in range(0, count, max(count // CELLS, 1)):
        first, second = list_tasks(study, [number], blocks=[0, 1])
        compute_block(first)  # also prepares the cell
        begin = time.process_time()
        compute_block(second)
        total += time.process_time() - begin
    return total / (block * len(range(0, count, max(count // CELLS, 1))))


def measure_block(name: str, block: int, cluster: Any) -> Constants:
    """Return what a block costs."""
    study = load_example(name, block)
    tasks = [next(list_tasks(study, [number])) for number in (0, len(study.cells) - 1)]
    sizes = [len(pickle.dumps(task)) for task in tasks]
    result = len(pickle.dumps(leave_empty(tasks[0])))
    driver, stored = run_empty(study, EmptyBlocks(Serial()))
    scheduler, _ = run_empty(study, EmptyBlocks(Dask(cluster.scheduler_address)))
    return Constants(sum(sizes) / len(sizes), result, stored, driver, scheduler)


def run_empty(study: Study, executor: Executor) -> tuple[float, float]:
    """Return the processor time of this process for a block [s], the lowest of `REPEATS` runs, and
    its bytes in the store.
    """
    return min(_run_once(study, executor) for _ in range(REPEATS))


def _run_once(study: Study, executor: Executor) -> tuple[float, float]:
    """Return what `run_empty` does, of one run."""
    with TemporaryDirectory() as place:
        folder = Path(place) / "study"
        with open_study(folder, StudySource(study)) as store:
            before = (folder / NAME).stat().st_size
            begin = time.process_time()
            report = run_blocks(study, store, executor)
            seconds = time.process_time() - begin
        assert report.is_complete
        return seconds / report.computed, (
            (folder / NAME).stat().st_size - before
        ) / report.computed


def calculate_load(seconds: float, block: int, constants: Constants) -> dict[str, float]:
    """Return the load of `WORKERS` workers that compute trials of so many seconds all the time.

    Returns
    -------
    blocks : per second. sent, received : [MB/s]. driver, scheduler : loads; 1 is one processor.
    store : [GB] per hour. memory : of the tasks in flight and their results [MB].
    workers : that driver and scheduler together can serve, when they share one processor.
    """
    rate = WORKERS / (block * seconds)
    return {
        "blocks": rate,
        "sent": 1e-6 * rate * constants.task,
        "received": 1e-6 * rate * constants.result,
        "driver": rate * constants.driver,
        "scheduler": rate * constants.scheduler,
        "store": 1e-9 * HOUR * rate * constants.stored,
        "memory": 1e-6 * QUEUED * WORKERS * (constants.task + constants.result),
        "workers": WORKERS / (rate * constants.scheduler),
    }


QUICK = {"NAMES": ("poses", "instruments"), "BLOCKS": (50,), "TIMED": 20, "REPEATS": 1, "CELLS": 1}


def check(tables: dict[str, Any]) -> None:
    """Assert what holds at the quick size."""
    assert all(min(row[2:]) > 0 for row in tables["trials"]["rows"])


def collect() -> dict[str, Any]:
    """Measure the constants, and calculate the loads."""
    import distributed

    local: Any = distributed.LocalCluster
    trial = {name: measure_trial(name) for name in NAMES}
    with local(n_workers=TESTED, threads_per_worker=1, dashboard_address=None) as cluster:
        costs = {block: measure_block("instruments", block, cluster) for block in BLOCKS}
    loads = {
        (name, block): calculate_load(trial[name], block, costs[block])
        for name in NAMES
        for block in BLOCKS
    }
    robots = {name: next(iter(load_example(name, 1).robots)) for name in NAMES}
    longest = max(cost.scheduler for cost in costs.values())
    return {
        "measured_with": {"workers": TESTED, "blocks": TIMED},
        "seconds_per_trial": trial,
        "seconds_per_block": longest,
        "tables": {
            "trials": {
                "columns": ["robot", "study", "time of a trial [ms]", "B for 1000 workers"],
                "formats": ["", "", ".2g", "d"],
                "rows": [
                    [robots[name], name, 1e3 * trial[name], find_block(trial[name], longest)]
                    for name in NAMES
                ],
            },
            "blocks": _tabulate_costs(costs),
            "loads": _tabulate_loads(loads, robots),
        },
    }


def find_block(trial: float, cost: float) -> int:
    """Return the smallest B with which `WORKERS` workers leave driver and scheduler below one
    processor, to two digits.

    trial, cost : seconds of a trial, and those of driver and scheduler for a block.
    """
    exact = WORKERS * cost / trial
    step = 10 ** max(math.floor(math.log10(exact)) - 1, 0)
    return math.ceil(exact / step) * step


def _tabulate_costs(costs: dict[int, Constants]) -> dict[str, Any]:
    columns = ["B", "task [kB]", "result [kB]", "store [kB]", "driver [ms]"]
    return {
        "columns": [*columns, "driver and scheduler [ms]"],
        "formats": ["d", ".1f", ".1f", ".1f", ".2g", ".2g"],
        "rows": [
            [
                block,
                *(1e-3 * size for size in (cost.task, cost.result, cost.stored)),
                *(1e3 * seconds for seconds in (cost.driver, cost.scheduler)),
            ]
            for block, cost in costs.items()
        ],
    }


def _tabulate_loads(
    loads: dict[tuple[str, int], dict[str, float]], robots: dict[str, str]
) -> dict[str, Any]:
    columns = ["robot", "B", "blocks/s", "sent [MB/s]", "received [MB/s]", "load of the driver"]
    columns += ["load of driver and scheduler", "store [GB/h]", "in flight [MB]"]
    return {
        "columns": [*columns, "most workers"],
        "formats": ["", "d", ",.0f", ".1f", ".1f", ".2f", ".2f", ".0f", ".0f", ",.0f"],
        "rows": [[robots[name], block, *load.values()] for (name, block), load in loads.items()],
    }
