# SPDX-License-Identifier: Apache-2.0
"""Workers plan the poses of cells ahead of time, and each of them once."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from loopcal.studies.running import (
    KEPT_POSES,
    MOST_WAITING,
    MissingBlock,
    Schedule,
    estimate_time,
    view_estimate,
)
from loopcal.studies.simulation.block import BlockTask, PosesTask, compute_task, list_tasks
from loopcal.studies.simulation.machines import CellPoses
from loopcal.studies.specification.levels import (
    EffectsLevel,
    ErrorsLevel,
    InstrumentLevel,
    MethodLevel,
    NoiseLevel,
    PosesLevel,
)
from loopcal.studies.specification.study import Study, compute_key, describe_cell
from tests.studies.studies import make_study

POSES = CellPoses([[0.1, 0.2]], [[0.3, 0.4]])
METHODS = {"LS": MethodLevel("least-squares"), "MAP": MethodLevel("map")}


def list_missing(study: Study) -> Iterator[Iterator[MissingBlock]]:
    for cell in study.cells:
        contents = [describe_cell(study, cell) | {"block": block} for block in range(study.blocks)]
        yield iter([MissingBlock(compute_key(c), cell.number, c) for c in contents])


def make_poses(count: int) -> dict[str, PosesLevel]:
    return {str(n): PosesLevel(n) for n in range(4, 4 + count)}


def make_schedule(**changes: Any) -> Schedule:
    return Schedule(list_missing(make_study("five-bar", **changes)))


def name(task: BlockTask | PosesTask | None) -> str:
    """Return "poses", the cell and block, or "none"."""
    if task is None:
        return "none"
    return "poses" if isinstance(task, PosesTask) else f"{task.cell}/{task.block}"


def take_poses(schedule: Schedule) -> PosesTask:
    task = next(schedule)
    assert isinstance(task, PosesTask)
    return task


def take_names(schedule: Schedule, count: int) -> list[str]:
    return [name(next(schedule)) for _ in range(count)]


def count_poses(schedule: Schedule) -> int:
    """Return how many poses are computed until the schedule ends."""
    count = 0
    for task in schedule:
        if isinstance(task, PosesTask):
            schedule.add_poses(task, POSES)
            count += 1
    return count


def test_one_worker_gets_the_tasks_of_the_study() -> None:
    study = make_study("five-bar", replicates=12, poses=make_poses(2))
    schedule, blocks = Schedule(list_missing(study)), []
    for task in schedule:
        if isinstance(task, PosesTask):
            poses = compute_task(task)
            assert isinstance(poses, CellPoses)
            schedule.add_poses(task, poses)
        else:
            blocks.append(task)
    assert blocks == list(list_tasks(study))


def test_poses_of_the_next_cell_are_computed_beside_the_blocks_of_this_one() -> None:
    schedule = make_schedule(replicates=18, poses=make_poses(3))
    schedule.add_poses(take_poses(schedule), POSES)
    assert take_names(schedule, 1) == ["0/0"]
    second = take_poses(schedule)
    assert take_names(schedule, 2) == ["0/1", "0/2"]
    third = take_poses(schedule)  # rather than none
    assert take_names(schedule, 2) == ["none", "none"]
    schedule.add_poses(third, POSES)
    schedule.add_poses(second, POSES)
    assert take_names(schedule, 6) == ["2/0", "2/1", "2/2", "1/0", "1/1", "1/2"]
    assert next(schedule, "end") == "end"


def test_many_workers_compute_poses_of_many_cells_at_once() -> None:
    schedule = make_schedule(poses=make_poses(MOST_WAITING + 5))
    assert take_names(schedule, MOST_WAITING + 1) == [*["poses"] * MOST_WAITING, "none"]


def test_cells_with_the_same_poses_wait_for_one_task() -> None:
    schedule = make_schedule(methods=METHODS, poses=make_poses(2))
    first = take_poses(schedule)
    second = take_poses(schedule)
    assert name(next(schedule)) == "none"
    schedule.add_poses(second, POSES)
    assert take_names(schedule, 3) == ["2/0", "3/0", "none"]
    schedule.add_poses(first, POSES)
    assert take_names(schedule, 2) == ["0/0", "1/0"]


def test_later_cells_take_the_poses_of_earlier_ones() -> None:
    factors = {"methods": METHODS, "order": ("method", "poses")}
    assert count_poses(make_schedule(poses=make_poses(3), **factors)) == 3
    many = KEPT_POSES + 1  # the oldest ones are forgotten, one after the other
    assert count_poses(make_schedule(poses=make_poses(many), **factors)) == 2 * many


def test_cells_whose_poses_are_given_up_are_left_out() -> None:
    schedule = make_schedule(methods=METHODS, poses=make_poses(2))
    first, second = take_poses(schedule), take_poses(schedule)
    schedule.add_poses(second, POSES)
    assert schedule.give_up(first) == [0, 1]
    assert take_names(schedule, 2) == ["2/0", "3/0"]
    assert next(schedule, "end") == "end"


def test_poses_depend_on_what_determines_them_only() -> None:
    """Planned ones on tolerances and instrument too, none on what is done with measurements."""
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
            counts[choice, factor] = count_poses(make_schedule(poses=poses, **{factor: levels}))
    assert {key for key, count in counts.items() if count == 2} == {
        ("planned", factor) for factor in ("instruments", "noise", "errors")
    }
    true_errors = {"1": ErrorsLevel(), "2": ErrorsLevel(error_factor=2.0)}
    planned = {"planned": PosesLevel(5, "planned")}
    assert count_poses(make_schedule(poses=planned, errors=true_errors)) == 1


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
