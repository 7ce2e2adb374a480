# SPDX-License-Identifier: Apache-2.0
"""The workers of a ray cluster, or of one that is started on this computer."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from loopcal.errors import StudyError
from loopcal.findings import report_finding
from loopcal.studies.execution.interface import MOST_LOSSES, Answer, R, T, TaskQueue, compute_timed
from loopcal.studies.execution.optional_packages import import_optional

QUEUED = 2
"""Tasks in flight for each processor."""


@dataclass(frozen=True)
class Ray:
    """The workers of a ray cluster.

    Parameters
    ----------
    address : of the cluster. Default: that of the variable RAY_ADDRESS; where this is not set, a
        cluster is started on this computer, and stopped at the end.
    processors : of a cluster that is started. Default: all.
    """

    address: str | None = None
    processors: int | None = None

    def map_blocks(
        self, function: Callable[[T], R], tasks: Iterable[T | None]
    ) -> Generator[Answer[T, R], None, None]:
        """Compute tasks on the cluster; see `Executor.map_blocks`.

        Ray itself computes the tasks of a lost worker again, `MOST_LOSSES` - 1 times.
        """
        ray = import_optional("ray", "ray")
        with _connect(self.address, self.processors):
            remote = ray.remote(num_cpus=1, max_retries=MOST_LOSSES - 1)(compute_timed)
            queue = TaskQueue(tasks)
            in_flight: dict[Any, T] = {}

            def submit() -> bool:
                task = queue.take()
                if task is not None:
                    in_flight[remote.remote(function, task)] = task
                return task is not None

            try:
                while True:
                    while len(in_flight) < _count_slots() and submit():
                        pass
                    if not in_flight:
                        return
                    finished, _ = ray.wait(list(in_flight), num_returns=1)
                    for reference in finished:
                        task = in_flight.pop(reference)
                        yield _take_answer(queue, task, reference)
            finally:
                for reference in in_flight:
                    ray.cancel(reference, force=True)


def _take_answer(queue: TaskQueue[T], task: T, reference: Any) -> Answer[T, Any]:
    """Return the answer to a task; raise what the function raised."""
    ray = import_optional("ray", "ray")
    try:
        return queue.answer(task, *ray.get(reference))
    except ray.exceptions.RayTaskError as error:
        cause = error.cause
        if isinstance(cause, Exception):
            raise cause from error
        raise
    except (
        ray.exceptions.WorkerCrashedError,
        ray.exceptions.NodeDiedError,
        ray.exceptions.OutOfMemoryError,
    ):
        return Answer(task, None, losses=MOST_LOSSES)


def _count_slots() -> int:
    """Return how many tasks may be in flight now; nodes may come and go."""
    ray = import_optional("ray", "ray")
    return QUEUED * max(int(ray.cluster_resources().get("CPU", 0)), 1)


@contextmanager
def _connect(address: str | None, processors: int | None) -> Iterator[None]:
    """Use a cluster in the body."""
    ray = import_optional("ray", "ray")
    if ray.is_initialized():
        yield
        return
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # it would report its use to its makers
    address = address or os.environ.get("RAY_ADDRESS")
    settings: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
    if address is None:
        settings |= {"num_cpus": processors, "include_dashboard": False}
    try:
        ray.init(address=address, **settings)
    except (ConnectionError, RuntimeError, ValueError) as error:
        finding = report_finding("workers.cluster-not-reached", address=address or "ray")
        raise StudyError(finding) from error
    try:
        yield
    finally:
        ray.shutdown()
