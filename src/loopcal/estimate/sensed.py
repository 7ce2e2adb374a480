# SPDX-License-Identifier: Apache-2.0
"""What was measured, kind by kind, and the blocks of poses in which it is compared with a robot.

A block is a run of consecutive poses with the rows that saw these alone. Rows that link poses of
different runs come in blocks of their own, each with the poses its rows name, so that no block is
larger than it must be.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from loopcal.measure import Kind, Measurements
from loopcal.typing import FloatArray, IntArray

BLOCK = 512
"""Poses (of all trials together) whose rows are made at once: large enough for NumPy, small enough
for the cache.
"""


def _no_places() -> IntArray:
    return np.zeros((0, 0), dtype=np.int64)


@dataclass(frozen=True, eq=False)
class Sensed:
    """Rows of one kind for t trials.

    Attributes
    ----------
    kind : what was measured. poses : (r,) the pose that each row saw, (r, links) where rows compare
        several.
    measured : (t | 1, r, c) [SI]. whitener : (t | 1, r, m, m), zero rows for what is absent.
    places : (r, u) which of the unknowns that the measurements bring each row uses.
    """

    kind: Kind
    poses: IntArray
    measured: FloatArray
    whitener: FloatArray
    places: IntArray = field(default_factory=_no_places)

    def __post_init__(self) -> None:
        if not self.places.size:
            object.__setattr__(self, "places", np.zeros((len(self.poses), 0), dtype=np.int64))

    def take(self, rows: IntArray, place: IntArray) -> Sensed:
        """Some rows, their poses counted anew: pose i becomes place[i]."""
        if len(rows) == len(self.poses):
            return Sensed(self.kind, place[self.poses], self.measured, self.whitener, self.places)
        parts = (self.measured[:, rows], self.whitener[:, rows], self.places[rows])
        return Sensed(self.kind, place[self.poses[rows]], *parts)

    def trials(self, chosen: IntArray) -> tuple[FloatArray, FloatArray]:
        """Measured values and whiteners of some trials."""
        measured = self.measured if len(self.measured) == 1 else self.measured[chosen]
        return measured, self.whitener if len(self.whitener) == 1 else self.whitener[chosen]

    @property
    def first(self) -> IntArray:
        """(r,) the pose, or the first one, of each row; with `linked` its block is the block of the
        row.
        """
        return self.per_pose[:, 0]

    @property
    def per_pose(self) -> IntArray:
        """(r, links) poses of each row, whatever their number."""
        return self.poses.reshape(len(self.poses), self.kind.poses_per_row)


class Residuals(NamedTuple):
    """Residuals (predicted - measured) of one kind's rows: raw (t, r, m) [SI] and whitened (t, r,
    m).
    """

    raw: FloatArray
    whitened: FloatArray


@dataclass(frozen=True, eq=False)
class Block:
    """Some poses: their places (b,) and readings (1, b, a), the rows of every kind (their numbers,
    and themselves), and which poses any row needs.
    """

    poses: IntArray
    readings: FloatArray
    rows: tuple[IntArray, ...]
    sensed: tuple[Sensed, ...]
    needed: np.ndarray


def linked(data: Measurements) -> IntArray:
    """Return the block (n,) of each pose, blocks that a row links made one."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    numbers, member = np.unique(data.block, return_inverse=True)
    pairs = [o.rows for o in data.observations if o.kind.poses_per_row > 1 and len(o)]
    if not pairs:
        return member
    ends = member[
        np.concatenate(
            [np.column_stack([rows[:, :-1].ravel(), rows[:, 1:].ravel()]) for rows in pairs]
        )
    ]
    graph = coo_array(
        (np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(len(numbers), len(numbers))
    )
    return connected_components(graph, directed=False)[1][member].astype(np.int64)


def blocks_of(
    readings: FloatArray, sensed: tuple[Sensed, ...], needed: np.ndarray, size: int
) -> list[Block]:
    """Divide n poses into blocks of this size; the first ones cover every pose once, in order,
    those of linked rows follow.
    """
    n = len(readings)
    runs = [s.per_pose // size for s in sensed]
    inside = [
        np.where(np.ptp(run, axis=1) == 0, run[:, 0], -1) if len(run) else run[:, 0] for run in runs
    ]
    made = []
    for k in range(0, n, size):
        poses = np.arange(k, min(k + size, n))
        rows = tuple(np.flatnonzero(run == k // size) for run in inside)
        made.append(block_of(poses, readings, sensed, rows, needed))
    nothing = np.zeros(0, dtype=np.int64)
    for i, run in enumerate(inside):
        for rows in _chunks(np.flatnonzero(run < 0), size // 2):
            poses = np.unique(sensed[i].poses[rows])
            one = tuple(rows if j == i else nothing for j in range(len(sensed)))
            made.append(block_of(poses, readings, sensed, one, needed))
    return made


def block_of(
    poses: IntArray,
    readings: FloatArray,
    sensed: tuple[Sensed, ...],
    rows: tuple[IntArray, ...],
    needed: np.ndarray,
) -> Block:
    """The block of these poses (b,) with these rows of every kind, whose poses all lie in it."""
    place = np.zeros(len(readings), dtype=np.int64)
    place[poses] = np.arange(len(poses))
    inside = tuple(s.take(r, place) for s, r in zip(sensed, rows, strict=True))
    return Block(poses, readings[None, poses], rows, inside, needed[poses])


def _chunks(rows: IntArray, size: int) -> Iterator[IntArray]:
    for first in range(0, len(rows), size):
        yield rows[first : first + size]
