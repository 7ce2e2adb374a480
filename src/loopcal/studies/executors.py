# SPDX-License-Identifier: Apache-2.0
"""The one interface to workers, whatever they are: `map_blocks(function, tasks)`."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, Protocol, TypeVar

from loopcal.checks import POSITIVE, Limit, Limited
from loopcal.environment import import_optional, pin_processes
from loopcal.errors import StudyError

# Workers that one task may stop. After that it is given up, because it stops any worker.
MOST_LOSSES = 5


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

    result : of the function; None where the task was given up. seconds : of computation by the
        worker. losses : workers that were lost while they had this task, as far as is known.
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

        function : pure, and importable by the workers: f(task) -> result.
        tasks : see `Task`. None instead of a task says that the next one depends on an answer that
            was not yielded yet; workers that are free wait for it.

        Raises StudyError: no worker can be reached, or none can start. Exception: of the function,
        as it was raised in the worker.
        """
        ...


def compute_timed(function: Callable[[T], R], task: T) -> tuple[R, float]:
    """Return the result of a task, and the seconds that it took."""
    start = time.perf_counter()
    result = function(task)
    return result, time.perf_counter() - start


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


class WorkerLostError(Exception):
    """The worker of a task has ended before its answer."""


class Pool(Protocol):
    """Workers as an executor sees them. A handle stands for a task that was submitted."""

    def count_slots(self) -> int:
        """Return how many tasks may be in flight now; workers may come and go."""
        ...

    def submit(self, function: Callable[[T], R], task: T, losses: int) -> Any:
        """Begin a task that already lost so many workers; return its handle."""
        ...

    def wait(self, handles: Collection[Any]) -> Iterable[Any]:
        """Wait until a task has ended; return the handles of those that have."""
        ...

    def take(self, handle: Any) -> tuple[Any, float]:
        """Return a result and its seconds; raise WorkerLostError, or what the function raised."""
        ...


class _PooledExecutor(Limited):
    """Base of executors whose workers are a pool that is opened for each iteration."""

    ERROR: ClassVar[type[Exception]] = StudyError

    def _open(self) -> AbstractContextManager[Pool]:
        raise NotImplementedError

    def map_blocks(
        self, function: Callable[[T], R], tasks: Iterable[T | None]
    ) -> Generator[Answer[T, R], None, None]:
        """Keep every slot of the pool filled, and yield answers; see `Executor.map_blocks`. Tasks
        that lost their worker come last.
        """
        waiting, in_flight = iter(tasks), dict[Any, T]()
        returned, losses = deque[T](), Counter[str]()
        with self._open() as pool:
            while True:
                while len(in_flight) < pool.count_slots():
                    task = next(waiting, None)
                    if task is None and returned:
                        task = returned.popleft()
                    if task is None:
                        break
                    in_flight[pool.submit(function, task, losses[task.key])] = task
                if not in_flight:
                    return
                for handle in pool.wait(list(in_flight)):
                    task = in_flight.pop(handle)
                    try:
                        result, seconds = pool.take(handle)
                    except WorkerLostError:
                        losses[task.key] += 1
                        if losses[task.key] < MOST_LOSSES:
                            returned.append(task)
                            continue
                        result, seconds = None, 0.0
                    yield Answer(task, result, seconds, losses.pop(task.key, 0))


@dataclass(frozen=True)
class Processes(_PooledExecutor):
    """Worker processes on this computer.

    Parameters
    ----------
    workers : their number, 1 or more.
    """

    LIMITS: ClassVar[Mapping[str, Limit]] = {"workers": POSITIVE}
    workers: int

    @contextmanager
    def _open(self) -> Iterator[Pool]:
        pool = _ProcessPool(self.workers)
        try:
            yield pool
        finally:
            for worker in (*pool.free, *pool.busy.values()):
                worker.shutdown(kill_workers=True)


class _ProcessPool:
    """Worker processes of loky, each a pool of one: a lost process costs its own task only."""

    def __init__(self, size: int) -> None:
        self._size = size
        self.free: list[Any] = []
        self.busy: dict[Any, Any] = {}

    def count_slots(self) -> int:
        return self._size

    def submit(self, function: Callable[[T], R], task: T, losses: int) -> Any:
        from loky import ProcessPoolExecutor

        worker = (
            self.free.pop()
            if self.free
            else ProcessPoolExecutor(1, initializer=_begin_worker, initargs=(os.getpid(),))
        )
        with pin_processes(), _without_interrupts():  # the first task starts the process
            future = worker.submit(compute_timed, function, task)
        self.busy[future] = worker
        return future

    def wait(self, handles: Collection[Any]) -> Iterable[Any]:
        from concurrent.futures import FIRST_COMPLETED, wait

        return wait(handles, return_when=FIRST_COMPLETED).done

    def take(self, handle: Any) -> tuple[Any, float]:
        from loky import BrokenProcessPool

        worker = self.busy.pop(handle)
        try:
            answer = handle.result()
        except BrokenProcessPool as error:
            worker.shutdown()
            raise WorkerLostError from error
        self.free.append(worker)
        return answer


def _begin_worker(driver: int) -> None:
    """Leave Ctrl-C to the driver, and end when it is no longer the parent, however it ends."""

    def end_with_driver() -> None:
        while os.getppid() == driver:
            time.sleep(PERIOD)
        os._exit(1)

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=end_with_driver, daemon=True).start()


@contextmanager
def _without_interrupts() -> Iterator[None]:
    """Delay Ctrl-C while a process starts, and keep it from that process.

    A process whose start is interrupted prints a traceback. It inherits the blocked signal. Windows
    cannot block it.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


# Tasks in flight for each thread of a cluster: one is computed, the next one waits there.
QUEUED = 2

PATIENCE = 60.0  # seconds to wait for the scheduler, and for the first worker
PERIOD = 1.0  # seconds after which workers are counted again, and look for their driver


@dataclass(frozen=True)
class Dask(_PooledExecutor):
    """The workers of a dask cluster (`dask.distributed`).

    Parameters
    ----------
    address : of the scheduler, such as `tcp://host:8786`. patience : see `PATIENCE`.
    """

    LIMITS: ClassVar[Mapping[str, Limit]] = {"patience": POSITIVE}
    address: str
    patience: float = PATIENCE

    @contextmanager
    def _open(self) -> Iterator[Pool]:
        """Connect to the scheduler, which itself computes the tasks of a lost worker again."""
        distributed = import_optional("distributed", "dask", StudyError)
        address, patience = self.address, self.patience
        try:
            client = distributed.Client(address, timeout=patience, set_as_default=False)
        except (OSError, ValueError) as error:
            raise StudyError.of("workers.cluster-not-reached", address=address) from error
        try:
            try:
                client.wait_for_workers(1, timeout=patience)
            except TimeoutError:
                code = "workers.cluster-without-workers"
                raise StudyError.of(code, address=address, seconds=patience) from None
            yield _DaskPool(distributed, client, address)
        finally:
            with suppress(OSError, TimeoutError):
                client.close()


class _DaskPool:
    """A dask cluster as a `Pool`."""

    def __init__(self, distributed: Any, client: Any, address: str) -> None:
        self._distributed, self._client, self._address = distributed, client, address
        self._count, self._end = 0, 0.0
        self._finished = distributed.as_completed(loop=client.loop)

    def count_slots(self) -> int:
        if self._client.status != "running":
            raise _report_lost(self._address)
        now = time.monotonic()
        if now > self._end:  # the answer grows with the number of workers
            try:
                threads = sum(self._client.nthreads().values())
            except OSError:
                raise _report_lost(self._address) from None
            self._count, self._end = QUEUED * max(threads, 1), now + PERIOD
        return self._count

    def submit(self, function: Callable[[T], R], task: T, losses: int) -> Any:
        name = f"{function.__qualname__}-{task.key}-{losses}"
        future = self._client.submit(compute_timed, function, task, key=name, pure=False)
        self._finished.add(future)
        return future

    def wait(self, handles: Collection[Any]) -> Iterable[Any]:
        return [next(self._finished)]

    def take(self, handle: Any) -> tuple[Any, float]:
        distributed = self._distributed
        try:
            return handle.result()
        except distributed.KilledWorker as error:
            raise WorkerLostError from error
        except (distributed.client.FutureCancelledError, distributed.comm.CommClosedError):
            raise _report_lost(self._address) from None


def _report_lost(address: str) -> StudyError:
    """Return the error of a scheduler that has ended."""
    return StudyError.of("workers.cluster-lost", address=address)


@dataclass(frozen=True)
class Ray(_PooledExecutor):
    """The workers of a ray cluster.

    Parameters
    ----------
    address : of the cluster. Default: that of the variable RAY_ADDRESS; where this is not set, a
        cluster is started on this computer, and stopped at the end.
    processors : of a cluster that is started. Default: all.
    """

    LIMITS: ClassVar[Mapping[str, Limit]] = {"processors": POSITIVE}
    address: str | None = None
    processors: int | None = None

    @contextmanager
    def _open(self) -> Iterator[Pool]:
        """Use the cluster of this process, or join or start one."""
        ray = import_optional("ray", "ray", StudyError)
        is_ours = not ray.is_initialized()
        if is_ours:
            # it would report its use to its makers
            os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
            address = self.address or os.environ.get("RAY_ADDRESS")
            settings: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
            if address is None:
                settings |= {"num_cpus": self.processors, "include_dashboard": False}
            try:
                ray.init(address=address, **settings)
            except (ConnectionError, RuntimeError, ValueError) as error:
                raise StudyError.of(
                    "workers.cluster-not-reached", address=address or "ray"
                ) from error
        pool = _RayPool(ray)
        try:
            yield pool
        finally:
            for reference in pool.in_flight:
                ray.cancel(reference, force=True)
            if is_ours:
                ray.shutdown()


class _RayPool:
    """A ray cluster as a `Pool`."""

    def __init__(self, ray: Any) -> None:
        self._ray = ray
        self._compute = ray.remote(num_cpus=1, max_retries=0)(compute_timed)
        self.in_flight: set[Any] = set()

    def count_slots(self) -> int:
        return QUEUED * max(int(self._ray.cluster_resources().get("CPU", 0)), 1)

    def submit(self, function: Callable[[T], R], task: T, losses: int) -> Any:
        reference = self._compute.remote(function, task)
        self.in_flight.add(reference)
        return reference

    def wait(self, handles: Collection[Any]) -> Iterable[Any]:
        return self._ray.wait(list(handles), num_returns=1)[0]

    def take(self, handle: Any) -> tuple[Any, float]:
        exceptions = self._ray.exceptions
        self.in_flight.discard(handle)
        try:
            return self._ray.get(handle)
        except exceptions.RayTaskError as error:
            if isinstance(error.cause, Exception):
                raise error.cause from error
            raise
        except (
            exceptions.WorkerCrashedError,
            exceptions.NodeDiedError,
            exceptions.OutOfMemoryError,
        ) as error:
            raise WorkerLostError from error
