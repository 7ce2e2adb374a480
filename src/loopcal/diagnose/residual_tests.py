# SPDX-License-Identifier: Apache-2.0
"""Test the residuals of a fit against repeated poses, and its start values against the fit.

Repeated poses. Poses of equal readings have equal predictions, so with the whitened residuals r of
a group of repeats

    SS_pure = sum over groups min over mu of |W (r - mu)|^2,   SS_lack = RSS - SS_pure

and SS_lack / dof_lack over SS_pure / dof_pure has an F distribution if the model is right, whatever
the true sigma is (the stated one must be right up to a factor). Source: Draper and Smith, Applied
Regression Analysis.

Start values. Where the start is the truth and the noise is as stated, the gain chi_square(start) -
chi_square(fit) has a chi-square distribution with as many degrees of freedom as fitted directions.
Where the noise is not stated, or contradicts the residuals of the fit, the gain per direction over
the residual per degree of freedom has an F distribution.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np

from loopcal.estimate.fit_input import exclude_poses
from loopcal.estimate.inference.residual_test import FEWEST_DEGREES, SIGNIFICANCE
from loopcal.estimate.problem import problem_of
from loopcal.estimate.result import Identification
from loopcal.findings import Finding, report_finding
from loopcal.measure import Measurements, fill_in_reading_sigma
from loopcal.typing import FloatArray, IntArray

SAME_READING = 1e-9
"""Readings [m] or [rad] that differ by less belong to repeats of one pose."""

LEVEL = 0.01
"""Probability below which the lack of fit exceeds the pure error."""

NO_GAIN = 1e-3
"""Share of the start's chi-square below which a gain is rounding: the last digits of a file."""


@dataclass(frozen=True)
class LackOfFit:
    """Lack of fit against the pure error of repeated poses.

    Attributes
    ----------
    groups : number of poses that were repeated.
    pure, pure_degrees : sum of squares between repeats in units of the stated sigma, and its
        degrees of freedom.
    lack, lack_degrees : the remaining sum of squares of the fit, and its degrees of freedom.
    sigma_scale : repeatability over the stated sigma.
    p_value : probability of a larger F if the model is right; NaN where there is no test.
    is_explained : whether the model explains the data; None where there is no test.
    findings : the result of the test, and the repeatability where it contradicts the stated sigma.
    """

    groups: int
    pure: float
    pure_degrees: int
    lack: float
    lack_degrees: float
    sigma_scale: float
    p_value: float
    is_explained: bool | None
    findings: tuple[Finding, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return the attributes for JSON; `is_explained` is called `explained` there."""
        content = dict(vars(self))
        content["explained"] = content.pop("is_explained")
        return content


class StartVerdict(Enum):
    """The start values of a fit, compared with the fit."""

    BEST = "best"
    WITHIN_NOISE = "within noise"
    NOT_CALIBRATED = "not calibrated"
    OPEN = "open"


@dataclass(frozen=True)
class StartCheck:
    """The geometry from which a fit started, compared with the fit.

    Attributes
    ----------
    verdict : see `StartVerdict`.
    before, after : root mean square of the residuals in units of the stated sigma, of the start and
        of the fit [1].
    p_value : probability of such a gain if the start is the truth; NaN where there is no test.
    finding : the result.
    """

    verdict: StartVerdict
    before: float
    after: float
    p_value: float
    finding: Finding

    def to_dict(self) -> dict[str, Any]:
        """Return the attributes by name for JSON."""
        return {**vars(self), "verdict": self.verdict.value}


def check_lack_of_fit(fit: Identification, data: Measurements) -> LackOfFit:
    """Test a fit against the pure error of repeated poses.

    Parameters
    ----------
    fit : an identification without a loss. data : the measurements it was made from.
    """
    if fill_in_reading_sigma(fit.robot, data).reading_sigma is not None:
        return _untested("residuals.repeats-with-uncertain-readings")
    data = exclude_poses(data, fit.options.excluded_poses)
    member, times = group_repeats(data.readings)
    pure, degrees = _pure_error(fit, data, member)
    lack = float(fit.history.cost[-1]) - pure
    lack_degrees = fit.residual_test.dof - degrees
    if degrees == 0:
        return _untested("residuals.no-repeats")
    scale = float(np.sqrt(pure / degrees))
    groups = int((times > 1).sum())
    if fit.pose_weights.min(initial=1.0) < 1.0:
        return _untested("residuals.repeats-with-weights", groups, pure, degrees, scale)
    if lack_degrees < 1.0 or pure <= 0.0:
        return _untested("residuals.repeats-only", groups, pure, degrees, scale)
    from scipy.special import fdtrc

    ratio = max(lack, 0.0) / lack_degrees / (pure / degrees)
    p_value = float(fdtrc(lack_degrees, degrees, ratio))
    findings = _lack_findings(ratio, p_value, scale, degrees)
    return LackOfFit(
        groups, pure, degrees, lack, lack_degrees, scale, p_value, p_value >= LEVEL, findings
    )


def group_repeats(readings: FloatArray) -> tuple[IntArray, IntArray]:
    """Return the group (n,) of equal readings of each pose, and the number of poses per group."""
    _, member, times = np.unique(
        np.round(readings / SAME_READING), axis=0, return_inverse=True, return_counts=True
    )
    return member.reshape(-1), times


def check_start_values(fit: Identification) -> StartCheck:
    """Compare the geometry from which a fit started with the fit, on the fitted measurements."""
    first, last = float(fit.history.cost[0]), float(fit.history.cost[-1])
    rows = sum(int(np.isfinite(r.raw).sum()) for r in fit.residuals)
    before, after = np.sqrt(first / rows), np.sqrt(last / rows)

    def judged(verdict: StartVerdict, p_value: float, code: str, **data: Any) -> StartCheck:
        finding = report_finding(f"residuals.start-{code}", **data)
        return StartCheck(verdict, before, after, p_value, finding)

    if not fit.converged:
        return judged(StartVerdict.OPEN, float("nan"), "not-comparable")
    gain = max(first - last, 0.0)
    if gain <= NO_GAIN * first:
        return judged(StartVerdict.BEST, 1.0, "is-best")
    p_value = _gain_p_value(fit, gain, last)
    ratio = float(before / after) if after > 0.0 else None
    if p_value < SIGNIFICANCE:
        return judged(StartVerdict.NOT_CALIBRATED, p_value, "not-calibrated", ratio=ratio)
    if fit.residual_test.dof < FEWEST_DEGREES and not _is_noise_consistent(fit):
        return judged(StartVerdict.OPEN, p_value, "needs-sigma", ratio=ratio)
    if fit.residual_test.failed:
        return judged(StartVerdict.OPEN, p_value, "undecided", ratio=ratio)
    return judged(StartVerdict.WITHIN_NOISE, p_value, "within-noise", ratio=ratio)


def _pure_error(fit: Identification, data: Measurements, member: IntArray) -> tuple[float, int]:
    """Sum of squares between repeats, and its degrees of freedom; each kind has its own means."""
    problem = problem_of(fit.free_parameters, data)
    z = fit.free_parameters.deviation(fit.robot.values[None])
    total, degrees = 0.0, 0
    residuals = problem.residuals(z, problem.solve(z, problem.start(z)))
    for rows, residual in zip(problem.rows, residuals, strict=True):
        same = np.column_stack([member[rows.poses_by_link], rows.nuisance])
        group_of_row = np.unique(same, axis=0, return_inverse=True)[1].ravel()
        for group in np.flatnonzero(np.bincount(group_of_row) > 1):
            chosen = group_of_row == group
            W = rows.whitener[0, chosen]
            present = np.einsum("rii->ri", W) != 0.0
            A = W.reshape(-1, W.shape[-1])
            b = np.where(present, residual.whitened[0, chosen], 0.0).ravel()
            mean, _, rank, _ = np.linalg.lstsq(A, b, rcond=1e-12)
            total += float(((b - A @ mean) ** 2).sum())
            degrees += int(present.sum()) - int(rank)
    return total, degrees


def _untested(
    code: str, groups: int = 0, pure: float = 0.0, degrees: int = 0, scale: float = np.nan
) -> LackOfFit:
    """Return the reason why there is no test."""
    finding = report_finding(code)
    return LackOfFit(groups, pure, degrees, np.nan, np.nan, scale, np.nan, None, (finding,))


def _lack_findings(ratio: float, p_value: float, scale: float, degrees: int) -> tuple[Finding, ...]:
    """Return the result of the test, and a repeatability that contradicts the stated sigma."""
    from scipy.special import chdtrc

    if p_value < LEVEL:
        findings = [report_finding("residuals.lack-of-fit", ratio=float(np.sqrt(ratio)))]
    else:
        findings = [report_finding("residuals.explained")]
    tail = float(chdtrc(degrees, scale**2 * degrees))
    if tail < SIGNIFICANCE:
        findings.append(report_finding("residuals.repeatability-larger", scale=scale))
    if tail > 1.0 - SIGNIFICANCE:
        findings.append(report_finding("residuals.repeatability-smaller", scale=scale))
    return tuple(findings)


def _is_noise_consistent(fit: Identification) -> bool:
    """Whether the noise is stated and explains the residuals of the fit (or none are left)."""
    return fit.residual_test.noise == "given" and not fit.residual_test.failed


def _gain_p_value(fit: Identification, gain: float, last: float) -> float:
    """Probability of a larger gain by noise alone: by the stated noise where it is consistent, else
    by that of the residuals.
    """
    from scipy.special import chdtrc, fdtrc

    if _is_noise_consistent(fit):
        return float(chdtrc(fit.rank, gain))
    if fit.residual_test.dof < 1.0 or last <= 0.0:
        return float("nan")
    return float(
        fdtrc(fit.rank, fit.residual_test.dof, gain / fit.rank / (last / fit.residual_test.dof))
    )
