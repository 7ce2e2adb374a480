# SPDX-License-Identifier: Apache-2.0
"""A study survives what happens to its driver and its workers, and its folder is continued; poses
are planned ahead of time, each once; the memory of a driver does not grow with the number of
trials.
"""

from __future__ import annotations

import gc
import json
import shutil
import sqlite3
import tracemalloc
from collections.abc import Callable, Generator, Iterable
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

import loopcal
from evidence.study_interruption import BLOCK, Disturbance, examine, read_contents
from loopcal.errors import EstimationError, FileError, StudyError
from loopcal.studies.executors import Answer, Dask, Processes, Serial
from loopcal.studies.files.store import (
    NAME,
    StudySource,
    StudyStore,
    merge_studies,
    open_store,
    open_study,
    read_study,
)
from loopcal.studies.running import (
    MOST_WAITING,
    Share,
    count_blocks,
    count_stored,
    estimate_time,
    list_missing_tasks,
    read_source,
    run_blocks,
    run_study,
    view_estimate,
)
from loopcal.studies.simulation.block import BlockTask, PosesTask, compute_task, list_tasks
from loopcal.studies.simulation.machines import CellPoses
from loopcal.studies.specification import (
    EffectsLevel,
    ErrorsLevel,
    InstrumentLevel,
    MethodLevel,
    NoiseLevel,
    PosesLevel,
)
from loopcal.studies.study_result import StudyResult
from loopcal.typing import FloatArray
from tests.findings.expectations import expect_refusal, list_codes
from tests.studies.small_study import CELLS, write_study
from tests.studies.studies import make_study

ROOT = str(Path(__file__).parents[2])

RESULT = Path(ROOT, "docs", "evidence", "study_interruption.json")


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory) -> Path:
    """Return the folder of the small study, computed without disturbance."""
    place = tmp_path_factory.mktemp("undisturbed")
    loopcal.study(write_study(place), place / "study")
    return place / "study"


def test_study_in_python_returns_its_results(undisturbed) -> None:
    result = StudyResult(undisturbed)
    assert next(c.name for c in result.study.columns) == "outcome"
    scores = result.read_scores(0, ["position", "rank"])
    assert scores.shape == (20, 2)
    assert (scores > 0.0).all()
    summary = result.summarize()
    assert summary.is_complete
    assert summary.trials == CELLS * 20
    frame, data = result.to_frame(), result.to_dataset()
    assert len(frame) == CELLS * 20
    cell = frame[(frame.poses == "12") & (frame.method == "map")]
    chosen = data.position.sel({"poses": "12", "method": "map"}).squeeze()
    assert np.array_equal(cell.position, chosen)
    assert chosen.attrs["units"] == "m"


def test_progress_counts_blocks_and_finished_study_computes_nothing(undisturbed, tmp_path) -> None:
    reports = []
    source = read_source(write_study(tmp_path))

    def note(done: int, total: int, _what: str) -> None:
        reports.append((done, total))

    again = run_study(source, undisturbed, Serial(), resume=True, progress=note)
    assert (again.total, again.before, again.computed) == (16, 16, 0)
    assert reports == [(16, 16)]
    assert again.is_complete


def test_folder_is_continued_extended_and_equal_to_one_made_at_once(undisturbed, tmp_path) -> None:
    file = write_study(tmp_path, replicates=10)
    first = loopcal.study(file, tmp_path / "study")
    assert first.summarize().trials == CELLS * 10
    more = StudySource(replace(read_study(tmp_path / "study"), replicates=20))
    report = run_study(more, tmp_path / "study", Serial(), resume=True)
    assert (report.total, report.before, report.computed, report.trials) == (16, 8, 8, 40)
    assert read_contents(tmp_path / "study") == read_contents(undisturbed)


def test_further_levels_keep_finished_blocks(undisturbed, tmp_path) -> None:
    source = read_source(write_study(tmp_path))
    fewer = replace(source.study, poses={"12": source.study.poses["12"]})
    run_study(StudySource(fewer), tmp_path / "study", Serial())
    report = run_study(source, tmp_path / "study", Serial(), resume=True)
    assert (report.before, report.computed) == (8, 8)
    assert read_contents(tmp_path / "study") == read_contents(undisturbed)


def test_folder_is_refused_where_it_is_in_use_changed_or_of_others(undisturbed, tmp_path) -> None:
    source = read_source(write_study(tmp_path))
    with expect_refusal("store.in-use", FileError):
        run_study(source, undisturbed, Serial())
    changed = StudySource(replace(source.study, seed=4))
    with expect_refusal("store.specification-changed", FileError, changes=("seed: 3 -> 4",)):
        run_study(changed, undisturbed, Serial(), resume=True)
    with expect_refusal("store.specification-changed", FileError):
        run_study(read_source(write_study(tmp_path, 10)), undisturbed, Serial(), resume=True)
    with expect_refusal("store.folder-of-others", FileError):
        run_study(source, tmp_path, Serial(), resume=True)
    (tmp_path / "file").touch()
    with pytest.raises(FileError, match="this is a file, but a study is a folder"):
        run_study(source, tmp_path / "file", Serial())


@pytest.mark.slow
@pytest.mark.parametrize("exists", [True, False])
def test_workers_that_are_not_reached_leave_nothing(tmp_path, exists) -> None:
    source, folder = read_source(write_study(tmp_path)), tmp_path / "study"
    if exists:
        folder.mkdir()
    before = sorted(tmp_path.rglob("*"))
    for _ in range(2):
        with expect_refusal("workers.cluster-not-reached", StudyError):
            run_study(source, folder, Dask("tcp://127.0.0.1:1", patience=0.5))
        assert sorted(tmp_path.rglob("*")) == before


def test_workers_that_are_not_reached_later_leave_the_stored_blocks(tmp_path) -> None:
    file, folder = write_study(tmp_path, replicates=10), tmp_path / "study"
    run_study(read_source(file), folder, Serial())
    before = read_contents(folder)
    with expect_refusal("workers.cluster-not-reached", StudyError):
        workers = Dask("tcp://127.0.0.1:1", patience=0.5)
        run_study(read_source(write_study(tmp_path)), folder, workers, resume=True)
    assert read_contents(folder) == before


class RefusesSecondBlock:
    """Workers that end with an error of the library at the second block."""

    def map_blocks(self, function, tasks) -> Any:
        for task in tasks:
            if isinstance(task, BlockTask) and task.block == 1:
                raise StudyError("the cluster was shut down")
            yield Answer(task, function(task))


def test_error_after_the_first_block_leaves_it_stored(tmp_path) -> None:
    source, folder = read_source(write_study(tmp_path)), tmp_path / "study"
    with pytest.raises(StudyError, match="the cluster was shut down"):
        run_study(source, folder, RefusesSecondBlock())
    assert len(read_contents(folder)) == 1


def test_store_of_other_numbers_is_refused(undisturbed, tmp_path) -> None:
    source = read_source(write_study(tmp_path))
    with open_study(tmp_path / "study", source) as store:
        store.set_header(replace(store.header, versions={"numerics": "0"}))
    with expect_refusal("store.other-numbers", FileError, found="0"):
        run_study(source, tmp_path / "study", Serial(), resume=True)


def test_settings_of_later_versions_are_no_change_and_unknown_ones_are_refused(tmp_path) -> None:
    source = read_source(write_study(tmp_path))
    with open_study(tmp_path / "study", source) as store:
        earlier = json.loads(store.header.specification)
        del earlier["scores"]["limit_angle"]  # as before this setting existed
        store.set_header(replace(store.header, specification=json.dumps(earlier)))
    with open_study(tmp_path / "study", source, resume=True) as store:
        assert store.header.specification == source.study.to_json()
        earlier["seed"] = "not a number"
        store.set_header(replace(store.header, specification=json.dumps(earlier)))
    with expect_refusal("store.other-numbers", FileError, part="loopcal"):
        read_study(tmp_path / "study")


def test_folder_contains_the_study_file_and_its_robots(tmp_path) -> None:
    shipped = Path(loopcal.__file__).parent / "robots" / "five-bar.yaml"
    (tmp_path / "mine.yaml").write_bytes(shipped.read_bytes())
    file = write_study(tmp_path, 2, 2)
    file.write_text(file.read_text().replace("[five-bar]", "[mine.yaml]"))
    with open_study(tmp_path / "study", read_source(file)):
        pass
    names = {path.name for path in (tmp_path / "study").iterdir()}
    assert names == {NAME, "study.yaml", "mine.yaml"}
    assert (tmp_path / "study" / "study.yaml").read_bytes() == file.read_bytes()
    assert read_source(tmp_path / "study" / "study.yaml").study == read_source(file).study


@pytest.mark.parametrize("parts", [2, 7])
def test_shares_are_disjoint_and_their_folders_join_to_the_whole(
    undisturbed, tmp_path, parts
) -> None:
    source = read_source(write_study(tmp_path))
    folders = [tmp_path / f"part-{part}" for part in range(1, parts + 1)]
    totals = []
    for part, folder in enumerate(folders, start=1):
        report = run_study(source, folder, Serial(), share=Share(part, parts))
        assert report.is_complete
        totals.append(report.total)
    assert sum(totals) == 16
    assert max(totals) - min(totals) <= 4
    assert merge_studies(folders, tmp_path / "study") == 16
    assert merge_studies(folders, tmp_path / "study") == 0
    assert read_contents(tmp_path / "study") == read_contents(undisturbed)
    other = StudySource(replace(source.study, seed=9))
    run_study(other, tmp_path / "other", Serial(), share=Share(1, 7))
    with expect_refusal("store.part-of-other-study", FileError, changes=("seed: 9 -> 3",)):
        merge_studies([folders[0], tmp_path / "other"], tmp_path / "third")


def test_damaged_part_is_refused_before_a_folder_is_made(undisturbed, tmp_path) -> None:
    shutil.copytree(undisturbed, tmp_path / "part")
    raw = (undisturbed / NAME).read_bytes()
    (tmp_path / "part" / NAME).write_bytes(raw[:-4096] + bytes(4096))
    with pytest.raises(FileError, match=f"^{tmp_path / 'part' / NAME}: this file is damaged"):
        merge_studies([undisturbed, tmp_path / "part"], tmp_path / "whole")
    assert not (tmp_path / "whole").exists()


@pytest.mark.parametrize("damaged", ["part", "whole"])
@pytest.mark.parametrize("change", ["seconds = 0.2", "cell = 9223372036854775807"])
def test_damaged_block_is_refused_before_a_merge_writes(
    undisturbed, tmp_path, damaged, change
) -> None:
    for name in ("part", "whole"):
        shutil.copytree(undisturbed, tmp_path / name)
    with closing(sqlite3.connect(tmp_path / damaged / NAME)) as connection, connection:
        connection.execute(f"UPDATE blocks SET {change} WHERE rowid = 2")
    before = (tmp_path / "whole" / NAME).read_bytes()
    with pytest.raises(FileError, match=f"^{tmp_path / damaged / NAME}: block .* is damaged"):
        merge_studies([undisturbed, tmp_path / "part"], tmp_path / "whole")
    assert (tmp_path / "whole" / NAME).read_bytes() == before


@dataclass
class GivesUp:
    """Workers that give up some tasks (a stand-in for tasks that need too much memory;
    `test_execution` has processes that are really killed).
    """

    is_given_up: Callable[[BlockTask | PosesTask], bool]

    def map_blocks(self, function, tasks):
        for task in tasks:
            is_lost = self.is_given_up(task)
            yield Answer(task, None if is_lost else function(task), 0.1, 5 if is_lost else 0)


def is_second_block(task: BlockTask | PosesTask) -> bool:
    return isinstance(task, BlockTask) and task.block == 1


def is_poses_of_twelve(task: BlockTask | PosesTask) -> bool:
    return isinstance(task, PosesTask) and '"count":12' in task.content


@pytest.mark.parametrize(
    ("is_given_up", "missing", "losses", "named"),
    [(is_second_block, 4, 20, "cell 0, block 1"), (is_poses_of_twelve, 8, 5, "cell 2, poses")],
)
def test_tasks_that_are_given_up_are_reported_and_computed_the_next_time(
    tmp_path, is_given_up, missing, losses, named
) -> None:
    source = read_source(write_study(tmp_path))
    report = run_study(source, tmp_path / "study", GivesUp(is_given_up))
    assert (report.computed, report.losses) == (16 - missing, losses)
    assert not report.is_complete
    assert list_codes(report.findings) == {"workers.lost", "workers.blocks-given-up"}
    assert named in str(report.findings[1])
    again = run_study(source, tmp_path / "study", Serial(), resume=True)
    assert (again.computed, again.is_complete) == (missing, True)


@pytest.mark.slow
def test_two_processes_give_the_same_blocks(undisturbed, tmp_path) -> None:
    report = run_study(read_source(write_study(tmp_path)), tmp_path / "study", Processes(2))
    assert report.computed == 16
    assert read_contents(tmp_path / "study") == read_contents(undisturbed)


@pytest.mark.parametrize("executor", [Serial(), Processes(1)], ids=["here", "in a process"])
def test_threads_give_the_same_blocks(undisturbed, tmp_path, executor) -> None:
    source = read_source(write_study(tmp_path))
    assert run_study(source, tmp_path / "study", executor, threads=2).computed == 16
    assert read_contents(tmp_path / "study") == read_contents(undisturbed)


def test_a_study_without_threads_is_refused(tmp_path) -> None:
    with pytest.raises(EstimationError, match=r"threads is 0. Give 1 or more"):
        loopcal.study(write_study(tmp_path), tmp_path / "study", threads=0)
    assert not (tmp_path / "study").exists()


@pytest.mark.slow
def test_study_survives_killed_drivers_and_workers(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("PYTHONPATH", f"{ROOT}/src:{ROOT}")
    counts = examine(tmp_path, Disturbance(replicates=30, block=5, kills=2), Serial())
    counts = {name: counts[name] for name in counts if name not in ("trials", "blocks")}
    assert counts == {
        "lost": 0, "doubled": 0, "different": 0, "driver_kills": 1, "worker_kills": 1,
    }  # fmt: skip
    left = {path.name for path in tmp_path.iterdir()} - {"study.yaml", "undisturbed", "disturbed"}
    assert left == set()


def test_full_size_evidence_lost_and_doubled_nothing() -> None:
    counts = json.loads(RESULT.read_text())["counts"]
    assert counts["blocks"] * BLOCK >= 50_000
    assert counts["driver_kills"] + counts["worker_kills"] == 20
    assert [counts[name] for name in ("lost", "doubled", "different")] == [0, 0, 0]


def test_counts_of_shares_add_up(undisturbed) -> None:
    study = read_study(undisturbed)
    for parts in (1, 3, 4, 5, 9):
        shares = [Share(part, parts) for part in range(1, parts + 1)]
        assert sum(count_blocks(study, share) for share in shares) == 16
    with open_store(undisturbed) as store:
        assert sum(count_stored(study, store, Share(part, 5)) for part in range(1, 6)) == 16


SIZE = 50

ALLOWED = 150_000


"""Bytes, of statements that SQLite and Python keep; the scores of 35,000 more trials would take
5.6 MB.
"""


def make_scores(task: Any) -> FloatArray | CellPoses:
    """Return scores that cost nothing, in place of `compute_task`."""
    if isinstance(task, PosesTask):
        return CellPoses([[0.0, 0.3]] * 12, [[0.0, 0.3]] * 5)
    return np.zeros((SIZE, 20))


class Cheap:
    """This process, with scores that cost nothing."""

    def map_blocks(
        self, function: Callable[[Any], Any], tasks: Iterable[Any]
    ) -> Generator[Answer[Any, Any], None, None]:
        yield from Serial().map_blocks(make_scores, tasks)


def empty_free_lists(done: int, _total: int, _what: str) -> None:
    """Let the interpreter return its free lists, which keep up to 2,000 tuples of each length."""
    if done % 500 == 0:
        gc.collect()


def measure_peak(folder: Path, replicates: int) -> int:
    """Return the largest memory [bytes] of a driver that stores this many trials of one cell."""
    study = make_study("five-bar", replicates=replicates, block=SIZE)
    with open_study(folder, StudySource(study), resume=True) as store:
        tracemalloc.start()
        try:
            report = run_blocks(study, store, Cheap(), progress=empty_free_lists)
            assert report.is_complete
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()


@pytest.mark.evidence
def test_memory_of_a_driver_is_that_of_an_eighth_of_the_trials(tmp_path) -> None:
    measure_peak(tmp_path / "first", 2 * SIZE)  # what is loaded once
    few = measure_peak(tmp_path / "few", 5_000)
    many = measure_peak(tmp_path / "many", 40_000)
    assert many < few + ALLOWED, (few, many)


def test_memory_of_a_driver_that_continues_does_not_grow_with_what_is_stored(tmp_path) -> None:
    measure_peak(tmp_path / "study", 2 * SIZE)
    few = measure_peak(tmp_path / "study", 5_000)
    measure_peak(tmp_path / "study", 40_000)
    last = measure_peak(tmp_path / "study", 40_000 + SIZE)
    assert last < few + ALLOWED, (few, last)


POSES = CellPoses([[0.1, 0.2]], [[0.3, 0.4]])

METHODS = {"LS": MethodLevel("least-squares"), "MAP": MethodLevel("map")}


def make_poses(count: int) -> dict[str, PosesLevel]:
    return {str(n): PosesLevel(n) for n in range(4, 4 + count)}


class EmptyStore:
    """A store without blocks."""

    def count_blocks(self, _levels: Any, _blocks: Any) -> int:
        return 0

    def list_keys(self, _levels: Any, _blocks: Any) -> set[str]:
        return set()


class Tasks:
    """The tasks of a study of which nothing is stored, by name."""

    def __init__(self, **changes: Any) -> None:
        self.poses: dict[str, CellPoses | None] = {}
        self.given_up: list[str] = []
        study, store = make_study("five-bar", **changes), cast(StudyStore, EmptyStore())
        self.rest = list_missing_tasks(study, store, self.poses, self.given_up)

    def take(self, count: int) -> list[str]:
        """Return "poses", the cell and block, or "none", of so many tasks."""
        names = []
        for task in islice(self.rest, count):
            block = f"{task.cell}/{task.block}" if isinstance(task, BlockTask) else "poses"
            names.append("none" if task is None else block)
        return names

    def take_poses(self) -> str:
        """Return the key of the next task, which is one of poses."""
        task = next(self.rest)
        assert isinstance(task, PosesTask)
        return task.key

    def count_poses(self) -> int:
        """Return how many poses are computed until the tasks end."""
        for task in self.rest:
            if isinstance(task, PosesTask):
                self.poses[task.key] = POSES
        return len(self.poses)


def test_one_worker_gets_the_tasks_of_the_study() -> None:
    changes = {"replicates": 12, "poses": make_poses(2)}
    tasks, given = Tasks(**changes), []
    for task in tasks.rest:
        if isinstance(task, PosesTask):
            poses = compute_task(task)
            assert isinstance(poses, CellPoses)
            tasks.poses[task.key] = poses
        else:
            given.append(task)
    assert given == list(list_tasks(make_study("five-bar", **changes)))


def test_poses_of_a_cell_come_before_its_blocks_and_those_of_others_while_it_waits() -> None:
    tasks = Tasks(replicates=18, poses=make_poses(3))
    tasks.poses[tasks.take_poses()] = POSES
    assert tasks.take(3) == ["0/0", "0/1", "0/2"]
    second, third = tasks.take_poses(), tasks.take_poses()
    assert tasks.take(2) == ["none", "none"]
    tasks.poses[second] = POSES
    assert tasks.take(4) == ["1/0", "1/1", "1/2", "none"]
    tasks.poses[third] = POSES
    assert tasks.take(4) == ["2/0", "2/1", "2/2"]


def test_many_workers_compute_poses_of_many_cells_at_once() -> None:
    tasks = Tasks(poses=make_poses(MOST_WAITING + 5))
    assert tasks.take(MOST_WAITING + 1) == [*["poses"] * MOST_WAITING, "none"]


def test_cells_with_the_same_poses_have_one_task() -> None:
    tasks = Tasks(methods=METHODS, poses=make_poses(2))
    first, second = tasks.take_poses(), tasks.take_poses()
    tasks.poses[first] = POSES
    assert tasks.take(3) == ["0/0", "1/0", "none"]
    tasks.poses[second] = POSES
    assert tasks.take(3) == ["2/0", "3/0"]
    assert Tasks(methods=METHODS, poses=make_poses(3), order=("method", "poses")).count_poses() == 3


def test_cells_whose_poses_are_given_up_are_left_out_and_named() -> None:
    tasks = Tasks(methods=METHODS, poses=make_poses(2))
    tasks.poses |= {tasks.take_poses(): None, tasks.take_poses(): POSES}
    assert tasks.take(3) == ["2/0", "3/0"]
    assert tasks.given_up == ["cell 0, poses", "cell 1, poses"]


def test_poses_depend_on_what_determines_them_only() -> None:
    """Planned ones on spreads and instrument too, none on what is done with measurements."""
    factors: dict[str, dict[str, Any]] = {
        "instruments": {"a": InstrumentLevel(), "b": InstrumentLevel(sigma_angle=1.0)},
        "noise": {"1": NoiseLevel(), "2": NoiseLevel(2.0)},
        "errors": {"1": ErrorsLevel(), "2": ErrorsLevel(2.0)},
        "methods": METHODS,
        "effects": {"none": EffectsLevel(), "more": EffectsLevel(2.0)},
    }
    counts = {}
    for choice in ("random", "planned"):
        poses = {choice: PosesLevel(5, choice)}
        for factor, levels in factors.items():
            counts[choice, factor] = Tasks(poses=poses, **{factor: levels}).count_poses()
    assert {key for key, count in counts.items() if count == 2} == {
        ("planned", factor) for factor in ("instruments", "noise", "errors")
    }
    true_errors = {"1": ErrorsLevel(), "2": ErrorsLevel(error_factor=2.0)}
    planned = {"planned": PosesLevel(5, "planned")}
    assert Tasks(poses=planned, errors=true_errors).count_poses() == 1


@pytest.mark.slow
def test_time_estimate_counts_planning_once_for_all_blocks_and_cells_that_share_poses() -> None:
    planned = {"6": PosesLevel(6, "planned"), "8": PosesLevel(8, "planned")}
    study = make_study("five-bar", poses=planned, methods=METHODS, replicates=6000)
    estimate = estimate_time(study, workers=1)
    assert (estimate.cells, estimate.blocks, estimate.plans) == (4, 4000, 2)
    total = 4000 * estimate.seconds_per_block + 2 * estimate.seconds_per_plan
    assert estimate.worker_seconds == pytest.approx(total)
    assert estimate.seconds == pytest.approx(total)
    page = [str(line) for line in view_estimate(study, estimate, lambda seconds: f"{seconds} s")]
    assert page[-1].startswith("This includes planning poses, ")
    assert page[-1].endswith(" s 2 times")
    shown = view_estimate(make_study("five-bar"), estimate, lambda seconds: f"{seconds} s")
    assert "planning" not in str(shown)
