# SPDX-License-Identifier: Apache-2.0
"""Which poses a plan considers to compare, for kinds that see several poses in one row: all
combinations, or some thousands.

N poses make N (N - 1) / 2 pairs, more than can be looked at where there are hundreds of poses. Then
half of those looked at are drawn from all of them; the other half is made of the poses whose pairs
of the first half tell most, by

    d = |x R^-1|^2,   R'R = sum x'x + 1,

the slope of log det for a row x where all rows count alike. A certificate holds among what was
looked at.
"""

from __future__ import annotations

from itertools import combinations
from math import comb

import numpy as np

from loopcal.errors import DataError
from loopcal.measure import Instrument
from loopcal.planning.design import allowed, triangle
from loopcal.typing import FloatArray, IntArray

MOST = 5000
"""Combinations of poses that are considered: as many rows are made in some seconds."""
DENSE = 20
"""Up to this many times the number wanted all combinations are written down, and drawn from."""


def poses_in_unit(instrument: Instrument) -> int:
    """Return how many poses are measured together; raises DataError for kinds that compare
    different numbers.
    """
    links = sorted({sensor.kind.poses_per_row for sensor in instrument.sensors} - {1})
    if len(links) > 1:
        raise DataError(
            f"kinds that compare {links[0]} and {links[1]} poses cannot be planned together; plan "
            "one of them"
        )
    return links[0] if links else 1


def units_of(
    poses: int, instrument: Instrument, rng: np.random.Generator, most: int = MOST
) -> IntArray:
    """Return members (N, k) of units: each pose alone, or different ones, all combinations or
    `most` drawn from them.

    Raises
    ------
    DataError
        The instrument compares more poses than there are.
    """
    k = poses_in_unit(instrument)
    if k == 1:
        return np.arange(poses)[:, None]
    if poses < k:
        raise DataError(
            f"this instrument compares {k} poses, but only {poses} are allowed; relax a constraint"
        )
    return chosen_of(np.arange(poses), k, most, rng)


def telling(
    rows: FloatArray, members: IntArray, poses: int, most: int, rng: np.random.Generator
) -> IntArray:
    """Return members (M, k) of at most `most` further units, made of the poses whose units tell
    most.

    Parameters
    ----------
    rows : (N, r, c) of units, whitened and in tolerances; NaN where not allowed. members : (N, k)
        their poses.
    poses : number of candidates.
    """
    good, k, c = allowed(rows), members.shape[1], rows.shape[2]
    if not good.any():
        return members[:0]
    R = triangle(np.concatenate([np.eye(c), rows[good].reshape(-1, c)]))
    slopes = ((rows[good] @ np.linalg.inv(R)) ** 2).sum(axis=(1, 2))
    best = np.zeros(poses)
    np.maximum.at(best, members[good].ravel(), np.repeat(slopes, k))
    count = k
    while count < poses and comb(count + 1, k) <= most:
        count += 1
    # in the order of their numbers, so that a combination is written in one way only
    more = chosen_of(np.sort(np.argsort(-best, kind="stable")[:count]), k, most, rng)
    return more[~_among(more, members, poses)]


def chosen_of(poses: IntArray, k: int, most: int, rng: np.random.Generator) -> IntArray:
    """Return combinations (N, k) of k of some poses (n,): all of them, or `most` drawn without
    repetition.
    """
    n = len(poses)
    if comb(n, k) <= DENSE * most:
        every = np.array(list(combinations(range(n), k)), dtype=np.int64).reshape(-1, k)
        return poses[
            every
            if len(every) <= most
            else every[np.sort(rng.choice(len(every), most, replace=False))]
        ]
    drawn = np.sort(rng.integers(0, n, (2 * most, k)), axis=1)
    drawn = np.unique(drawn[(np.diff(drawn, axis=1) > 0).all(axis=1)], axis=0)
    return poses[drawn[np.sort(rng.permutation(len(drawn))[:most])]]


def _among(members: IntArray, others: IntArray, poses: int) -> np.ndarray:
    """Tell which of members (M, k) are among others (N, k)."""
    places = float(poses) ** np.arange(members.shape[1])
    return np.isin(members @ places, others @ places)
