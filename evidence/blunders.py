# SPDX-License-Identifier: Apache-2.0
"""Outliers: accuracy with robust losses, detected outliers, and false alarms on clean data.

The 42-parameter hexapod with 40 poses, 1 um and 5 urad. Two poses are moved by 20 standard
deviations in the norm of the row, and one row comes from another machine (without its errors of
leg length).
"""

from dataclasses import replace
from typing import Any

import numpy as np

from loopcal.diagnose.outliers import find_outliers
from loopcal.estimate.identification import identify
from loopcal.estimate.losses import Huber, Tukey
from loopcal.estimate.penalties import LeastSquares
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.poses import Pose
from loopcal.measure.measurements import Measurements
from loopcal.measure.simulation import sample_truth, simulate

DRAWS, CLEAN, POSES = 200, 1000, 40
SIGMA = np.array([5e-6] * 3 + [1e-6] * 3)
OUTLIERS = (3, 22, 10)
LOSSES = {"least squares, no loss": None, "Huber": Huber(), "Tukey": Tukey()}
ROBOT = load_robot("hexapod-42")


def simulate_machine(seed: int) -> tuple[np.ndarray, Measurements]:
    """Return the true values of a drawn machine and its measurements."""
    truth = sample_truth(ROBOT, 1, seed)[0]
    return truth, simulate(ROBOT.with_values(truth), draw_poses(seed), make_instrument(), seed)


def make_instrument() -> Instrument:
    """Return an instrument of full poses."""
    return Instrument((Sensor(Pose(), Gaussian(SIGMA)),))


def draw_poses(seed: int) -> np.ndarray:
    """Draw coordinates from the workspace."""
    ranges = np.array([ROBOT.assembly.workspace[name] for name in ROBOT.controlled])
    return np.random.default_rng(seed).uniform(ranges[:, 0], ranges[:, 1], (POSES, len(ranges)))


def add_outliers(truth: np.ndarray, data: Measurements, seed: int) -> Measurements:
    """Return the measurements with three outliers."""
    rng, rows = np.random.default_rng(seed), data.observations[0]
    values = np.array(rows.measured)
    for pose in OUTLIERS[:2]:
        step = rng.standard_normal(6)
        values[pose] += 20.0 * step / np.linalg.norm(step) * SIGMA
    other = truth.copy()
    lengths = [i for i, name in enumerate(ROBOT.parameters.names) if name.endswith("length")]
    other[lengths] = ROBOT.values[lengths]
    run = simulate(ROBOT.with_values(other), draw_poses(seed), make_instrument(), seed)
    values[OUTLIERS[2]] = run.observations[0].measured[OUTLIERS[2]]
    return replace(data, observations=(replace(rows, measured=values),))


QUICK = {"DRAWS": 5, "CLEAN": 10}


def check(tables: dict[str, Any]) -> None:
    """Assert what holds at the quick size."""
    plain, huber, tukey = tables["robust"]["rows"]
    assert huber[2] == tukey[2] == 100.0
    assert max(huber[1], tukey[1]) < plain[1]


def collect() -> dict:
    """Return the tables."""
    squares = {name: [] for name in ("clean", *LOSSES)}
    named, falsely, leverage = dict.fromkeys(LOSSES, 0), dict.fromkeys(LOSSES, 0), []
    for seed in range(DRAWS):
        truth, data = simulate_machine(seed)
        bad = add_outliers(truth, data, seed)
        squares["clean"].append(
            np.mean((identify(ROBOT, data, LeastSquares()).estimate - truth) ** 2)
        )
        for name, loss in LOSSES.items():
            fit = identify(ROBOT, bad, LeastSquares(), loss=loss)
            result = find_outliers(fit, bad)
            squares[name].append(np.mean((fit.estimate - truth) ** 2))
            right = {data.labels[i] for i in OUTLIERS}
            named[name] += len(right & set(result.names))
            falsely[name] += len(set(result.names) - right)
            leverage.append(
                float(result.influence.leverage.sum() / result.influence.residuals.sum())
            )
    rms = {name: float(np.sqrt(np.mean(values))) for name, values in squares.items()}
    rows = [
        [
            name,
            rms[name] / rms["clean"],
            100.0 * named[name] / (len(OUTLIERS) * DRAWS),
            falsely[name] / DRAWS,
        ]
        for name in LOSSES
    ]
    alarms = sum(
        bool(find_outliers(identify(ROBOT, d, LeastSquares()), d).outliers)
        for d in (simulate_machine(s)[1] for s in range(CLEAN))
    )
    return {
        "seeds": [0, CLEAN],
        "tables": {
            "robust": {
                "columns": [
                    "fit",
                    "parameter error / error with clean data",
                    "outliers named [%]",
                    "correct poses named as outliers, per data set",
                ],
                "formats": ["", ".3g", ".1f", ".3f"],
                "rows": rows,
            },
            "alarms": {
                "columns": [
                    "clean data sets",
                    "false alarms [%]",
                    "nominal level [%]",
                    "mean leverage of a row",
                ],
                "formats": ["d", ".1f", ".1f", ".2f"],
                "rows": [[CLEAN, 100.0 * alarms / CLEAN, 5.0, float(np.mean(leverage))]],
            },
        },
    }
