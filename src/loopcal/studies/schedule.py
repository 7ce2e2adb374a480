# SPDX-License-Identifier: Apache-2.0
"""The order of the work of a study: the poses of a cell, then its blocks.

Planning the poses of a cell takes as long as many blocks. Workers do it, one cell ahead of the
blocks that are computed, so that none waits for poses while there is other work.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain
from typing import Any

from loopcal.studies.simulation.poses import CellPoses
from loopcal.studies.simulation.tasks import BlockTask, PosesTask, make_block_task, make_poses_task

KEPT_POSES = 256
"""Poses that are kept, because later cells have the same ones, such as those of other methods."""

MOST_WAITING = 64
"""Cells that may wait for poses which they have in common."""


@dataclass(frozen=True)
class MissingBlock:
    """A block to compute. `cell` : number of its cell. `content` : what determines its numbers."""

    key: str
    cell: int
    content: dict[str, Any]


Blocks = Iterator[MissingBlock]
"""The missing blocks of one cell."""


class Schedule(Iterator["BlockTask | PosesTask | None"]):
    """Tasks, one by one; None while all that is left needs poses that a worker computes.

    Parameters
    ----------
    cells : missing blocks of each cell. Few of them are taken ahead, so that memory does not grow
        with the number of cells or blocks.
    """

    def __init__(self, cells: Iterable[Blocks]) -> None:
        self._cells = iter(cells)
        self._current: tuple[Blocks, CellPoses] | None = None
        self._next: deque[tuple[Blocks, CellPoses]] = deque()  # not begun, poses are known
        self._waiting: dict[str, list[tuple[int, Blocks]]] = {}  # by the task of their poses
        self._poses: dict[str, CellPoses] = {}  # the latest ones, by their task

    def __next__(self) -> BlockTask | PosesTask | None:
        """Return the next task."""
        if not self._next and not self._waiting and (task := self._look_ahead()) is not None:
            return task
        while True:
            if self._current is not None:
                blocks, poses = self._current
                block = next(blocks, None)
                if block is not None:
                    return make_block_task(block.key, block.cell, block.content, poses)
            self._current = None
            if not self._next and (task := self._look_ahead()) is not None:
                return task
            if self._next:
                self._current = self._next.popleft()
            elif self._waiting:
                return None
            else:
                raise StopIteration

    def add_poses(self, task: PosesTask, poses: CellPoses) -> None:
        """Accept the poses of a task; the blocks that wait for them come next."""
        self._next.extend((blocks, poses) for _, blocks in self._waiting.pop(task.key))
        self._poses[task.key] = poses
        if len(self._poses) > KEPT_POSES:
            del self._poses[next(iter(self._poses))]

    def give_up(self, task: PosesTask) -> list[int]:
        """Leave out the cells that wait for poses, and return their numbers."""
        return [cell for cell, _ in self._waiting.pop(task.key)]

    def _look_ahead(self) -> PosesTask | None:
        """Take cells until one can begin, or needs poses that no worker has; return their task."""
        while sum(map(len, self._waiting.values())) < MOST_WAITING:
            blocks = next(self._cells, None)
            if blocks is None:
                return None
            first = next(blocks, None)
            if first is None:
                continue
            blocks, task = chain((first,), blocks), make_poses_task(first.content)
            if (poses := self._poses.get(task.key)) is not None:
                self._next.append((blocks, poses))
                return None
            waiting = self._waiting.setdefault(task.key, [])
            waiting.append((first.cell, blocks))
            if len(waiting) == 1:
                return task
        return None
