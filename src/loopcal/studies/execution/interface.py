# SPDX-License-Identifier: Apache-2.0
"""The one interface to workers, whatever they are: `map_blocks(function, tasks)`."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

MOST_LOSSES = 5
"""Workers that one task may stop. After that it is given up, because it stops any worker."""


class Task(Protocol):
    """A unit of work: a value that can be pickled, with a key that no other task has."""

    @property
    def key(self) -> str:
        """Text that identifies the work."""
        ...


T = TypeVar("T", bound=Task)
R = TypeVar("R")


@dataclass(frozen=True, eq=False)
class Answer(Generic[T, R]):
    """What became of one task.

    Attributes
    ----------
    task : as it was submitted.
    result : of the function; None where the task was given up.
    seconds : of computation by the worker.
    losses : number of workers that were lost while they had this task, as far as is known.
    """

    task: T
    result: R | None
    seconds: float = 0.0
    losses: int = 0


class Executor(Protocol):
    """Workers that compute tasks. Each kind of them is one class with this method."""

    def map_blocks(
        self, function: Callable[[T], R], tasks: Iterable[T | None]
    ) -> Generator[Answer[T, R], None, None]:
        """Compute tasks and yield their answers as they finish, in any order.

        The number of tasks in flight is bounded, so `tasks` may be endless. A lost worker costs
        only the tasks that it had; these are computed again. An iteration that is closed stops the
        work.

        Parameters
        ----------
        function : pure, and importable by the workers: f(task) -> result.
        tasks : see `Task`. None instead of a task says that the next one depends on an answer that
            was not yielded yet; workers that are free wait for it.

        Raises
        ------
        StudyError : no worker can be reached, or none can start.
        Exception : of the function, as it was raised in the worker.
        """
        ...


def compute_timed(function: Callable[[T], R], task: T) -> tuple[R, float]:
    """Return the result of a task, and the seconds that it took."""
    start = time.perf_counter()
    result = function(task)
    return result, time.perf_counter() - start


class TaskQueue(Generic[T]):
    """Tasks that wait for a worker. Those that lost their worker come last.

    Parameters
    ----------
    tasks : taken one by one, when a worker is free; see `Executor.map_blocks`.

    Attributes
    ----------
    is_exhausted : whether `tasks` has no further one.
    """

    def __init__(self, tasks: Iterable[T | None]) -> None:
        self._tasks = iter(tasks)
        self._returned: deque[T] = deque()
        self._losses: dict[str, int] = {}
        self.is_exhausted: bool = False

    def take(self) -> T | None:
        """Return the next task; None where there is none, or none before the next answer."""
        task = None
        if not self.is_exhausted:
            try:
                task = next(self._tasks)
            except StopIteration:
                self.is_exhausted = True
        if task is None and self._returned:
            task = self._returned.popleft()
        return task

    def give_back(self, task: T) -> bool:
        """Accept a task whose worker was lost; return whether it will be computed again."""
        losses = self._losses[task.key] = self.count_losses(task) + 1
        if losses < MOST_LOSSES:
            self._returned.append(task)
        return losses < MOST_LOSSES

    def count_losses(self, task: T) -> int:
        """Return how many workers were lost with this task."""
        return self._losses.get(task.key, 0)

    def answer(self, task: T, result: R | None, seconds: float = 0.0) -> Answer[T, R]:
        """Return the answer to a task, and forget its losses."""
        return Answer(task, result, seconds, self._losses.pop(task.key, 0))
