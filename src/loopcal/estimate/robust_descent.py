# SPDX-License-Identifier: Apache-2.0
"""Robust fits by reweighting: descend, weigh each block by its distance from the fit, descend
again, until weights stand.

The weights are found outside the descent and enter it as weights of the same rows, so that every
method, decomposition and covariance is used as it is. Blocks are what `Measurements.block` says
belongs together: never a single component.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from loopcal.estimate.descent import Descent, DescentStatus
from loopcal.estimate.inference.prior import Prior
from loopcal.estimate.methods.losses import Huber, Loss, Tukey
from loopcal.estimate.rows import AnyRows
from loopcal.typing import FloatArray, IntArray

ROUNDS = 50
"""Reweightings at most."""

SETTLED = 1e-4
"""Largest change of a weight at which they stand; a hundred times that where they are only the
start of another loss.
"""


@dataclass(frozen=True, eq=False)
class RobustFit:
    """A robust descent.

    Attributes
    ----------
    fit : Descent over the weighted rows, after all those that found the weights. The first of its
        costs, and those of the last descent, are of these rows; those between are of the rows as
        they were weighted then. rows : these rows.
    weight : (n,) of each pose, equal within a block.
    """

    fit: Descent
    rows: AnyRows
    weight: FloatArray


def descend_robustly(
    rows: AnyRows,
    block: IntArray,
    loss: Loss,
    start: FloatArray,
    estimate_scale: bool,
    run: Callable[[AnyRows, FloatArray], Descent],
    prior: Prior | None = None,
) -> RobustFit:
    """Fit with a loss (one trial).

    Parameters
    ----------
    rows : unweighted. block : (n,) block of each pose. start : (1, p) deviation.
    estimate_scale : whether the sigmas are only true up to a factor; it is then the median of the
        blocks' distances.
    run : descends rows, and those of the prior, from a deviation. prior : the one that `run` adds.
    """
    member = np.unique(block, return_inverse=True)[1]
    found = RobustFit(run(rows, start), rows, np.ones(len(block)))
    if isinstance(loss, Tukey):
        found = _settle(rows, member, Huber(), found, estimate_scale, run, 100.0 * SETTLED)
    return _compared(
        _settle(rows, member, loss, found, estimate_scale, run, SETTLED), rows, start, prior
    )


def _compared(found: RobustFit, rows: AnyRows, start: FloatArray, prior: Prior | None) -> RobustFit:
    """Weigh the cost of the start as that of the fit, so that the two can be compared."""
    if found.rows is rows:
        return found
    every, costs = np.arange(len(start)), found.fit.cost_history.copy()
    problem = found.rows if prior is None else prior.added(found.rows)
    costs[0] = problem.fold(start, every)[1]
    found.rows.fold(
        found.fit.deviation, every
    )  # what rows remember of poses and frames is that of the fit again
    return replace(found, fit=replace(found.fit, cost_history=costs))


def _settle(
    rows: AnyRows,
    member: IntArray,
    loss: Loss,
    found: RobustFit,
    estimate_scale: bool,
    run: Callable[[AnyRows, FloatArray], Descent],
    settled: float,
) -> RobustFit:
    """Reweight until the weights stand."""
    for _ in range(ROUNDS):
        if found.fit.status[0] != DescentStatus.CONVERGED:
            break
        distance, degrees = block_distances(rows, found.fit.deviation, member, found.rows)
        if estimate_scale:
            distance = distance / scale_of(distance, degrees)
        weight = loss.weight(distance, degrees)[member]
        change = float(np.abs(weight - found.weight).max())
        if change <= settled:
            break
        weighted = rows.weighted(weight)
        found = RobustFit(run(weighted, found.fit.deviation).after(found.fit), weighted, weight)
    return found


def block_distances(
    rows: AnyRows, deviation: FloatArray, member: IntArray, like: AnyRows | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return d = |W r| (u,) and the number of residuals (u,) of every block; member (n,) is the
    block of each pose.

    Frames and targets that are unknown are those that fit best with the weights of `like`, default
    these rows.
    """
    count = int(member.max()) + 1
    own = None if like is None else like.own_values(deviation)
    square, degrees = np.zeros(count), np.zeros(count)
    for sensed, found in zip(rows.sensed, rows.residuals(deviation, own), strict=True):
        of = member[sensed.first]
        present = np.einsum("rii->ri", sensed.whitener[0]) != 0.0
        square += np.bincount(of, np.where(present, found.whitened[0] ** 2, 0.0).sum(axis=1), count)
        degrees += np.bincount(of, present.sum(axis=1), count)
    return np.sqrt(square), degrees - rows.spent(member, count)


def scale_of(distance: FloatArray, degrees: FloatArray) -> float:
    """Return the factor on sigma that the median block shows: its d against the median of chi with
    its degrees.
    """
    from scipy.special import chdtri

    there = degrees > 0.0
    ratio = distance[there] / np.sqrt(chdtri(degrees[there], 0.5))
    middle = float(np.median(ratio)) if len(ratio) else 1.0
    return middle if middle > 0.0 else 1.0
