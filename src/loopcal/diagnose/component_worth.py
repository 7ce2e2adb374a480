# SPDX-License-Identifier: Apache-2.0
"""Is calibrating with this instrument worth it? Expected pose errors by the tolerances alone
against those after the fit.

With D the error model at a pose in units of tolerance, the pose's covariance is D D' before and D C
D' after, C the covariance of z. A direction that the data do not see keeps its tolerance: there the
estimate is the nominal value. Where noise is as large as what the tolerances do, after is no better
than before, and the honest advice is another instrument.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from loopcal.estimate.result import Identification
from loopcal.measure import Measurements
from loopcal.mechanism import Status, differentiate_pose, forward_trials
from loopcal.typing import FloatArray
from loopcal.units import DISPLAY_UNITS, Dimension, find_unit

GAIN = 1.1
"""Times by which an expected error must become smaller to be called better."""

POSES = 200
"""Poses at most at which the errors are expected, evenly chosen."""


@dataclass(frozen=True)
class CalibrationGain:
    """Expected errors of the platform at the measured poses.

    Attributes
    ----------
    position_before, position_after : root mean square over poses of the expected position error
        [m].
    angle_before, angle_after : the same of the orientation [rad].
    calibrate : whether either becomes smaller; None where no tolerance says what to expect before.
    sentence : what this means.
    """

    position_before: float
    position_after: float
    angle_before: float
    angle_after: float
    calibrate: bool | None
    sentence: str

    def to_dict(self) -> dict[str, Any]:
        """Return the attributes by name for JSON, SI."""
        return dict(vars(self))


def estimate_calibration_gain(fit: Identification, data: Measurements) -> CalibrationGain:
    """Compare what calibration is expected to leave with what the tolerances allow.

    Parameters
    ----------
    fit : an identification; its tolerances must be stated. data : the measurements it was made
        from, or other readings.
    """
    free = fit.free_parameters
    if free.assumed.any():
        missing = f"{int(free.assumed.sum())} parameters have no tolerance"
        return _open(f"{missing}; state them")
    if fit.residual_test.failed:
        return _open("the residual does not fit the stated noise")
    known = data.readings if fit.poses is None else fit.poses.readings[fit.poses.kept]
    chosen = np.unique(np.linspace(0, len(known) - 1, min(POSES, len(known))).astype(int))
    readings, values = known[None, chosen], fit.robot.values[None]
    state = forward_trials(fit.robot, values, readings)
    ok = np.asarray(state.status == Status.CONVERGED)[0]
    D = differentiate_pose(fit.robot, values, readings, state).parameters[0, ok][..., free.places]
    spread = _spread(fit)
    if not ok.any() or np.isnan(spread).any():
        return _open("no interval can be given")
    before, after = _errors(D * free.tolerance), _errors(D @ spread)
    better = [b > GAIN * a for b, a in zip(before, after, strict=True) if b > 0.0]
    calibrate = any(better)
    return CalibrationGain(
        before[1],
        after[1],
        before[0],
        after[0],
        calibrate,
        _sentence(fit, before, after, calibrate),
    )


def _open(why: str) -> CalibrationGain:
    """Return that nothing can be said."""
    nan = float("nan")
    return CalibrationGain(
        nan, nan, nan, nan, None, f"what calibration gains cannot be predicted: {why}"
    )


def _spread(fit: Identification) -> FloatArray:
    """Return S (p, p) [SI] with S S' the covariance of the estimate, the tolerance's own where a
    direction is not known.
    """
    known = fit.posterior
    variance = np.where(np.isinf(known.variance), 1.0, known.variance)
    return known.unit[:, None] * known.directions * np.sqrt(variance)


def _errors(spread: FloatArray) -> tuple[float, float]:
    """Root mean squares over poses of the orientation [rad] and the position [m] from factors (n,
    6, k).
    """
    square = (spread**2).sum(axis=2)
    return float(np.sqrt(square[:, :3].sum(axis=1).mean())), float(
        np.sqrt(square[:, 3:].sum(axis=1).mean())
    )


def _sentence(
    fit: Identification, before: tuple[float, float], after: tuple[float, float], calibrate: bool
) -> str:
    """Say what to expect."""
    shown = []
    for name, dimension, b, a in (
        ("position", Dimension.LENGTH, before[1], after[1]),
        ("orientation", Dimension.ANGLE, before[0], after[0]),
    ):
        symbol = fit.robot.units.get(dimension, DISPLAY_UNITS[dimension].symbol)
        factor = find_unit(symbol).factor_to_si
        if b > 0.0:
            shown.append(
                f"{name} {b / factor:.3g} {symbol} by tolerances, {a / factor:.3g} {symbol} after"
            )
    expected = f"expected errors at these poses (rms): {'; '.join(shown)}"
    if calibrate:
        return expected
    return f"do not calibrate with this instrument and these poses: the result is no better than the tolerances; {expected}"
