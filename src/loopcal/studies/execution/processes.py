# SPDX-License-Identifier: Apache-2.0
"""Worker processes on this computer.

Each worker has a pipe of its own and one task at a time, so the loss of one disturbs no other. (The
pool of the standard library stops all its workers when it loses one.) Workers are started anew
("spawn"), with one thread of linear algebra each. They ignore Ctrl-C, which is for their driver,
and end when its end of the pipe closes.
"""

from __future__ import annotations

import signal
import traceback
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Generic

from loopcal.errors import StudyError
from loopcal.findings import report_finding
from loopcal.studies.execution.interface import Answer, R, T, TaskQueue, compute_timed
from loopcal.threads import use_one_thread

if TYPE_CHECKING:
    from multiprocessing.connection import Connection
    from multiprocessing.process import BaseProcess

MOST_FAILED_STARTS = 3
"""Processes that may end in a row before they are ready. After that none is started."""

LONGEST_STOP = 5.0
"""Seconds to wait for a worker that was told to stop."""


@dataclass(frozen=True)
class Processes:
    """Worker processes on this computer.

    Parameters
    ----------
    workers : their number.
    """

    workers: int

    def map_blocks(
        self, function: Callable[[T], R], tasks: Iterable[T | None]
    ) -> Generator[Answer[T, R], None, None]:
        """Compute tasks by processes; see `Executor.map_blocks`."""
        pool = _Pool(function, TaskQueue(tasks), self.workers)
        try:
            yield from pool.run()
        finally:
            pool.stop()


@dataclass(eq=False)
class _Worker(Generic[T]):
    """A process, our end of its pipe, and its task."""

    process: BaseProcess
    connection: Connection
    is_ready: bool = False
    task: T | None = None


class _Pool(Generic[T, R]):
    """The workers of one iteration."""

    def __init__(self, function: Callable[[T], R], queue: TaskQueue[T], size: int) -> None:
        self._function, self._queue, self._size = function, queue, size
        self._workers: dict[Connection, _Worker[T]] = {}
        self._failed_starts = 0

    def run(self) -> Iterator[Answer[T, R]]:
        """Yield answers until no task is left."""
        from multiprocessing.connection import wait

        for _ in range(self._size):
            task = self._queue.take()
            if task is None and self._queue.is_exhausted:
                break
            self._start(task)  # also without a task, as starting takes time
        while self._workers:
            for connection in wait(list(self._workers)):
                worker = self._workers[connection]  # pyright: ignore[reportArgumentType]
                try:
                    message = worker.connection.recv()
                except (EOFError, OSError):  # the process has ended
                    yield from self._replace(worker)
                    continue
                if not worker.is_ready:
                    worker.is_ready, self._failed_starts = True, 0
                    if worker.task is not None:
                        self._send(worker, worker.task)
                    continue
                task, worker.task = worker.task, None
                assert task is not None
                if isinstance(message, BaseException):
                    raise message
                yield self._queue.answer(task, *message)
            self._give_tasks()

    def _give_tasks(self) -> None:
        """Give every free worker a task, replace lost ones, and end those that are not needed."""
        for worker in [w for w in self._workers.values() if w.is_ready and w.task is None]:
            task = self._queue.take()
            if task is not None:
                self._send(worker, task)
            elif self._queue.is_exhausted:
                self._forget(worker)
        while len(self._workers) < self._size and (task := self._queue.take()) is not None:
            self._start(task)
        workers = self._workers.values()
        assert not workers or any(w.task is not None or not w.is_ready for w in workers)

    def _start(self, task: T | None) -> None:
        """Start a worker for a task, which it receives when it is ready."""
        from multiprocessing import get_context

        context = get_context("spawn")
        ours, theirs = context.Pipe()
        process = context.Process(target=_serve, args=(theirs, self._function), daemon=True)
        with use_one_thread(), _without_interrupts():
            process.start()
        theirs.close()  # so that our end notices when the process ends
        self._workers[ours] = _Worker(process, ours, task=task)

    def _send(self, worker: _Worker[T], task: T) -> None:
        """Send a worker its task."""
        worker.task = task
        with suppress(OSError):  # it has ended, which the next message shows
            worker.connection.send(task)

    def _replace(self, worker: _Worker[T]) -> Iterator[Answer[T, R]]:
        """Forget a worker that has ended, and yield its task where that is given up."""
        self._forget(worker)
        task = worker.task
        if not worker.is_ready:
            self._failed_starts += 1
            if self._failed_starts >= MOST_FAILED_STARTS:
                code = worker.process.exitcode
                raise StudyError(report_finding("workers.not-started", exit=code))
            self._start(task)
        elif task is not None and not self._queue.give_back(task):
            yield self._queue.answer(task, None)

    def _forget(self, worker: _Worker[T]) -> None:
        """Close the pipe of a worker, which ends it."""
        del self._workers[worker.connection]
        worker.connection.close()
        worker.process.join(LONGEST_STOP)

    def stop(self) -> None:
        """Stop all workers at once."""
        for worker in self._workers.values():
            worker.process.kill()
        for worker in list(self._workers.values()):
            self._forget(worker)


@contextmanager
def _without_interrupts() -> Iterator[None]:
    """Delay Ctrl-C while a process starts, and keep it from that process.

    A process whose start is interrupted, here or there, prints a traceback. It inherits the blocked
    signal. Windows cannot block it.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _serve(connection: Connection, function: Callable[[Any], Any]) -> None:
    """Compute tasks from a pipe until its other end closes: the work of a worker process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with suppress(EOFError, OSError):
        connection.send("ready")
        while True:
            connection.send(_compute(function, connection.recv()))


def _compute(function: Callable[[Any], Any], task: Any) -> Any:
    """Return a result with its seconds, or the exception of the function."""
    try:
        return compute_timed(function, task)
    except Exception as error:  # noqa: BLE001 the driver raises it
        error.add_note(traceback.format_exc())
        return error
