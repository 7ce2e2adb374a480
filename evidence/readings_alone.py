# SPDX-License-Identifier: Apache-2.0
"""A machine that calibrates itself: the belt robot from 100 poses of readings alone, repeated.

One machine, drawn from the spreads, is measured again and again. Its readings determine nine of
twelve combinations of parameters. In the coordinates in which a fit calls their errors independent
and of variance one, the spread of the repeats must be one in every direction, and chi-square must
be that of its degrees of freedom.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.stats import chi2

from loopcal.estimate.identification import identify
from loopcal.estimate.penalties import LeastSquares
from loopcal.estimate.result import Identification
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.joints import Closure
from loopcal.measure.simulation import Trials, sample_truth, simulate_trials
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.workspace import sample_workspace
from loopcal.typing import FloatArray

SEED, POSES, REPEATS = 17, 100, 200
READINGS = Instrument((Sensor(Closure(), Gaussian(np.zeros(0))),))
BAND = 0.99


def measure_repeatedly(robot: Mechanism, repeats: int, poses: int) -> Trials:
    """Return repeats of the measurement of one machine that is drawn from the spreads."""
    truth = np.repeat(sample_truth(robot, 1, SEED), repeats, axis=0)
    coordinates = sample_workspace(robot, poses, SEED).coordinates
    return simulate_trials(robot, truth, coordinates, READINGS, SEED)


def whiten_errors(fit: Identification, truth: FloatArray) -> FloatArray:
    """Return the errors (k,) of the k determined directions over their standard deviations."""
    posterior = fit.posterior
    seen = posterior.determined
    error = (fit.robot.values - truth)[posterior.places] / posterior.unit
    return (posterior.directions[:, seen].T @ error) / np.sqrt(posterior.variance[seen])


def repeat_fits(repeats: int, poses: int = POSES) -> tuple[FloatArray, FloatArray, int]:
    """Return whitened errors (repeats, k) and chi-square (repeats,), and its degrees of freedom."""
    robot = load_robot("belt-4")
    trials = measure_repeatedly(robot, repeats, poses)
    fits = [identify(robot, trials.trial(i), LeastSquares()) for i in range(repeats)]
    assert all(fit.converged for fit in fits)
    errors = np.array([whiten_errors(fit, trials.truth[0]) for fit in fits])
    return errors, np.array([fit.chi_square for fit in fits]), int(fits[0].residual_test.dof)


QUICK = {"REPEATS": 20}


def check(tables: dict[str, Any]) -> None:
    """Assert what holds at the quick size."""
    one, _, squares, band, _ = tables["spread"]["rows"]
    assert 0.5 < one[1] < one[2] < 1.6
    assert band[1] < squares[1] <= squares[2] < band[2]


def collect() -> dict:
    """Collect the spread of all directions, and of the directions together, and chi-square."""
    errors, squares, degrees = repeat_fits(REPEATS)
    low, high = chi2.ppf([(1 - BAND) / 2, (1 + BAND) / 2], degrees) / degrees
    within = float(np.mean((squares / degrees >= low) & (squares / degrees <= high)))
    blocks = [np.sqrt((part**2).mean()) for part in np.split(errors, REPEATS // 20)]
    rows = [
        ["spread of one direction, smallest and largest of nine", *_ends(errors.std(axis=0))],
        ["spread of nine directions of 20 repeats, of 10 such sets", *_ends(np.array(blocks))],
        ["chi-square per degree of freedom, mean of 20 repeats", *_ends(_means(squares) / degrees)],
        [f"99 % band of chi-square per degree of freedom ({degrees})", float(low), float(high)],
        ["share of repeats within this band, and its expectation", within, BAND],
    ]
    return {
        "seeds": [SEED],
        "tables": {
            "spread": {
                "columns": ["100 poses, 200 repeats", "from", "to"],
                "formats": ["", ".3f", ".3f"],
                "rows": rows,
            }
        },
    }


def _means(squares: FloatArray) -> FloatArray:
    """Return means of 20 repeats."""
    return squares.reshape(-1, 20).mean(axis=1)


def _ends(values: FloatArray) -> tuple[float, float]:
    """Return the smallest and the largest value."""
    return float(values.min()), float(values.max())
