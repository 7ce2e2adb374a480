# SPDX-License-Identifier: Apache-2.0
"""Workers of every kind give the same results, and a lost worker costs only its tasks."""

from __future__ import annotations

import itertools
import logging
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import dask.config
import numpy as np
import pytest

import loopcal as lc
from evidence.study_interruption import Contents, read_contents
from loopcal.errors import FileError, StudyError
from loopcal.studies.executors import MOST_LOSSES, Answer, Dask, Executor, Processes, Ray, Serial
from loopcal.studies.running import read_source, run_study
from tests.findings.expectations import expect_refusal
from tests.studies.block_functions import (
    NumberTask,
    count_threads,
    die_always,
    die_once,
    draw_numbers,
    list_tasks,
    make_cluster,
    refuse_third,
)
from tests.studies.small_study import CELLS, write_study

ROOT = str(Path(__file__).parents[2])


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """Return a real scheduler and two real worker processes of dask."""
    # its defaults must be set before: dask would remove them with our setting
    import distributed  # noqa: F401

    with (
        dask.config.set({"distributed.comm.timeouts.connect": "2s"}),  # to a worker that was killed
        make_cluster(2) as cluster,
    ):
        yield cluster


@pytest.fixture(params=["serial", "processes", "dask"])
def executor(request) -> Executor:
    match request.param:
        case "serial":
            return Serial()
        case "processes":
            return Processes(2)
        case _:
            return Dask(request.getfixturevalue("cluster").scheduler_address)


@pytest.mark.parametrize("count", [0, -1])
@pytest.mark.parametrize(
    "make",
    [
        lambda count, folder: lc.study(write_study(folder), folder / "results", workers=count),
        lambda count, _: Processes(count),
        lambda count, _: Ray(processors=count),
        lambda count, _: Dask("tcp://127.0.0.1:1", patience=count),
    ],
)
def test_numbers_of_workers_and_seconds_below_one_are_refused(make, count, tmp_path) -> None:
    with pytest.raises(StudyError, match=f" is {count}, but must be above 0"):
        make(count, tmp_path)
    assert not (tmp_path / "results").exists()


def collect(answers) -> dict[int, Answer]:
    """Return answers by the number of their task; each task has one."""
    collected = list(answers)
    by_number = {answer.task.number: answer for answer in collected}
    assert len(by_number) == len(collected)
    return by_number


def check_numbers(answers: dict[int, Answer], count: int) -> None:
    assert sorted(answers) == list(range(count))
    for number, answer in answers.items():
        assert answer.result is not None
        assert np.array_equal(answer.result, draw_numbers(NumberTask(number)))


@pytest.mark.slow
def test_every_kind_of_worker_gives_the_same_results(executor) -> None:
    answers = collect(executor.map_blocks(draw_numbers, list_tasks(20, pause=0.01)))
    check_numbers(answers, 20)
    assert all(answer.seconds >= 0.01 for answer in answers.values())
    assert all(answer.losses == 0 for answer in answers.values())


def test_no_task_gives_no_answer(executor) -> None:
    assert list(executor.map_blocks(draw_numbers, [])) == []


def test_tasks_may_be_endless_because_few_are_in_flight(executor, tmp_path) -> None:
    tasks = list_tasks(sys.maxsize, tmp_path)
    with closing(executor.map_blocks(draw_numbers, tasks)) as answers:
        first = list(itertools.islice(answers, 10))
    assert len(first) == 10
    assert len(list(tmp_path.glob("taken-*"))) <= 10 + 5


def test_error_of_the_library_reaches_the_caller_with_its_place(executor) -> None:
    with pytest.raises(FileError) as caught:
        collect(executor.map_blocks(refuse_third, list_tasks(6)))
    assert str(caught.value) == "study.yaml:7: task 3 is refused"


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["processes", "dask"])
def test_lost_workers_cost_only_their_tasks(kind, request, tmp_path) -> None:
    chosen = Processes(2)
    if kind == "dask":
        chosen = Dask(request.getfixturevalue("cluster").scheduler_address)
    answers = collect(chosen.map_blocks(die_once, list_tasks(8, tmp_path)))
    check_numbers(answers, 8)
    if kind == "processes":  # the scheduler of dask does not say which tasks it repeated
        assert [n for n, answer in sorted(answers.items()) if answer.losses] == [0, 3, 6]


@pytest.mark.slow
def test_task_that_stops_every_worker_is_given_up() -> None:
    answers = collect(Processes(2).map_blocks(die_always, list_tasks(5)))
    lost = answers.pop(2)
    assert (lost.result, lost.losses) == (None, MOST_LOSSES)
    assert sorted(answers) == [0, 1, 3, 4]


def test_processes_have_one_thread_of_linear_algebra_each(monkeypatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    answers = list(Processes(2).map_blocks(count_threads, list_tasks(8)))
    results = [answer.result for answer in answers if answer.result is not None]
    assert len(results) == 8
    assert len({process for process, _ in results} - {os.getpid()}) == 2
    assert all(threads == ["1", "1", "1"] for _, threads in results)
    assert (os.environ["OMP_NUM_THREADS"], os.environ.get("MKL_NUM_THREADS")) == ("7", None)


def test_closed_iteration_leaves_no_process() -> None:
    before = multiprocessing.active_children()  # such as those of earlier tests that still end
    with closing(Processes(2).map_blocks(draw_numbers, list_tasks(50, pause=0.2))) as answers:
        next(answers)
        workers = [p for p in multiprocessing.active_children() if p not in before]
        assert len(workers) == 2
    assert not any(worker.is_alive() for worker in workers)


UNGUARDED = """
from loopcal.studies.executors import Processes
from tests.studies.block_functions import draw_numbers, list_tasks
print(len(list(Processes(1).map_blocks(draw_numbers, list_tasks(2)))))
"""


@pytest.mark.slow
def test_script_without_guard_computes_once(tmp_path) -> None:
    script = tmp_path / "script.py"
    script.write_text(UNGUARDED)
    environment = os.environ | {"PYTHONPATH": f"{ROOT}/src:{ROOT}"}
    done = subprocess.run(
        [sys.executable, script], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout == "2\n"


ORPHAN = """
from loopcal.studies.executors import Processes
from tests.studies.block_functions import count_threads, list_tasks
if __name__ == "__main__":
    for answer in Processes(2).map_blocks(count_threads, list_tasks(10_000)):
        print(answer.result[0], flush=True)
"""


def test_workers_end_when_their_driver_is_killed(tmp_path) -> None:
    script = tmp_path / "script.py"
    script.write_text(ORPHAN)
    environment = os.environ | {"PYTHONPATH": f"{ROOT}/src:{ROOT}"}
    with subprocess.Popen(
        [sys.executable, script], env=environment, stdout=subprocess.PIPE, text=True
    ) as driver:
        assert driver.stdout is not None
        workers: set[int] = set()
        while len(workers) < 2:
            workers.add(int(driver.stdout.readline()))
        driver.send_signal(signal.SIGKILL)
    end = time.monotonic() + 60.0
    while any(is_running(worker) for worker in workers):
        assert time.monotonic() < end
        time.sleep(0.05)


def is_running(process: int) -> bool:
    try:
        return "Z" not in Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False


@pytest.mark.slow
def test_dask_without_scheduler_or_workers_is_refused() -> None:
    with expect_refusal("workers.cluster-not-reached", StudyError):
        list(Dask("tcp://127.0.0.1:1", patience=0.5).map_blocks(draw_numbers, list_tasks(1)))
    with make_cluster(0) as empty, expect_refusal("workers.cluster-without-workers", StudyError):
        address = empty.scheduler_address  # which a busy computer reaches within the patience
        list(Dask(address, patience=3.0).map_blocks(draw_numbers, list_tasks(1)))


@pytest.mark.slow
def test_scheduler_that_ends_is_reported() -> None:
    cluster = make_cluster(1)
    workers = Dask(cluster.scheduler_address, patience=5.0)  # also to wait for it to come back
    answers = workers.map_blocks(draw_numbers, list_tasks(500, pause=0.05))
    next(answers)
    cluster.close()
    with expect_refusal("workers.cluster-lost", StudyError):
        list(answers)


def test_missing_package_is_named(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with expect_refusal("workers.package-missing", StudyError, package="ray", extra="ray"):
        list(Ray().map_blocks(draw_numbers, list_tasks(1)))


def compute(folder: Path, executor: Executor) -> Contents:
    folder.mkdir()
    report = run_study(read_source(write_study(folder)), folder / "study", executor)
    assert report.is_complete
    return read_contents(folder / "study")


@pytest.mark.slow
def test_dask_computes_the_same_blocks_as_this_process(tmp_path, cluster) -> None:
    expected = compute(tmp_path / "serial", Serial())
    assert len(expected) == CELLS * 4
    assert len(set(expected.values())) == len(expected)
    assert compute(tmp_path / "dask", Dask(cluster.scheduler_address)) == expected


@pytest.mark.evidence
def test_ray_computes_identical_blocks_survives_lost_workers_and_passes_errors_on(
    tmp_path, monkeypatch
) -> None:
    """Ray takes a quarter of a minute to start and half a minute to replace lost workers; those of
    dask and of processes are lost above.
    """
    monkeypatch.setenv("PYTHONPATH", f"{ROOT}/src:{ROOT}")
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    import ray

    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, logging_level=logging.ERROR)
    try:
        assert compute(tmp_path / "ray", Ray()) == compute(tmp_path / "serial", Serial())
        answers = collect(Ray().map_blocks(draw_numbers, list_tasks(20)))
        check_numbers(answers, 20)
        check_numbers(collect(Ray().map_blocks(die_once, list_tasks(8, tmp_path))), 8)
        with pytest.raises(FileError) as caught:
            collect(Ray().map_blocks(refuse_third, list_tasks(6)))
        assert str(caught.value) == "study.yaml:7: task 3 is refused"
    finally:
        ray.shutdown()
