# SPDX-License-Identifier: Apache-2.0
"""The posterior of one of many simulated machines that were identified at once."""

from __future__ import annotations

import numpy as np

from loopcal.estimate.frame_freedoms import find_measured_frames
from loopcal.estimate.identified_trials import IdentifiedTrials
from loopcal.estimate.inference.posterior import Posterior, VarianceSources, compute_posterior
from loopcal.estimate.problem_construction import problem_of
from loopcal.measure import Trials


def compute_trial_posterior(fits: IdentifiedTrials, trials: Trials, trial: int) -> Posterior:
    """Return the posterior of a trial, as its own `identify` gives it for stated noise.

    Parameters
    ----------
    fits : of `identify_trials`. trials : their measurements. trial : number of the machine.
    """
    free, chosen = fits.free_parameters, np.array([trial])
    data = trials.trial(trial)
    problem = problem_of(free, data)
    z = free.deviation(fits.values[chosen])
    start = problem.start(z)
    linearization = problem.linearize(z, start)
    frames = find_measured_frames(
        problem, data, z, linearization.next_start, linearization=linearization
    )
    prior = fits.prior_variance
    return compute_posterior(
        free.robot.with_values(fits.values[trial]),
        free.places,
        free.tolerance,
        fits.decomposition.take(chosen),
        fits.penalty[chosen],
        VarianceSources(1.0, None if prior is None else prior[chosen]),
        frames,
    )
