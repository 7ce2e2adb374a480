# SPDX-License-Identifier: Apache-2.0
"""A start for fits of very many poses: the estimate of a small part of them.

The estimate of k of n poses differs from that of all by about sqrt(n / k) of its standard
deviations, which are small where n is large: a descent to all poses that begins there has the same
minimum, and needs fewer linearizations of all of them. See docs/theory/identification.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from loopcal.estimate.methods.penalties import MAP, LeastSquares, Method, Ridge
from loopcal.estimate.minimization.descent import Descent, StepControl, descend
from loopcal.estimate.poses.linearization import LinearizedPoses
from loopcal.estimate.problem import Problem
from loopcal.measure import Evaluation
from loopcal.numerics.gauss_newton import DescentStatus
from loopcal.typing import FloatArray, IntArray, Progress, report_no_progress

SHARE = 16
"""A part has one of so many poses. Its estimate is about four standard deviations of all poses
away: from there, one step of all poses is enough for noise of 1e-5 m and rad, too."""
FEWEST_POSES = 65_536
"""A part is used from so many poses on. Processor time of fits of hexapod-42 with drawn errors, in
seconds with a part | without: noise of 1e-6 m and rad, 66,000 poses 0.49 | 0.49, 100,000 0.69 |
0.84; noise of 1e-5, 33,000 0.28 | 0.23, 66,000 0.44 | 0.73, 100,000 0.77 | 0.97. A fit that begins
at the truth needs no part and loses its time."""
EQUATIONS = 50
"""Equations of a part for each parameter, at least: its estimate is near enough then."""
METHODS = (LeastSquares, Ridge, MAP)
"""Methods whose estimate from a part of the poses is near that from all of them. A chosen number of
directions, for example, depends on how many equations there are."""

GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)


def descend_in_parts(
    problem: Problem,
    deviation: FloatArray,
    method: Method,
    control: StepControl,
    tolerance: float,
    progress: Progress = report_no_progress,
) -> Descent | None:
    """Descend from a deviation (1, p) with a part of the poses, and from there with all of them.

    None where a part cannot be used, where the residuals of all poses are not finite at the
    deviation, or where one of the two descents does not converge within the steps of `control`: all
    poses together then begin at the deviation. The history has the steps of the part. Its first sum
    of squares is that of all poses, the others of the part are estimates: sums of the part times
    the ratio of the numbers of equations.
    """
    part = select_part(problem) if type(method) in METHODS else None
    if part is None:
        return None
    count, at_start = part.readings.shape[1], sum_squares(problem, deviation)
    if not np.isfinite(at_start):
        return None

    def report(done: int, total: int, what: str) -> None:
        progress(done, total, f"{what} ({count} of {problem.readings.shape[1]} poses)")

    first = descend(part, deviation, method, control, tolerance, progress=report)
    if not _is_converged(first) or int(first.decomposition.rank[0]) < problem.parameters:
        return None
    left = control.iterations - int(first.iterations[0])
    if left <= 0:
        return None
    control = replace(control, iterations=left)
    fit = descend(problem, first.deviation, method, control, tolerance, progress=progress)
    if not _is_converged(fit):
        return None
    costs = first.cost_history * (problem.equations[0] / part.equations[0])
    costs[0], costs[-1] = at_start, fit.cost_history[0]
    return fit.after(replace(first, cost_history=costs))


def sum_squares(problem: Problem, deviation: FloatArray) -> float:
    """Return the whitened sum of squares of one trial at a deviation (1, p), without derivatives;
    infinite where a pose that a row needs is not reached.
    """
    is_lost = False

    def observe(i: int, poses: LinearizedPoses, evaluations: Sequence[Evaluation | None]) -> None:
        nonlocal is_lost
        del evaluations
        is_lost |= bool(poses.is_lost(problem.poses.blocks[i].is_needed)[0])

    with np.errstate(over="ignore", invalid="ignore"):  # poses out of reach
        solution = problem.solve(deviation, problem.start(deviation), derivatives=False)
        residuals = problem.residuals(deviation, solution, observe)
        cost = sum(float(np.nansum(r.whitened**2)) for r in residuals)  # NaN: not measured
    return np.inf if is_lost else cost


def select_part(problem: Problem) -> Problem | None:
    """Return the problem of a spread part of the poses.

    None where the poses are too few, several trials are fitted at once, or something other than the
    free parameters and the readings determines the rows: uncertain or missing readings, nuisance
    parameters, rows that compare poses, measured passive joints, smooth errors, chains of stages,
    or fewer readings than lengths (`Problem.folds_plain_rows`).
    """
    n = problem.readings.shape[1]
    if not problem.folds_plain_rows or len(problem) != 1:
        return None
    count = n // SHARE
    if n < FEWEST_POSES or problem.equations[0] * count < EQUATIONS * problem.parameters * n:
        return None
    return take_poses(problem, spread_poses(n, count))


def spread_poses(n: int, count: int) -> IntArray:
    """Return `count` of n poses, one in each of as many equal ranges.

    Their places in the ranges follow the golden ratio, i G modulo 1. Whatever repeats in the order
    of the poses, as the lines of a grid do, every phase of it has its share.
    """
    i = np.arange(count)
    return np.floor((i + (i * GOLDEN) % 1.0) * (n / count)).astype(np.int64)


def take_poses(problem: Problem, poses: IntArray) -> Problem:
    """Return the problem of some poses (k,), ascending; every row must depend on one pose."""
    place = np.full(problem.readings.shape[1], -1)
    place[poses] = np.arange(len(poses))
    chosen = [np.flatnonzero(place[rows.poses] >= 0) for rows in problem.rows]
    rows = (r.take_rows(numbers, place) for r, numbers in zip(problem.rows, chosen, strict=True))
    return replace(problem, readings=problem.readings[:, poses], rows=tuple(rows))


def _is_converged(fit: Descent) -> bool:
    return bool(fit.status[0] == DescentStatus.CONVERGED.value)
