# SPDX-License-Identifier: Apache-2.0
"""Check the linear prediction of pose errors by many simulated calibrations.

Every trial has its own true machine and its own noise. Predicted are the standard deviations from
D C D' of one fit. Observed is the root mean square, over all trials, of the pose error between the
identified and the true machine at the same readings. Both are those after the best rigid fit, over
the measured poses, of the motions of frames that the instrument does not determine. JCGM 101; see
docs/theory/uncertainty.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from loopcal import geometry
from loopcal.apply.accuracy import PoseUncertainty, pose_uncertainty
from loopcal.diagnose.error_frames import fit_unfixed_frames
from loopcal.engine import State
from loopcal.errors import EstimationError
from loopcal.estimate.identified_trials import IdentifiedTrials
from loopcal.estimate.methods.penalties import LeastSquares, Method
from loopcal.estimate.trial_identification import identify_trials
from loopcal.estimate.trial_posteriors import compute_trial_posterior
from loopcal.measure import Instrument, Trials, sample_truth, simulate_trials
from loopcal.mechanism import Mechanism, Status, forward, forward_trials, inverse
from loopcal.presentation import TableResult
from loopcal.typing import BoolArray, FloatArray, Progress, report_no_progress

BATCH = 250
"""Trials that are identified at once; progress is reported between them."""


@dataclass(frozen=True, eq=False)
class AccuracySimulation(TableResult):
    """Predicted and observed errors of n poses.

    Attributes
    ----------
    predicted : of the fit of the first trial, with its frame: platform origin, base axes.
    observed : (n, 6) root mean square error [rad, m].
    trials, failed : number of fits that converged, and that did not.
    """

    predicted: PoseUncertainty
    observed: FloatArray
    trials: int
    failed: int

    @property
    def ratio(self) -> FloatArray:
        """(n, 6) observed over predicted; NaN where the prediction is infinite or zero."""
        sd = self.predicted.sd
        valid = np.isfinite(sd) & (sd > 0.0)
        return np.divide(self.observed, sd, out=np.full(sd.shape, np.nan), where=valid)


def simulate_accuracy(
    robot: Mechanism,
    commanded: ArrayLike,
    instrument: Instrument,
    poses: ArrayLike,
    method: Method | None = None,
    trials: int = 2000,
    seed: int = 0,
    progress: Progress = report_no_progress,
) -> AccuracySimulation:
    """Compare predicted with observed errors of poses.

    Parameters
    ----------
    robot : its tolerances are those of the true errors, which each trial draws anew.
    commanded : measured poses, (m, 4, 4) or (m, c). instrument : with what they are measured.
    poses : compared poses, (n, 4, 4) or (n, c), at the readings of the nominal robot.
    method : default least squares. trials : their number. seed : of all random streams.
    progress : receives the trials that are done.

    Raises
    ------
    EstimationError : no trial converged.
    """
    truth = sample_truth(robot, trials, seed)
    measured = simulate_trials(robot, truth, commanded, instrument, seed)
    compared = inverse(robot.nominal, poses)
    method = method or LeastSquares()
    posterior, squares, converged = None, np.zeros((len(compared.q), 6)), 0
    for first in range(0, trials, BATCH):
        progress(first, trials, "calibrating simulated machines")
        batch = _take_trials(measured, slice(first, first + BATCH))
        fits = identify_trials(robot, batch, method)
        valid, errors = _compare_with_truth(fits, batch, compared.q, compared.state)
        if posterior is None and valid.any():
            posterior = compute_trial_posterior(fits, batch, int(np.flatnonzero(valid)[0]))
        if posterior is None:
            continue
        frames = fit_unfixed_frames(posterior)
        if frames.motions.shape[1]:
            closed, reference = _compare_with_truth(fits, batch, measured.readings)
            valid &= closed
            errors = frames.remove(errors, compared.T, reference)
        errors = errors[valid]
        squares += (errors**2).sum(axis=0)
        converged += len(errors)
    if posterior is None:
        raise EstimationError(f"none of the {trials} trials converged; check poses and method")
    predicted = pose_uncertainty(posterior, forward(posterior.robot, compared.q), point="platform")
    observed = np.sqrt(squares / converged)
    return AccuracySimulation(predicted, observed, converged, trials - converged)


def _take_trials(trials: Trials, chosen: slice) -> Trials:
    """Return some of the trials."""
    return replace(
        trials,
        measured=tuple(values[chosen] for values in trials.measured),
        truth=trials.truth[chosen],
        T=trials.T[chosen],
        reached=trials.reached[chosen],
        recorded=None if trials.recorded is None else trials.recorded[chosen],
    )


def _compare_with_truth(
    fits: IdentifiedTrials, trials: Trials, readings: FloatArray, start: State | None = None
) -> tuple[BoolArray, FloatArray]:
    """Return which trials (t,) have a fit and all poses at readings (n, a), and the errors (t, n,
    6) of these poses.
    """
    states = [
        forward_trials(fits.free_parameters.robot, values, readings[None], start)
        for values in (fits.values, trials.truth)
    ]
    is_closed = [(state.status == Status.CONVERGED).all(axis=1) for state in states]
    valid = fits.converged & is_closed[0] & is_closed[1]
    return valid, geometry.pose_difference(states[0].T, states[1].T)
