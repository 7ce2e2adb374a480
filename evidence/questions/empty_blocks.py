# SPDX-License-Identifier: Apache-2.0
"""Blocks whose scores are all 0: what is left of a study is the work of driver and scheduler."""

from __future__ import annotations

import json
from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from loopcal.studies.executors import Answer, Executor, R, T
from loopcal.studies.simulation.block import PosesTask, compute_task
from loopcal.studies.simulation.machines import CellPoses
from loopcal.studies.specification import read_columns
from loopcal.typing import FloatArray


@dataclass(frozen=True)
class EmptyBlocks:
    """Workers that receive the real tasks of a study, and return blocks of the real size.

    Parameters
    ----------
    executor : the workers.
    """

    executor: Executor

    def map_blocks(
        self, function: Callable[[T], R], tasks: Iterable[T | None]
    ) -> Generator[Answer[Any, Any], None, None]:
        """Compute poses as they are, and blocks of zeros; see `Executor.map_blocks`."""
        assert function is compute_task
        return self.executor.map_blocks(leave_empty, tasks)


def leave_empty(task: Any) -> FloatArray | CellPoses:
    """Return the poses of a task, or a block of zeros."""
    if isinstance(task, PosesTask):
        return compute_task(task)
    trials = json.loads(task.content)["trials"]
    return np.zeros((trials, len(read_columns()["every"])))
