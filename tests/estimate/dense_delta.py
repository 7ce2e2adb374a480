# SPDX-License-Identifier: Apache-2.0
"""A linear delta in closed form, with dense least squares: nothing of loopcal's estimation.

The nozzle is the lower point at the distance arm_k from the three carriages, which is the
intersection of three spheres. Derivatives are complex steps.
"""

from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from scipy.optimize import least_squares

TOLERANCE = np.array([0.5e-3, *[np.radians(0.3), 0.3e-3, 0.5e-3] * 2, 0.3e-3, 0.5e-3])
NOMINAL = np.array([0.105, np.radians(210), 0.22, 0.3, np.radians(330), 0.22, 0.3, 0.22, 0.3])
THIRD_ANGLE = np.radians(90)


def locate_nozzle(values, readings):
    """Return positions (n, 3) [m] at readings (n, 3): the intersection of three spheres."""
    radius, a1, l1, s1, a2, l2, s2, l3, s3 = values
    centers, arms = [], (l1, l2, l3)
    for k, (angle, arm, stop) in enumerate(((a1, l1, s1), (a2, l2, s2), (THIRD_ANGLE, l3, s3))):
        height = stop + np.sqrt(arm**2 - radius**2) - readings[:, k]
        x, y = radius * np.cos(angle), radius * np.sin(angle)
        centers.append(np.stack([x + 0 * height, y + 0 * height, height], axis=1))
    first = centers[0]
    normals = [2.0 * (center - first) for center in centers[1:]]
    offsets = [
        ((c**2).sum(axis=1) - (first**2).sum(axis=1) - arm**2 + arms[0] ** 2)[:, None]
        for c, arm in zip(centers[1:], arms[1:], strict=True)
    ]
    line = np.cross(*normals)
    across = offsets[0] * np.cross(normals[1], line) + offsets[1] * np.cross(line, normals[0])
    point = across / (line**2).sum(axis=1)[:, None]
    a = (line**2).sum(axis=1)
    b = (line * (point - first)).sum(axis=1)
    c = ((point - first) ** 2).sum(axis=1) - arms[0] ** 2
    root = np.sqrt(b**2 - a * c)
    both = [point + ((-b + sign * root) / a)[:, None] * line for sign in (1.0, -1.0)]
    lower = both[0][:, 2].real < both[1][:, 2].real
    return np.where(lower[:, None], both[0], both[1])


def differentiate(values, readings):
    """Return positions and their derivatives (n, 3, 9) by the parameters, in spreads."""
    steps = 1e-30j * np.diag(TOLERANCE)
    slopes = [locate_nozzle(values + step, readings).imag / 1e-30 for step in steps]
    return locate_nozzle(values, readings), np.stack(slopes, axis=2)


@dataclass(frozen=True)
class DenseFit:
    """Estimates (9,) [SI], whitened residuals b (m,) = measured - predicted, and rows A (m, 9) in
    spreads.
    """

    estimate: np.ndarray
    b: np.ndarray
    A: np.ndarray

    @property
    def data(self):
        """(m,) whitened values that a linear fit about nominal sees: b + A z."""
        return self.b + self.A @ ((self.estimate - NOMINAL) / TOLERANCE)


def fit_delta(readings, measured, sigma, penalty=0.0):
    """Estimate the nine parameters by scipy: least squares, with penalty * z^2 if there is one."""

    def residual(z):
        rows = (locate_nozzle(NOMINAL + TOLERANCE * z, readings) - measured).ravel() / sigma
        return np.r_[rows, np.sqrt(penalty) * z]

    def slope(z):
        D = differentiate(NOMINAL + TOLERANCE * z, readings)[1]
        return np.vstack([D.reshape(-1, 9) / sigma, np.sqrt(penalty) * np.eye(9)])

    result = least_squares(
        residual, np.zeros(9), cast(Any, slope), method="lm", xtol=1e-12, ftol=1e-12, gtol=1e-12
    )
    m = measured.size
    return DenseFit(NOMINAL + TOLERANCE * result.x, -result.fun[:m], slope(result.x)[:m])
