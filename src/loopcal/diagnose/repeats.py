# SPDX-License-Identifier: Apache-2.0
"""Repeated poses: what they differ by is pure error, and no geometry can explain it; what is left
beyond it is lack of fit.

Poses of equal readings have equal predictions, so with the whitened residuals r of a group

    SS_pure = sum over groups min over mu of |W (r - mu)|^2,   SS_lack = RSS - SS_pure

and SS_lack / dof_lack over SS_pure / dof_pure has an F distribution if the model is right, whatever
the true sigma is (the stated one only has to be right up to a factor). Draper and Smith, Applied
Regression Analysis.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from loopcal.estimate.fit_input import exclude_poses
from loopcal.estimate.inference.residual_test import SIGNIFICANCE
from loopcal.estimate.problem import problem_of
from loopcal.estimate.result import Identification
from loopcal.measure import Measurements, fill_in_reading_sigma
from loopcal.typing import FloatArray, IntArray

SAME = 1e-9
"""Readings [m] or [rad] that differ by less are a repeat of one pose."""

LEVEL = 0.01
"""Probability below which the lack of fit is said to be more than pure error."""


@dataclass(frozen=True)
class LackOfFit:
    """The lack of fit against the pure error of repeated poses.

    Attributes
    ----------
    groups : number of poses that were repeated.
    pure, pure_degrees : sum of squares between repeats in units of the stated sigma, and its
        degrees of freedom.
    lack, lack_degrees : what the fit leaves beyond it.
    sigma_scale : repeatability over the stated sigma.
    p_value : probability of a larger F if geometry explains everything but noise; NaN where nothing
        can be said.
    explained : whether it does; None where it cannot be said. sentence : what this means.
    """

    groups: int
    pure: float
    pure_degrees: int
    lack: float
    lack_degrees: float
    sigma_scale: float
    p_value: float
    explained: bool | None
    sentence: str

    def to_dict(self) -> dict[str, Any]:
        """Return the attributes by name for JSON."""
        return dict(vars(self))


def check_lack_of_fit(fit: Identification, data: Measurements) -> LackOfFit:
    """Test the fit against the pure error of repeats.

    Parameters
    ----------
    fit : an identification without a loss. data : the measurements it was made from.
    """
    if fill_in_reading_sigma(fit.robot, data).reading_sigma is not None:
        return _open(
            "readings are uncertain, so poses of equal readings differ, and repeats are no pure "
            "error"
        )
    data = exclude_poses(data, fit.options.excluded_poses)
    member, times = repeated(data.readings)
    pure, degrees = _pure_error(fit, data, member)
    left = float(fit.history.cost[-1]) - pure
    lack_degrees = fit.residual_test.dof - degrees
    if degrees == 0:
        return _open(
            "no pose was measured twice, so pure error cannot be told from a wrong model; repeat "
            "some poses"
        )
    scale = float(np.sqrt(pure / degrees))
    groups = int((times > 1).sum())
    if fit.pose_weights.min(initial=1.0) < 1.0:
        return _open(
            "weights by residuals: there is no test of the lack of fit",
            groups,
            pure,
            degrees,
            scale,
        )
    if lack_degrees < 1.0 or pure <= 0.0:
        return _open(
            "nothing but repeats is left over, so the lack of fit cannot be tested",
            groups,
            pure,
            degrees,
            scale,
        )
    from scipy.special import fdtrc

    ratio = max(left, 0.0) / lack_degrees / (pure / degrees)
    p_value = float(fdtrc(lack_degrees, degrees, ratio))
    return LackOfFit(
        groups,
        pure,
        degrees,
        left,
        lack_degrees,
        scale,
        p_value,
        p_value >= LEVEL,
        _sentence(ratio, p_value, scale, degrees),
    )


def repeated(readings: FloatArray) -> tuple[IntArray, IntArray]:
    """Return the group (n,) of equal readings of each pose, and the number of poses in each group."""
    _, member, times = np.unique(
        np.round(readings / SAME), axis=0, return_inverse=True, return_counts=True
    )
    return member.reshape(-1), times


def _pure_error(fit: Identification, data: Measurements, member: IntArray) -> tuple[float, int]:
    """Sum of squares between repeats, and its degrees of freedom; each kind has means of its own."""
    problem = problem_of(fit.free_parameters, data)
    z = fit.free_parameters.deviation(fit.robot.values[None])
    total, degrees = 0.0, 0
    residuals = problem.residuals(z, problem.solve(z, problem.start(z)))
    for rows, found in zip(problem.rows, residuals, strict=True):
        same = np.column_stack([member[rows.poses_by_link], rows.nuisance])
        of = np.unique(same, axis=0, return_inverse=True)[1].ravel()
        for group in np.flatnonzero(np.bincount(of) > 1):
            own = of == group
            W = rows.whitener[0, own]
            present = np.einsum("rii->ri", W) != 0.0
            A = W.reshape(-1, W.shape[-1])
            b = np.where(present, found.whitened[0, own], 0.0).ravel()
            mean, _, rank, _ = np.linalg.lstsq(A, b, rcond=1e-12)
            total += float(((b - A @ mean) ** 2).sum())
            degrees += int(present.sum()) - int(rank)
    return total, degrees


def _open(
    sentence: str, groups: int = 0, pure: float = 0.0, degrees: int = 0, scale: float = np.nan
) -> LackOfFit:
    """Return that nothing can be said."""
    return LackOfFit(groups, pure, degrees, np.nan, np.nan, scale, np.nan, None, sentence)


def _sentence(ratio: float, p_value: float, scale: float, degrees: int) -> str:
    """Say what explains the residuals."""
    times = np.sqrt(ratio)
    if p_value < LEVEL:
        sentence = f"something else than the geometry of this model is at work: residuals are {times:.3g} times repeatability"
    else:
        sentence = "the geometry explains the data to within their repeatability"
    from scipy.special import chdtrc

    tail = float(chdtrc(degrees, scale**2 * degrees))
    if tail < SIGNIFICANCE:
        return f"{sentence}; repeats differ by {scale:.3g} times the stated sigma"
    if tail > 1.0 - SIGNIFICANCE:
        return f"{sentence}; repeats differ by only {scale:.3g} of the stated sigma"
    return sentence
