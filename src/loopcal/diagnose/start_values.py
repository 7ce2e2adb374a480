# SPDX-License-Identifier: Apache-2.0
"""Was the robot calibrated to these measurements before the fit? What the fit gained over its
start, against the noise.

Where the start is the truth and the noise is what was stated, the gain chi_square(start) -
chi_square(fit) has a chi-square distribution with as many degrees of freedom as directions were
fitted. Where the noise is not stated, or the stated one does not explain what the fit leaves, the
gain per direction over the residual per degree of freedom has an F distribution.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np

from loopcal.estimate.inference.residual_test import FEWEST_DEGREES, SIGNIFICANCE
from loopcal.estimate.result import Identification

NOTHING = 1e-3
"""Share of the start's chi-square below which a gain is none: other rounding, the last digits of a
file.
"""


class StartVerdict(Enum):
    """What is known of the geometry from which a fit started."""

    BEST = "best"
    WITHIN_NOISE = "within noise"
    NOT_CALIBRATED = "not calibrated"
    OPEN = "open"


@dataclass(frozen=True)
class StartCheck:
    """The geometry from which a fit started, against the measurements.

    Attributes
    ----------
    verdict : see `Start`.
    before, after : root mean square of the residuals in units of the stated sigma, of the start and
        of the fit [1].
    p_value : probability of such a gain where the start is the truth; NaN where it cannot be said.
    sentence : what this means.
    """

    verdict: StartVerdict
    before: float
    after: float
    p_value: float
    sentence: str

    def to_dict(self) -> dict[str, Any]:
        """Return the attributes by name for JSON."""
        return {**vars(self), "verdict": self.verdict.value}


def check_start_values(fit: Identification) -> StartCheck:
    """Compare the geometry from which a fit started with the fit, on the fitted measurements.

    Parameters
    ----------
    fit : its start is the robot that was given (`initial`).

    Returns
    -------
    StartCheck
    """
    first, last = float(fit.history.cost[0]), float(fit.history.cost[-1])
    rows = sum(int(np.isfinite(r.raw).sum()) for r in fit.residuals)
    before, after = np.sqrt(first / rows), np.sqrt(last / rows)
    if not fit.converged:
        sentence = "the robot file's geometry cannot be compared with a best fit: the iteration did not converge"
        return StartCheck(StartVerdict.OPEN, before, after, float("nan"), sentence)
    gain = max(first - last, 0.0)
    if gain <= NOTHING * first:
        return StartCheck(
            StartVerdict.BEST,
            before,
            after,
            1.0,
            "the robot file's geometry is already the best fit to these rows",
        )
    p_value = _p_value(fit, gain, last)
    ratio = (
        f"its residuals are {before / after:.3g} times those of the fit"
        if after > 0.0
        else "the fit leaves no residual"
    )
    if p_value < SIGNIFICANCE:
        sentence = f"the robot file's geometry is NOT calibrated to these rows: {ratio}, which noise does not explain"
        return StartCheck(StartVerdict.NOT_CALIBRATED, before, after, p_value, sentence)
    if fit.residual_test.dof < FEWEST_DEGREES and not _trusted(fit):
        sentence = f"the robot file's geometry: {ratio}; whether noise explains that can only be said with its true sigma"
        return StartCheck(StartVerdict.OPEN, before, after, p_value, sentence)
    if fit.residual_test.failed:
        sentence = f"the robot file's geometry: {ratio}; neither fits the stated noise, so which is better cannot be said"
        return StartCheck(StartVerdict.OPEN, before, after, p_value, sentence)
    sentence = f"the robot file's geometry is as good as the fit within the noise ({ratio})"
    return StartCheck(StartVerdict.WITHIN_NOISE, before, after, p_value, sentence)


def _trusted(fit: Identification) -> bool:
    """Whether the noise is stated, and explains what the fit leaves (or nothing is left to tell)."""
    return fit.residual_test.noise == "given" and not fit.residual_test.failed


def _p_value(fit: Identification, gain: float, last: float) -> float:
    """Probability of a larger gain by noise alone: of the stated noise where it is trusted, else of
    the residual's.
    """
    from scipy.special import chdtrc, fdtrc

    if _trusted(fit):
        return float(chdtrc(fit.rank, gain))
    if fit.residual_test.dof < 1.0 or last <= 0.0:
        return float("nan")
    return float(
        fdtrc(fit.rank, fit.residual_test.dof, gain / fit.rank / (last / fit.residual_test.dof))
    )
