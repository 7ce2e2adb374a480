# SPDX-License-Identifier: Apache-2.0
"""The same study computed in one process, by dask and by ray has identical blocks; by two
processes: test_driver.py.
"""

from __future__ import annotations

import logging
from pathlib import Path

import pytest

from evidence.study_interruption import Contents, read_contents
from loopcal.errors import FileError
from loopcal.studies.execution.executors import Dask, Executor, Ray, Serial
from loopcal.studies.running import read_source, run_study
from tests.studies.block_functions import (
    die_once,
    draw_numbers,
    list_tasks,
    make_cluster,
    refuse_third,
)
from tests.studies.small_study import CELLS, write_study
from tests.studies.test_execution import check_numbers, collect

ROOT = str(Path(__file__).parents[2])


def compute(folder: Path, executor: Executor) -> Contents:
    folder.mkdir()
    report = run_study(read_source(write_study(folder)), folder / "study", executor)
    assert report.is_complete
    return read_contents(folder / "study")


@pytest.mark.slow
def test_dask_computes_identical_blocks(tmp_path) -> None:
    expected = compute(tmp_path / "serial", Serial())
    assert len(expected) == CELLS * 4
    assert len(set(expected.values())) == len(expected)
    with make_cluster(2) as cluster:
        assert compute(tmp_path / "dask", Dask(cluster.scheduler_address)) == expected


@pytest.mark.evidence
def test_ray_computes_identical_blocks_survives_lost_workers_and_passes_errors_on(
    tmp_path, monkeypatch
) -> None:
    """Ray takes a quarter of a minute to start and half a minute to replace lost workers; those of
    dask and of processes are lost in test_execution.py.
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
