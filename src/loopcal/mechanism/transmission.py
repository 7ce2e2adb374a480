# SPDX-License-Identifier: Apache-2.0
"""From an actuator's reading to the value of the joint it drives.

    joint = offset + gain r + sin1 sin(w r) + cos1 cos(w r) + sin2 sin(2 w r) + cos2 cos(2 w r),   w = 2 pi / period

Derivation and use: docs/theory/parameters.md.
"""

from __future__ import annotations

import numpy as np

from loopcal.mechanism.assembly import Actuator, Array

TERMS = ("offset", "gain", "sin1", "cos1", "sin2", "cos2")
"""Terms in the order of the last axis of tau (t, a, 6); `gain` is a ratio, the others have the joint's unit."""


def nominal_terms(actuators: tuple[Actuator, ...]) -> Array:
    """Nominal transmission terms (a, 6) of these actuators."""
    return np.array([[a.terms.get(term, 1.0 if term == "gain" else 0.0) for term in TERMS] for a in actuators]).reshape(-1, 6)


def frequency(actuators: tuple[Actuator, ...]) -> Array:
    """Angular frequency of the harmonics (a,) [rad per unit of reading], 0 where there are none."""
    return np.array([2 * np.pi / a.period if a.period else 0.0 for a in actuators])


def joint_values(readings: Array, tau: Array, w: Array) -> Array:
    """Joint values (t, n, a) of readings (t | 1, n, a) under terms tau (t | 1, a, 6)."""
    columns = term_columns(readings, w)
    return sum((columns[i] * tau[:, None, :, i] for i in range(1, len(TERMS))), start=columns[0] * tau[:, None, :, 0])


def term_columns(readings: Array, w: Array) -> list[Array]:
    """Derivative of the joint values in each term, six arrays (t | 1, n, a)."""
    a = w * readings
    # with w = 0 the cosines would repeat the offset
    on = (w != 0).astype(float)
    return [np.ones_like(readings), readings, np.sin(a), on * np.cos(a), np.sin(2 * a), on * np.cos(2 * a)]


def slope(readings: Array, tau: Array, w: Array) -> Array:
    """d joint / d reading (t, n, a)."""
    a, tau = w * readings, tau[:, None]
    return (
        tau[..., 1]
        + w * (tau[..., 2] * np.cos(a) - tau[..., 3] * np.sin(a))
        + 2 * w * (tau[..., 4] * np.cos(2 * a) - tau[..., 5] * np.sin(2 * a))
    )


def readings_of(joints: Array, tau: Array, w: Array) -> Array:
    """Readings (t, n, a) that give these joint values: the linear part, then Newton on the harmonics."""
    readings = (joints - tau[:, None, :, 0]) / tau[:, None, :, 1]
    if not w.any():
        return readings
    for _ in range(8):
        readings = readings - (joint_values(readings, tau, w) - joints) / slope(readings, tau, w)
    return readings
