# SPDX-License-Identifier: Apache-2.0
"""Predict the gain of a calibration: pose errors expected from the tolerances, and after the fit.

With D the error model at a pose in units of tolerance, the covariance of the pose is D D' before
and D C D' after calibration, C the covariance of z. Both refer to one frame, see
`loopcal.diagnose.error_frames`. A direction that the data do not determine keeps its tolerance,
because its estimate is the nominal value. Where the noise is as large as the effect of the
tolerances, the error after calibration is no smaller, and another instrument is needed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from loopcal.diagnose.error_frames import FITTED
from loopcal.diagnose.tool_errors import linearize_tool_errors, locate_measured_poses
from loopcal.estimate.result import Identification
from loopcal.findings import Finding, Quantity, report_finding
from loopcal.measure import Measurements
from loopcal.mechanism import Mechanism
from loopcal.typing import FloatArray
from loopcal.units import Dimension

GAIN = 1.1
"""Factor by which an expected error must become smaller to count as an improvement."""

ROUNDING = 1e-12
"""Expected errors below this share of the robot's size, or this angle [rad], are rounding."""

MOST_POSES = 200
"""Largest number of poses at which errors are predicted, evenly chosen."""


@dataclass(frozen=True)
class CalibrationGain:
    """Expected errors of the platform at the measured poses.

    Attributes
    ----------
    position_before, position_after : root mean square over poses of the expected position error
        [m].
    angle_before, angle_after : the same of the orientation [rad].
    is_worthwhile : whether either becomes smaller; None where it cannot be predicted.
    finding : the expected errors, or the reason why there are none.
    """

    position_before: float
    position_after: float
    angle_before: float
    angle_after: float
    is_worthwhile: bool | None
    finding: Finding

    def to_dict(self) -> dict[str, Any]:
        """Return the attributes for JSON; `is_worthwhile` is called `calibrate` there."""
        content = dict(vars(self))
        content["calibrate"] = content.pop("is_worthwhile")
        return content


def estimate_calibration_gain(
    fit: Identification, data: Measurements, frame: str = FITTED
) -> CalibrationGain:
    """Compare the errors expected after calibration with those that the tolerances allow.

    Parameters
    ----------
    fit : an identification; its tolerances must be stated. data : the measurements it was made
        from, or other readings.
    frame : in which the errors are stated, see `loopcal.diagnose.choose_error_frame`; "relative"
        means relative to the home pose.

    Raises
    ------
    EstimationError : no such frame.
    """
    free = fit.free_parameters
    if free.assumed.any():
        return _unpredicted("model.gain-needs-tolerances", missing=int(free.assumed.sum()))
    if fit.residual_test.failed:
        return _unpredicted("model.gain-needs-consistent-noise")
    solution = locate_measured_poses(fit, data, MOST_POSES)
    # S with S S' the covariance of the estimate; undetermined directions keep their tolerance
    posterior = fit.posterior.without_discrepancy
    variance = np.where(np.isinf(posterior.variance), 1.0, posterior.variance)
    factor = posterior.directions * np.sqrt(variance)
    if not len(solution.q) or np.isnan(factor).any():
        return _unpredicted("model.gain-without-intervals")
    effects = linearize_tool_errors(fit.posterior, solution, frame)
    D, own = effects.by_parameters, (effects.by_frame, effects.by_discrepancy)
    size = fit.robot.size
    angle_before, position_before = _rms_errors(
        (D * (free.tolerance / posterior.unit)) @ free.correlation_root(), size
    )
    angle_after, position_after = _rms_errors(np.concatenate([D @ factor, *own], axis=2), size)
    pairs = ((position_before, position_after), (angle_before, angle_after))
    is_worthwhile = any(before > GAIN * after for before, after in pairs if before > 0.0)
    finding = report_finding(
        "model.expected-gain" if is_worthwhile else "model.no-expected-gain",
        position=_quantities(fit.robot, Dimension.LENGTH, *pairs[0]),
        orientation=_quantities(fit.robot, Dimension.ANGLE, *pairs[1]),
        **effects.reference.data,
    )
    return CalibrationGain(
        position_before, position_after, angle_before, angle_after, is_worthwhile, finding
    )


def _unpredicted(code: str, **data: Any) -> CalibrationGain:
    """Return the reason why there is no prediction."""
    nan = float("nan")
    return CalibrationGain(nan, nan, nan, nan, None, report_finding(code, **data))


def _rms_errors(factor: FloatArray, size: float) -> tuple[float, float]:
    """Return root mean squares of orientation [rad] and position [m] from factors (n, 6, k).

    They are 0 where they are rounding, such as the orientation of a delta of this size [m].
    """
    square = (factor**2).sum(axis=2)
    orientation = float(np.sqrt(square[:, :3].sum(axis=1).mean()))
    position = float(np.sqrt(square[:, 3:].sum(axis=1).mean()))
    return orientation * (orientation > ROUNDING), position * (position > ROUNDING * size)


def _quantities(
    robot: Mechanism, dimension: Dimension, before: float, after: float
) -> tuple[Quantity, Quantity] | None:
    """Return errors before and after in the unit of the robot's file; None where they are zero."""
    if not before > 0.0:
        return None
    return robot.to_quantity(before, dimension), robot.to_quantity(after, dimension)
