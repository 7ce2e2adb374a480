# SPDX-License-Identifier: Apache-2.0
"""Expected errors of the poses of a calibrated machine, and the sources that they come from.

The covariance of a fit is C = b (sigma^2 A'A + P) b, b = (A'A + P)^-1, with the whitened rows A
after the elimination of the setup parameters, and the penalty P. A direction that the data do not
determine keeps its nominal value and errs by its tolerance, which is a penalty of 1. With the rows
A_known for known frames, targets, surfaces and offsets, and b_known and C_known from these, the
variance of a pose error is the sum of

    instrument              b_known sigma^2 A_known'A_known b_known     noise of the rows
    undetermined tolerances b_known P b_known           what the rows leave to the tolerances
    set-up                  C - C_known                 what the unknown setup parameters add
    repeatability           J_q S_q J_q'                readings, where the actuators have a sigma

each taken to a pose by D, in the frame of `loopcal.diagnose.error_frames`. Less knowledge never
lowers C, so that no part is negative. See docs/theory/uncertainty.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from loopcal.diagnose.error_frames import FITTED, RELATIVE
from loopcal.diagnose.fit_checks.expected_errors import ROUNDING
from loopcal.diagnose.tool_errors import ToolErrors, linearize_tool_errors, locate_measured_poses
from loopcal.errors import MechanismError
from loopcal.estimate.fit_input import check_fitted_data, exclude_poses
from loopcal.estimate.fit_linearization import factor_known_setup, linearize_fit
from loopcal.estimate.result import Identification
from loopcal.findings import Finding, report_finding
from loopcal.measure import Measurements, fill_in_reading_sigma
from loopcal.mechanism import Solution, sample_workspace
from loopcal.typing import FloatArray
from loopcal.units import Dimension

POSES, SEED = 200, 0
"""Number of poses that are drawn from the workspace, and the seed of their draw."""

NEGLIGIBLE = 0.01
"""Share of an expected error below which the sentence leaves out a source."""


class ErrorSources(NamedTuple):
    """Variances [m^2 or rad^2] of the length of an error, mean over poses, by source."""

    instrument: float
    setup: float
    tolerances: float
    repeatability: float

    @property
    def rms(self) -> float:
        """Root mean square of the error from all sources [m or rad]."""
        return float(np.sqrt(sum(self)))


@dataclass(frozen=True, eq=False)
class ErrorBudget:
    """Expected errors of the tool point and of the orientation over the workspace.

    Attributes
    ----------
    position, orientation : variances by source. poses : number of poses.
    is_workspace : whether they are drawn from the workspace of the robot; otherwise they are those
        that were measured. finding : the errors with their frame, in one sentence.
    """

    position: ErrorSources
    orientation: ErrorSources
    poses: int
    is_workspace: bool
    finding: Finding

    def __str__(self) -> str:
        return str(self.finding)

    def to_dict(self) -> dict[str, Any]:
        """Return root mean squares and variances by source for JSON, SI."""
        errors = {}
        for name in ("position", "orientation"):
            sources: ErrorSources = getattr(self, name)
            errors[name] = {"rms": sources.rms, "variances": sources._asdict()}
        place = "workspace" if self.is_workspace else "measured poses"
        return {**errors, "poses": self.poses, "over": place, "finding": self.finding}


def compute_error_budget(
    fit: Identification, data: Measurements, frame: str = FITTED
) -> ErrorBudget | None:
    """Compute the expected errors of a calibrated machine over its workspace, by source.

    Parameters
    ----------
    fit : an identification. data : the measurements it was made from.
    frame : in which the errors are stated, see `loopcal.diagnose.choose_error_frame`; "relative"
        means relative to the home pose.

    Returns
    -------
    ErrorBudget; None where the fit has no intervals, where its residuals contradict the stated
    noise, or where no pose is reached.

    Raises
    ------
    EstimationError : no such frame.
    """
    check_fitted_data(fit, data)
    if not fit.residual_test.intervals or fit.residual_test.failed:
        return None
    data = exclude_poses(fill_in_reading_sigma(fit.robot, data), fit.options.excluded_poses)
    solution, is_workspace = _choose_poses(fit, data)
    if not len(solution.q):
        return None
    effects = linearize_tool_errors(fit.posterior, solution, frame)
    angle, position = _split(effects, _split_covariance(fit, data), is_relative=frame == RELATIVE)
    n = len(solution.q)
    finding = _word(fit, (position, angle), n, is_workspace, effects.reference)
    return ErrorBudget(position, angle, n, is_workspace, finding)


class CovarianceRoots(NamedTuple):
    """Square roots (p, p) of the covariance of a fit and, for known setup parameters, of its parts
    by noise and by tolerances; in the units of the posterior.
    """

    whole: FloatArray
    noise: FloatArray
    tolerances: FloatArray


def _choose_poses(fit: Identification, data: Measurements) -> tuple[Solution, bool]:
    """Return poses from the workspace that the calibrated robot reaches, or the measured poses
    where it states no workspace; and which of the two.
    """
    try:
        solution = sample_workspace(fit.robot, POSES, SEED).solution
    except MechanismError:
        return locate_measured_poses(fit, data, POSES), False
    return solution.take(np.flatnonzero(solution.converged)), True


def _split_covariance(fit: Identification, data: Measurements) -> CovarianceRoots:
    """Return the parts of the covariance of a fit.

    With the triangle of [A_known V; sqrt P] = Q R, V the directions of the fit, b_known is R^-1
    R^-T, and the roots of the parts are R^-1 Q_1' and R^-1 Q_2'. A'A is never formed.
    """
    from scipy.linalg import solve_triangular

    linear = linearize_fit(fit, data)
    d, scaled, variance = linear.decomposition, linear.scaled, linear.variance
    V, used = d.directions[0], linear.is_estimated
    variance = np.where(np.isinf(variance), 1.0, variance)
    penalty = np.where(used, scaled.penalty[0], 1.0 / variance)
    # with an estimated noise and a prior, the rows are divided by the noise
    unit = 1.0 if scaled.decomposition is d else fit.residual_test.sigma_scale
    rows = factor_known_setup(fit, data) @ (d.scale[:, None] * V) / unit
    Q, R = np.linalg.qr(np.concatenate([rows, np.diag(np.sqrt(penalty))]))
    noise, tolerances = (solve_triangular(R, q.T) for q in (Q[: len(rows)], Q[len(rows) :]))
    return CovarianceRoots(V * np.sqrt(variance), V @ noise * np.sqrt(scaled.noise), V @ tolerances)


def _split(
    effects: ToolErrors, roots: CovarianceRoots, *, is_relative: bool
) -> tuple[ErrorSources, ErrorSources]:
    """Return the sources of the errors of orientation and position.

    Errors of the frame itself are those of the set-up; those of the reference pose of relative
    errors are repeatability.
    """
    whole, noise, tolerances = (_mean_squares(effects.by_parameters @ root) for root in roots)
    of_frame, repeated = _mean_squares(effects.by_frame), _mean_squares(effects.by_readings)
    sources = []
    for i in range(2):
        setup = max(whole[i] - noise[i] - tolerances[i], 0.0)  # rounding, for known parameters
        sources.append(
            ErrorSources(
                instrument=max(whole[i] - tolerances[i] - setup, 0.0),
                setup=setup + (0.0 if is_relative else of_frame[i]),
                tolerances=tolerances[i],
                repeatability=repeated[i] + (of_frame[i] if is_relative else 0.0),
            )
        )
    return sources[0], sources[1]


def _mean_squares(twists: FloatArray) -> tuple[float, float]:
    """Return the mean over poses of the squares of rotations [rad^2] and displacements [m^2] of
    twists (n, 6, k) by independent errors of variance 1.
    """
    squares = (twists**2).sum(axis=2)
    return float(squares[:, :3].sum(axis=1).mean()), float(squares[:, 3:].sum(axis=1).mean())


def _word(
    fit: Identification,
    errors: tuple[ErrorSources, ErrorSources],
    poses: int,
    is_workspace: bool,
    reference: Finding,
) -> Finding:
    """Return the errors in one sentence."""
    stated: dict[str, Any] = {}
    dimensions = (("position", Dimension.LENGTH), ("orientation", Dimension.ANGLE))
    for (name, dimension), sources in zip(dimensions, errors, strict=True):
        size = fit.robot.size if dimension is Dimension.LENGTH else 1.0
        parts = {key: float(np.sqrt(value)) for key, value in sources._asdict().items()}
        stated[name] = None
        if sources.rms > ROUNDING * size:
            quantities = {
                key: fit.robot.to_quantity(value, dimension)
                for key, value in parts.items()
                if value > NEGLIGIBLE * sources.rms
            }
            stated[name] = (fit.robot.to_quantity(sources.rms, dimension), quantities)
    return report_finding(
        "accuracy.budget",
        **stated,
        poses=poses,
        is_workspace=is_workspace,
        tolerances_assumed=bool(fit.free_parameters.assumed.any()),
        repeatability_stated=any(actuator.sigma for actuator in fit.robot.actuators),
        **reference.data,
    )
