# SPDX-License-Identifier: Apache-2.0
"""Check the linear prediction of pose errors by many simulated calibrations.

Every trial has its own true machine and its own noise. Predicted are the standard deviations from
D C D' of one fit. Observed is the root mean square, over all trials, of the pose error between the
identified and the true machine at the same readings. JCGM 101; see docs/theory/uncertainty.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from loopcal import geometry
from loopcal.apply.accuracy import PoseUncertainty, pose_uncertainty
from loopcal.estimate.identification import identify_trials
from loopcal.estimate.inference.posterior import compute_posterior
from loopcal.estimate.methods.penalties import LeastSquares, Method
from loopcal.measure import Instrument, sample_truth, simulate_trials
from loopcal.mechanism import Mechanism, Status, forward, forward_trials, inverse
from loopcal.typing import FloatArray


@dataclass(frozen=True, eq=False)
class AccuracySimulation:
    """Predicted and observed errors of n poses.

    Attributes
    ----------
    predicted : of the fit of the first trial: platform origin, base axes, no direction excluded.
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
    where: ArrayLike,
    method: Method | None = None,
    trials: int = 2000,
    seed: int = 0,
) -> AccuracySimulation:
    """Compare predicted with observed errors of poses.

    Parameters
    ----------
    robot : its tolerances are those of the true errors, which each trial draws anew.
    commanded : measured poses, (m, 4, 4) or (m, c). instrument : with what they are measured.
    where : compared poses, (n, 4, 4) or (n, c), at the readings of the nominal robot.
    method : default least squares. trials : their number. seed : of all random streams.
    """
    truth = sample_truth(robot, trials, seed)
    measured = simulate_trials(robot, truth, commanded, instrument, seed)
    fits = identify_trials(robot, measured, method or LeastSquares())
    compared = inverse(robot.nominal, where)
    states = [
        forward_trials(robot, values, compared.q[None], compared.state)
        for values in (fits.values, truth)
    ]
    closed = [(state.status == Status.CONVERGED).all(axis=1) for state in states]
    valid = fits.converged & closed[0] & closed[1]
    errors = geometry.pose_difference(states[0].T[valid], states[1].T[valid])
    free, first = fits.free_parameters, int(np.flatnonzero(valid)[0])
    trial = np.array([first])
    identified = robot.with_values(fits.values[first])
    known = compute_posterior(
        identified, free.places, free.tolerance, fits.decomposition.take(trial), fits.penalty[trial]
    )
    predicted = pose_uncertainty(
        known, forward(identified, compared.q), gauge="infinite", point="platform"
    )
    observed = np.sqrt((errors**2).mean(axis=0))
    return AccuracySimulation(predicted, observed, int(valid.sum()), int((~valid).sum()))
