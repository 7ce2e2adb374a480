# SPDX-License-Identifier: Apache-2.0
"""Where a geometry says that the machine stood, by its readings as far as each of them is believed.

With as many actuators as freedoms a pose needs all its readings, and their sigmas do not move it.
Redundant readings contradict each other: the pose is where they fit best in units of their own
sigma, and one that was not taken may not be needed at all. See docs/theory/latent.md.
"""

from __future__ import annotations

import numpy as np

from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.inference.null_space import listed
from loopcal.estimate.latent import latent_rows
from loopcal.measure import Measurements, fill_in_reading_sigma
from loopcal.mechanism import Mechanism, Solution, forward, make_solution

SAME = 1e-9
"""Relative difference of sigma ratios below which a pose's readings are weighted as the robot
states.
"""


def predicted(robot: Mechanism, data: Measurements) -> tuple[Solution, np.ndarray]:
    """Return the poses of all readings, and which of them (n,) the readings that were taken and are
    believed tell.

    Raises
    ------
    DataError : a redundant reading that is stated to be exact.
    """
    sigma = data.reading_sigma
    if robot.program.sigma is None or sigma is None:
        told = (
            np.ones(data.n_poses, dtype=bool) if sigma is None else np.isfinite(sigma).all(axis=1)
        )
        return forward(robot, data.readings), np.asarray(told)
    ratio = sigma / np.array(robot.program.sigma)
    if np.isfinite(ratio).all() and np.ptp(ratio, axis=1).max() <= SAME * ratio.min():
        return forward(robot, data.readings), np.ones(data.n_poses, dtype=bool)
    return _fitted(robot, fill_in_reading_sigma(robot, data))


def untold(data: Measurements, told: np.ndarray) -> tuple[str, ...]:
    """Say which poses are left out because their readings do not tell them; not those without rows
    that count.
    """
    counts = np.zeros(data.n_poses, dtype=bool)
    for rows in data.observations:
        counts[rows.rows[rows.weight > 0.0]] = True
    names = [label for label, lost in zip(data.labels, counts & ~told, strict=True) if lost]
    return (
        (f"left out, a reading was not taken or is not believed: {listed(names)}",) if names else ()
    )


def _fitted(robot: Mechanism, data: Measurements) -> tuple[Solution, np.ndarray]:
    """Poses of redundant readings where these fit best by their sigmas, and which of them they
    determine (n,).
    """
    assert data.reading_sigma is not None
    nothing = np.zeros(0)
    fixed = FreeParameters(robot, nothing.astype(np.int64), nothing, nothing, nothing.astype(bool))
    rows = latent_rows(fixed, data.readings[None], data.reading_sigma, (), 1, lambda member: None)
    one = np.arange(1)
    here = rows.poses.settle(np.zeros((1, 0)), one, rows.memory.take(one))
    return make_solution(robot, here.standing.state, here.standing.q[0]), ~here.open[0].any(axis=1)
