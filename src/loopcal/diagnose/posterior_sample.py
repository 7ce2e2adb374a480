# SPDX-License-Identifier: Apache-2.0
"""Sample the exact posterior of one calibration by weighted draws from the linear one.

Draws come from a multivariate t distribution about the estimate with the covariance of the fit, so
that its tails are heavier than those of the posterior. Each draw gets the exact density of all rows
and priors, with the kinematics solved at it, divided by the density of the proposal (importance
sampling). Where few draws have all the weight, the proposal is moved to them, and drawn from again.
See docs/theory/uncertainty.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from loopcal.diagnose.intervals import (
    ENDS,
    OFF,
    Intervals,
    compare_ends,
    effective_size,
    fit_tail_shape,
    mask_intervals,
    normalize_weights,
    report_intervals,
)
from loopcal.errors import EstimationError
from loopcal.estimate.fit_linearization import FitLinearization, linearize_fit
from loopcal.estimate.prior import WithPrior
from loopcal.estimate.resampling import repeat_trial, resample_rows
from loopcal.estimate.residual_test import LEVEL, coverage_factor
from loopcal.estimate.result import Identification
from loopcal.findings import Finding, report_finding
from loopcal.measure.measurements import Measurements
from loopcal.numerics.decomposition import Decomposition
from loopcal.results.description import Field, fields, label_axes
from loopcal.results.result import TableResult
from loopcal.typing import FloatArray, Progress, report_no_progress


@dataclass(frozen=True, eq=False)
class PosteriorDensity:
    """The posterior of a fit in the coordinates v = (y, w) of its linear approximation."""

    linear: FitLinearization  # the fit and its rows
    prior: WithPrior | None  # rows of an earlier calibration with them, or None
    # decomposition, penalty: of rows divided by s; the penalty is that of a prior, or 0
    decomposition: Decomposition
    penalty: FloatArray
    mean: FloatArray  # (p,) of the linear posterior, in tolerances
    root: FloatArray  # (p, k) E
    setup_root: FloatArray  # (U, u) T
    scale: float  # s
    degrees: float  # nu
    directions: int  # K

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
        nuisance = self.linear.problem.nuisance
        mean = np.zeros((count, 0)) if nuisance is None else nuisance.prior_mean.repeat(count, 0)
        problem = resample_rows(self.linear.problem, None, None, mean)
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


def describe_density(linear: FitLinearization) -> PosteriorDensity:
    """Return the posterior of a fit by least squares or MAP, with intervals."""
    fit = linear.fit
    scale, degrees = fit.residual_test.sigma_scale, fit.residual_test.noise_degrees
    stated, penalty = linear.decomposition, linear.prior_weight
    d = stated.divided(np.array([scale]))
    finite = np.where(np.isfinite(penalty), penalty, 0.0)
    # without a prior a direction is used within the rank; with one, also beyond it
    used = np.where(np.isfinite(penalty), finite, np.inf)[None]
    variance = d.variances(used)[0]
    is_known = np.isfinite(variance)
    root = d.directions[0][:, is_known] * np.sqrt(variance[is_known])
    mean = d.deviation(d.solution(used))[0]
    setup_root, rank = np.zeros((0, 0)), 0
    nuisance = linear.linearization.nuisance
    if nuisance is not None:
        joint = scale * nuisance.elimination.joint_root()
        setup_root = joint[:, (joint != 0.0).any(axis=0)]
        rank = int(nuisance.elimination.rank[0])
    prior = None if fit.options.prior is None else fit.options.prior.added(linear.problem)
    directions = int(stated.used[0].sum()) + rank
    return PosteriorDensity(
        linear, prior, d, finite, mean, root, setup_root, scale, degrees, directions
    )


BATCH = 250  # draws that are evaluated at once; progress is reported between them
ROUNDS = 4  # proposals that are tried, at most
GOOD_SHARE = 0.2  # effective size, as a share of the draws, with which a proposal is kept
# Limits of the degrees of freedom of the proposal. As many as there are directions lose about a
# third of the draws where the posterior is normal.
SMALLEST_DEGREES, LARGEST_DEGREES = 8.0, 100.0
# Effective size below which, and shape of the tail of the weights above which, the draws do not
# represent the posterior (Vehtari et al., 2024).
FEWEST_DRAWS, LARGEST_SHAPE = 400.0, 0.7
# Effective size, in directions, to which weights are flattened before a proposal is moved.
FLATTENED = 50.0


@dataclass(frozen=True, eq=False)
class PosteriorSample(TableResult):
    """T weighted draws from the posterior of a fit.

    Attributes
    ----------
    fit : the calibration. seed : of the random numbers. rounds : proposals that were tried.
    draws : (T, p) [SI]. setup : (T, U) [SI] setup parameters that belong to them.
    weight : (T,) of sum 1. linear_weight : (T,) with which the same draws represent the linear
        posterior.
    linear_mean, linear_sd : (p,) [SI] of the linear posterior, known exactly; for Student's t the
        scale. Infinite where the data do not determine a parameter.
    degrees : degrees of freedom of the noise; infinite where it is known.
    tail_shape : of the largest weights, see `fit_tail_shape`.
    """

    fit: Identification
    seed: int
    rounds: int
    draws: FloatArray
    setup: FloatArray
    weight: FloatArray
    linear_weight: FloatArray
    linear_mean: FloatArray
    linear_sd: FloatArray
    degrees: float
    tail_shape: float

    FIELDS: ClassVar[tuple[Field, ...]] = (
        *fields(robot="fit.robot.name", seed="", draws=lambda sample: len(sample.draws)),
        *fields("effective_size", "tail_shape", "rounds", "findings"),
        Field("weight", axes="draw", unit="1"),
        Field("estimate", "draws", "draw parameter", units="fit.free_parameters.dimensions"),
    )
    LABELS: ClassVar[Mapping[str, Any]] = label_axes(parameter="fit.names")

    @property
    def effective_size(self) -> float:
        """Number of independent draws that are worth as much."""
        return effective_size(self.weight)

    def intervals(self, level: float = LEVEL) -> Intervals:
        """Return intervals between quantiles, corrected by the known linear posterior.

        A quantile is the linear one plus the difference of the two in the same draws.
        """
        weights = (self.weight, self.draws, self.linear_weight)
        quantile, drawn, error = compare_ends(self.draws, *weights, level)
        half = coverage_factor(self.degrees, level) * self.linear_sd
        linear = self.linear_mean + np.array([[-1.0], [1.0]]) * half
        change = quantile - drawn
        center = self.weight @ self.draws
        return mask_intervals(
            np.isfinite(self.linear_sd),
            self.fit.names,
            level,
            "posterior",
            center=self.linear_mean + (self.weight - self.linear_weight) @ self.draws,
            sd=np.sqrt(self.weight @ (self.draws - center) ** 2),
            **dict(zip(ENDS, (*(linear + change), *linear), strict=True)),
            shift=change / half,
            shift_error=error / half,
        )

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Whether the draws represent the posterior, whether linear intervals hold, and whether the
        fit states wider ones.
        """
        size, intervals = self.effective_size, self.intervals()
        if size < FEWEST_DRAWS or self.tail_shape > LARGEST_SHAPE:
            size_or_tail = {"size": size, "count": len(self.draws), "shape": self.tail_shape}
            return (report_finding("sampling.few-effective-draws", **size_or_tail),)
        codes = ("sampling.posterior-agrees", "sampling.posterior-differs")
        rest = report_intervals(intervals, *codes)
        known = np.isfinite(self.linear_sd)
        ratio = (self.fit.standard_deviations[known] / self.linear_sd[known]).max(initial=1.0)
        if ratio > 1.0 + OFF:
            rest.append(report_finding("sampling.stated-wider", ratio=float(ratio)))
        if self.rounds == ROUNDS and size < GOOD_SHARE * len(self.draws):
            tried = {"rounds": ROUNDS, "size": size, "count": len(self.draws)}
            rest.append(report_finding("sampling.proposals-exhausted", **tried))
        return tuple(rest)


def sample_posterior(
    fit: Identification,
    data: Measurements,
    count: int = 4000,
    *,
    seed: int = 1,
    progress: Progress = report_no_progress,
) -> PosteriorSample:
    """Draw parameters from the posterior of a fit by least squares or MAP.

    The prior is that of the fit: the tolerances of MAP, the earlier calibration, and the priors of
    setup parameters. Other parameters have a flat prior.

    Parameters
    ----------
    fit : an identification that converged. data : the measurements it was made from.
    count : number of draws. seed : of all random numbers.
    progress : receives the draws that are evaluated.

    Raises
    ------
    EstimationError : the fit did not converge, has no intervals, or was made by a method that
        states no prior; or no draw is possible.
    """
    if count < 100:
        raise EstimationError(f"{count} draws: give at least 100")
    if not fit.converged:
        raise EstimationError(report_finding("sampling.not-converged"))
    if fit.method.is_biased:
        name = type(fit.method).__name__
        raise EstimationError(report_finding("sampling.method-without-prior", method=name))
    if not fit.residual_test.intervals:
        raise EstimationError(report_finding("sampling.without-intervals"))
    density = describe_density(linearize_fit(fit, data))
    rng = np.random.default_rng(np.random.SeedSequence(seed))
    # the linear posterior with heavier tails
    degrees = float(np.clip(density.size, SMALLEST_DEGREES, LARGEST_DEGREES))
    degrees = min(degrees, density.degrees)
    proposal = _Proposal(np.zeros(density.size), np.eye(density.size), degrees)
    rounds, best = 0, None
    while rounds < ROUNDS:
        rounds += 1
        v, log_q = proposal.draw(count, rng)
        log_densities = []
        for first in range(0, len(v), BATCH):
            progress(first, len(v), "evaluating draws")
            log_densities.append(density.exact(v[first : first + BATCH]))
        progress(len(v), len(v), "evaluating draws")
        log_p = np.concatenate(log_densities)
        weight = normalize_weights(log_p - log_q)
        size = effective_size(weight)
        if best is None or size > effective_size(best[1]):
            best = (v, weight, log_q)
        if not size or size >= GOOD_SHARE * count:
            break
        proposal = proposal.moved(v, log_p - log_q)
    assert best is not None
    v, weight, log_q = best
    if not weight.any():
        raise EstimationError(report_finding("sampling.no-draw-possible", count=count))
    tolerance = fit.tolerance
    sd = np.sqrt((density.root**2).sum(axis=1))
    return PosteriorSample(
        fit=fit,
        seed=seed,
        rounds=rounds,
        draws=fit.nominal + tolerance * density.parameters(v),
        setup=density.setup(v),
        weight=weight,
        linear_weight=normalize_weights(density.approximate(v) - log_q),
        linear_mean=fit.nominal + tolerance * density.mean,
        linear_sd=np.where(np.isfinite(fit.standard_deviations), sd * tolerance, np.inf),
        degrees=density.degrees,
        tail_shape=fit_tail_shape(weight),
    )


@dataclass(frozen=True, eq=False)
class _Proposal:
    """A multivariate t distribution of coordinates v: mean (K,), root (K, K), degrees."""

    mean: FloatArray
    root: FloatArray
    degrees: float

    def draw(self, count: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Return draws (count, K) and the logarithm of their density (count,)."""
        from scipy.special import gammaln

        size, nu = len(self.mean), self.degrees
        normal = rng.standard_normal((count, size))
        scale = np.sqrt(nu / rng.chisquare(nu, count))[:, None]
        square = ((scale * normal) ** 2).sum(axis=1)
        log_q = -0.5 * (nu + size) * np.log1p(square / nu)
        constant = gammaln(0.5 * (nu + size)) - gammaln(0.5 * nu) - 0.5 * size * np.log(nu * np.pi)
        determinant = np.log(np.abs(np.diag(self.root))).sum()
        return self.mean + scale * normal @ self.root.T, log_q + constant - determinant

    def moved(self, v: FloatArray, log_weight: FloatArray) -> _Proposal:
        """Return a proposal with the mean and the covariance of weighted draws.

        Where few draws have all the weight, the weights are flattened by a power below 1, so that
        enough draws determine the covariance.
        """
        size = len(self.mean)
        needed, power = min(FLATTENED + 4.0 * size, 0.5 * len(v)), 1.0
        weight = normalize_weights(log_weight)
        while effective_size(weight) < needed and power > 1e-3:
            power *= 0.7
            weight = normalize_weights(power * log_weight)
        mean = weight @ v
        spread = (v - mean) * np.sqrt(weight)[:, None]
        rows = np.concatenate([spread, 0.1 * np.eye(size)])
        triangle = np.asarray(np.linalg.qr(rows, mode="r"))
        return _Proposal(mean, triangle.T, self.degrees)
