# SPDX-License-Identifier: Apache-2.0
"""A short order in which to visit poses, from home, over straight ways that are allowed; where none
is, via home.

Nearest neighbour from several first poses, each improved by turning stretches round while that
makes the way shorter (2-opt, Croes 1958, doi:10.1287/opre.6.6.791): within a few per cent of the
shortest for the few dozen poses of a plan.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopcal.planning.candidates import home_coordinates
from loopcal.planning.constraints import Rules
from loopcal.planning.paths import distance, follow
from loopcal.typing import BoolArray, FloatArray, IntArray

BEGINNINGS = 8
"""First poses that are tried."""
LEAST = 1e-12
"""Share of the length by which a way must become shorter to count: rounding is no gain."""


@dataclass(frozen=True, eq=False)
class Visit:
    """An order of n poses.

    Attributes
    ----------
    order : (n,) numbers of the poses. via_home : (n,) True where home is visited before the pose,
        because the straight way
        is not allowed. length : of all ways from home to the last pose [m], see `paths.distance`.
    """

    order: IntArray
    via_home: BoolArray
    length: float


def visiting_order(rules: Rules, poses: FloatArray) -> Visit:
    """Order poses (n, c) [m, rad], to each of which a straight way from home is allowed (see
    `candidates`).
    """
    robot, n = rules.robot, len(poses)
    from_home = distance(robot, np.broadcast_to(home_coordinates(robot), poses.shape), poses)
    direct = distance(robot, poses[:, None], poses[None, :])
    around = from_home[:, None] + from_home[None, :]
    known, free = np.eye(n, dtype=bool), np.ones((n, n), dtype=bool)
    # a way is followed when an order wants to use it; one that is not allowed costs the way round,
    # and the order is made anew
    while True:
        order, length = shortest(np.where(free, direct, around), from_home)
        first, second = order[:-1], order[1:]
        new = ~known[first, second]
        if not new.any():
            break
        first, second = first[new], second[new]
        allowed = follow(rules, poses[first], poses[second]).allowed
        known[first, second] = known[second, first] = True
        free[first, second] = free[second, first] = allowed
    via = np.concatenate([[False], ~free[order[:-1], order[1:]]])
    return Visit(order, via, length)


def shortest(cost: FloatArray, from_home: FloatArray) -> tuple[IntArray, float]:
    """Return a short order (n,) and its length, from symmetric costs (n, n) and those of beginning
    (n,).
    """
    n = len(cost)
    whole = np.zeros((n + 1, n + 1))
    whole[1:, 1:], whole[0, 1:], whole[1:, 0] = cost, from_home, from_home
    best: tuple[IntArray, float] | None = None
    for beginning in np.argsort(from_home, kind="stable")[:BEGINNINGS]:
        tour = _turned(whole, _nearest(whole, int(beginning) + 1))
        length = float(whole[tour[:-1], tour[1:]].sum())
        if best is None or length < best[1] * (1.0 - LEAST):
            best = (tour[1:] - 1, length)
    assert best is not None
    return best


def _nearest(cost: FloatArray, beginning: int) -> IntArray:
    """Visit the nearest that is left, after home (0) and the beginning."""
    tour, left = [0, beginning], set(range(1, len(cost))) - {beginning}
    while left:
        tour.append(min(left, key=lambda i: (cost[tour[-1], i], i)))
        left.remove(tour[-1])
    return np.array(tour)


def _turned(cost: FloatArray, tour: IntArray) -> IntArray:
    """Turn the stretch round whose turning shortens the way most, until none does; the end is free,
    the beginning is not.
    """
    tour = np.array(tour)
    m = len(tour)
    while m > 2:
        steps = cost[tour[:-1], tour[1:]]
        # turning i..j replaces the steps before i and after j; after the last pose there is none
        after = np.concatenate([steps[1:], [0.0]])
        new = cost[tour[:-1, None], tour[None, 1:]]
        beyond = np.concatenate(
            [cost[tour[1:, None], tour[None, 2:]], np.zeros((m - 1, 1))], axis=1
        )
        gain = steps[:, None] + after[None, :] - new - beyond
        gain[np.tril_indices(m - 1)] = -np.inf
        i, j = np.unravel_index(int(np.argmax(gain)), gain.shape)
        if not gain[i, j] > LEAST * steps.sum():
            break
        tour[i + 1 : j + 2] = tour[i + 1 : j + 2][::-1]
    return tour
