# SPDX-License-Identifier: Apache-2.0
"""Transmissions: the value of a joint from the reading of its actuator, and back.

    joint = offset + gain r + curve r^2 + sin1 sin(w r) + cos1 cos(w r)
            + sin2 sin(2 w r) + cos2 cos(2 w r) + backlash d / 2

with w = 2 pi / period and d = +1 or -1 the direction from which the reading was approached (0 if
unknown). A gear ratio or a spool radius is a gain. A spool whose radius changes with the line on it
is a curve: radius r0 - b phi / (2 pi) pays out r0 phi - b phi^2 / (4 pi). Derivation:
docs/theory/parameters.md.

Readings are (t, n, a), or (t, n, 2 a) with the directions of approach behind them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from loopcal.errors import MechanismError
from loopcal.mechanism.assembly import Actuator
from loopcal.typing import FloatArray

TERMS = ("offset", "gain", "curve", "sin1", "cos1", "sin2", "cos2", "backlash")
"""Terms in the order of the last axis of tau (t, a, 8).

Each has the joint's unit, per power of the reading's unit.
"""


def nominal_terms(actuators: Sequence[Actuator]) -> FloatArray:
    """Return the nominal transmission terms (a, 8).

    Raises
    ------
    MechanismError
        Unknown term, or a gain of zero.
    """
    for actuator in actuators:
        wrong = sorted(set(actuator.terms) - set(TERMS))
        if wrong:
            raise MechanismError(
                f"actuator {actuator.name!r} has an unknown term {wrong[0]!r}; allowed are "
                f"{', '.join(TERMS)}"
            )
        if actuator.terms.get("gain", 1.0) == 0.0:
            raise MechanismError(
                f"actuator {actuator.name!r} has a gain of 0, so its reading moves nothing; "
                "state a gain other than 0"
            )
    rows = [
        [a.terms.get(term, 1.0 if term == "gain" else 0.0) for term in TERMS] for a in actuators
    ]
    return np.array(rows, dtype=float).reshape(-1, len(TERMS))


def harmonic_frequencies(actuators: Sequence[Actuator]) -> FloatArray:
    """Return the angular frequency of the harmonics (a,) [rad per unit of reading], 0 for none."""
    return np.array([2 * np.pi / a.period if a.period else 0.0 for a in actuators])


def term_derivatives(
    q: FloatArray, w: FloatArray, terms: Sequence[int] = range(len(TERMS))
) -> list[FloatArray]:
    """Return the derivative of the joint values in each of the 8 terms, or in some of them, arrays
    (t | 1, n, a).
    """
    r, approach = split_readings(q, len(w))
    # with w = 0 the cosines would repeat the offset
    on = (w != 0).astype(float)
    columns = {
        "offset": lambda: np.ones_like(r),
        "gain": lambda: r,
        "curve": lambda: r * r,
        "sin1": lambda: np.sin(w * r),
        "cos1": lambda: on * np.cos(w * r),
        "sin2": lambda: np.sin(2 * w * r),
        "cos2": lambda: on * np.cos(2 * w * r),
        "backlash": lambda: 0.5 * approach,
    }
    return [columns[TERMS[term]]() for term in terms]


def joints_from_readings(q: FloatArray, tau: FloatArray, w: FloatArray) -> FloatArray:
    """Return the joint values (t, n, a) of readings q under terms tau (t | 1, a, 8)."""
    if not tau[..., 2:].any():
        return tau[:, None, :, 0] + split_readings(q, len(w))[0] * tau[:, None, :, 1]
    columns = term_derivatives(q, w)
    return sum(
        (columns[i] * tau[:, None, :, i] for i in range(1, len(TERMS))),
        start=columns[0] * tau[:, None, :, 0],
    )


def joint_slopes(q: FloatArray, tau: FloatArray, w: FloatArray) -> FloatArray:
    """Return d joint / d reading (t, n, a), of plain gains (t | 1, 1, a)."""
    if not tau[..., 2:7].any():
        return tau[:, None, :, 1]
    r, _ = split_readings(q, len(w))
    turn = w * r
    _, gain, curve, sin1, cos1, sin2, cos2, _ = np.moveaxis(tau[:, None], -1, 0)
    first = w * (sin1 * np.cos(turn) - cos1 * np.sin(turn))
    second = 2 * w * (sin2 * np.cos(2 * turn) - cos2 * np.sin(2 * turn))
    return gain + 2 * curve * r + first + second


def readings_from_joints(joints: FloatArray, tau: FloatArray, w: FloatArray) -> FloatArray:
    """Return the readings (t, n, a) of joint values, without backlash.

    The linear terms are inverted exactly; Newton's method adds the others.
    """
    readings = (joints - tau[:, None, :, 0]) / tau[:, None, :, 1]
    if not tau[..., 2:7].any():
        return readings
    for _ in range(20):
        step = (joints_from_readings(readings, tau, w) - joints) / joint_slopes(readings, tau, w)
        readings = readings - step
        if np.abs(step).max(initial=0.0) <= 1e-15 * np.abs(readings).max(initial=1.0):
            break
    return readings


def split_readings(q: FloatArray, a: int) -> tuple[FloatArray, FloatArray]:
    """Return readings and directions of approach, the latter 0 where none are given."""
    return q[..., :a], q[..., a:] if q.shape[-1] == 2 * a else np.zeros_like(q[..., :a])
