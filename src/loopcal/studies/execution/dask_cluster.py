# SPDX-License-Identifier: Apache-2.0
"""The workers of a dask cluster (`dask.distributed`), by the address of its scheduler."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any

from loopcal.errors import StudyError
from loopcal.findings import report_finding
from loopcal.studies.execution.interface import Answer, R, T, TaskQueue, compute_timed
from loopcal.studies.execution.optional_packages import import_optional

QUEUED = 2
"""Tasks in flight for each thread of the workers: one is computed, the next one waits there."""

PATIENCE = 60.0
"""Seconds to wait for the scheduler, and for the first worker."""

PERIOD = 1.0
"""Seconds after which workers are counted again."""


@dataclass(frozen=True)
class Dask:
    """The workers of a dask cluster.

    Parameters
    ----------
    address : of the scheduler, such as `tcp://host:8786`. patience : see `PATIENCE`.
    """

    address: str
    patience: float = PATIENCE

    def map_blocks(
        self, function: Callable[[T], R], tasks: Iterable[T | None]
    ) -> Generator[Answer[T, R], None, None]:
        """Compute tasks on the cluster; see `Executor.map_blocks`.

        The scheduler itself computes the tasks of a lost worker again, a few times.
        """
        distributed = import_optional("distributed", "dask")
        with _connect(self.address, self.patience) as client:
            queue, slots = TaskQueue(tasks), _Slots(client, self.address)
            in_flight: dict[Any, T] = {}
            finished = distributed.as_completed(loop=client.loop)

            def submit() -> bool:
                task = queue.take()
                if task is None:
                    return False
                name = f"{function.__qualname__}-{task.key}-{queue.count_losses(task)}"
                future = client.submit(compute_timed, function, task, key=name, pure=False)
                in_flight[future] = task
                finished.add(future)
                return True

            while len(in_flight) < slots.count() and submit():
                pass
            for future in finished:
                task = in_flight.pop(future)
                try:
                    answer = queue.answer(task, *future.result())
                except distributed.KilledWorker:
                    answer = None if queue.give_back(task) else queue.answer(task, None)
                except (distributed.client.FutureCancelledError, distributed.comm.CommClosedError):
                    raise _report_lost(self.address) from None
                del future  # the scheduler forgets the result
                if answer is not None:
                    yield answer
                while len(in_flight) < slots.count() and submit():
                    pass


class _Slots:
    """How many tasks may be in flight; workers may come and go.

    Parameters
    ----------
    client : asked once in `PERIOD`, as the answer grows with the number of workers.
    """

    def __init__(self, client: Any, address: str) -> None:
        self._client, self._address = client, address
        self._count, self._end = 0, 0.0

    def count(self) -> int:
        """Return the number; raise StudyError where the scheduler is lost."""
        if self._client.status != "running":
            raise _report_lost(self._address)
        now = time.monotonic()
        if now > self._end:
            try:
                threads = sum(self._client.nthreads().values())
            except OSError:
                raise _report_lost(self._address) from None
            self._count, self._end = QUEUED * max(threads, 1), now + PERIOD
        return self._count


def _report_lost(address: str) -> StudyError:
    """Return the error of a scheduler that has ended."""
    return StudyError(report_finding("workers.cluster-lost", address=address))


@contextmanager
def _connect(address: str, patience: float) -> Iterator[Any]:
    """Yield a client of a scheduler that has a worker."""
    distributed = import_optional("distributed", "dask")
    try:
        client = distributed.Client(address, timeout=patience, set_as_default=False)
    except (OSError, ValueError) as error:
        finding = report_finding("workers.cluster-not-reached", address=address)
        raise StudyError(finding) from error
    try:
        try:
            client.wait_for_workers(1, timeout=patience)
        except TimeoutError:
            code = "workers.cluster-without-workers"
            finding = report_finding(code, address=address, seconds=patience)
            raise StudyError(finding) from None
        yield client
    finally:
        with suppress(OSError, TimeoutError):
            client.close()
