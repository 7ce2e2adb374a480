# SPDX-License-Identifier: Apache-2.0
"""A start for fits of very many poses: the estimate of a small part of them.

The estimate of k of n poses differs from that of all by about sqrt(n / k) of its standard
deviations, which are small where n is large: a descent to all poses that begins there has the same
minimum, and needs fewer linearizations of all of them. See docs/theory/identification.md.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from loopcal.estimate.methods.penalties import MAP, LeastSquares, Method, Ridge
from loopcal.estimate.minimization.descent import Descent, StepControl, descend
from loopcal.estimate.observation_rows import BLOCK
from loopcal.estimate.poses.exact import ExactPoses
from loopcal.estimate.problem import Problem
from loopcal.numerics.gauss_newton import DescentStatus
from loopcal.typing import FloatArray, IntArray, Progress, report_no_progress

SHARE = 16
"""So many times as many poses as a part has make its descent cost less than it saves."""
EQUATIONS = 50
"""Equations of a part for each parameter, at least: its estimate is near enough then."""
METHODS = (LeastSquares, Ridge, MAP)
"""Methods whose estimate changes little where rows are left out that say the same."""

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

    None where a part cannot be used, or where one of the two descents does not converge: all poses
    together then begin at the deviation. The history has the steps of the part with its sums of
    squares times the ratio of the numbers of equations.
    """
    part = select_part(problem) if type(method) in METHODS else None
    if part is None:
        return None
    count = part.readings.shape[1]

    def report(done: int, total: int, what: str) -> None:
        progress(done, total, f"{what} ({count} of {problem.readings.shape[1]} poses)")

    first = descend(part, deviation, method, control, tolerance, progress=report)
    if not _is_converged(first) or int(first.decomposition.rank[0]) < problem.parameters:
        return None
    fit = descend(problem, first.deviation, method, control, tolerance, progress=progress)
    if not _is_converged(fit):
        return None
    costs = first.cost_history * (problem.equations[0] / part.equations[0])
    costs[-1] = fit.cost_history[0]
    return fit.after(replace(first, cost_history=costs))


def select_part(problem: Problem) -> Problem | None:
    """Return the problem of a spread part of the poses.

    None where readings are uncertain, rows depend on more than one pose or on nuisance parameters,
    several trials are fitted at once, or the poses are too few.
    """
    poses, n = problem.poses, problem.readings.shape[1]
    if not (isinstance(poses, ExactPoses) and problem.folds_plain_rows and len(problem) == 1):
        return None
    count = BLOCK
    if n < SHARE * count or problem.equations[0] * count < EQUATIONS * problem.parameters * n:
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
