# SPDX-License-Identifier: Apache-2.0
"""A hexapod measured by a pose probe, simulated without the kinematics of loopcal.

True poses are drawn, and the readings follow from the true leg lengths in closed form. An error of
a drive is part of the reading: the machine stands elsewhere than its reading says.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import loopcal as lc

Array = NDArray[np.float64]
DriveError = Callable[[Array, np.random.Generator], Array]
"""Errors (n, 6) [m] of readings (n, 6) [m], in the order of measurement."""

ROBOT = lc.load_robot("hexapod-42")
TABLE, WORKSPACE = ROBOT.parameters, ROBOT.assembly.workspace
BASE, PLATFORM = (
    np.array([[TABLE.index(f"leg{leg}.{end}.{axis}") for axis in "xyz"] for leg in range(1, 7)])
    for end in ("base", "platform")
)
LENGTH = np.array([TABLE.index(f"leg{leg}.length") for leg in range(1, 7)])


@dataclass(frozen=True, eq=False)
class MeasuredHexapod:
    """A drawn machine. truth : (p,) [SI]. data : measured poses. readings, positions : (h, 6), (h,
    3) [m] of poses that are not measured.
    """

    truth: Array
    data: lc.Measurements
    readings: Array
    positions: Array


def measure_hexapod(
    seed: int, sigma: tuple[float, float], poses: int = 60, noise: float = 1.0,
    error: DriveError | None = None, unmeasured: int = 12,
) -> MeasuredHexapod:  # fmt: skip
    """Measure a drawn machine.

    sigma : stated, of a position [m] and an angle [rad]. noise : true one in stated sigmas.
    """
    rng, n = np.random.default_rng([31, seed]), poses
    truth = TABLE.nominal + np.asarray(TABLE.tolerance) * rng.standard_normal(len(TABLE))
    low, high = np.array([WORKSPACE[c] for c in ("x", "y", "z", "roll", "pitch", "yaw")]).T
    x = rng.uniform(low, high, (n + unmeasured, 6))
    R = Rotation.from_euler("xyz", x[:, 3:])
    legs = x[:, None, :3] + np.einsum("nij,kj->nki", R.as_matrix(), truth[PLATFORM]) - truth[BASE]
    q = np.linalg.norm(legs, axis=2) - truth[LENGTH]
    q = q if error is None else q - error(q, rng)
    stated = np.array([sigma[1]] * 3 + [sigma[0]] * 3)
    drawn = noise * stated * rng.standard_normal((n, 6))
    turned = (Rotation.from_rotvec(drawn[:, :3]) * R[:n]).as_rotvec()
    measured = np.hstack([turned, x[:n, :3] + drawn[:, 3:]])
    kind = lc.Pose().with_tool(ROBOT.tool)
    rows = lc.Observations.from_sigma(kind, np.arange(n), measured, stated)
    data = lc.Measurements(ROBOT.name, q[:n], (rows,), labels=tuple(map(str, range(1, n + 1))))
    return MeasuredHexapod(truth, data, q[n:], x[n:, :3])


def draw_repeatability(size: float) -> DriveError:
    """Return independent normal errors of this standard deviation [m]."""
    return lambda q, rng: size * rng.standard_normal(q.shape)


def make_backlash(size: float) -> DriveError:
    """Return half a backlash [m] in the direction of travel from the pose before."""

    def error(q: Array, rng: np.random.Generator) -> Array:
        before = np.vstack([q[0] - rng.standard_normal(6), q[:-1]])
        return 0.5 * size * np.sign(q - before)

    return error


def make_periodic_error(amplitude: float, period: float) -> DriveError:
    """Return the error of a gear or a screw of this amplitude and period [m]."""
    return lambda q, rng: amplitude * np.sin(2.0 * np.pi * (q / period + rng.uniform(size=6)))
