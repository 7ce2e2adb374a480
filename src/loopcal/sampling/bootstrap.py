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
from loopcal.estimate.methods.penalties import MAP
from loopcal.estimate.resampling import (
    ResampleFits,
    Resamples,
    draw_centers,
    fit_resamples,
    join_fits,
)
from loopcal.estimate.result import Identification
from loopcal.findings import report_finding
from loopcal.measure import Measurements, fill_in_reading_sigma
from loopcal.sampling.block_errors import compute_block_errors
from loopcal.sampling.blocks import choose_blocks
from loopcal.typing import BoolArray, FloatArray, Progress, report_no_progress

Scheme = Literal["wild", "pairs", "normal"]
"""How resamples are drawn."""

BATCH = 250
"""Resamples that are fitted at once; progress is reported between them."""

FEW_BLOCKS = 12
"""Number of blocks below which the random factor of the wild bootstrap has six values instead of
two, so that there are enough different resamples (Webb, 2023).
"""

WEBB = np.sqrt([0.5, 1.0, 1.5])
"""Sizes of the six values +/-."""


@dataclass(frozen=True, eq=False)
class Bootstrap:
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
    """

    fit: Identification
    scheme: Scheme
    seed: int
    blocks: Clusters
    draws: FloatArray
    linear: FloatArray
    sd: FloatArray
    failed: int


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
    data = exclude_poses(fill_in_reading_sigma(fit.robot, data), fit.options.excluded_poses)
    blocks, linear = choose_blocks(data, unit), linearize_fit(fit, data)
    draw = _Draw(fit, linear, blocks, scheme, np.random.default_rng(np.random.SeedSequence(seed)))
    parts = []
    for first in range(0, count, BATCH):
        progress(first, count, "fitting resamples")
        parts.append(fit_resamples(fit, linear, draw(min(BATCH, count - first))))
    progress(count, count, "fitting resamples")
    fits = join_fits(parts)
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
        self.errors = None if scheme == "pairs" else compute_block_errors(linear, blocks)

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

    def _draw_factors(self, count: int) -> FloatArray:
        """Return random factors (count, G) of mean 0 and variance 1."""
        sign = self.rng.choice([-1.0, 1.0], (count, self.blocks.count))
        if self.blocks.count >= FEW_BLOCKS:
            return sign
        return sign * self.rng.choice(WEBB, sign.shape)

    def _draw_priors(self, count: int) -> tuple[FloatArray, FloatArray | None, FloatArray]:
        """Return drawn centers of the tolerances, errors of the rows of an earlier calibration, and
        means of the priors of nuisance parameters.

        They scatter about the truth: the estimate where errors of rows are drawn, and the
        unknown one, whose best guess is nominal, where the residuals keep their bias.
        """
        linear, fit, rng = self.linear, self.fit, self.rng
        is_recentered = self.errors is not None
        z, nuisance = linear.linearization.deviation, linear.problem.nuisance
        center = np.repeat(z if is_recentered else np.zeros_like(z), count, axis=0)
        if isinstance(fit.method, MAP):
            center = center + draw_centers(linear, count, rng)
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

    def _count_rows(self) -> FloatArray:
        """Return the number (G,) of present residuals of each block."""
        total = np.zeros(self.blocks.count, dtype=np.int64)
        for rows in self.linear.problem.rows:
            present = rows.is_present[0].sum(axis=1)
            owner = self.blocks.member[rows.first_poses]
            total += np.bincount(owner, present, self.blocks.count).astype(np.int64)
        return total
