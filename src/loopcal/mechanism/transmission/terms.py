# SPDX-License-Identifier: Apache-2.0
"""Transmissions: the value of a joint from the reading of its actuator, and back.

    joint = offset + gain r + curve r^2 + sin1 sin(w r) + cos1 cos(w r)
            + sin2 sin(2 w r) + cos2 cos(2 w r) + backlash d / 2

with w = 2 pi / period and d = +1 or -1 the direction from which the reading was approached (0 if
unknown). A gear ratio or a spool radius is a gain. A spool whose radius changes with the line on it
is a curve: radius r0 - b phi / (2 pi) pays out r0 phi - b phi^2 / (4 pi). Derivation:
docs/theory/parameters.md. Of a triangle drive this is the length of the actuator, from which the
joint's angle follows (`loopcal.mechanism.transmission.triangle`).

Readings are (t, n, a), or (t, n, 2 a) with the directions of approach behind them. Terms tau are
(t, a, 8), or (t, a, 18) with those of triangles behind them, all zero for any other drive. Where a
drive reads a sum of joint values, the weights W of the J driven joints follow, (t, a, 18 + J), and
the formula gives the sums s = W joints (`loopcal.mechanism.transmission.sums`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from loopcal.errors import MechanismError
from loopcal.mechanism.assembly import Actuator
from loopcal.mechanism.transmission.sums import apply_weights, invert_weights
from loopcal.mechanism.transmission.triangle import (
    MOVABLE,
    TRIANGLE_TERMS,
    compute_angle,
    compute_length,
    compute_range,
    differentiate_length,
)
from loopcal.typing import FloatArray, IntArray

TERMS = ("offset", "gain", "curve", "sin1", "cos1", "sin2", "cos2", "backlash")
"""Terms in the order of the last axis of tau (t, a, 8).

Each has the joint's unit, per power of the reading's unit; of a triangle drive, that of its length.
"""
ALL_TERMS = (*TERMS, *TRIANGLE_TERMS)
"""Terms of a robot with triangle drives, in the order of the last axis of tau (t, a, 18)."""
SIDE = ALL_TERMS.index("side")
WEIGHT = "weight."
"""What the name of the term of a weight begins with; the name of a driven joint follows."""


def name_terms(actuators: Sequence[Actuator]) -> tuple[str, ...]:
    """Return the names of the terms of actuators, in the order of the last axis of tau."""
    if any(a.weights for a in actuators):
        joints = dict.fromkeys(name for a in actuators for name in a.driven_joints)
        return (*ALL_TERMS, *(f"{WEIGHT}{name}" for name in joints))
    return ALL_TERMS if any("side" in a.terms for a in actuators) else TERMS


def nominal_terms(actuators: Sequence[Actuator]) -> FloatArray:
    """Return the nominal transmission terms (a, 8), or (a, 18) if one is a triangle drive.

    With summed drives they are (a, 18 + J).

    Raises
    ------
    MechanismError
        Unknown term, or a gain of zero.
    """
    for actuator in actuators:
        wrong = sorted(set(actuator.terms) - set(ALL_TERMS))
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
    terms, rows = name_terms(actuators), []
    for a in actuators:
        weights = {f"{WEIGHT}{name}": w for name, w in (a.weights or {a.name: 1.0}).items()}
        stated = {"gain": 1.0, **a.terms, **weights}
        rows.append([stated.get(term, 0.0) for term in terms])
    return np.array(rows, dtype=float).reshape(-1, len(terms))


def harmonic_frequencies(actuators: Sequence[Actuator]) -> FloatArray:
    """Return the angular frequency of the harmonics (a,) [rad per unit of reading], 0 for none."""
    return np.array([2 * np.pi / a.period if a.period else 0.0 for a in actuators])


def term_derivatives(
    q: FloatArray, tau: FloatArray, w: FloatArray, terms: Sequence[int] | None = None
) -> list[FloatArray]:
    """Return the derivative of the joint values in each of the terms, or in some of them, arrays
    (t | 1, n, a).
    """
    chosen = range(min(tau.shape[-1], len(TERMS) + MOVABLE)) if terms is None else terms
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
    triangles = find_triangles(tau)
    if not len(triangles):
        return [columns[TERMS[term]]() for term in chosen]
    arm, by_term = _differentiate_triangles(joints_from_readings(q, tau, w), tau, triangles)
    results = []
    for term in chosen:
        column = columns[TERMS[term]]() if term < len(TERMS) else np.zeros_like(r)
        column = np.array(np.broadcast_to(column, (*arm.shape[:2], len(w))))
        with np.errstate(divide="ignore", invalid="ignore"):
            if term < len(TERMS):
                column[..., triangles] /= arm
            else:
                column[..., triangles] = -by_term[..., term - len(TERMS)] / arm
        results.append(column)
    return results


def joints_from_readings(q: FloatArray, tau: FloatArray, w: FloatArray) -> FloatArray:
    """Return the joint values (t, n, a) of readings q under terms tau (t | 1, a, 8 | 18 | 18 + a).

    The angle of a triangle drive is NaN where no angle reaches its length. Summed drives must have
    as many readings as joints.
    """
    values = transmit_readings(q, tau, w)
    if (weights := select_weights(tau)) is not None:
        return apply_weights(invert_weights(weights), values)
    return values


def transmit_readings(q: FloatArray, tau: FloatArray, w: FloatArray) -> FloatArray:
    """Return what the transmissions give (t, n, a): joint values, and of summed drives the sums."""
    values = evaluate_sums(q, tau, w)
    triangles = find_triangles(tau)
    if len(triangles):
        values = np.array(values)
        values[..., triangles] = compute_angle(
            values[..., triangles], _select_triangles(tau, triangles)
        )
    return values


def joint_slopes(q: FloatArray, tau: FloatArray, w: FloatArray) -> FloatArray:
    """Return d joint / d reading (t, n, a), of plain gains (t | 1, 1, a).

    Of summed drives it is d sum / d reading.
    """
    slopes, triangles = _evaluate_slopes(q, tau, w), find_triangles(tau)
    if not len(triangles):
        return slopes
    arm, _ = _differentiate_triangles(joints_from_readings(q, tau, w), tau, triangles)
    slopes = np.array(np.broadcast_to(slopes, (*arm.shape[:2], len(w))))
    with np.errstate(divide="ignore", invalid="ignore"):
        slopes[..., triangles] /= arm
    return slopes


def readings_from_joints(joints: FloatArray, tau: FloatArray, w: FloatArray) -> FloatArray:
    """Return the readings (t, n, a) of joint values, without backlash.

    The linear terms are inverted exactly; Newton's method adds the others. Joints that read their
    own values are returned as they are.
    """
    if (weights := select_weights(tau)) is not None:
        joints = apply_weights(weights, joints)
    triangles = find_triangles(tau)
    if len(triangles):
        shape = np.broadcast_shapes(joints.shape, (len(tau), 1, 1))
        joints = np.array(np.broadcast_to(joints, shape))
        joints[..., triangles] = compute_length(
            joints[..., triangles], _select_triangles(tau, triangles)
        )
    if len(tau) == 1 and not tau[..., 0].any() and bool((tau[..., 1] == 1.0).all()):
        readings = joints
    else:
        readings = (joints - tau[:, None, :, 0]) / tau[:, None, :, 1]
    if not tau[..., 2:7].any():
        return readings
    for _ in range(20):
        step = (evaluate_sums(readings, tau, w) - joints) / _evaluate_slopes(readings, tau, w)
        readings = readings - step
        if np.abs(step).max(initial=0.0) <= 1e-15 * np.abs(readings).max(initial=1.0):
            break
    return readings


def select_weights(tau: FloatArray) -> FloatArray | None:
    """Return the weights (t | 1, a, J) of summed drives, None of a machine without them."""
    return tau[..., len(ALL_TERMS) :] if tau.shape[-1] > len(ALL_TERMS) else None


def differentiate_sums(
    q: FloatArray, tau: FloatArray, w: FloatArray, joints: FloatArray
) -> FloatArray:
    """Return d (s - W joints) / d tau at constant readings and joints (t, n, J), (t, n, a, k)."""
    columns = term_derivatives(q, tau[..., : len(TERMS)], w)
    shape = np.broadcast_shapes(columns[0].shape, (*joints.shape[:2], len(w)))
    slopes = np.zeros((*shape, tau.shape[-1]))
    for i, column in enumerate(columns):
        slopes[..., i] = column
    slopes[..., len(ALL_TERMS) :] = -joints[:, :, None]
    return slopes


def find_triangles(tau: FloatArray) -> IntArray:
    """Return the places of the actuators that are triangle drives; tau : (t | 1, a, 8 | 18)."""
    if tau.shape[-1] == len(TERMS):
        return np.zeros(0, np.int64)
    return np.flatnonzero(tau[0, :, SIDE])


def measure_excess(q: FloatArray, tau: FloatArray, w: FloatArray) -> FloatArray:
    """Return by how much the lengths of triangles are out of their reach (t, n) [m], the largest.

    It is NaN where a reading is not a number.
    """
    triangles = find_triangles(tau)
    length = evaluate_sums(q, tau, w)[..., triangles]
    low, high = compute_range(_select_triangles(tau, triangles))
    return np.maximum(np.maximum(low - length, length - high), 0.0).max(axis=-1)


def evaluate_sums(q: FloatArray, tau: FloatArray, w: FloatArray) -> FloatArray:
    """Return the joint values (t, n, a) of readings; of triangle drives lengths, else sums."""
    if not tau[..., 2 : len(TERMS)].any():
        readings = q[..., : len(w)]
        if len(tau) in (1, len(q)) and (tau[..., :2] == (0.0, 1.0)).all():
            return readings + 0.0  # no offset and no gain: one pass, with the same bits
        return tau[:, None, :, 0] + readings * tau[:, None, :, 1]
    columns = term_derivatives(q, tau[..., : len(TERMS)], w)
    return sum(
        (columns[i] * tau[:, None, :, i] for i in range(1, len(TERMS))),
        start=columns[0] * tau[:, None, :, 0],
    )


def _evaluate_slopes(q: FloatArray, tau: FloatArray, w: FloatArray) -> FloatArray:
    """Return d joint / d reading; of triangle drives d length / d reading."""
    if not tau[..., 2:7].any():
        return tau[:, None, :, 1]
    r, _ = split_readings(q, len(w))
    turn = w * r
    _, gain, curve, sin1, cos1, sin2, cos2, *_ = np.moveaxis(tau[:, None], -1, 0)
    first = w * (sin1 * np.cos(turn) - cos1 * np.sin(turn))
    second = 2 * w * (sin2 * np.cos(2 * turn) - cos2 * np.sin(2 * turn))
    return gain + 2 * curve * r + first + second


def _select_triangles(tau: FloatArray, triangles: IntArray) -> FloatArray:
    """Return the terms (t | 1, 1, k, 10) of triangles."""
    return tau[:, None, triangles, len(TERMS) : len(ALL_TERMS)]


def _differentiate_triangles(
    joints: FloatArray, tau: FloatArray, triangles: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Return the derivatives of lengths by angles (t, n, k) and by movable terms (t, n, k, 8)."""
    return differentiate_length(joints[..., triangles], _select_triangles(tau, triangles))


def split_readings(q: FloatArray, a: int) -> tuple[FloatArray, FloatArray]:
    """Return readings and directions of approach, the latter 0 where none are given."""
    return q[..., :a], q[..., a:] if q.shape[-1] == 2 * a else np.zeros_like(q[..., :a])
