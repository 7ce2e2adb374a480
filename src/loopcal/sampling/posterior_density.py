# SPDX-License-Identifier: Apache-2.0
"""The exact posterior of a fit, and its linear approximation, at drawn parameters.

The machine's deviation is z = mean + E y and the setup parameters are x = best(z) + T w, with
independent standard normal y and w of the linear posterior. Both densities are functions of the sum
of squares R of all rows, priors of setup parameters and rows of an earlier calibration included,
and of the penalty of the tolerances:

    log p = g(R(z, x)) - 1/2 sum penalty_i y_i(z)^2
    g(R) = -(R - U) / (2 s^2)                                     noise known
    g(R) = -(nu + K) / 2 log(nu s^2 + R - U)                      s^2 with nu degrees of freedom

U is the smallest R, K the number of directions that the rows determine. The second form is the
integral over the noise variance (Jeffreys' prior, or a stated sigma that is itself uncertain); for
linear rows it is Student's t with nu degrees of freedom. Poses of uncertain readings are where they
fit best at z and x. See docs/theory/resampling.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopcal.estimate.fit_linearization import FitLinearization
from loopcal.estimate.inference.prior import WithPrior
from loopcal.estimate.resampling import repeat_trial, resample_rows
from loopcal.estimate.result import Identification
from loopcal.numerics.decomposition import Decomposition
from loopcal.typing import FloatArray


@dataclass(frozen=True, eq=False)
class PosteriorDensity:
    """The posterior of a fit in the coordinates v = (y, w) of its linear approximation.

    Attributes
    ----------
    fit, linear : the fit and its rows. prior : rows of an earlier calibration with them, or None.
    decomposition, penalty : of rows divided by s; the penalty is that of a prior, or 0.
    mean : (p,) of the linear posterior, in tolerances. root : (p, k) E.
    setup_root : (U, u) T. scale : s. degrees : nu. directions : K.
    """

    fit: Identification
    linear: FitLinearization
    prior: WithPrior | None
    decomposition: Decomposition
    penalty: FloatArray
    mean: FloatArray
    root: FloatArray
    setup_root: FloatArray
    scale: float
    degrees: float
    directions: int

    @property
    def size(self) -> int:
        """Number k + u of coordinates."""
        return self.root.shape[1] + self.setup_root.shape[1]

    def parameters(self, coordinates: FloatArray) -> FloatArray:
        """Return deviations (T, p) in tolerances at coordinates (T, k + u)."""
        return self.mean + coordinates[:, : self.root.shape[1]] @ self.root.T

    def setup(self, coordinates: FloatArray) -> FloatArray:
        """Return setup parameters (T, U) [SI] at coordinates (T, k + u)."""
        nuisance = self.linear.linearization.nuisance
        if nuisance is None:
            return np.zeros((len(coordinates), 0))
        change = self.parameters(coordinates) - self.linear.linearization.deviation
        own = coordinates[:, self.root.shape[1] :] @ self.setup_root.T
        return nuisance.best[0] + change @ nuisance.elimination.slope[0].T + own

    def exact(self, coordinates: FloatArray) -> FloatArray:
        """Return log p (T,) at coordinates (T, k + u); -inf where a pose is not reached."""
        z, x = self.parameters(coordinates), self.setup(coordinates)
        count = len(z)
        problem = resample_rows(self.linear.problem, None, None, self._prior_mean(count))
        start = repeat_trial(self.linear.linearization.next_start, count)
        has_setup = x.shape[1] > 0
        if has_setup:
            start = start.with_nuisance(x)
        solution = problem.solve(z, start, x if has_setup else None)
        total = np.zeros(count)
        for rows, kind in zip(problem.rows, problem.residuals(z, solution), strict=True):
            white = np.where(rows.is_present, kind.whitened, 0.0)
            total += (white**2).sum(axis=(1, 2))
        if problem.nuisance is not None:
            total += problem.nuisance.prior_cost(x)
        if self.prior is not None:
            total += (self.prior.residuals(z) ** 2).sum(axis=1)
        value = self._of_squares(total / self.scale**2) - 0.5 * self._penalize(z)
        return np.where(np.isfinite(value), value, -np.inf)

    def approximate(self, coordinates: FloatArray) -> FloatArray:
        """Return log p (T,) of the linear posterior at coordinates (T, k + u)."""
        d, z = self.decomposition, self.parameters(coordinates)
        y = d.coordinates(z)
        left = ((d.singular_values[0] * y - d.projections[0]) ** 2).sum(axis=1) + d.outside[0]
        own = coordinates[:, self.root.shape[1] :]
        return self._of_squares(left + (own**2).sum(axis=1)) - 0.5 * self._penalize(z)

    def _of_squares(self, total: FloatArray) -> FloatArray:
        """Return g (T,) of sums of squares R / s^2."""
        above = total - self.decomposition.unexplained[0]
        if np.isinf(self.degrees):
            return -0.5 * above
        with np.errstate(invalid="ignore"):
            return -0.5 * (self.degrees + self.directions) * np.log(self.degrees + above)

    def _penalize(self, z: FloatArray) -> FloatArray:
        """Return the penalty (T,) of the tolerances."""
        return (self.penalty * self.decomposition.coordinates(z) ** 2).sum(axis=1)

    def _prior_mean(self, count: int) -> FloatArray:
        """Return the means of the priors of setup parameters, for each draw."""
        nuisance = self.linear.problem.nuisance
        return np.zeros((count, 0)) if nuisance is None else nuisance.prior_mean.repeat(count, 0)


def describe_density(fit: Identification, linear: FitLinearization) -> PosteriorDensity:
    """Return the posterior of a fit by least squares or MAP, with intervals.

    `linear` are its rows, see `linearize_fit`.
    """
    scale, degrees = fit.residual_test.sigma_scale, fit.residual_test.noise_degrees
    stated, penalty = linear.decomposition, linear.prior_weight
    d = stated.divided(np.array([scale]))
    finite = np.where(np.isfinite(penalty), penalty, 0.0)
    # without a prior a direction is used within the rank; with one, also beyond it
    used = np.where(np.isfinite(penalty), finite, np.inf)[None]
    variance = d.variances(used)[0]
    is_known = np.isfinite(variance)
    root = d.scale[:, None] * d.directions[0][:, is_known] * np.sqrt(variance[is_known])
    mean = d.deviation(d.solution(used))[0]
    setup_root, rank = np.zeros((0, 0)), 0
    nuisance = linear.linearization.nuisance
    if nuisance is not None:
        joint = scale * nuisance.elimination.joint_root()[0]
        setup_root = joint[:, (joint != 0.0).any(axis=0)]
        rank = int(nuisance.elimination.rank[0])
    prior = None if fit.options.prior is None else fit.options.prior.added(linear.problem)
    directions = int(stated.used[0].sum()) + rank
    return PosteriorDensity(
        fit, linear, prior, d, finite, mean, root, setup_root, scale, degrees, directions
    )
