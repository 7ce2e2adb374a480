# SPDX-License-Identifier: Apache-2.0
"""The one interface to workers, whatever they are: `map_blocks(function, tasks)`."""

from __future__ import annotations

import os
import signal
import time
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar

from loopcal import optional_packages
from loopcal.errors import StudyError
from loopcal.findings import report_finding
from loopcal.threads import use_one_thread

if TYPE_CHECKING:
    from multiprocessing.connection import Connection
    from multiprocessing.process import BaseProcess

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


# --- Computation in this process, one task after the other.


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


# --- Worker processes on this computer.

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


# --- Packages that only some studies need, imported when they are used.


def import_optional(module: str, extra: str) -> Any:
    """Return a module of an optional package, see `loopcal.optional_packages.import_optional`.

    Raises
    ------
    StudyError : it is not installed.
    """
    return optional_packages.import_optional(module, extra, StudyError)


# --- The workers of a dask cluster (`dask.distributed`), by the address of its scheduler.

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


# --- The workers of a ray cluster, or of one that is started on this computer.

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
        with _connect_to_ray(self.address, self.processors):
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
def _connect_to_ray(address: str | None, processors: int | None) -> Iterator[None]:
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
