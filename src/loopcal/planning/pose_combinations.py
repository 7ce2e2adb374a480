# SPDX-License-Identifier: Apache-2.0
"""Combinations of poses for kinds that compare several poses: all of them, or some thousands.

N poses make N (N - 1) / 2 pairs, too many to linearize where there are hundreds of poses. Then half
of the candidate pairs are drawn from all of them. The other half is made of the poses whose pairs
of the first half are most informative, by

    d = |x R^-1|^2,   R'R = sum x'x + 1,

the slope of log det for a row x where all rows count alike. A certificate then holds among the
candidate pairs.
"""

from __future__ import annotations

from itertools import combinations
from math import comb

import numpy as np

from loopcal.errors import DataError
from loopcal.measure import Instrument
from loopcal.planning.design import factor_rows, is_allowed
from loopcal.typing import FloatArray, IntArray

MOST = 5000
"""Largest number of candidate combinations: as many rows are computed in some seconds."""
DENSE = 20
"""Up to this many times the requested number all combinations are enumerated before drawing."""


def count_poses_per_group(instrument: Instrument) -> int:
    """Return how many poses are measured together.

    Raises
    ------
    DataError
        The instrument has kinds that compare different numbers of poses.
    """
    links = sorted({sensor.kind.poses_per_row for sensor in instrument.sensors} - {1})
    if len(links) > 1:
        raise DataError(
            f"kinds that compare {links[0]} and {links[1]} poses cannot be planned together; plan "
            "one of them"
        )
    return links[0] if links else 1


def list_groups(
    poses: int, instrument: Instrument, rng: np.random.Generator, most: int = MOST
) -> IntArray:
    """Return the members (N, k) of groups: each pose alone, or combinations, all or `most` drawn.

    Raises
    ------
    DataError
        The instrument compares more poses than there are.
    """
    k = count_poses_per_group(instrument)
    if k == 1:
        return np.arange(poses)[:, None]
    if poses < k:
        raise DataError(
            f"this instrument compares {k} poses, but only {poses} are allowed; relax a constraint"
        )
    return draw_combinations(np.arange(poses), k, most, rng)


def add_informative_groups(
    rows: FloatArray, members: IntArray, poses: int, most: int, rng: np.random.Generator
) -> IntArray:
    """Return members (M, k) of at most `most` further groups of the most informative poses.

    Parameters
    ----------
    rows : (N, r, c) of groups, whitened and in tolerances; NaN where not allowed. members : (N, k)
        their poses.
    poses : number of candidate poses.
    """
    good, k, c = is_allowed(rows), members.shape[1], rows.shape[2]
    if not good.any():
        return members[:0]
    R = factor_rows(np.concatenate([np.eye(c), rows[good].reshape(-1, c)]))
    slopes = ((rows[good] @ np.linalg.inv(R)) ** 2).sum(axis=(1, 2))
    best = np.zeros(poses)
    np.maximum.at(best, members[good].ravel(), np.repeat(slopes, k))
    count = k
    while count < poses and comb(count + 1, k) <= most:
        count += 1
    # in the order of their numbers, so that a combination is written in one way only
    informative = np.sort(np.argsort(-best, kind="stable")[:count])
    further = draw_combinations(informative, k, most, rng)
    return further[~_is_member(further, members, poses)]


def draw_combinations(poses: IntArray, k: int, most: int, rng: np.random.Generator) -> IntArray:
    """Return combinations (N, k) of k of the poses (n,): all, or `most` different ones."""
    n = len(poses)
    if comb(n, k) <= DENSE * most:
        indices = np.array(list(combinations(range(n), k)), dtype=np.int64).reshape(-1, k)
        if len(indices) > most:
            indices = indices[np.sort(rng.choice(len(indices), most, replace=False))]
        return poses[indices]
    draws = np.sort(rng.integers(0, n, (2 * most, k)), axis=1)
    draws = np.unique(draws[(np.diff(draws, axis=1) > 0).all(axis=1)], axis=0)
    return poses[draws[np.sort(rng.permutation(len(draws))[:most])]]


def _is_member(members: IntArray, others: IntArray, poses: int) -> np.ndarray:
    """Return which of members (M, k) occur among others (N, k)."""
    places = float(poses) ** np.arange(members.shape[1])
    return np.isin(members @ places, others @ places)
