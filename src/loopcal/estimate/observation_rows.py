# SPDX-License-Identifier: Apache-2.0
"""Observed rows of every kind for a batch of trials."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from loopcal.measure.array_checks import drop_repeats
from loopcal.measure.kinds.kind import Kind, MeasuredColumns
from loopcal.measure.measurements import Measurements, anchor_rows
from loopcal.measure.nuisance import NuisanceParameters
from loopcal.numerics.elimination import find_connected_groups
from loopcal.numerics.statistics import find_distinct
from loopcal.typing import BoolArray, FloatArray, IntArray

TRIAL_BLOCK = 16384
"""Poses of many trials together whose rows the engine folds as it makes them, so that less of them
is in memory: larger parts leave less time to Python, which runs in one thread at a time."""


@dataclass(frozen=True, eq=False)
class ObservationRows:
    """Rows of one kind for t trials.

    kind : what was measured.
    poses : (r,) pose that each row observed; (r, links) where rows compare several poses.
    measured : (t | 1, r, c) [SI]. whitener : (t | 1, r, m, m), zero rows for absent components.
    nuisance : (r, u) which nuisance parameters each row uses. factor : (r, u) the parts of them
        that it takes; None where all are 1.
    offset : (t | 1, r, m), optional; it is added to the whitened residuals, as an error drawn for a
        resample.
    """

    kind: Kind
    poses: IntArray
    measured: FloatArray
    whitener: FloatArray
    nuisance: IntArray = field(default_factory=lambda: np.zeros((0, 0), dtype=np.int64))
    factor: FloatArray | None = None
    offset: FloatArray | None = None

    def __post_init__(self) -> None:
        if not self.nuisance.size:
            object.__setattr__(self, "nuisance", np.zeros((len(self.poses), 0), dtype=np.int64))

    @property
    def poses_by_link(self) -> IntArray:
        """(r, links) poses of each row."""
        return self.poses.reshape(len(self.poses), self.kind.poses_per_row)

    @property
    def first_poses(self) -> IntArray:
        """(r,) first pose of each row; its block of linked poses is the block of the row."""
        return self.poses_by_link[:, 0]

    @property
    def is_present(self) -> BoolArray:
        """(t | 1, r, m) components that are not absent."""
        return np.asarray(np.einsum("trii->tri", self.whitener) != 0.0)

    @cached_property
    def rows_of_each(self) -> int:
        """Number of rows of each pose from the first to the last one of these rows, where all have
        as many, one behind the other in the order of the poses; else 0.
        """
        each = int((self.poses == 0).sum())
        ordered = np.arange(len(self.poses) // max(each, 1)).repeat(each)
        return each * np.array_equal(self.poses, ordered)

    def take_rows(self, rows: IntArray, place: IntArray) -> ObservationRows:
        """Return some rows with poses renumbered: pose i becomes place[i]."""
        if len(rows) == len(self.poses):
            return replace(self, poses=place[self.poses])
        is_run = len(rows) > 0 and (np.diff(rows) == 1).all()  # which is not copied
        at: Any = slice(int(rows[0]), int(rows[-1]) + 1) if is_run else rows
        selected = (self.measured[:, at], self.whitener[:, at], self.nuisance[at])
        factor = None if self.factor is None else self.factor[at]
        offset = None if self.offset is None else self.offset[:, at]
        return ObservationRows(self.kind, place[self.poses[at]], *selected, factor, offset)

    def divided(self) -> ObservationRows:
        """Return the rows of each target on its own, (r k, ..), where the noise allows it: they
        move their own place and what all share, and no other target.
        """
        if (done := self.kind.divided) is None or self.kind.is_of_base:
            return self
        (kind, places), (t, r, m) = done, self.whitener.shape[:3]
        k = len(places)
        white = drop_repeats(self.whitener)
        parts = white.reshape(*white.shape[:2], k, m // k, k, m // k)
        own = np.einsum("trkikj->trkij", parts)
        if np.count_nonzero(own) != np.count_nonzero(white):  # errors that targets share
            return self
        white = np.broadcast_to(own, (t if len(white) > 1 else 1, r, *own.shape[2:]))
        offset = self.offset
        return ObservationRows(
            kind,
            self.poses.repeat(k, axis=0),
            self.measured.reshape(len(self.measured), r * k, -1),
            white.reshape(len(white), r * k, m // k, m // k),
            self.nuisance[:, places].reshape(r * k, -1),
            None if self.factor is None else self.factor[:, places].reshape(r * k, -1),
            None if offset is None else offset.reshape(len(offset), r * k, -1),
        )

    def list_target_parameters(self) -> IntArray:
        """Return the nuisance parameters that only the rows of one target use, where rows are
        `divided`.
        """
        done = self.kind.divided
        if done is None or self.divided() is self:
            return np.zeros(0, dtype=np.int64)
        own = done[1][:, (done[1] != done[1][:1]).any(axis=0)]
        return find_distinct(self.nuisance[:, own.ravel()])

    def cut_trials(self, trials: IntArray) -> ObservationRows:
        """Return the rows of some trials (a,), which are numbered from 0 then."""
        arrays = (self.measured, self.whitener, self.offset)
        cut = (a if a is None or len(a) == 1 else a[trials] for a in arrays)
        return replace(self, **dict(zip(("measured", "whitener", "offset"), cut, strict=True)))

    def take_trials(self, trials: IntArray) -> tuple[MeasuredColumns, FloatArray]:
        """Return measured columns and whiteners of some trials; one set stands for all of them."""
        t, r = self.measured.shape[:2]
        if t == 1:
            columns = self._columns
        elif t * r > TRIAL_BLOCK:  # too many to keep
            columns = self.kind.prepare_columns(self.measured[trials])
        elif np.array_equal(trials, np.arange(t)):
            columns = self._columns
        else:
            columns = self._columns.take(trials)
        return columns, self.whitener if len(self.whitener) == 1 else self.whitener[trials]

    @cached_property
    def _columns(self) -> MeasuredColumns:
        """The measured columns of all trials; they stay the same in all evaluations."""
        return self.kind.prepare_columns(self.measured)

    def whiten(self, whitener: FloatArray, residual: FloatArray, trials: IntArray) -> FloatArray:
        """Return whitened residuals (a, r, m) of some trials (a,), with their offset."""
        white = self.whiten_columns(whitener, residual[..., None])[..., 0]
        if self.offset is None:
            return white
        return white + (self.offset if len(self.offset) == 1 else self.offset[trials])

    def whiten_columns(self, whitener: FloatArray, columns: FloatArray) -> FloatArray:
        """Return whitened derivatives (a, r, m, c)."""
        if not self._is_diagonal:
            return np.matmul(whitener, columns)
        return np.einsum("trmm->trm", whitener)[..., None] * columns

    @cached_property
    def _is_diagonal(self) -> bool:
        """Whether the whiteners scale each residual by itself."""
        return np.count_nonzero(self.whitener) == np.count_nonzero(
            np.einsum("trmm->trm", self.whitener)
        )

    def weighted(self, weight: FloatArray) -> ObservationRows:
        """Return the rows with a factor (n,) or (t, n) on each pose's squares; linked poses share
        it. Rows of targets on the base belong to no pose and keep theirs.
        """
        if self.kind.is_of_base:
            return self
        linked = np.sqrt(weight)[..., self.poses_by_link]
        each = linked.prod(axis=-1) ** (1.0 / linked.shape[-1])
        return replace(self, whitener=self.whitener * np.atleast_2d(each)[:, :, None, None])


def list_rows(data: Measurements, nuisance: NuisanceParameters) -> tuple[ObservationRows, ...]:
    """Return the rows of one machine's measurements, those of targets on the base last."""
    return tuple(
        ObservationRows(
            o.kind,
            anchor_rows(o, data.observations) if o.kind.is_of_base else o.rows,
            o.measured[None],
            o.whitener[None],
            nuisance.indices[i],
            nuisance.factor(i),
        )
        for i, o in enumerate(data.all_observations)
        if len(o)
    )


def whiten(whitener: FloatArray, residual: FloatArray) -> FloatArray:
    """Return whitened residuals (.., m) of whiteners (.., m, m) and residuals (.., m)."""
    return np.matmul(whitener, residual[..., None])[..., 0]


class Residuals(NamedTuple):
    """Residuals (predicted - measured) of one kind: raw (t, r, m) [SI], whitened (t, r, m)."""

    raw: FloatArray
    whitened: FloatArray


def linked_blocks(data: Measurements, block: IntArray | None = None) -> IntArray:
    """Return the block (n,) of each pose, where rows that compare poses join their blocks; `block`
    are those of the data by default.
    """
    numbers, member = np.unique(data.block if block is None else block, return_inverse=True)
    pairs = [o.rows for o in data.observations if o.kind.poses_per_row > 1 and len(o)]
    if not pairs:
        return member
    links = member[np.concatenate([consecutive_pairs(rows) for rows in pairs])]
    return find_connected_groups(links, len(numbers))[member]


def list_block_labels(labels: Sequence[str], member: IntArray) -> tuple[tuple[str, ...], ...]:
    """Return the labels of the poses of each block; `member` (n,) numbers the blocks."""
    blocks: list[list[str]] = [[] for _ in range(int(member.max(initial=-1)) + 1)]
    for label, block in zip(labels, member.tolist(), strict=True):
        blocks[block].append(label)
    return tuple(map(tuple, blocks))


def consecutive_pairs(poses: IntArray) -> IntArray:
    """Return pairs (r (l - 1), 2) of poses that rows (r, l) link."""
    return np.column_stack([poses[:, :-1].ravel(), poses[:, 1:].ravel()])
