# SPDX-License-Identifier: Apache-2.0
"""Test the residuals of a fit against the noise (chi-square), and estimate the noise.

The test takes what no parameter can explain: the part of the rows outside the range of the
parameters. No penalty and no prior enters it, so that wrong spreads are not reported as noise.

A stated sigma is taken as known to within a relative standard uncertainty u. That is knowledge of
nu0 = 1 / (2 u^2) degrees of freedom (JCGM 100, equation G.3), to which the residuals add their own:

    s^2 = (nu0 + unexplained) / (nu0 + degrees)        with nu0 + degrees degrees of freedom

u = 0 takes sigma as exact (s = 1); an estimated noise has nu0 = 0. The test allows for the same u:
unexplained / degrees is distributed like F(degrees, nu0) where the stated sigma is right within its
uncertainty. Only what this rejects contradicts the stated noise.

Residuals that are larger or smaller than an exact sigma explains show the noise better than the
statement does: then s is that of the residuals alone. An exact sigma is replaced by a larger one
only, and none by residuals without noise, such as those of computed values, or by residuals with
fewer than FEWEST_DEGREES degrees of freedom. See docs/theory/uncertainty.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from loopcal.findings import Finding, Severity, report_finding
from loopcal.numerics.decomposition import Decomposition
from loopcal.numerics.statistics import (
    compute_chi_square_tail,
    compute_f_tail,
    normal_quantile,
    student_quantile,
)
from loopcal.typing import FloatArray

FALSE_ALARMS: Mapping[str, float] = {
    "noise": 0.002,  # residuals too large, and too small, for the stated sigma
    "doubtful noise": 0.004,  # the same where few degrees of freedom are left
    "tolerances": 0.003,
    "tolerance components": 0.009,  # as measured; they are chosen by odds, see `PRIOR_ODDS`
    "outliers": 0.01,
    "causes of residuals": 0.009,  # as measured; chosen by odds, see `error_causes.EXCLUDED`
    "correlation of neighbors": 0.002,
    "model discrepancy": 0.004,
    "motion of frames": 0.002,
    "heavy tails": 0.001,
    "held-out rows": 0.001,
}
"""Probability that each test of a calibration rejects where every assumption holds. Together they
are below 5 %, and `compute_single_level` divides each one among the tests of its kind.
"""


FEWEST_DEGREES = 5
"""Degrees of freedom below which an estimated noise is too uncertain to weigh data against
tolerances: with 4 its own standard deviation is 35 %. Intervals account for it by Student's t.
"""

LEVEL = 0.95
"""Coverage of the intervals called +/-."""

SIGNIFICANCE = 0.5 * FALSE_ALARMS["noise"]
"""Probability below which a test rejects: residuals that do not agree with the noise, tolerances
that do not agree with the data.
"""

DOUBT = FALSE_ALARMS["doubtful noise"]
"""Probability below which a test does not accept either."""

NOTABLE = 0.05
"""Probability below which residuals that an exact sigma does not explain are notable, although the
uncertainty of sigma allows them.
"""

NO_NOISE = 1e-3
"""Share of the stated noise up to which residuals (rms) are no noise, but computed values."""

SIGMA_UNCERTAINTY = 0.25
"""Relative standard uncertainty of the stated sigmas, where nothing else is said: the reliability
of the example in JCGM 100, G.4.2.
"""

ASSUMED_UNCERTAINTY = 0.5
"""The same for sigmas that nobody stated, and that a program assumed."""


@dataclass(frozen=True)
class ResidualTest:
    """The residuals of a fit against the noise.

    chi_square : whitened sum of squares of the rows outside the range of the parameters; like the
        other numbers NaN where the iteration did not converge, because it then belongs to no fit.
        Where a loss chose the weights: of all weighted residuals.
    degrees : its degrees of freedom, equations minus rank.
    p_value : probability of a larger chi_square, sigmas being as uncertain as stated; NaN where
        nothing can be tested. Where errors other than noise explain it, that of what they leave.
    dof : equations minus the number of parameters that the method effectively uses.
    noise : "given", "estimated", or "assumed" where nobody stated it.
    sigma_scale : factor s on the stated sigmas; 1 where they are exact and not contradicted.
    noise_degrees : degrees of freedom of s; infinite where the stated sigmas are exact.
    intervals : whether intervals are given at all.
    stated_degrees : nu0 of the stated sigmas: infinite if they are exact, 0 if noise is estimated.
    converged, weighted : whether the iteration converged, and whether a loss chose the weights.
    """

    chi_square: float
    degrees: float
    p_value: float
    dof: float
    noise: str
    sigma_scale: float
    noise_degrees: float
    stated_degrees: float
    intervals: bool
    converged: bool = True
    weighted: bool = False

    def explain(self, left: float) -> ResidualTest:
        """Return the test where other errors than noise leave this of chi_square, if the residuals
        exceed the noise, and what is left does not.
        """
        p_value = float(compute_f_tail(self.degrees, self.stated_degrees, left / self.degrees))
        return replace(self, p_value=p_value) if self.failed and p_value >= SIGNIFICANCE else self

    @property
    def exact_p_value(self) -> float:
        """Probability of a larger chi_square if the stated sigmas were exact; NaN as `p_value`."""
        tested = np.isfinite(self.p_value)
        return float(compute_chi_square_tail(self.degrees, self.chi_square)) if tested else np.nan

    @property
    def failed(self) -> bool:
        """Whether the residuals exceed the stated noise beyond its uncertainty."""
        return self.noise == "given" and self.p_value < SIGNIFICANCE

    @property
    def exceeds_sigma(self) -> bool:
        """Whether the residuals exceed the stated noise, were it exact."""
        return self.noise == "given" and self.exact_p_value < SIGNIFICANCE

    @property
    def is_notable(self) -> bool:
        """Whether an exact sigma does not explain the residuals, and an uncertain one hardly."""
        return self.exact_p_value < DOUBT and self.p_value < NOTABLE

    @property
    def is_doubtful(self) -> bool:
        """Whether the residuals exceed the stated noise, and have too few degrees of freedom to
        find out whether noise or the model is the cause.
        """
        return self.degrees < FEWEST_DEGREES and self.is_notable

    @property
    def sigma_degrees(self) -> float:
        """Degrees of freedom of s by the stated sigmas: nu0, or 0 where residuals contradict."""
        return self.noise_degrees if self.weighted else self.noise_degrees - max(self.degrees, 0.0)

    @property
    def finding(self) -> Finding:
        """The result of the test."""
        if not self.converged:
            return report_finding("noise.not-tested")
        if self.noise == "estimated":
            return self._estimated
        if self.weighted:
            return report_finding("noise.weighted")
        if self.degrees < 0.5:
            return report_finding("noise.no-degrees-of-freedom")
        code = "noise.consistent"
        each = self.chi_square / self.degrees
        if self.p_value < SIGNIFICANCE:
            code = "noise.residuals-too-large"
        elif compute_f_tail(self.degrees, self.stated_degrees, each) < SIGNIFICANCE:
            code = "noise.explained"
        elif self.is_notable:
            code = "noise.doubtful"
        elif self.exact_p_value > 1.0 - SIGNIFICANCE and self.p_value > 1.0 - NOTABLE:
            code = "noise.residuals-too-small"
        ratio = float(np.sqrt(each))
        return report_finding(
            code,
            ratio=ratio,
            degrees=self.degrees,
            p_value=self.p_value,
            scale=self.sigma_scale,
            noise_degrees=self.noise_degrees,
            uncertainty=float(np.sqrt(0.5 / self.stated_degrees)),
        )

    @property
    def _estimated(self) -> Finding:
        """The result where the noise is estimated."""
        if not self.intervals:
            return report_finding("noise.not-estimated")
        data: dict[str, Any] = {"scale": self.sigma_scale, "dof": self.noise_degrees}
        if self.noise_degrees < FEWEST_DEGREES:
            factor = coverage_factor(self.noise_degrees)
            return report_finding("noise.few-degrees", factor=float(factor), **data)
        return report_finding("noise.estimated", **data)


@dataclass(frozen=True)
class NoiseKnowledge:
    """What a calibration knows of the noise of measurements: the factor on the stated sigmas, and
    its degrees of freedom.
    """

    scale: float = 1.0
    degrees: float = 0.5 / SIGMA_UNCERTAINTY**2

    @property
    def known_degrees(self) -> float:
        """The degrees of freedom; infinite where they are NaN, as infinity is no number of JSON."""
        return np.inf if np.isnan(self.degrees) else self.degrees

    @classmethod
    def of(cls, test: ResidualTest) -> NoiseKnowledge:
        """Return what the residuals of a fit show; sigma as stated where they show nothing, or are
        larger than noise can be.
        """
        numbers = (test.sigma_scale, test.noise_degrees, test.stated_degrees)
        return cls._choose(*numbers, has_failed=test.failed)

    @classmethod
    def restore(cls, fit: Mapping[str, Any]) -> NoiseKnowledge:
        """Return the same from the `fit` of a stored result; sigma as stated where it did not
        converge.
        """
        scale, p_value = fit["sigma_scale"], fit["p_value"]
        if scale is None:
            return SIGMA_AS_STATED
        stated = count_sigma_degrees(fit["noise"], fit["sigma_uncertainty"])
        has_failed = fit["noise"] == "given" and p_value is not None and p_value < SIGNIFICANCE
        degrees = fit["noise_degrees"]
        degrees = np.inf if degrees is None else degrees
        return cls._choose(scale, degrees, stated, has_failed=has_failed)

    @classmethod
    def _choose(
        cls, scale: float, degrees: float, stated_degrees: float, *, has_failed: bool
    ) -> NoiseKnowledge:
        if has_failed:
            return cls(degrees=stated_degrees)
        return cls(scale, degrees) if scale > 0.0 and degrees > 0.0 else SIGMA_AS_STATED


SIGMA_AS_STATED = NoiseKnowledge()
"""What is known where no fit has shown anything."""


def choose_severity(p_value: float) -> Severity:
    """Return how much an effect counts that a test found: it is a warning where chance hardly ever
    shows it, else information.
    """
    return Severity.WARNING if p_value < SIGNIFICANCE else Severity.INFO


def run_residual_test(
    decomposition: Decomposition,
    penalty: FloatArray,
    noise: str,
    sigma_uncertainty: float = SIGMA_UNCERTAINTY,
    weighted: bool = False,
    converged: bool = True,
) -> ResidualTest:
    """Test the residuals of a fit (t = 1).

    With assumed noise the test is a note. Where a loss chose the weights by the residuals, the sum
    of squares has no known distribution; elsewhere than at the minimum there are neither tests nor
    intervals.
    """
    if not converged:
        nan = np.nan
        return ResidualTest(nan, nan, nan, nan, noise, 1.0, nan, nan, False, False, weighted)
    left = float(decomposition.unexplained[0])
    m, degrees = float(decomposition.rows[0]), float((decomposition.rows - decomposition.rank)[0])
    dof = m - float(decomposition.filter_factors(penalty).sum())
    square, exact, p_value = left, np.nan, np.nan
    stated = count_sigma_degrees(noise, sigma_uncertainty)
    if weighted:
        square = float(decomposition.remaining(penalty)[0])
    elif noise != "estimated" and degrees > 0:
        exact = float(compute_chi_square_tail(degrees, left))
        p_value = float(compute_f_tail(degrees, stated, left / degrees))
    scale, nu = _estimate_scale(left, degrees, exact, stated, weighted)
    return ResidualTest(
        square, degrees, p_value, dof, noise, scale, nu, stated, nu > 0.0, True, weighted
    )


def _estimate_scale(
    unexplained: float, degrees: float, p_value: float, stated: float, weighted: bool
) -> tuple[float, float]:
    """Return the factor on the stated sigmas, and its degrees of freedom; see the module.

    p_value : of a larger `unexplained`, if the stated sigmas were exact. stated : nu0.
    """
    is_noise = degrees > 0 and unexplained > NO_NOISE**2 * degrees
    is_enough = is_noise and degrees >= FEWEST_DEGREES  # fewer are small by chance
    is_too_large = p_value > 1.0 - SIGNIFICANCE and np.isfinite(stated) and is_enough
    if stated == 0.0 or p_value < SIGNIFICANCE or is_too_large:
        return (float(np.sqrt(unexplained / degrees)), degrees) if degrees > 0 else (np.nan, 0.0)
    if weighted or degrees <= 0 or np.isinf(stated):
        return 1.0, stated
    total = stated + degrees
    if not is_noise:
        return 1.0, total
    return float(np.sqrt((stated + unexplained) / total)), total


def count_sigma_degrees(noise: str, uncertainty: float) -> float:
    """Return nu0, the degrees of freedom that the stated sigmas count for with this relative
    standard uncertainty: infinite where they are exact, 0 where the noise is estimated.
    """
    if noise == "estimated":
        return 0.0
    if uncertainty == 0.0:
        return np.inf
    u = max(uncertainty, ASSUMED_UNCERTAINTY) if noise == "assumed" else uncertainty
    return 0.5 / u / u  # the square of a tiny one is zero


def coverage_factor(degrees: FloatArray | float, level: float = LEVEL) -> FloatArray:
    """Return half-widths (..,) of intervals of this coverage, in standard deviations.

    They are those of Student's t, and of the normal distribution for infinite degrees of freedom.
    """
    quantile = 0.5 + 0.5 * level
    degrees = np.asarray(degrees, dtype=np.float64)
    is_known = np.isinf(degrees)
    student = student_quantile(np.where(is_known, 1.0, degrees), quantile)
    return np.asarray(np.where(is_known, normal_quantile(quantile), student))
