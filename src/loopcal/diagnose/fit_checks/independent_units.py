# SPDX-License-Identifier: Apache-2.0
"""Divide poses into the units that may share an error: days, sessions, blocks or single poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopcal.estimate.observation_rows import linked_blocks
from loopcal.measure import Measurements
from loopcal.numerics.elimination_tree import find_connected_groups
from loopcal.typing import IntArray

FEWEST_CLUSTERS = 5
"""Clusters that a cluster-robust variance needs. The variance of a mean has one degree of freedom
less, and with fewer than 4 its distribution is not known well enough (Tipton, 2015).
"""

NIGHT = 6 * 3600.0
"""Time without a measurement [s] after which another day begins."""


@dataclass(frozen=True, eq=False)
class Clusters:
    """Poses that may share an error, and are independent of the poses of other clusters.

    Attributes
    ----------
    unit : "day", "session", "block" or "pose". member : (n,) cluster 0..count-1 of each pose.
    """

    unit: str
    member: IntArray
    count: int


def divide_into_clusters(data: Measurements) -> tuple[Clusters, ...]:
    """Return the possible divisions of n poses with at least `FEWEST_CLUSTERS` clusters, those of
    the largest units first.

    Days are runs of poses without a break of `NIGHT` in the column `time`, sessions those of the
    rows. Units that share a pose, a block or a row that compares poses are one cluster.
    """
    blocks = linked_blocks(data)
    count = int(blocks.max()) + 1
    unit = "pose" if count == data.n_poses else "block"
    divisions = [Clusters(unit, blocks, count)]
    for name, pairs in (("session", _pose_sessions(data)), ("day", _pose_days(data))):
        if len(pairs):
            links = np.column_stack([blocks[pairs[:, 0]], count + pairs[:, 1]])
            joined = find_connected_groups(links, int(links.max()) + 1)[blocks]
            names, member = np.unique(joined, return_inverse=True)
            divisions.append(Clusters(name, member, len(names)))
    enough = [clusters for clusters in reversed(divisions) if clusters.count >= FEWEST_CLUSTERS]
    return tuple(sorted(enough, key=lambda clusters: clusters.count))


def _pose_sessions(data: Measurements) -> IntArray:
    """Return pairs (k, 2) of a pose and a session that measured it; none without named sessions.

    Rows without a session belong to those of the same pose, or else to one session.
    """
    poses = [np.zeros(0, dtype=np.int64)]
    names = [np.zeros(0, dtype=str)]
    for rows in (rows for rows in data.observations if len(rows)):
        numbers = rows.rows.reshape(len(rows), -1)
        poses.append(numbers.ravel())
        names.append(np.repeat(rows.session.astype(str), numbers.shape[1]))
    pose, name = np.concatenate(poses), np.concatenate(names)
    is_named = name != ""
    if not is_named.any():
        return np.zeros((0, 2), dtype=np.int64)
    unnamed = np.setdiff1d(np.arange(data.n_poses), pose[is_named])
    pose = np.concatenate([pose[is_named], unnamed])
    name = np.concatenate([name[is_named], np.full(len(unnamed), "")])
    return np.column_stack([pose, np.unique(name, return_inverse=True)[1]])


def _pose_days(data: Measurements) -> IntArray:
    """Return pairs (n, 2) of a pose and its day; none where a pose has no time."""
    time = data.context.get("time")
    if time is None or np.isnan(time).any():
        return np.zeros((0, 2), dtype=np.int64)
    order = np.argsort(time, kind="stable")
    day = np.empty(len(time), dtype=np.int64)
    day[order] = np.concatenate([[0], np.cumsum(np.diff(time[order]) > NIGHT)])
    return np.column_stack([np.arange(len(time)), day])
