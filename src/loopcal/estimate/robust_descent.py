# SPDX-License-Identifier: Apache-2.0
"""Robust fits by reweighting: descend, weigh each block by its distance from the fit, repeat.

The weights are determined outside the descent and enter it as weights of the rows, so that every
method, decomposition and covariance is used as it is. Blocks are the poses that
`Measurements.block` declares to belong together, joined where a row links them; never a single
component.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from loopcal.estimate.descent import Descent
from loopcal.estimate.linearization import Start
from loopcal.estimate.losses import Huber, Loss, Tukey, weigh_blocks
from loopcal.estimate.prior import Prior
from loopcal.estimate.problem import Problem
from loopcal.numerics.gauss_newton import DescentStatus
from loopcal.numerics.statistics import compute_chi_square_quantile, compute_median
from loopcal.typing import FloatArray, IntArray

ROUNDS = 50
"""Reweightings, at most."""

CONVERGED_CHANGE = 1e-4
"""Largest change of a weight at which the weights have converged; a hundred times that where they
only begin another loss."""

Run = Callable[[Problem, FloatArray, Start | None], Descent]
"""Descends a problem from a deviation and a warm start."""


@dataclass(frozen=True, eq=False)
class RobustFit:
    """A robust descent.

    Attributes
    ----------
    fit : descent of the weighted problem, after all those that determined the weights. The first of
        its costs, and those of the last descent, have these weights; those between have the weights
        of their rounds.
    problem : weighted. weight : (n,) of each pose, equal within a block.
    """

    fit: Descent
    problem: Problem
    weight: FloatArray


def descend_robustly(
    problem: Problem,
    block: IntArray,
    loss: Loss,
    deviation: FloatArray,
    estimate_scale: bool,
    run: Run,
    prior: Prior | None = None,
) -> RobustFit:
    """Fit with a loss (one trial).

    Parameters
    ----------
    problem : unweighted. block : (n,) block of each pose. deviation : (1, p) where to begin.
    estimate_scale : whether sigmas are only known up to a factor; it is then the median of the
        blocks' distances.
    run : descends a problem, with the rows of the prior. prior : the one that `run` adds.
    """
    member = np.unique(block, return_inverse=True)[1]
    fit = RobustFit(run(problem, deviation, None), problem, np.ones(len(block)))
    if fit.fit.status[0] not in (DescentStatus.CONVERGED, DescentStatus.BAD_START):
        fit = _begin_without_far_blocks(problem, member, fit, deviation, run)
    if isinstance(loss, Tukey):
        coarse = 100.0 * CONVERGED_CHANGE
        fit = _reweight(problem, member, Huber(), fit, estimate_scale, run, coarse)
    fit = _reweight(problem, member, loss, fit, estimate_scale, run, CONVERGED_CHANGE)
    return _with_comparable_start(fit, problem, deviation, prior)


def measure_block_distances(
    problem: Problem, z: FloatArray, start: Start, member: IntArray, weighted: Problem
) -> tuple[FloatArray, FloatArray]:
    """Return d = |W r| (u,) and the number of residuals (u,) of every block.

    Parameters
    ----------
    z, start : deviation (1, p), and a start there. member : (n,) block of each pose.
    weighted : the problem that the nuisance parameters fit best.
    """
    count = int(member.max()) + 1
    nuisance = None
    if problem.nuisance is not None:
        nuisance = weighted.solve(z, start).nuisance
    solution = problem.solve(z, start, nuisance)
    square, degrees = np.zeros(count), np.zeros(count)
    for rows, kind in zip(problem.rows, problem.residuals(z, solution), strict=True):
        blocks, present = member[rows.first_poses], rows.is_present[0]
        each = np.where(present, kind.whitened[0] ** 2, 0.0).sum(axis=1)
        square += np.bincount(blocks, each, count)
        degrees += np.bincount(blocks, present.sum(axis=1), count)
    return np.sqrt(square), degrees - problem.count_pose_directions(solution, member, count)


def estimate_scale_of(distance: FloatArray, degrees: FloatArray) -> float:
    """Return the factor on sigma that the median block shows.

    It is the median of d over the median of the chi distribution with the block's degrees.
    """
    is_tested = degrees > 0.0
    ratio = distance[is_tested] / np.sqrt(compute_chi_square_quantile(degrees[is_tested], 0.5))
    middle = compute_median(ratio) if len(ratio) else 1.0
    return middle if middle > 0.0 else 1.0


def _with_comparable_start(
    robust: RobustFit, problem: Problem, deviation: FloatArray, prior: Prior | None
) -> RobustFit:
    """Return the fit with the first cost weighted as the last one, so that both compare."""
    if robust.problem is problem:
        return robust
    whole = robust.problem if prior is None else prior.added(robust.problem)
    costs = robust.fit.cost_history.copy()
    costs[0] = whole.linearize(deviation, robust.fit.start).cost
    return replace(robust, fit=replace(robust.fit, cost_history=costs))


def _begin_without_far_blocks(
    problem: Problem, member: IntArray, failed: RobustFit, deviation: FloatArray, run: Run
) -> RobustFit:
    """Return a fit without the blocks that lie far from the start, where the fit to all of them
    did not converge: one row that is far off can prevent every step. The scale is that of the
    median block, whose distance is the error of the start.
    """
    start = problem.start(deviation)
    distance, degrees = measure_block_distances(problem, deviation, start, member, problem)
    weight = Tukey().weight(distance / estimate_scale_of(distance, degrees), degrees)[member]
    weighted = problem.weighted(weight)
    return RobustFit(run(weighted, deviation, None), weighted, weight)


def _reweight(
    problem: Problem,
    member: IntArray,
    loss: Loss,
    robust: RobustFit,
    estimate_scale: bool,
    run: Run,
    change: float,
) -> RobustFit:
    """Reweight until no weight changes by more than `change`."""
    for _ in range(ROUNDS):
        fit = robust.fit
        if fit.status[0] != DescentStatus.CONVERGED:
            break
        distance, degrees = measure_block_distances(
            problem, fit.deviation, fit.start, member, robust.problem
        )
        if estimate_scale:
            distance = distance / estimate_scale_of(distance, degrees)
        weight = weigh_blocks(loss, distance, degrees)[member]
        if float(np.abs(weight - robust.weight).max()) <= change:
            break
        weighted = problem.weighted(weight)
        again = run(weighted, fit.deviation, fit.start).after(fit)
        robust = RobustFit(again, weighted, weight)
    return robust
