# SPDX-License-Identifier: Apache-2.0
"""A start for many trials: one step of each with a factor that all of them share.

Simulated machines differ from the nominal one by their tolerances, so that the factor R of the rows
of one trial at the common start, A = Q R, nearly is that of all. A chord costs a trial its
residuals r at poses that all trials share:

    dz = -R^-1 Q' [r; P z]         P z: rows of the penalty

The exact descent goes on from there, see `ACCEPTED_STEP`. (Deuflhard, "Newton Methods for Nonlinear
Problems", 2004, chapter 2.1, simplified Newton iteration.) See docs/theory/identification.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from loopcal.estimate.linearization import Start
from loopcal.estimate.methods.fixed_penalty import fix_penalty
from loopcal.estimate.methods.penalties import MAP, Method
from loopcal.estimate.poses.exact import ExactPoses
from loopcal.estimate.poses.linearization import linearize_rows
from loopcal.estimate.poses.states import PoseSolution
from loopcal.estimate.problem import Problem
from loopcal.numerics.triangular_systems import solve_regular
from loopcal.typing import FloatArray

ACCEPTED_STEP = 1e-3
"""A trial that began with a chord has converged where all further steps together would change the
whitened residuals by less than this: no estimate then moves by more than this share of its standard
deviation."""


@dataclass(frozen=True, eq=False)
class SharedFactor:
    """The factor of the rows of one trial at the start of all.

    Attributes
    ----------
    solution : of this trial at the start. start : there, for the linearizations nearby.
    triangle : (p, p) R. by_residuals : (p, m) R^-1 Q' of the rows. by_deviation : (p, p) R^-1 Q' P.
    """

    solution: PoseSolution
    start: Start
    triangle: FloatArray
    by_residuals: FloatArray
    by_deviation: FloatArray


@dataclass(frozen=True, eq=False)
class ChordStart:
    """Where chords lead.

    Attributes
    ----------
    deviation : (t, p). length : (t,) by which the chords changed the whitened residuals, to first
        order; infinite in trials that begin where they were. start : for the linearization there.
    """

    deviation: FloatArray
    length: FloatArray
    start: Start


def share_factor(
    problem: Problem, deviation: FloatArray, method: Method, tolerance: float
) -> SharedFactor | None:
    """Return the factor of the first trial at deviation (1, p).

    None where chords cannot be used: poses or nuisance parameters are eliminated from the rows, the
    penalty depends on them, or a direction might not count.
    """
    poses, p = problem.poses, problem.parameters
    if isinstance(method, MAP) and callable(method.inflation):
        method = replace(method, inflation=1.0)  # which only chooses where the exact descent begins
    fixed = fix_penalty(method, p)
    is_plain = problem.nuisance is None and problem.consistent is None
    if fixed is None or not is_plain or not isinstance(poses, ExactPoses):
        return None
    if not poses.is_single_block:
        return None
    first = problem.take(np.array([0]))
    begin = first.start(deviation)
    solution = first.poses.solve(deviation, first.trials, begin, first.control)
    assert solution.linearized is not None
    if solution.linearized.is_lost(poses.blocks[0].is_needed).any():
        return None
    kinds = [
        linearize_rows(rows, solution.linearized, first.trials, None)
        for rows in poses.blocks[0].rows
    ]
    A = np.concatenate([kind.by_parameters.reshape(-1, p) for kind in kinds])
    q, r = np.linalg.qr(np.concatenate([A, fixed.matrix]))
    if len(r) < p:  # fewer rows than parameters
        return None
    _, is_regular = solve_regular(r[None], np.zeros((1, p)), tolerance)
    if not is_regular[0]:
        return None
    inverse = np.linalg.solve(r, q.T)
    states, is_near = poses.next_start(solution, begin)
    start = replace(begin, deviation=deviation, poses=states, is_near=is_near)
    by_residuals = np.ascontiguousarray(inverse[:, : len(A)])
    return SharedFactor(
        solution, start, np.array(r), by_residuals, inverse[:, len(A) :] @ fixed.matrix
    )


def take_chords(problem: Problem, shared: SharedFactor, deviation: FloatArray) -> ChordStart:
    """Return where one chord leads from deviations (t, p), which are equal in all trials."""
    t = len(deviation)
    kinds = problem.residuals(deviation, shared.solution)
    residual = np.concatenate([kind.whitened.reshape(t, -1) for kind in kinds], axis=1)
    # one product for each trial: a product of all of them would round by their number
    step = np.matmul(shared.by_residuals, residual[:, :, None])
    step = -(step + np.matmul(shared.by_deviation, deviation[:, :, None]))[:, :, 0]
    length = np.linalg.norm(np.matmul(shared.triangle, step[:, :, None])[:, :, 0], axis=1)
    good = np.isfinite(length)
    return ChordStart(
        np.where(good[:, None], deviation + step, deviation),
        np.where(good, length, np.inf),
        shared.start.take(np.zeros(t, dtype=np.int64)),
    )
