# SPDX-License-Identifier: Apache-2.0
"""Robust fits by reweighting: descend, weigh each block by its distance from the fit, repeat.

The weights are determined outside the descent and enter it as weights of the rows, so that every
method, decomposition and covariance is used as it is. Blocks are the poses that
`Measurements.block` declares to belong together, joined where a row links them; never a single
component.

The uncertainty of a fit with a loss, where its residuals exceed the stated noise: with the weight
w(d) of a block of m residuals at distance d, the estimate solves sum A' w r = 0. Its covariance is
(Huber, Robust Statistics, 1981, section 7.6)

    K^2 (sum w^2 d^2 / (N - p)) / h^2 (A'A)^-1        h = sum (m w + d w'(d)) / N

with N residuals, p parameters, and K = 1 + p / N var((m w + d w') / m) / h^2. The weighted rows
give (A'WA)^-1 = (A'A)^-1 / mean w, for unit noise. See docs/theory/uncertainty.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from loopcal.estimate.descent import Descent
from loopcal.estimate.linearization import Start
from loopcal.estimate.losses import Huber, Loss, Tukey, weigh_blocks
from loopcal.estimate.posterior import NOISE
from loopcal.estimate.prior import Prior
from loopcal.estimate.problem import Problem
from loopcal.estimate.residual_test import SIGNIFICANCE
from loopcal.estimate.result import Identification, add_covariance
from loopcal.findings import report_finding
from loopcal.numerics.gauss_newton import DescentStatus
from loopcal.numerics.statistics import (
    compute_chi_square_quantile,
    compute_chi_square_tail,
    compute_median,
)
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
    """Fit with a loss (one trial), blocks of poses numbered by `block` (n,).

    Where sigmas are only known up to a factor (`estimate_scale`), it is the median of the blocks'
    distances. `run` descends a problem, with the rows of the prior.
    """
    member = np.unique(block, return_inverse=True)[1]
    fit = RobustFit(run(problem, deviation, None), problem, np.ones(len(block)))
    if fit.fit.status[0] not in (DescentStatus.CONVERGED, DescentStatus.BAD_START):
        # one row that is far off can prevent every step: blocks far from the start, whose error the
        # distance of the median block shows, are left out first
        start = problem.start(deviation)
        distance, degrees = measure_block_distances(problem, deviation, start, member, problem)
        weight = Tukey().weight(distance / estimate_scale_of(distance, degrees), degrees)[member]
        weighted = problem.weighted(weight)
        fit = RobustFit(run(weighted, deviation, None), weighted, weight)
    if getattr(loss, "is_redescending", False):
        coarse = 100.0 * CONVERGED_CHANGE
        fit = _reweight(problem, member, Huber(), fit, estimate_scale, run, coarse)
    fit = _reweight(problem, member, loss, fit, estimate_scale, run, CONVERGED_CHANGE)
    if fit.problem is problem:
        return fit
    # the first cost is weighted as the last one, so that both compare
    whole = fit.problem if prior is None else prior.added(fit.problem)
    costs = fit.fit.cost_history.copy()
    costs[0] = whole.linearize(deviation, fit.fit.start).cost
    return replace(fit, fit=replace(fit.fit, cost_history=costs))


def measure_block_distances(
    problem: Problem, z: FloatArray, start: Start, member: IntArray, weighted: Problem
) -> tuple[FloatArray, FloatArray]:
    """Return d = |W r| (u,) and the number of residuals (u,) of every block at a deviation (1, p),
    with the nuisance parameters that fit `weighted` best; `member` (n,) is the block of each pose.
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


STEP = 1e-4
"""Relative change of a distance for the derivative of a weight."""


def add_loss_uncertainty(
    result: Identification, fit: Descent, problem: Problem, weighted: Problem, blocks: IntArray
) -> Identification:
    """Return a fit with a loss whose covariance allows for residuals that exceed the noise in it.

    Without a loss, or where the residuals agree with the noise (p > 0.001), it stays as it is.
    """
    loss, test = result.options.loss, result.residual_test
    if loss is None or not (result.converged and test.intervals):
        return result
    member = np.unique(blocks, return_inverse=True)[1]
    distance, counts = measure_block_distances(problem, fit.deviation, fit.start, member, weighted)
    unit = estimate_scale_of(distance, counts) if test.noise == "estimated" else 1.0
    variance, left = compute_loss_variance(loss, distance, counts, result.rank, unit)
    times = variance / test.sigma_scale**2
    if left < 1.0 or compute_chi_square_tail(left, left * times) >= SIGNIFICANCE:
        return result
    roots = [part.root for part in result.posterior.parts if part.source == NOISE]
    root = np.sqrt(times - 1.0) * np.concatenate(roots, axis=1)
    finding = report_finding("noise.loss-contradicted", ratio=float(np.sqrt(times)))
    return add_covariance(result, root, left, finding)


def compute_loss_variance(
    loss: Loss, distance: FloatArray, counts: FloatArray, rank: int, unit: float = 1.0
) -> tuple[float, float]:
    """Return the variance of the noise that the covariance of the weighted rows must contain, and
    its degrees of freedom, from norm and number (u,) of the whitened residuals of each block. The
    loss divides distances by `unit`.
    """
    weight = loss.weight(distance / unit, counts)
    longer = loss.weight(distance * (1.0 + STEP) / unit, counts)
    slope = (longer - loss.weight(distance * (1.0 - STEP) / unit, counts)) / (2.0 * STEP)
    total, is_tested = float(counts.sum()), counts > 0.0
    left = total - rank
    influence = counts * weight + slope
    gain = float(influence.sum()) / total
    mean_weight = float((counts * weight).sum()) / total
    if left < 1.0 or gain <= 0.0:
        return np.nan, 0.0
    each = influence[is_tested] / counts[is_tested]
    correction = 1.0 + rank / total * float(np.var(each)) / gain**2
    square = float(((weight * distance) ** 2).sum()) / left
    return correction**2 * square * mean_weight / gain**2, left
