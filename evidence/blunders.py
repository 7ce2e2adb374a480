# SPDX-License-Identifier: Apache-2.0
"""Wrong rows: what a loss saves, what is named, and false alarms on clean data.

The 42-parameter hexapod, 40 poses, 1 um and 5 urad. Blunders: two poses moved by 20 standard
deviations in the norm of the row, and one row of another run (the machine without its errors of leg
length).
"""

from dataclasses import replace

import numpy as np

from loopcal.diagnose import find_outliers
from loopcal.estimate import Huber, LeastSquares, Tukey, identify
from loopcal.io import load_robot
from loopcal.measure import Gaussian, Instrument, Measurements, Pose, Sensor, sample_truth, simulate

DRAWS, CLEAN, POSES = 200, 1000, 40
SIGMA = np.array([5e-6] * 3 + [1e-6] * 3)
WRONG = (3, 22, 10)
LOSSES = {"least squares, no loss": None, "Huber": Huber(), "Tukey": Tukey()}
ROBOT = load_robot("hexapod-42")


def measured(seed: int) -> tuple[np.ndarray, Measurements]:
    """Return the true values of a drawn machine and its measurements."""
    truth = sample_truth(ROBOT, 1, seed)[0]
    return truth, simulate(ROBOT.with_values(truth), poses(seed), instrument(), seed)


def instrument() -> Instrument:
    """Full poses."""
    return Instrument((Sensor(Pose(), Gaussian(SIGMA)),))


def poses(seed: int) -> np.ndarray:
    """Random coordinates in the workspace."""
    ranges = np.array([ROBOT.assembly.workspace[name] for name in ROBOT.controlled])
    return np.random.default_rng(seed).uniform(ranges[:, 0], ranges[:, 1], (POSES, len(ranges)))


def with_blunders(truth: np.ndarray, data: Measurements, seed: int) -> Measurements:
    """Return the measurements with three wrong rows."""
    rng, rows = np.random.default_rng(seed), data.observations[0]
    values = np.array(rows.measured)
    for pose in WRONG[:2]:
        step = rng.standard_normal(6)
        values[pose] += 20.0 * step / np.linalg.norm(step) * SIGMA
    other = truth.copy()
    lengths = [i for i, name in enumerate(ROBOT.parameters.names) if name.endswith("length")]
    other[lengths] = ROBOT.values[lengths]
    run = simulate(ROBOT.with_values(other), poses(seed), instrument(), seed)
    values[WRONG[2]] = run.observations[0].measured[WRONG[2]]
    return replace(data, observations=(replace(rows, measured=values),))


def collect() -> dict:
    """Return the tables."""
    squares = {name: [] for name in ("clean", *LOSSES)}
    named, falsely, leverage = dict.fromkeys(LOSSES, 0), dict.fromkeys(LOSSES, 0), []
    for seed in range(DRAWS):
        truth, data = measured(seed)
        bad = with_blunders(truth, data, seed)
        squares["clean"].append(
            np.mean((identify(ROBOT, data, LeastSquares()).estimate - truth) ** 2)
        )
        for name, loss in LOSSES.items():
            fit = identify(ROBOT, bad, LeastSquares(), loss=loss)
            found = find_outliers(fit, bad)
            squares[name].append(np.mean((fit.estimate - truth) ** 2))
            right = {data.labels[i] for i in WRONG}
            named[name] += len(right & set(found.names))
            falsely[name] += len(set(found.names) - right)
            leverage.append(float(found.influence.leverage.sum() / found.influence.residuals.sum()))
    rms = {name: float(np.sqrt(np.mean(values))) for name, values in squares.items()}
    rows = [
        [
            name,
            rms[name] / rms["clean"],
            100.0 * named[name] / (len(WRONG) * DRAWS),
            falsely[name] / DRAWS,
        ]
        for name in LOSSES
    ]
    alarms = sum(
        bool(find_outliers(identify(ROBOT, d, LeastSquares()), d).outliers)
        for d in (measured(s)[1] for s in range(CLEAN))
    )
    return {
        "seeds": [0, CLEAN],
        "tables": {
            "robust": {
                "columns": [
                    "fit",
                    "parameter error over that of clean data",
                    "wrong rows named [%]",
                    "right poses named, a data set",
                ],
                "formats": ["", ".3g", ".1f", ".3f"],
                "rows": rows,
            },
            "alarms": {
                "columns": [
                    "clean data sets",
                    "with an alarm [%]",
                    "stated level [%]",
                    "mean leverage of a row",
                ],
                "formats": ["d", ".1f", ".1f", ".2f"],
                "rows": [[CLEAN, 100.0 * alarms / CLEAN, 5.0, float(np.mean(leverage))]],
            },
        },
    }
