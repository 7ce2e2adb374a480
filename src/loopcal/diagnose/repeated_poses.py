# SPDX-License-Identifier: Apache-2.0
"""Test a fit against the pure error of repeated poses (lack of fit).

Poses of equal readings have equal predictions, so with the whitened residuals r of a group of
repeats

    SS_pure = sum over groups min over mu of |W (r - mu)|^2,   SS_lack = RSS - SS_pure

and SS_lack / dof_lack over SS_pure / dof_pure has an F distribution if the model is right, whatever
the true sigma is (the stated one must be right up to a factor). Source: Draper and Smith, Applied
Regression Analysis.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from loopcal.estimate.identification import exclude_poses
from loopcal.estimate.observation_rows import ObservationRows
from loopcal.estimate.problem import problem_of
from loopcal.estimate.residual_test import SIGNIFICANCE
from loopcal.estimate.result import Identification
from loopcal.findings import Finding, report_finding
from loopcal.measure.measurements import Measurements
from loopcal.measure.readings import fill_in_reading_sigma
from loopcal.numerics.statistics import compute_chi_square_tail, find_distinct
from loopcal.results.description import Field, fields
from loopcal.typing import IntArray

# Singular values of the whiteners of repeats below this share of the largest belong to components
# that no repeat measured, which have no mean. Stated sigmas differ by less than that.
UNMEASURED = 1e-12
LEVEL = 0.01  # probability below which the lack of fit exceeds the pure error


@dataclass(frozen=True)
class LackOfFit:
    """Lack of fit against the pure error of repeated poses."""

    groups: int  # number of poses that were repeated
    # pure, pure_degrees: sum of squares between repeats in units of the stated sigma, and its
    # degrees of freedom
    pure: float
    pure_degrees: int
    # lack, lack_degrees: the remaining sum of squares of the fit, and its degrees of freedom
    lack: float
    lack_degrees: float
    sigma_scale: float  # repeatability over the stated sigma
    p_value: float  # probability of a larger F if the model is right; NaN where there is no test
    is_explained: bool | None  # whether the model explains the data; None where there is no test
    # the result of the test, and the repeatability where it contradicts the stated sigma
    findings: tuple[Finding, ...]

    FIELDS: ClassVar[tuple[Field, ...]] = fields(
        *("groups", "pure", "pure_degrees", "lack", "lack_degrees", "sigma_scale", "p_value"),
        *("findings",),
        explained="is_explained",
    )


def check_lack_of_fit(fit: Identification, data: Measurements) -> LackOfFit:
    """Test a fit against the pure error of repeated poses."""
    if fill_in_reading_sigma(fit.robot, data).reading_sigma is not None:
        return _untested("residuals.repeats-with-uncertain-readings")
    data = exclude_poses(data, fit.options.excluded_poses)
    member = data.repeats
    times = np.bincount(member)
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
    findings = [report_finding("residuals.explained")]
    if p_value < LEVEL:
        findings = [report_finding("residuals.lack-of-fit", ratio=float(np.sqrt(ratio)))]
    tail = float(compute_chi_square_tail(degrees, scale**2 * degrees))
    if tail < SIGNIFICANCE:
        findings.append(report_finding("residuals.repeatability-larger", scale=scale))
    if tail > 1.0 - SIGNIFICANCE:
        findings.append(report_finding("residuals.repeatability-smaller", scale=scale))
    numbers = (groups, pure, degrees, lack, lack_degrees, scale, p_value)
    return LackOfFit(*numbers, p_value >= LEVEL, tuple(findings))


def _pure_error(fit: Identification, data: Measurements, member: IntArray) -> tuple[float, int]:
    """Sum of squares between repeats, and its degrees of freedom; each kind has its own means."""
    problem = problem_of(fit.free_parameters, data)
    groups = [_group_repeats(rows, member) for rows in problem.rows]
    total, degrees = 0.0, 0
    if all(len(find_distinct(of_rows)) == len(of_rows) for of_rows in groups):
        return total, degrees
    z = fit.free_parameters.deviation(fit.robot.values[None])
    residuals = problem.residuals(z, problem.solve(z, problem.start(z)))
    for rows, group_of_row, residual in zip(problem.rows, groups, residuals, strict=True):
        for group in np.flatnonzero(np.bincount(group_of_row) > 1):
            chosen = group_of_row == group
            W = rows.whitener[0, chosen]
            present = np.einsum("rii->ri", W) != 0.0
            A = W.reshape(-1, W.shape[-1])
            b = np.where(present, residual.whitened[0, chosen], 0.0).ravel()
            mean, _, rank, _ = np.linalg.lstsq(A, b, rcond=UNMEASURED)
            total += float(((b - A @ mean) ** 2).sum())
            degrees += int(present.sum()) - int(rank)
    return total, degrees


def _group_repeats(rows: ObservationRows, member: IntArray) -> IntArray:
    """Return the group (r,) of rows of one kind that repeat each other; rows of targets on the base
    repeat no pose.
    """
    if rows.kind.is_of_base:
        return np.arange(len(rows.poses))
    same = np.column_stack([member[rows.poses_by_link], rows.nuisance])
    return np.asarray(np.unique(same, axis=0, return_inverse=True)[1].ravel())


def _untested(
    code: str, groups: int = 0, pure: float = 0.0, degrees: int = 0, scale: float = np.nan
) -> LackOfFit:
    """Return the reason why there is no test."""
    finding = report_finding(code)
    return LackOfFit(groups, pure, degrees, np.nan, np.nan, scale, np.nan, None, (finding,))
