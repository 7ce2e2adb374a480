# SPDX-License-Identifier: Apache-2.0
"""Is the linear prediction of pose errors right? Many simulated calibrations, each with its own
truth and noise.

Predicted are standard deviations from D C D' of one fit; observed is the root mean square of the
errors of pose (identified against true machine, the same readings) over all trials. JCGM 101; see
docs/theory/uncertainty.md.
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
class MonteCarlo:
    """Predicted and observed errors of n poses.

    Attributes
    ----------
    predicted : of the first trial's fit: platform origin, base axes, no direction left out.
    observed : (n, 6) root mean square error [rad, m]. trials : how many fits converged. failed :
        how many did not.
    """

    predicted: PoseUncertainty
    observed: FloatArray
    trials: int
    failed: int

    @property
    def ratio(self) -> FloatArray:
        """(n, 6) observed over predicted; NaN where nothing is predicted or nothing moves."""
        sd = self.predicted.sd
        there = np.isfinite(sd) & (sd > 0.0)
        return np.divide(self.observed, sd, out=np.full(sd.shape, np.nan), where=there)


def monte_carlo(
    robot: Mechanism,
    commanded: ArrayLike,
    instrument: Instrument,
    where: ArrayLike,
    method: Method | None = None,
    trials: int = 2000,
    seed: int = 0,
) -> MonteCarlo:
    """Compare predicted with observed errors of pose.

    Parameters
    ----------
    robot : its tolerances are those of the true errors, drawn anew in each trial.
    commanded : poses that are measured, (m, 4, 4) or (m, c). instrument : with what.
    where : poses that are judged, (n, 4, 4) or (n, c); the nominal robot's readings there.
    method : default least squares. trials, seed : how many, and of which random streams.
    """
    truth = sample_truth(robot, trials, seed)
    measured = simulate_trials(robot, truth, commanded, instrument, seed)
    fits = identify_trials(robot, measured, method or LeastSquares())
    good = fits.converged
    judged = inverse(robot.nominal, where)
    states = [
        forward_trials(robot, values, judged.q[None], judged.state)
        for values in (fits.values, truth)
    ]
    closed = [(state.status == Status.CONVERGED).all(axis=1) for state in states]
    good = good & closed[0] & closed[1]
    errors = geometry.pose_difference(states[0].T[good], states[1].T[good])
    free, first = fits.unknowns, int(np.flatnonzero(good)[0])
    one = np.array([first])
    identified = robot.with_values(fits.values[first])
    known = compute_posterior(
        identified, free.places, free.tolerance, fits.decomposition.take(one), fits.penalty[one]
    )
    predicted = pose_uncertainty(
        known, forward(identified, judged.q), gauge="infinite", point="platform"
    )
    observed = np.sqrt((errors**2).mean(axis=0))
    return MonteCarlo(predicted, observed, int(good.sum()), int((~good).sum()))
