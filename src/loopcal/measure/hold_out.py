# SPDX-License-Identifier: Apache-2.0
"""Choose at random which poses are held out, so that the others determine every setup.

A session has a frame of its own, a surface its plane. Where too few of its poses are fitted, nobody
can predict the others. Each frame, target, surface and offset that is estimated therefore keeps, in
the order of the choice, poses with as many measured values as it has parameters, and one pose more:
three points for a frame, because two leave the rotation about their line.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from loopcal.errors import DataError
from loopcal.numerics.elimination import find_connected_groups
from loopcal.numerics.statistics import find_distinct
from loopcal.typing import BoolArray, IntArray

if TYPE_CHECKING:
    from loopcal.measure.measurements import Measurements

ENOUGH = 0.5  # share of the poses to hold out that the setup must leave


class _SetupValues(NamedTuple):
    """How many values e different poses measure with each frame, target, surface and offset."""

    owner: IntArray  # (e,) which frame, target, surface or offset
    pose: IntArray  # (e,) the pose, of repeats only one
    values: IntArray  # (e,) number of its measured values
    needed: IntArray  # (o,) number of unknown parameters of each owner

    def find_needed(self, unit: IntArray, rank: IntArray) -> tuple[BoolArray, BoolArray]:
        """Return which units of poses (u,) determine the setup, those of low rank first; and which
        entries (e,) belong to owners that need all of their units, of two or more.

        unit : (n,) of each pose. rank : (u,) of each unit in the order of the choice.
        """
        pairs, member = np.unique(
            np.column_stack([self.owner, rank[unit[self.pose]]]), axis=0, return_inverse=True
        )
        owner, place = pairs.T
        begin = np.searchsorted(owner, np.arange(len(self.needed)))
        after = np.cumsum(np.bincount(member.ravel(), self.values, len(pairs)))
        before = np.concatenate([[0.0], after])[:-1]
        is_short = before - before[begin[owner]] < self.needed[owner]
        last = begin + np.bincount(owner, is_short, len(begin)).astype(np.intp)
        is_needed = np.arange(len(pairs)) <= last[owner]  # those that are short, and one more
        is_needed &= np.bincount(owner)[owner] > 1
        is_whole = np.bincount(owner, ~is_needed, len(begin)) == 0
        return np.isin(rank, place[is_needed]), is_whole[self.owner]


def choose_fitted(
    data: Measurements, hold_out: float, seed: int, regions: IntArray | None = None
) -> BoolArray:
    """Return which poses (n,) are fitted where a share is held out, by whole `data.undivided` and
    whole regions (n,), if they are given; not by regions that link all poses with each other.

    Where the setup leaves less than half of the poses to hold out, sessions that need all of theirs
    are held out as a whole; where it leaves none then, it does not count. DataError where the poses
    cannot be divided.
    """
    unit, setup = np.unique(data.undivided, return_inverse=True)[1], _count_values(data)
    if regions is not None:
        joined = _join(np.column_stack([unit, unit.max() + 1 + regions]), unit)
        unit = joined if joined.max() > 0 else unit
    if unit.max() == 0:
        raise DataError(
            "cannot split measurements of a single block. Measure more poses, or use smaller blocks"
        )

    def permute(unit: IntArray) -> IntArray:
        return np.random.default_rng(np.random.SeedSequence(seed)).permutation(unit.max() + 1)

    order = permute(unit)
    is_needed, is_whole = setup.find_needed(unit, np.argsort(order))
    if np.bincount(unit)[~is_needed].sum() < ENOUGH * hold_out * data.n_poses:
        links = np.column_stack([unit[setup.pose], unit.max() + 1 + setup.owner])[is_whole]
        joined = _join(links, unit)
        order = permute(joined)
        is_needed = setup.find_needed(joined, np.argsort(order))[0]
        if is_needed.all() or len(order) < 2:
            order = permute(unit)
            is_needed = np.zeros(len(order), dtype=bool)
        else:
            unit = joined
    order = order[np.argsort(~is_needed[order], kind="stable")]
    error = np.abs(np.cumsum(np.bincount(unit)[order])[:-1] - (1.0 - hold_out) * data.n_poses)
    error[: max(int(is_needed.sum()) - 1, 0)] = np.inf
    return np.isin(unit, order[: int(np.argmin(error)) + 1])


def _join(links: IntArray, unit: IntArray) -> IntArray:
    """Return the number (n,) of the group of units to which each pose belongs; links (k, 2) join
    units (n,) and what has the numbers above them.
    """
    groups = find_connected_groups(links, int(max(links.max(initial=0), unit.max())) + 1)
    return np.unique(groups[unit], return_inverse=True)[1]


def _count_values(data: Measurements) -> _SetupValues:
    """Return the measured values with each unknown setup; repeats of a pose add nothing."""
    nuisance, n = data.nuisance_parameters, data.n_poses
    table = nuisance.table
    is_open = np.array(table.free & np.isnan(table.tolerance))
    names = [name.rsplit(".", 1)[0] for name in table.names]
    owner_of = np.unique(names, return_inverse=True)[1].reshape(-1)
    keys, counts = [np.zeros(0, np.intp)], [np.zeros(0)]
    for o, used in zip(data.observations, nuisance.indices, strict=False):
        row, column = np.nonzero(is_open[used] & (o.weight > 0.0)[:, None])
        pair = find_distinct(np.column_stack([row, owner_of[used[row, column]]]), axis=0)
        keys.append(pair[:, 1] * n + o.rows.reshape(len(o), -1)[pair[:, 0], 0])
        counts.append(o.present.sum(axis=1)[pair[:, 0]])
    at, member = np.unique(np.concatenate(keys), return_inverse=True)
    count = np.bincount(member, np.concatenate(counts), len(at)).astype(np.intp)
    owner, pose = at // n, at % n
    by_count = np.lexsort((-count, data.repeats[pose], owner))
    owner, pose, count = owner[by_count], pose[by_count], count[by_count]
    same = (np.diff(owner) == 0) & (np.diff(data.repeats[pose]) == 0)
    first = np.concatenate([[True], ~same])[: len(at)]
    needed = np.bincount(owner_of[is_open], minlength=int(owner_of.max(initial=-1)) + 1)
    return _SetupValues(owner[first], pose[first], count[first], needed)
