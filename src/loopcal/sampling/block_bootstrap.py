# SPDX-License-Identifier: Apache-2.0
"""The block bootstrap of one calibration: the scatter of its estimates over resampled data.

Blocks of poses that may share an error are resampled together. In the world of the bootstrap the
estimate is the truth, and each of the t resamples is fitted as the data were, by the same method,
nonlinearly, with setup parameters and poses of uncertain readings. Priors are observations whose
errors are drawn from their stated distributions.

    wild     errors of a block, corrected for leverage, times one random number (default)
    pairs    blocks are drawn with replacement: multinomial weights
    normal   independent normal errors of the stated sigmas (Monte Carlo, JCGM 101)

See docs/theory/resampling.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from loopcal.diagnose.fit_checks.independent_units import Clusters
from loopcal.errors import EstimationError
from loopcal.estimate.fit_input import check_fitted_data, exclude_poses
from loopcal.estimate.fit_linearization import FitLinearization, linearize_fit
from loopcal.estimate.inference.residual_test import LEVEL
from loopcal.estimate.methods.penalties import MAP, LeastSquares
from loopcal.estimate.resampling import Resamples, draw_centers, fit_resamples, join_fits
from loopcal.estimate.result import Identification
from loopcal.findings import Finding, report_finding
from loopcal.measure import Measurements, fill_in_reading_sigma
from loopcal.presentation import TableResult
from loopcal.sampling.block_errors import compute_block_errors
from loopcal.sampling.block_scatter import BlockScatter, describe_scatter
from loopcal.sampling.blocks import choose_blocks
from loopcal.sampling.intervals import Intervals, compare_ends, half_widths, report_intervals
from loopcal.typing import BoolArray, FloatArray, IntArray, Progress, report_no_progress

Scheme = Literal["wild", "pairs", "normal"]
"""How resamples are drawn."""

IntervalKind = Literal["widened", "percentile", "bias-corrected", "studentized"]
"""How intervals are read from the resamples, see `Bootstrap.intervals`."""

MOST_FAILED = 0.02
"""Share of resamples that do not converge above which it is reported."""

BATCH = 250
"""Resamples that are fitted at once; progress is reported between them."""

FEW_BLOCKS = 12
"""Number of blocks below which the random factor of the wild bootstrap has six values instead of
two, so that there are enough different resamples (Webb, 2023).
"""

WEBB = np.sqrt([0.5, 1.0, 1.5])
"""Sizes of the six values +/-."""


@dataclass(frozen=True, eq=False)
class Bootstrap(TableResult):
    """Estimates of T resamples of one calibration. Arrays over parameters are (p,) as in the fit.

    Attributes
    ----------
    fit : the calibration. scheme : "wild", "pairs" or "normal". seed : of the random numbers.
    blocks : what was resampled together.
    draws : (T, p) [SI] estimates of the resamples that converged.
    linear : (T, p) [SI] the same to first order about the estimate.
    sd : (T, p) [SI] standard deviations that each resample states by its own residuals; NaN without
        degrees of freedom.
    failed : number of resamples that did not converge; they are left out.
    scatter : the scatter of the blocks' errors against the stated uncertainty.
    """

    fit: Identification
    scheme: Scheme
    seed: int
    blocks: Clusters
    draws: FloatArray
    linear: FloatArray
    sd: FloatArray
    failed: int
    scatter: BlockScatter

    def __repr__(self) -> str:
        """Return scheme, blocks and number of resamples."""
        blocks = f"{self.blocks.count} {self.blocks.unit}s"
        return f"<Bootstrap: {len(self.draws)} resamples of {blocks}, scheme {self.scheme}>"

    @property
    def is_known(self) -> BoolArray:
        """(p,) parameters whose standard deviation the fit states."""
        return np.isfinite(self.fit.standard_deviations)

    @property
    def standard_deviations(self) -> FloatArray:
        """(p,) of the resamples [SI]; infinite where the data determine no parameter."""
        return np.where(self.is_known, self.draws.std(axis=0, ddof=1), np.inf)

    def intervals(self, level: float = LEVEL, kind: IntervalKind = "widened") -> Intervals:
        """Return intervals of the parameters.

        Parameters
        ----------
        level : coverage of each. kind : "percentile": between quantiles of the resamples.
            "widened" (default): the same, its ends moved away from the estimate by t(nu) / 1.96,
            because the scatter was estimated from few blocks (nu: see `BlockScatter`).
            "bias-corrected": quantiles shifted by the share of resamples below the estimate (Efron,
            1981). "studentized": quantiles of (resample - estimate) / sd, each with its own noise.
        """
        if kind not in get_args(IntervalKind):
            words = ", ".join(get_args(IntervalKind))
            raise EstimationError(f"kind of interval is {kind!r}; it must be one of {words}")
        estimate, weight = self.fit.estimate, np.full(len(self.draws), 1.0 / len(self.draws))
        ends = compare_ends(self.draws, weight, self.linear, weight, level)
        known = np.where(self.is_known, 1.0, np.nan)
        half = 0.5 * (ends.linear[1] - ends.linear[0])
        with np.errstate(divide="ignore", invalid="ignore"):
            shift, error = (ends.quantile - ends.linear) / half, ends.error / half
        lower, upper = self._ends(kind, level, ends.quantile)
        degrees = self.scatter.degrees if self.scheme != "normal" else np.inf
        widen = half_widths(level, degrees) / half_widths(level)
        linear = estimate + (ends.linear - estimate) * (widen if kind == "widened" else 1.0)
        return Intervals(
            names=self.fit.names,
            level=level,
            source=f"{self.scheme} bootstrap, {kind}",
            center=self.draws.mean(axis=0) * known,
            sd=self.draws.std(axis=0, ddof=1) * known,
            lower=lower * known,
            upper=upper * known,
            linear_lower=linear[0] * known,
            linear_upper=linear[1] * known,
            shift=shift * known,
            shift_error=error * known,
        )

    @property
    def findings(self) -> tuple[Finding, ...]:
        """How many resamples failed, and whether the stated intervals agree with the scatter."""
        total = len(self.draws) + self.failed
        findings = []
        if self.failed > MOST_FAILED * total:
            findings.append(report_finding("sampling.failures", failed=self.failed, count=total))
        codes = ("sampling.bootstrap-agrees", "sampling.bootstrap-differs")
        findings += report_intervals(self.intervals(kind="percentile"), *codes)
        if not isinstance(self.fit.method, MAP | LeastSquares):
            name = type(self.fit.method).__name__
            findings.append(report_finding("sampling.bias-not-drawn", method=name))
        if self.scheme == "normal" or not isinstance(self.fit.method, MAP | LeastSquares):
            return tuple(findings)
        stated = np.where(self.is_known, self.fit.standard_deviations, np.nan)
        ratio = self.standard_deviations / stated
        return (*findings, self.scatter.report(self.fit.names, ratio, self.blocks))

    def to_dict(self) -> dict[str, Any]:
        """Return what was drawn and what was found, for JSON."""
        return {
            "robot": self.fit.robot.name,
            "scheme": self.scheme,
            "seed": self.seed,
            "unit": self.blocks.unit,
            "blocks": self.blocks.count,
            "resamples": len(self.draws),
            "failed": self.failed,
            "degrees": self.scatter.degrees,
            "findings": self.findings,
        }

    def _ends(
        self, kind: IntervalKind, level: float, quantile: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the ends (p,) of intervals; `quantile` (2, p) are those of the resamples."""
        estimate, tails = self.fit.estimate, np.array([0.5 - 0.5 * level, 0.5 + 0.5 * level])
        if kind == "percentile" or (kind == "widened" and self.scheme == "normal"):
            return quantile[0], quantile[1]
        if kind == "widened":
            factor = half_widths(level, self.scatter.degrees) / half_widths(level)
            return tuple(estimate + (quantile - estimate) * factor)
        if kind == "studentized":
            ratio = (self.draws - estimate) / self.sd
            q = np.quantile(ratio, tails, axis=0)
            own = self.scatter.noise * self.scatter.unit_sd
            return estimate - q[1] * own, estimate - q[0] * own
        return self._bias_corrected(tails)

    def _bias_corrected(self, tails: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return quantiles (p,) shifted by the share of resamples below the estimate."""
        from loopcal.numerics.special_functions import ndtr, ndtri

        share = (self.draws < self.fit.estimate).mean(axis=0)
        least = 0.5 / len(self.draws)
        z = 2.0 * ndtri(np.clip(share, least, 1.0 - least)) + ndtri(tails)[:, None]
        columns = range(self.draws.shape[1])
        probabilities = ndtr(z)
        ends = [
            [np.quantile(self.draws[:, j], probabilities[i, j]) for j in columns] for i in (0, 1)
        ]
        return np.array(ends[0]), np.array(ends[1])


def bootstrap(
    fit: Identification,
    data: Measurements,
    count: int = 1000,
    *,
    scheme: Scheme = "wild",
    unit: str | int | None = None,
    seed: int = 1,
    progress: Progress = report_no_progress,
) -> Bootstrap:
    """Resample a calibration by blocks.

    Parameters
    ----------
    fit : an identification that converged. data : the measurements it was made from.
    count : number of resamples. scheme : see the module.
    unit : what is resampled together: "pose", "block", "session", "day", or a number of
        consecutive poses; None takes the largest unit of which there are enough, see
        `choose_blocks`.
    seed : of all random numbers. progress : receives the resamples that are done.

    Raises
    ------
    EstimationError : the fit did not converge, the data have no such unit, or fewer than two
        resamples converged.
    """
    check_fitted_data(fit, data)
    if scheme not in get_args(Scheme):
        raise EstimationError(f"scheme is {scheme!r}; it must be wild, pairs or normal")
    if count < 2:
        raise EstimationError(f"{count} resamples: give at least 2")
    if not fit.converged:
        raise EstimationError(report_finding("sampling.not-converged"))
    if not np.isfinite(fit.standard_deviations).any():
        raise EstimationError(report_finding("sampling.without-intervals"))
    if scheme == "pairs" and isinstance(fit.method, MAP) and callable(fit.method.inflation):
        raise EstimationError(report_finding("sampling.pairs-with-rule"))
    data = exclude_poses(fill_in_reading_sigma(fit.robot, data), fit.options.excluded_poses)
    blocks, linear = choose_blocks(data, unit), linearize_fit(fit, data)
    draw = _Draw(fit, linear, blocks, scheme, np.random.default_rng(np.random.SeedSequence(seed)))
    batches = []
    for first in range(0, count, BATCH):
        progress(first, count, "fitting resamples")
        batches.append(fit_resamples(fit, linear, draw(min(BATCH, count - first))))
    progress(count, count, "fitting resamples")
    fits = join_fits(batches)
    kept = fits.take(np.flatnonzero(fits.converged))
    if len(kept.deviation) < 2:
        raise EstimationError(report_finding("sampling.resamples-failed", count=count))
    nominal, unit_of = fit.nominal, fit.tolerance
    noise = np.sqrt(kept.noise)[:, None]
    return Bootstrap(
        fit=fit,
        scheme=scheme,
        seed=seed,
        blocks=blocks,
        draws=nominal + unit_of * kept.deviation,
        linear=nominal + unit_of * kept.linear,
        sd=unit_of * kept.sd * noise,
        failed=count - len(kept.deviation),
        scatter=describe_scatter(fit, blocks, linear),
    )


class _Draw:
    """Draws resamples of the rows of a fit."""

    def __init__(
        self,
        fit: Identification,
        linear: FitLinearization,
        blocks: Clusters,
        scheme: Scheme,
        rng: np.random.Generator,
    ) -> None:
        self.fit, self.linear, self.blocks = fit, linear, blocks
        self.scheme, self.rng = scheme, rng
        self.is_prior = isinstance(fit.method, MAP)
        self.errors = None
        if scheme != "pairs":
            self.errors = compute_block_errors(linear, blocks, self._shift_truth())

    def __call__(self, count: int) -> Resamples:
        """Draw `count` resamples."""
        G, sigma = self.blocks.count, self.fit.residual_test.sigma_scale
        base = int(self.linear.linearization.equations[0])
        equations = np.full(count, base)
        weight, offset = None, None
        if self.errors is None:
            drawn = self.rng.multinomial(G, np.full(G, 1.0 / G), count)
            weight = drawn[:, self.blocks.member].astype(np.float64)
            equations = equations + (drawn - 1) @ self._count_rows()
        elif self.scheme == "normal":
            offset = self.errors.draw_normal(count, sigma, self.rng)
        else:
            offset = self.errors.draw(self._draw_factors(count), sigma, self.rng)
        center, prior, nuisance = self._draw_priors(count)
        return Resamples(weight, offset, center, prior, nuisance, equations)

    def _shift_truth(self) -> FloatArray:
        """Return the step (p,) from the estimate to the truth of the resamples.

        The penalty of a ridge or a truncation is no observation and stays as it is. Then the truth
        is the least-squares solution, so that the resamples scatter about the estimate.
        """
        d, z = self.linear.decomposition, self.linear.linearization.deviation
        if self.is_prior:
            return np.zeros(z.shape[1])
        unpenalized = np.where(d.used, 0.0, np.inf)
        return (d.deviation(d.solution(unpenalized)) - z)[0]

    def _draw_factors(self, count: int) -> FloatArray:
        """Return random factors (count, G) of mean 0 and variance 1."""
        sign = self.rng.choice([-1.0, 1.0], (count, self.blocks.count))
        if self.blocks.count >= FEW_BLOCKS:
            return sign
        return sign * self.rng.choice(WEBB, sign.shape)

    def _draw_priors(self, count: int) -> tuple[FloatArray, FloatArray | None, FloatArray]:
        """Return drawn centers of the tolerances, errors of the rows of an earlier calibration, and
        means of the priors of nuisance parameters.

        They scatter about the truth of the resamples where errors of rows are drawn, and about the
        given values where the residuals keep their bias.
        """
        linear, fit, rng = self.linear, self.fit, self.rng
        is_recentered = self.errors is not None
        z, nuisance = linear.linearization.deviation, linear.problem.nuisance
        center = np.zeros((count, z.shape[1]))
        if self.is_prior:
            center = draw_centers(linear, count, rng) + (z if is_recentered else 0.0)
        prior = None
        if fit.options.prior is not None:
            rows = fit.options.prior.added(linear.problem)
            at_estimate = rows.residuals(z) if is_recentered else 0.0
            prior = rng.standard_normal((count, rows.constant.shape[1])) - at_estimate
        if nuisance is None:
            return center, prior, np.zeros((count, 0))
        has_prior, table = nuisance.has_prior, nuisance.local.table
        sd = np.where(has_prior, np.nan_to_num(table.tolerance), 0.0)
        mean = fit.nuisance.estimate if is_recentered else table.nominal
        return center, prior, mean + sd * rng.standard_normal((count, len(sd)))

    def _count_rows(self) -> IntArray:
        """Return the number (G,) of present residuals of each block."""
        total = np.zeros(self.blocks.count, dtype=np.int64)
        for rows in self.linear.problem.rows:
            present = rows.is_present[0].sum(axis=1)
            owner = self.blocks.member[rows.first_poses]
            total += np.bincount(owner, present, self.blocks.count).astype(np.int64)
        return total
