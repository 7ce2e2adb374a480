# SPDX-License-Identifier: Apache-2.0
"""Fit resamples of the rows of one fit, all at once.

A resample weighs the blocks of rows anew, or draws new errors of the rows, and of the prior. All
resamples have the structure of the rows that were fitted, so that they are a batch of trials. Each
begins at the estimate of the fit. With the drawn center m of the prior the penalty acts on z - m:
a prior is an observation, too, and its error is drawn from its stated distribution.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from loopcal.estimate.descent import LeastSquaresProblem, descend
from loopcal.estimate.fit_linearization import FitLinearization
from loopcal.estimate.linearization import Linearization, Start
from loopcal.estimate.penalties import decompose_for
from loopcal.estimate.problem import Problem
from loopcal.estimate.result import Identification
from loopcal.numerics.gauss_newton import DescentStatus
from loopcal.numerics.trial_batch import TrialBatch, map_arrays
from loopcal.typing import BoolArray, FloatArray, IntArray

LEAST_DEGREES = 0.5
"""Degrees of freedom below which residuals show no noise."""


@dataclass(frozen=True, eq=False)
class Resamples(TrialBatch):
    """What t resamples change in the rows of a fit.

    weight : (t, n) factors on the squares of each pose; None where the rows keep theirs.
    offset : of every kind (t, r, m), added to the whitened residuals; None without any.
    center : (t, p) drawn center of the prior, in spreads from nominal.
    prior : (t, r) errors of the rows of an earlier calibration; None without one.
    nuisance : (t, U) [SI] drawn means of the priors of nuisance parameters.
    equations : (t,) number of equations of each resample.
    """

    weight: FloatArray | None
    offset: tuple[FloatArray, ...] | None
    center: FloatArray
    prior: FloatArray | None
    nuisance: FloatArray
    equations: IntArray

    def __len__(self) -> int:
        return len(self.center)


@dataclass(frozen=True, eq=False)
class ResampleFits(TrialBatch):
    """Estimates of t resamples.

    deviation : (t, p) in spreads from nominal. linear : (t, p) the same to first order about the
        estimate of the fit.
    status : (t,) DescentStatus.
    sd : (t, p) standard deviations in spreads, for rows of unit variance.
    noise : (t,) variance of the rows that the residuals show; NaN without degrees of freedom.
    """

    deviation: FloatArray
    linear: FloatArray
    status: IntArray
    sd: FloatArray
    noise: FloatArray

    @property
    def converged(self) -> BoolArray:
        """(t,) which resamples converged."""
        return self.status == DescentStatus.CONVERGED


@dataclass(frozen=True, eq=False)
class CenteredProblem:
    """A problem of t trials whose deviations count from a center (t, p) of their own.

    It is a problem of the descent. `equations` (t,) replace those that the rows count.
    """

    problem: LeastSquaresProblem
    center: FloatArray
    equations: IntArray

    @property
    def parameters(self) -> int:
        """Number of unknowns p."""
        return self.problem.parameters

    def start(self, deviation: FloatArray) -> Start:
        """Return the warm start of a descent from deviations (t, p)."""
        return self.problem.start(deviation + self.center)

    def take(self, trials: IntArray) -> CenteredProblem:
        """Return the problem of some trials."""
        own = self.problem.take(trials)
        return CenteredProblem(own, self.center[trials], self.equations[trials])

    def linearize(self, deviation: FloatArray, start: Start) -> Linearization:
        """Linearize at deviations (t, p) from the centers."""
        linearized = self.problem.linearize(deviation + self.center, start)
        return Linearization(
            deviation, linearized.factor, linearized.cost, self.equations, linearized.next_start
        )


def resample_rows(
    problem: Problem,
    weight: FloatArray | None,
    offset: Sequence[FloatArray] | None,
    prior_mean: FloatArray,
) -> Problem:
    """Return the problem of t resamples of the rows of a problem (one trial), with factors `weight`
    (t, n) on each pose's squares, `offset` (t, r, m) of every kind added to the whitened residuals,
    and means (t, U) [SI] of the priors of nuisance parameters.
    """
    rows = problem.rows if weight is None else tuple(r.weighted(weight) for r in problem.rows)
    if offset is not None:
        rows = tuple(replace(r, offset=o) for r, o in zip(rows, offset, strict=True))
    nuisance = problem.nuisance
    if nuisance is not None:
        nuisance = replace(nuisance, prior_mean=prior_mean)
    poses = replace(problem.poses, rows=rows, nuisance=nuisance)
    return replace(problem, poses=poses, trials=np.arange(len(prior_mean)))


def fit_resamples(linear: FitLinearization, resamples: Resamples) -> ResampleFits:
    """Fit resamples of the rows of a fit that converged, each from its estimate."""
    fit, t, method = linear.fit, len(resamples), linear.fit.method
    changed = (resamples.weight, resamples.offset, resamples.nuisance)
    problem = resample_rows(linear.problem, *changed)
    if fit.options.prior is not None:
        problem = fit.options.prior.added(problem, resamples.prior)
    centered = CenteredProblem(problem, resamples.center, resamples.equations)
    start = repeat_trial(linear.linearization.next_start, t)
    estimate = np.repeat(linear.linearization.deviation, t, axis=0)
    z = estimate - resamples.center
    rows = replace(problem.linearize(estimate, start), deviation=z, equations=resamples.equations)
    tolerance = fit.spectrum.tolerance
    first = decompose_for(method, rows.factor, rows.equations, z, tolerance)
    solution = first.deviation(first.solution(method.penalty(first)))
    descent = _descend(fit, centered, solution, rows.next_start)
    again = np.flatnonzero(descent.status != DescentStatus.CONVERGED)
    if again.size:  # the linear solution may be out of reach, the estimate is not
        other = _descend(fit, centered.take(again), z[again], rows.next_start.take(again))
        descent = descent.put(again, other)
    return replace(
        descent, deviation=descent.deviation + resamples.center, linear=solution + resamples.center
    )


def _descend(
    fit: Identification, problem: CenteredProblem, z: FloatArray, start: Start
) -> ResampleFits:
    """Return where descents from deviations z (t, p) end."""
    control, tolerance = fit.options.control, fit.spectrum.tolerance
    descent = descend(problem, z, fit.method, control, tolerance, start)
    d, penalty = descent.decomposition, descent.penalty
    left = d.rows - d.filter_factors(penalty).sum(axis=1)
    noise = np.full(len(z), np.nan)
    np.divide(d.remaining(penalty), left, out=noise, where=left > LEAST_DEGREES)
    return ResampleFits(descent.deviation, z, descent.status, d.standard_deviations(penalty), noise)


def draw_centers(linear: FitLinearization, count: int, rng: np.random.Generator) -> FloatArray:
    """Draw centers (count, p) of the prior of a fit by MAP, in spreads from nominal."""
    d, penalty = linear.decomposition, linear.prior_weight
    is_penalized = np.isfinite(penalty) & (penalty > 0.0)
    sd = np.where(is_penalized, 1.0 / np.sqrt(np.where(is_penalized, penalty, 1.0)), 0.0)
    return d.deviation(rng.standard_normal((count, len(penalty))) * sd)


def repeat_trial(start: Start, count: int) -> Start:
    """Return a start of one trial as that of `count` trials."""
    return map_arrays(lambda array: np.repeat(array[:1], count, axis=0), start)
