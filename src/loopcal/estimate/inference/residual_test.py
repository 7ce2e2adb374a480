# SPDX-License-Identifier: Apache-2.0
"""Does the residual fit its degrees of freedom, and how wide are intervals: chi-square and
Student's t, in words.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopcal.numerics.decomposition import Decomposition
from loopcal.typing import FloatArray

FEWEST_DEGREES = 5
"""Degrees of freedom below which an estimated noise is too uncertain for intervals (at 4 its own sd
is 35 %).
"""

LEVEL = 0.95
"""Coverage of the intervals called +/-."""

DOUBT = 1e-3
"""Probability below which the residual is said not to fit the noise."""

ASTRAY = "no interval is given and nothing is said of the noise: what is left is not the residual of a best fit"
"""What is said of the residual where the iteration did not converge."""


@dataclass(frozen=True)
class ResidualTest:
    """The residual against its degrees of freedom.

    Attributes
    ----------
    chi_square : whitened sum of squares, with the penalty of a prior.
    degrees : of freedom that chi_square has when model, noise and prior are right.
    p_value : probability of a larger chi_square; NaN where the noise is estimated or nothing is
        left over.
    dof : equations minus the number of parameters that the method effectively uses.
    noise : "given" or "estimated". sigma_scale : factor on the stated sigmas; 1 where the noise is
        given, unless the residual is too large for it: then the intervals are wider by this factor,
        as the stated noise is not believed.
    intervals : whether intervals are given at all.
    sentence : what this means.
    """

    chi_square: float
    degrees: float
    p_value: float
    dof: float
    noise: str
    sigma_scale: float
    intervals: bool
    sentence: str

    @property
    def failed(self) -> bool:
        """Whether the residual is, beyond doubt, larger than the stated noise explains."""
        return self.noise == "given" and self.p_value < DOUBT


def run_residual_test(
    decomposition: Decomposition,
    penalty: FloatArray,
    noise: str,
    robust: bool = False,
    converged: bool = True,
) -> ResidualTest:
    """Check the residual of a fit (t = 1).

    chi_square = |W r|^2 + sum penalty_i y_i^2 over the directions used, with one degree of freedom
    for each equation less one for each direction used without penalty: m - rank for least squares,
    m for MAP.

    Parameters
    ----------
    decomposition, penalty : of the fit. noise : "given" or "estimated".
    robust : whether a loss gave the rows weights by their residuals, so that chi_square has no
        known distribution.
    converged : whether the iteration did; elsewhere than at the minimum neither noise nor intervals
        can be spoken of.
    """
    finite = np.where(np.isfinite(penalty), penalty, 0.0)
    left = float(decomposition.remaining(penalty)[0])
    y = decomposition.solution(penalty)
    chi_square = left + float((finite * y**2).sum())
    used = np.isfinite(penalty)
    m = float(decomposition.rows[0])
    degrees = m - float((used & (penalty == 0.0)).sum())
    dof = m - float(decomposition.filter_factors(penalty).sum())
    if not converged:
        return ResidualTest(chi_square, degrees, np.nan, dof, noise, 1.0, False, ASTRAY)
    if noise == "estimated":
        enough = dof >= FEWEST_DEGREES
        scale = float(np.sqrt(left / dof)) if dof > 0 else np.nan
        return ResidualTest(
            chi_square, degrees, np.nan, dof, noise, scale, enough, _estimated(dof, scale, enough)
        )
    from scipy.special import chdtrc

    if robust:
        return ResidualTest(
            chi_square,
            degrees,
            np.nan,
            dof,
            noise,
            1.0,
            True,
            "weights by residuals: no test of the noise",
        )
    p_value = float(chdtrc(degrees, chi_square)) if degrees > 0 else np.nan
    scale = max(1.0, float(np.sqrt(chi_square / degrees))) if p_value < DOUBT else 1.0
    return ResidualTest(
        chi_square, degrees, p_value, dof, noise, scale, True, _given(chi_square, degrees, p_value)
    )


def coverage_factor(check: ResidualTest, level: float = LEVEL) -> float:
    """Return by how many standard deviations an interval of this coverage extends to each side."""
    from scipy.special import ndtri, stdtrit

    quantile = 0.5 + 0.5 * level
    if check.noise == "estimated":
        return float(stdtrit(check.dof, quantile)) if check.intervals else np.nan
    return float(ndtri(quantile))


def _estimated(dof: float, scale: float, enough: bool) -> str:
    if dof < 0.5:
        return "no degree of freedom is left: neither noise nor intervals can be estimated; measure more, or state sigma"
    word = "one degree of freedom is" if round(dof) == 1 else f"{dof:.3g} degrees of freedom are"
    if not enough:
        return f"{word} too few for intervals unless the instrument's sigma is given"
    return f"noise estimated from the residual with {dof:.3g} degrees of freedom: {scale:.3g} times the stated sigma"


def _given(chi_square: float, degrees: float, p_value: float) -> str:
    if degrees < 0.5:
        return "no degree of freedom is left: the residual cannot be checked against the noise; measure more"
    ratio = np.sqrt(chi_square / degrees)
    if p_value < DOUBT:
        return (
            f"the residual is {ratio:.3g} times what the stated noise explains: sigma too small, "
            "wrong rows,"
            f" or a model that misses something; intervals are {ratio:.3g} times wider than by the "
            "stated noise,"
            " and hold only if no row is wrong"
        )
    if p_value > 1.0 - DOUBT:
        return f"the residual is only {ratio:.3g} of what the stated noise explains: sigma is too large"
    return "the residual fits the stated noise"
