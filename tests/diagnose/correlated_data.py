# SPDX-License-Identifier: Apache-2.0
"""Simulated measurements whose errors are correlated, drift, or depend on a session."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from loopcal.diagnose.residual_patterns import FitRoot, ResidualRows
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.poses import Component, Pose
from loopcal.measure.kinds.position import Position
from loopcal.measure.measurements import Measurements
from loopcal.measure.simulation import sample_truth, simulate
from loopcal.mechanism.workspace import sample_workspace
from loopcal.numerics.split_columns import SplitColumns

LENGTH, ANGLE = 5e-6, 25e-6
"""Stated noise [m], [rad]."""

ROBOTS = {name: load_robot(name) for name in ("linear-delta", "3-prs", "hexapod-42")}
TARGETS = 0.05 * np.array([[1.0, 0.0, 0.0], [-0.5, 0.8, 0.0], [-0.5, -0.8, 1.0]])
SENSORS = {
    "component": Sensor(Component(("x", "y", "z")), Gaussian(np.full(3, LENGTH))),
    "pose": Sensor(Pose(), Gaussian(np.array([ANGLE] * 3 + [LENGTH] * 3))),
    "tracker": Sensor(
        Position(targets=("a", "b", "c"), places=TARGETS, unknown=("frame",)),
        Gaussian(np.full(9, LENGTH)),
    ),
}


def measure(
    robot: str,
    kind: str,
    errors: np.ndarray,
    seed: int,
    session: np.ndarray | None = None,
    context: Mapping[str, np.ndarray] | None = None,
) -> tuple[np.ndarray, Measurements]:
    """Return the true values of a machine drawn from the spreads, and its measurements with
    errors (n, m) in units of the stated noise.
    """
    machine, sensor = ROBOTS[robot], SENSORS[kind]
    truth = sample_truth(machine, 1, seed)[0]
    poses = sample_workspace(machine, len(errors), seed).coordinates
    sigma = np.asarray(sensor.noise.sigma)
    exact = Sensor(sensor.kind, Gaussian(1e-9 * sigma))
    data = simulate(machine.with_values(truth), poses, Instrument((exact,)), seed)
    (rows,) = data.observations
    rows = replace(
        rows,
        measured=rows.measured + errors[: len(rows)] * sigma,
        covariance=np.diag(sigma**2),
        session=rows.session if session is None else session[: len(rows)],
        context={} if context is None else {k: v[: len(rows)] for k, v in context.items()},
    )
    return truth, replace(data, observations=(rows,))


def draw_errors(n: int, m: int, seed: int, correlation: float = 0.0) -> np.ndarray:
    """Return m series (n, m) of unit variance, each of this correlation of neighbors (AR(1))."""
    drawn = np.random.default_rng([seed, 5]).standard_normal((n, m))
    errors = drawn.copy()
    for i in range(1, n):
        errors[i] = correlation * errors[i - 1] + np.sqrt(1.0 - correlation**2) * drawn[i]
    return errors


def make_rows(basis, errors, series=None):
    """Return rows (R,) with given errors, from which what is estimated, basis (R, q), is taken."""
    zero, columns = np.zeros(len(errors), dtype=np.int64), SplitColumns.of(basis)
    root = FitRoot(np.eye(basis.shape[1]), zero[:0], None)
    numbers = zero, zero, zero, zero if series is None else series
    return ResidualRows(columns, columns.remove(errors), columns, root, *numbers)
