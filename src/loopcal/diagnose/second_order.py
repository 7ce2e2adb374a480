# SPDX-License-Identifier: Apache-2.0
"""Measure by how much second-order effects of a change of parameters exceed the noise.

A linear test of parameters compares a difference d with its covariance. Along directions that the
data hardly determine d may be large, and its second-order effect on the poses is taken for an
effect of the other parameters. With the pose T(e) of the estimate, in twists relative to it,

    r = (T(e + d) + T(e - d)) / 2

is this effect, without any first-order part. The parameters that would cause it, in posterior
standard deviations, are w = argmin |G w - r|, where the columns of G are the derivatives of the
poses by one standard deviation of each determined direction. |w|^2 is comparable with the
chi-square of the test.
"""

from __future__ import annotations

import numpy as np

from loopcal.errors import MechanismError
from loopcal.estimate.inference.posterior import Posterior
from loopcal.geometry import log_so3
from loopcal.measure import make_random_stream
from loopcal.mechanism import (
    POSITION,
    Mechanism,
    compute_readings,
    forward_trials,
    inverse_trials,
    read_coordinates,
    sample_workspace,
)
from loopcal.typing import FloatArray

POSES, NEAR = 20, 0.05
"""Poses at which machines are compared; without a stated workspace their distance from home: a
share of the robot's size, or radians.
"""
STEP = 1e-3
"""Step of the differences that make G [standard deviations]."""
SMALLEST = 1e-8
"""Singular values of G below this share of the largest count as zero."""
DRAWN_POSES = 5  # purpose of a random stream


def draw_readings(robot: Mechanism) -> FloatArray:
    """Return readings (1, POSES, a) [SI] of poses in the workspace, or else near home."""
    try:
        target = sample_workspace(robot, POSES, 0).coordinates
    except MechanismError:
        home = read_coordinates(robot.home[None], robot.controlled)[0]
        drawn = make_random_stream(0, 0, DRAWN_POSES).uniform(-1.0, 1.0, (POSES, len(home)))
        is_length = np.isin(robot.controlled, POSITION)
        target = home + drawn * np.where(is_length, NEAR * robot.size, NEAR)
    known = robot.values[None]
    return compute_readings(robot, known, inverse_trials(robot, known, target[None]))


def measure_second_order(posterior: Posterior, change: FloatArray) -> float:
    """Return the chi-square of the second-order effect of a change (p,) [SI] of the parameters."""
    robot, places = posterior.robot, posterior.places
    is_known = posterior.determined & np.isfinite(posterior.variance)
    sd = np.sqrt(posterior.variance[is_known])
    steps = STEP * posterior.unit[:, None] * posterior.directions[:, is_known] * sd  # (p, k)
    changes = np.vstack([np.zeros_like(change), change, -change, *steps.T, *-steps.T])
    values = np.repeat(robot.values[None], len(changes), axis=0)
    values[:, places] += changes
    T = forward_trials(robot, values, draw_readings(robot)).T
    T = T[:, np.isfinite(T).all(axis=(0, 2, 3))]
    if not T.shape[1]:
        return np.inf
    turned = np.matmul(T[:, :, :3, :3], T[0, :, :3, :3].swapaxes(-1, -2))
    twists = np.concatenate(
        [log_so3(turned) * robot.size, T[..., :3, 3] - T[0, :, :3, 3]], axis=-1
    ).reshape(len(changes), -1)
    k = len(sd)
    G = (twists[3 : 3 + k] - twists[3 + k :]).T / (2.0 * STEP)
    w = np.linalg.lstsq(G, 0.5 * (twists[1] + twists[2]), rcond=SMALLEST)[0]
    return float(w @ w)
