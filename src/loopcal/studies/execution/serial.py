# SPDX-License-Identifier: Apache-2.0
"""Computation in this process, one task after the other."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass

from loopcal.studies.execution.interface import Answer, R, T, compute_timed


@dataclass(frozen=True)
class Serial:
    """No workers: this process computes."""

    def map_blocks(
        self, function: Callable[[T], R], tasks: Iterable[T | None]
    ) -> Generator[Answer[T, R], None, None]:
        """Compute tasks in their order; see `Executor.map_blocks`."""
        for task in tasks:
            assert task is not None  # all answers have been yielded
            result, seconds = compute_timed(function, task)
            yield Answer(task, result, seconds)
