# SPDX-License-Identifier: Apache-2.0
"""Test the residuals of a fit against the noise (chi-square), and scale its intervals.

Intervals use the normal distribution where the noise is given, and Student's t where it is
estimated.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from loopcal.findings import Finding, report_finding
from loopcal.numerics.chi_square import compute_chi_square_tail
from loopcal.numerics.decomposition import Decomposition
from loopcal.typing import FloatArray

FEWEST_DEGREES = 5
"""Degrees of freedom below which an estimated noise is too uncertain for intervals: with 4 its own
standard deviation is 35 %.
"""

LEVEL = 0.95
"""Coverage of the intervals called +/-."""

SIGNIFICANCE = 1e-3
"""Probability below which a test rejects: residuals that do not agree with the noise, tolerances
that do not agree with the data.
"""

DOUBT = 1e-2
"""Probability below which a test does not accept either."""


class SquareTest(NamedTuple):
    """A sum of squares, its degrees of freedom, and the probability of a larger one."""

    square: float
    degrees: float
    p_value: float


@dataclass(frozen=True)
class ResidualTest:
    """The residuals of a fit against the noise.

    Attributes
    ----------
    chi_square : whitened sum of squares, with the penalty of a prior; like the other numbers NaN
        where the iteration did not converge, because it then belongs to no fit.
    degrees : degrees of freedom of chi_square if model, noise and prior are right.
    p_value : probability of a larger chi_square; NaN where nothing can be tested.
    dof : equations minus the number of parameters that the method effectively uses.
    noise : "given", "estimated", or "assumed" where nobody stated it.
    sigma_scale : factor on the stated sigmas. With given noise it is 1, unless the test rejects the
        residuals: then the intervals are wider by this factor.
    intervals : whether intervals are given at all.
    converged, weighted : whether the iteration converged, and whether a loss chose the weights.
    residuals : the test of the residuals alone, where the penalty is no prior but a ridge: with it,
        `chi_square` has no chi-square distribution. None elsewhere.
    """

    chi_square: float
    degrees: float
    p_value: float
    dof: float
    noise: str
    sigma_scale: float
    intervals: bool
    converged: bool = True
    weighted: bool = False
    residuals: SquareTest | None = None

    @property
    def decisive(self) -> SquareTest:
        """The test that decides: that of the residuals alone, or with the prior."""
        return self.residuals or SquareTest(self.chi_square, self.degrees, self.p_value)

    @property
    def failed(self) -> bool:
        """Whether the residuals exceed the stated noise beyond doubt."""
        return self.noise == "given" and self.decisive.p_value < SIGNIFICANCE

    @property
    def noise_degrees(self) -> float:
        """Degrees of freedom of the noise variance in the intervals; infinite where it is known."""
        return self.dof if self.noise == "estimated" and self.intervals else np.inf

    @property
    def finding(self) -> Finding:
        """The result of the test."""
        if not self.converged:
            return report_finding("noise.not-tested")
        if self.noise == "estimated":
            return self._estimated
        if self.weighted:
            return report_finding("noise.weighted")
        square, degrees, p_value = self.decisive
        if degrees < 0.5:
            return report_finding("noise.no-degrees-of-freedom")
        code = "noise.consistent"
        if p_value < SIGNIFICANCE:
            code = "noise.residuals-too-large"
        elif p_value < DOUBT:
            code = "noise.doubtful"
        elif p_value > 1.0 - SIGNIFICANCE:
            code = "noise.residuals-too-small"
        ratio = float(np.sqrt(square / degrees))
        return report_finding(code, ratio=ratio, degrees=degrees, p_value=p_value)

    @property
    def _estimated(self) -> Finding:
        """The result where the noise is estimated."""
        if self.dof < 0.5:
            return report_finding("noise.not-estimated")
        if not self.intervals:
            return report_finding("noise.too-few-degrees", dof=self.dof, fewest=FEWEST_DEGREES)
        return report_finding("noise.estimated", scale=self.sigma_scale, dof=self.dof)


def run_residual_test(
    decomposition: Decomposition,
    penalty: FloatArray,
    noise: str,
    weighted: bool = False,
    converged: bool = True,
    is_prior: bool = True,
) -> ResidualTest:
    """Test the residuals of a fit (t = 1).

    chi_square = |W r|^2 + sum penalty_i y_i^2 over the directions used. Each equation is a degree
    of freedom, less one for each direction used without penalty: m - rank for least squares, m for
    MAP. The penalty of a ridge is no prior. Then the residuals alone are tested: with filter
    factors f_i their expected sum of squares is m - sum f_i (2 - f_i), but for the bias.

    Parameters
    ----------
    decomposition, penalty : of the fit. noise : "given", "estimated" or "assumed"; with assumed
        noise the test is a note.
    weighted : whether a loss chose the weights by the residuals, so that chi_square has no known
        distribution.
    converged : whether the iteration did; elsewhere than at the minimum there are neither tests nor
        intervals.
    is_prior : whether the penalty is knowledge of the parameters, as with MAP.
    """
    if not converged:
        nan = np.nan
        return ResidualTest(nan, nan, nan, nan, noise, 1.0, False, False, weighted)
    finite = np.where(np.isfinite(penalty), penalty, 0.0)
    left = float(decomposition.remaining(penalty)[0])
    y = decomposition.solution(penalty)
    chi_square = left + float((finite * y**2).sum())
    used = np.isfinite(penalty)
    m = float(decomposition.rows[0])
    degrees = m - float((used & (penalty == 0.0)).sum())
    f = decomposition.filter_factors(penalty)
    dof = m - float(f.sum())
    p_value, scale, intervals, alone = np.nan, 1.0, True, None
    p_own = _compute_tail(degrees, chi_square)
    tested = SquareTest(chi_square, degrees, p_own)
    if not is_prior and (finite > 0.0).any() and not weighted:
        spare = m - float((f * (2.0 - f)).sum())
        tested = alone = SquareTest(left, spare, _compute_tail(spare, left))
    if noise == "estimated":
        intervals = dof >= FEWEST_DEGREES
        scale = float(np.sqrt(left / dof)) if dof > 0 else np.nan
    elif not weighted:
        p_value = p_own
        if tested.p_value < SIGNIFICANCE:
            scale = max(1.0, float(np.sqrt(tested.square / tested.degrees)))
    return ResidualTest(
        chi_square, degrees, p_value, dof, noise, scale, intervals, True, weighted, alone
    )


def _compute_tail(degrees: float, square: float) -> float:
    """Return the probability of a larger sum of squares; NaN without degrees of freedom."""
    return float(compute_chi_square_tail(degrees, square)) if degrees > 0 else np.nan


def coverage_factor(test: ResidualTest, level: float = LEVEL) -> float:
    """Return the half-width of an interval of this coverage, in standard deviations."""
    from scipy.special import ndtri, stdtrit

    quantile = 0.5 + 0.5 * level
    if test.noise == "estimated":
        return float(stdtrit(test.dof, quantile)) if test.intervals else np.nan
    return float(ndtri(quantile))
