# SPDX-License-Identifier: Apache-2.0
"""Sample the exact posterior of one calibration by weighted draws from the linear one.

Draws come from a multivariate t distribution about the estimate with the covariance of the fit, so
that its tails are heavier than those of the posterior. Each draw gets the exact density of all rows
and priors, with the kinematics solved at it, divided by the density of the proposal (importance
sampling). Where few draws have all the weight, the proposal is moved to them, and drawn from again.
See docs/theory/resampling.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from loopcal.errors import EstimationError
from loopcal.estimate.fit_input import check_fitted_data, exclude_poses
from loopcal.estimate.fit_linearization import linearize_fit
from loopcal.estimate.inference.residual_test import LEVEL
from loopcal.estimate.methods.penalties import MAP, LeastSquares
from loopcal.estimate.result import Identification
from loopcal.findings import Finding, report_finding
from loopcal.measure import Measurements, fill_in_reading_sigma
from loopcal.presentation import TableResult
from loopcal.sampling.intervals import OFF, Intervals, compare_ends, half_widths, report_intervals
from loopcal.sampling.posterior_density import PosteriorDensity, describe_density
from loopcal.sampling.weighted_sample import effective_size, fit_tail_shape, normalize_weights
from loopcal.typing import FloatArray, Progress, report_no_progress

BATCH = 250
"""Draws that are evaluated at once; progress is reported between them."""

ROUNDS = 4
"""Proposals that are tried, at most."""

GOOD_SHARE = 0.2
"""Effective size, as a share of the draws, with which a proposal is kept."""

SMALLEST_DEGREES, LARGEST_DEGREES = 8.0, 100.0
"""Limits of the degrees of freedom of the proposal. As many as there are directions lose about a
third of the draws where the posterior is normal."""

FEWEST_DRAWS, LARGEST_SHAPE = 400.0, 0.7
"""Effective size below which, and shape of the tail of the weights above which, the draws do not
represent the posterior (Vehtari et al., 2024)."""

FLATTENED = 50.0
"""Effective size, in directions, to which weights are flattened before a proposal is moved."""


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

    @property
    def effective_size(self) -> float:
        """Number of independent draws that are worth as much."""
        return effective_size(self.weight)

    def intervals(self, level: float = LEVEL) -> Intervals:
        """Return intervals between quantiles, corrected by the known linear posterior.

        A quantile is the linear one plus the difference of the two in the same draws.
        """
        ends = compare_ends(self.draws, self.weight, self.draws, self.linear_weight, level)
        half = half_widths(level, self.degrees) * self.linear_sd
        linear = self.linear_mean + np.array([[-1.0], [1.0]]) * half
        change = ends.quantile - ends.linear
        known = np.where(np.isfinite(self.linear_sd), 1.0, np.nan)
        mean = self.linear_mean + (self.weight - self.linear_weight) @ self.draws
        return Intervals(
            names=self.fit.names,
            level=level,
            source="posterior",
            center=mean * known,
            sd=self._standard_deviations() * known,
            lower=(linear[0] + change[0]) * known,
            upper=(linear[1] + change[1]) * known,
            linear_lower=linear[0] * known,
            linear_upper=linear[1] * known,
            shift=change / half * known,
            shift_error=ends.error / half * known,
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
        rest = [*report_intervals(intervals, *codes), *self._report_wider()]
        if self.rounds == ROUNDS and size < GOOD_SHARE * len(self.draws):
            tried = {"rounds": ROUNDS, "size": size, "count": len(self.draws)}
            rest.append(report_finding("sampling.proposals-exhausted", **tried))
        return tuple(rest)

    def _report_wider(self) -> list[Finding]:
        """Return whether stated intervals allow for more than the posterior contains."""
        known = np.isfinite(self.linear_sd)
        ratio = (self.fit.standard_deviations[known] / self.linear_sd[known]).max(initial=1.0)
        if ratio <= 1.0 + OFF:
            return []
        return [report_finding("sampling.stated-wider", ratio=float(ratio))]

    def to_dict(self) -> dict[str, Any]:
        """Return what was drawn and what was found, for JSON."""
        return {
            "robot": self.fit.robot.name,
            "seed": self.seed,
            "draws": len(self.draws),
            "effective_size": self.effective_size,
            "tail_shape": self.tail_shape,
            "rounds": self.rounds,
            "findings": self.findings,
        }

    def _standard_deviations(self) -> FloatArray:
        """Return standard deviations (p,) of the weighted draws."""
        mean = self.weight @ self.draws
        return np.asarray(np.sqrt(self.weight @ (self.draws - mean) ** 2))


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
    check_fitted_data(fit, data)
    if count < 100:
        raise EstimationError(f"{count} draws: give at least 100")
    if not fit.converged:
        raise EstimationError(report_finding("sampling.not-converged"))
    if not isinstance(fit.method, MAP | LeastSquares):
        name = type(fit.method).__name__
        raise EstimationError(report_finding("sampling.method-without-prior", method=name))
    if not fit.residual_test.intervals:
        raise EstimationError(report_finding("sampling.without-intervals"))
    data = exclude_poses(fill_in_reading_sigma(fit.robot, data), fit.options.excluded_poses)
    density = describe_density(fit, linearize_fit(fit, data))
    rng = np.random.default_rng(np.random.SeedSequence(seed))
    proposal = _Proposal.of(density)
    rounds, best = 0, None
    while rounds < ROUNDS:
        rounds += 1
        v, log_q = proposal.draw(count, rng)
        log_p = _evaluate(density, v, progress)
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


def _evaluate(density: PosteriorDensity, v: FloatArray, progress: Progress) -> FloatArray:
    """Return log p (T,) of draws v (T, k + u)."""
    log_densities = []
    for first in range(0, len(v), BATCH):
        progress(first, len(v), "evaluating draws")
        log_densities.append(density.exact(v[first : first + BATCH]))
    progress(len(v), len(v), "evaluating draws")
    return np.concatenate(log_densities)


@dataclass(frozen=True, eq=False)
class _Proposal:
    """A multivariate t distribution of coordinates v: mean (K,), root (K, K), degrees."""

    mean: FloatArray
    root: FloatArray
    degrees: float

    @classmethod
    def of(cls, density: PosteriorDensity) -> _Proposal:
        """Return the linear posterior with heavier tails."""
        size = density.size
        degrees = float(np.clip(size, SMALLEST_DEGREES, LARGEST_DEGREES))
        return cls(np.zeros(size), np.eye(size), min(degrees, density.degrees))

    def draw(self, count: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Return draws (count, K) and the logarithm of their density (count,)."""
        from loopcal.numerics.special_functions import gammaln

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
