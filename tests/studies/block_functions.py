# SPDX-License-Identifier: Apache-2.0
"""Functions that workers compute in tests, and their tasks."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from loopcal.errors import DataError, FileError
from loopcal.typing import FloatArray


def make_cluster(workers: int) -> Any:
    """Return a context with a real scheduler and real worker processes of dask."""
    import distributed

    cluster: Any = distributed.LocalCluster  # its annotations leave out what is documented
    return cluster(n_workers=workers, threads_per_worker=1, dashboard_address=":0")


@dataclass(frozen=True)
class NumberTask:
    """A task: `number`, and a folder where workers note what they did."""

    number: int
    place: str = ""
    pause: float = 0.0

    @property
    def key(self) -> str:
        return f"task-{self.number}"


def draw_numbers(task: NumberTask) -> FloatArray:
    """Return random numbers that depend on the task alone."""
    time.sleep(task.pause)
    return np.random.default_rng(task.number).normal(size=(5, 3))


def die_once(task: NumberTask) -> FloatArray:
    """Stop the worker of every third task when it comes for the first time."""
    if task.number % 3 == 0 and _is_first(task):
        os.kill(os.getpid(), signal.SIGKILL)
    return draw_numbers(task)


def die_always(task: NumberTask) -> FloatArray:
    """Stop every worker of task 2."""
    if task.number == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return draw_numbers(task)


def refuse_third(task: NumberTask) -> FloatArray:
    """Raise an error of the library for task 3."""
    if task.number == 3:
        raise FileError("task 3 is refused", Path("study.yaml"), 7) from DataError("inner")
    return draw_numbers(task)


def count_threads(_task: NumberTask) -> tuple[int, list[str]]:
    """Return the process, and the settings of its threads of linear algebra."""
    time.sleep(0.05)
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    return os.getpid(), [os.environ.get(name, "") for name in names]


def list_tasks(count: int, place: Path | str = "", pause: float = 0.0) -> Iterator[NumberTask]:
    """Yield tasks, and note in `place` how many were taken."""
    for number in range(count):
        if place:
            Path(place, f"taken-{number}").touch()
        yield NumberTask(number, str(place), pause)


def _is_first(task: NumberTask) -> bool:
    try:
        Path(task.place, f"begun-{task.number}").touch(exist_ok=False)
    except FileExistsError:
        return False
    return True
