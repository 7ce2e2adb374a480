# SPDX-License-Identifier: Apache-2.0
"""The work of a study, for any worker: the poses of a cell, and blocks of its trials."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from loopcal.studies.simulation.block import compute_scores
from loopcal.studies.simulation.poses import CellPoses, compute_poses, describe_poses
from loopcal.studies.specification.keys import compute_key, describe_block, format_json
from loopcal.studies.specification.study import Study
from loopcal.typing import FloatArray


@dataclass(frozen=True)
class PosesTask:
    """Poses to draw or to plan. `content` : what determines them, as JSON. `key` : its hash."""

    key: str
    content: str


@dataclass(frozen=True)
class BlockTask:
    """A block to compute.

    Attributes
    ----------
    key : hash of everything that determines its numbers. cell : number of its cell.
    block : number of the block in its cell. content : all that `compute_block` needs, as JSON.
    """

    key: str
    cell: int
    block: int
    content: str


@dataclass(frozen=True, eq=False)
class BlockResult:
    """The scores of the trials of a block.

    Attributes
    ----------
    key : of its task. values : (B, s), columns as `Study.columns`, SI. Column 0 is the outcome: 0
        for a trial that converged, else the number of a code in OUTCOMES. The other numbers of a
        failed trial are NaN as far as they do not exist.
    """

    key: str
    values: FloatArray


def compute_block(task: BlockTask, threads: int = 1) -> BlockResult:
    """Simulate and calibrate the machines of a block, and return their scores.

    It is a pure function of `task.content`: the same numbers to the last bit in every process, for
    every number of threads and workers.

    Raises
    ------
    LoopcalError : the cell cannot be simulated at all, such as a kind that the robot does not have.
    """
    content: Mapping[str, Any] = json.loads(task.content)
    return BlockResult(task.key, compute_scores(content, threads))


def compute_task(task: BlockTask | PosesTask, threads: int = 1) -> BlockResult | CellPoses:
    """Compute a block or poses; a pure function of the task, whatever the number of threads.

    Raises
    ------
    LoopcalError : as `compute_block`.
    """
    if isinstance(task, PosesTask):
        return compute_poses(json.loads(task.content))
    return compute_block(task, threads)


def make_poses_task(content: Mapping[str, Any]) -> PosesTask:
    """Return the task of the poses of a block, from its description."""
    description = describe_poses(content)
    return PosesTask(compute_key(description), format_json(description))


def make_block_task(key: str, cell: int, content: Mapping[str, Any], poses: CellPoses) -> BlockTask:
    """Return the task of a block, from its description and its poses."""
    complete = {**content, "measured": poses.measured, "held_out": poses.held_out}
    return BlockTask(key, cell, content["block"], format_json(complete))


def list_tasks(
    study: Study, cells: Sequence[int] | None = None, blocks: Sequence[int] | None = None
) -> Iterator[BlockTask]:
    """Yield the tasks of these blocks of these cells, of all by default.

    The poses of a cell are drawn or planned when its first task is made. The driver of a study
    leaves them to workers instead, see `loopcal.studies.schedule`.
    """
    for number in range(len(study.cells)) if cells is None else cells:
        cell = study.cells[number]
        poses: CellPoses | None = None
        for block in range(study.blocks) if blocks is None else blocks:
            content = describe_block(study, cell, block)
            poses = compute_poses(describe_poses(content)) if poses is None else poses
            yield make_block_task(compute_key(content), number, content, poses)
