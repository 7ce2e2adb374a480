# SPDX-License-Identifier: Apache-2.0
"""Transmissions: the value of a joint from the reading of its actuator, and back.

    joint = offset + gain r + curve r^2 + sin1 sin(w r) + cos1 cos(w r)
            + sin2 sin(2 w r) + cos2 cos(2 w r) + backlash d / 2 + compliance f + table(r)

with w = 2 pi / period, d = +1 or -1 the direction from which the reading was approached (0 if
unknown) and f [N, Nm] the load of the drive, a reading that is never commanded. A gear ratio or a
spool radius is a gain. A spool whose radius changes with the line on it is a curve: radius r0 - b
phi / (2 pi) pays out r0 phi - b phi^2 / (4 pi). Derivation: docs/theory/families.md. A table
gives values at points, between which it is a broken line or a natural cubic spline, and straight
beyond. Of a triangle drive this is the length of the actuator, from which the joint's angle
follows.

Readings are (t, n, a), or (t, n, 2 a) with the directions of approach behind them. Terms tau are
(t, a, 9), or (t, a, 19) with those of triangles behind them, all zero for any other drive. Values
of tables with up to K points follow, (t, a, 19 + K). Where a drive reads a sum of joint values, the
weights W of the J driven joints follow, (t, a, 19 + K + J), and the formula gives the sums s = W
joints. What no parameter changes are the constants of `list_constants`.

Tau and constants have a row for each commanded reading and each coupling. A coupling is such a row
without a reading, s = offset, or with one that is never commanded, such as a temperature; several
couplings may have the same one. Derivation: docs/theory/kinematics.md.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from scipy.interpolate import PPoly

from loopcal import geometry
from loopcal.errors import MechanismError
from loopcal.mechanism.assembly import Actuator
from loopcal.numerics.decomposition import are_nonzero
from loopcal.typing import BoolArray, FloatArray, IntArray

# Sums of joint values: s = W joints, with a weight for each reading and driven joint.

# Ratio of singular values of weights, each row divided by its largest weight, below which they are
# singular.
SINGULAR = 1e-9


def apply_weights(weights: FloatArray, values: FloatArray) -> FloatArray:
    """Return W values (t, n, a) of values (t | 1, n, J)."""
    return np.matmul(values, np.swapaxes(weights, -1, -2))


def invert_weights(weights: FloatArray) -> FloatArray:
    """Return the inverses of matrices (.., J, J), NaN where one is singular or not finite."""
    finite = np.all(np.isfinite(weights), axis=(-1, -2), keepdims=True)
    unit = np.eye(weights.shape[-1])
    weights = np.where(finite, weights, unit)
    with np.errstate(all="ignore"):
        try:
            inverse = np.linalg.inv(weights)
        except np.linalg.LinAlgError:
            rank = np.asarray(np.linalg.matrix_rank(weights))[..., None, None]
            finite = finite & (rank == len(unit))
            inverse = np.linalg.inv(np.where(finite, weights, unit))
        return np.where(finite, inverse, np.nan)


def count_independent(weights: FloatArray) -> int:
    """Return how many rows of W (a, J) are independent."""
    scale = np.abs(weights).max(axis=1, initial=0.0, keepdims=True)
    s = np.linalg.svd(weights / np.where(scale > 0.0, scale, 1.0), compute_uv=False)
    return int(are_nonzero(s, SINGULAR).sum())


# Triangle drives: a linear actuator that turns a revolute joint through two anchor points.

# Terms of a triangle, (.., 10). `side` is +1 or -1, the sign of sin(theta - gamma), and `middle`
# the nominal angle between the dead points; no parameter changes these two.
TRIANGLE_TERMS = (
    *("foot.x", "foot.y", "foot.z", "head.x", "head.y", "head.z", "skew.x", "skew.y"),
    *("side", "middle"),
)
MOVABLE = 8  # number of the terms that parameters can change


def complete_triangle(terms: Mapping[str, float]) -> FloatArray:
    """Return the terms (10,) of a triangle from those that are stated; others are zero."""
    return np.array([terms.get(term, 0.0) for term in TRIANGLE_TERMS])


def compute_angle(length: FloatArray, triangle: FloatArray) -> FloatArray:
    """Return the joint angle [rad] at a length (..) [m] of triangles (.., 10), NaN out of reach."""
    level, reach, gamma = describe_triangle(triangle)
    side, middle = triangle[..., 8], triangle[..., 9]
    with np.errstate(invalid="ignore"):
        square = np.where(length < 0.0, np.nan, length * length)
        opening = np.arccos((level - square) / reach)
    return middle + geometry.wrap_angle(gamma + side * opening - middle)


def compute_length(angle: FloatArray, triangle: FloatArray) -> FloatArray:
    """Return the length of the actuator [m] at joint angles (..) [rad] of triangles (.., 10)."""
    level, reach, gamma = describe_triangle(triangle)
    return np.sqrt(level - reach * np.cos(angle - gamma))


def compute_range(triangle: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the lengths [m] at the dead points of triangles (.., 10): the least, the largest."""
    level, reach, _ = describe_triangle(triangle)
    return np.sqrt(np.maximum(level - reach, 0.0)), np.sqrt(level + reach)


def turn_head(angle: FloatArray, triangle: FloatArray) -> FloatArray:
    """Return the head (.., 3) [m] at joint angles (..) of triangles (.., 10), h = S Rz S' H."""
    return _apply(_turn(angle, triangle), triangle[..., 3:6])


def differentiate_length(angle: FloatArray, triangle: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the derivatives of the length by the angle (..) and by the movable terms (.., 8).

    With n the unit vector from head to foot, k the axis of the joint and h the turned head:
    dl/dtheta = k . (n x h), the arm of the actuator's force; dl/dF = n; dl/dH = -Q'n with
    Q = S Rz S'; dl/ds = J_l' (H x Q'n - h x n) with the left Jacobian J_l of S.
    """
    foot, head = triangle[..., 0:3], triangle[..., 3:6]
    skew = _pad(triangle[..., 6:8])
    S, Q = geometry.exp_so3(skew), _turn(angle, triangle)
    turned = _apply(Q, head)
    n = foot - turned
    n = n / np.sqrt((n * n).sum(axis=-1, keepdims=True))
    back = _apply(np.swapaxes(Q, -1, -2), n)
    arm = (S[..., :, 2] * np.cross(n, turned)).sum(axis=-1)
    tilt = np.cross(head, back) - np.cross(turned, n)
    slope = np.swapaxes(geometry.left_jacobian_so3(skew), -1, -2)
    by_skew = np.einsum("...ij,...j->...i", slope, tilt)[..., :2]
    shape = np.broadcast_shapes(n.shape, (*by_skew.shape[:-1], 1))[:-1]
    slopes = [np.broadcast_to(d, (*shape, d.shape[-1])) for d in (n, -back, by_skew)]
    return arm, np.concatenate(slopes, axis=-1)


def describe_triangle(triangle: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return a, b and gamma of l^2 = a - b cos(theta - gamma) for triangles (.., 10)."""
    tilt = np.swapaxes(geometry.exp_so3(_pad(triangle[..., 6:8])), -1, -2)
    u, v = _apply(tilt, triangle[..., 0:3]), _apply(tilt, triangle[..., 3:6])
    level = (u * u).sum(axis=-1) + (v * v).sum(axis=-1) - 2 * u[..., 2] * v[..., 2]
    reach = 2 * np.hypot(u[..., 0], u[..., 1]) * np.hypot(v[..., 0], v[..., 1])
    gamma = np.arctan2(u[..., 1], u[..., 0]) - np.arctan2(v[..., 1], v[..., 0])
    return level, reach, gamma


def _turn(angle: FloatArray, triangle: FloatArray) -> FloatArray:
    """Return the rotations (.., 3, 3) of the head, S Rz(theta) S'."""
    S = geometry.exp_so3(_pad(triangle[..., 6:8]))
    return S @ geometry.rotation_about_axis(angle, 2) @ np.swapaxes(S, -1, -2)


def _pad(skew: FloatArray) -> FloatArray:
    """Return skews (.., 2) as rotation vectors (.., 3)."""
    return np.concatenate([skew, np.zeros_like(skew[..., :1])], axis=-1)


def _apply(matrix: FloatArray, vector: FloatArray) -> FloatArray:
    """Return matrices (.., 3, 3) times vectors (.., 3)."""
    return np.matmul(matrix, vector[..., None])[..., 0]


class Shape(NamedTuple):
    """What a term adds to the value of a joint: `value`(r, d, w) per unit of the term, and its
    derivative `slope`(r, w) by the reading. r, d : readings and directions, of a compliance loads,
    (t, n, a). w : (a,).
    """

    value: Callable[[FloatArray, FloatArray, FloatArray], FloatArray]
    slope: Callable[[FloatArray, FloatArray], FloatArray]


def _is_periodic(w: FloatArray) -> FloatArray:
    """Return 1 where a drive has harmonics: with w = 0 the cosines would repeat the offset."""
    return (w != 0).astype(float)


SHAPES: Mapping[str, Shape] = {
    "offset": Shape(lambda r, d, w: np.ones_like(r), lambda r, w: np.zeros_like(r)),
    "gain": Shape(lambda r, d, w: r, lambda r, w: np.ones_like(r)),
    "curve": Shape(lambda r, d, w: r * r, lambda r, w: 2 * r),
    "sin1": Shape(lambda r, d, w: np.sin(w * r), lambda r, w: w * np.cos(w * r)),
    "cos1": Shape(lambda r, d, w: _is_periodic(w) * np.cos(w * r), lambda r, w: -w * np.sin(w * r)),
    "sin2": Shape(lambda r, d, w: np.sin(2 * w * r), lambda r, w: 2 * w * np.cos(2 * w * r)),
    "cos2": Shape(
        lambda r, d, w: _is_periodic(w) * np.cos(2 * w * r), lambda r, w: -2 * w * np.sin(2 * w * r)
    ),
    "backlash": Shape(lambda r, d, w: 0.5 * d, lambda r, w: np.zeros_like(r)),
    "compliance": Shape(lambda r, d, w: d, lambda r, w: np.zeros_like(r)),
}
"""The terms that a joint value is a sum of, in the order of the last axis of tau (t, a, 9). To add
one, state its shape.

Each has the joint's unit, per power of the reading's unit or per N or Nm of the load; of a triangle
drive, that of its length.
"""
TERMS = tuple(SHAPES)
HARMONICS = ("sin1", "cos1", "sin2", "cos2")
# Terms of a robot with triangle drives, in the order of the last axis of tau (t, a, 19).
ALL_TERMS = (*TERMS, *TRIANGLE_TERMS)
SIDE, COMPLIANCE = ALL_TERMS.index("side"), ALL_TERMS.index("compliance")
TABLE = "table"  # what the name of the term of a table begins with; the number of its point follows
# What the name of the term of a weight begins with; the name of a driven joint follows.
WEIGHT = "weight."
LOAD = "load."  # what the name of the load of a drive begins with; the name of the drive follows
SOURCE, REFERENCE, LOADED, FIXED = 2, 3, 4, 5
"""Constants of a row before the points of its table: frequency, whether it is cubic, the number of
its reading, -1 for none, the reference of that reading, NaN where it is commanded, and the number
of its load among the readings, -1 for none."""

# Tables: a correction, or all of the motion of a cam, between points.


@lru_cache
def make_spline(points: bytes, is_cubic: bool) -> PPoly:
    """Return the weights of the values at points as functions of the reading: broken lines, or
    natural cubic splines.
    """
    from scipy.interpolate import CubicSpline, PPoly

    x = np.frombuffer(points)
    values = np.eye(len(x))
    if is_cubic:
        return CubicSpline(x, values, bc_type="natural")
    return PPoly(np.stack([np.diff(values, axis=0) / np.diff(x)[:, None], values[:-1]]), x)


def name_terms(actuators: Sequence[Actuator]) -> tuple[str, ...]:
    """Return the names of the terms of actuators, in the order of the last axis of tau."""
    points = max((len(a.points) for a in actuators), default=0)
    terms = (*ALL_TERMS, *(f"{TABLE}{k + 1}" for k in range(points)))
    if any(a.weights for a in actuators):
        joints = dict.fromkeys(name for a in actuators for name in a.driven_joints)
        return (*terms, *(f"{WEIGHT}{name}" for name in joints))
    if points:
        return terms
    return ALL_TERMS if any("side" in a.terms for a in actuators) else TERMS


def nominal_terms(actuators: Sequence[Actuator]) -> FloatArray:
    """Return the nominal transmission terms (a, 9), (a, 19) if one is a triangle drive, or (a, 19 +
    K + J) with tables and summed drives.
    """
    for actuator in actuators:
        table = (f"{TABLE}{k + 1}" for k in range(len(actuator.points)))
        assert {*actuator.terms} <= {*ALL_TERMS, *table}, actuator.terms
        is_plain = actuator.column is None and not actuator.points
        if actuator.terms.get("gain", 1.0) == 0.0 and is_plain:
            raise MechanismError(
                f"actuator {actuator.name!r} has a gain of 0, so its reading moves nothing. "
                "Give a gain other than 0"
            )
    terms, rows = name_terms(actuators), []
    for a in actuators:
        weights = {f"{WEIGHT}{name}": w for name, w in (a.weights or {a.name: 1.0}).items()}
        stated = {"gain": 1.0, **a.terms, **weights}
        rows.append([stated.get(term, 0.0) for term in terms])
    return np.array(rows, dtype=float).reshape(-1, len(terms))


def list_constants(
    actuators: Sequence[Actuator], readings: Sequence[Actuator] | None = None
) -> FloatArray:
    """Return what no parameter changes (a, 5 + K): the angular frequency of the harmonics [rad per
    unit of reading], 0 for none, whether a table is cubic, the number of the reading among
    `readings` (default: each row has its own), its reference, the number of its load, and the
    readings at the points of the table, NaN behind the last one.
    """
    points = max((len(a.points) for a in actuators), default=0)
    constants = np.full((len(actuators), FIXED + points), np.nan)
    known = {a.name: (i, a.reference) for i, a in enumerate(readings or actuators)}
    for row, a in zip(constants, actuators, strict=True):
        column = a.name if a.column is None else a.column
        source, reference = known.get(column, (-1, None))
        row[:SOURCE] = 2 * np.pi / a.period if a.period else 0.0, a.interpolation == "cubic"
        load = known.get(LOAD + a.name, (-1, None))[0]
        row[SOURCE:FIXED] = source, np.nan if reference is None else reference, load
        row[FIXED : FIXED + len(a.points)] = a.points
    return constants


@dataclass(frozen=True, eq=False)
class Transmissions:
    """Terms tau (t | 1, a, k) of transmissions, and what no parameter changes, the constants (a,
    5 + K) of `list_constants`.
    """

    shared: ClassVar[tuple[str, ...]] = ("constants",)

    tau: FloatArray
    constants: FloatArray

    @property
    def fixed_rows(self) -> BoolArray:
        """The rows (a,) that inverse kinematics cannot choose: those without a reading, and those
        whose reading is never commanded.
        """
        return (self.constants[:, SOURCE] < 0) | np.isfinite(self.constants[:, REFERENCE])

    @property
    def triangles(self) -> IntArray:
        """The places of the actuators that are triangle drives."""
        if self.tau.shape[-1] == len(TERMS):
            return np.zeros(0, np.int64)
        return np.flatnonzero(self.tau[0, :, SIDE])

    @property
    def table(self) -> FloatArray:
        """The values (t | 1, a, K) of tables."""
        first = len(ALL_TERMS)
        return self.tau[..., first : first + self.points]

    @property
    def weights(self) -> FloatArray | None:
        """The weights (t | 1, a, J) of summed drives, None of a machine without them."""
        first = len(ALL_TERMS) + self.points
        return self.tau[..., first:] if self.tau.shape[-1] > first else None

    def list_triangle_terms(self, triangles: IntArray | int) -> FloatArray:
        """Return the terms (t | 1, 1, k, 10) of triangle drives, of a single one (t | 1, 1, 10)."""
        return self.tau[:, None, triangles, len(TERMS) : len(ALL_TERMS)]

    @property
    def points(self) -> int:
        """The largest number K of points that a table of these drives has."""
        return self.constants.shape[1] - FIXED

    @property
    def _readings(self) -> int:
        """How many readings the rows have, loads among them."""
        return int(self.constants[:, SOURCE : LOADED + 1 : 2].max(initial=-1.0)) + 1

    def evaluate_references(self) -> FloatArray:
        """Return what the transmissions give (t | 1, 1, a) at the references of readings, and at
        zero of those without one.
        """
        references = np.nan_to_num(self.constants[None, None, :, REFERENCE])
        return self._select(slice(None)).evaluate_sums(references)

    def _select(self, rows: BoolArray | slice) -> Transmissions:
        """Return some of the rows, each with a reading of its own, without loads and weights."""
        own = self.constants[rows].copy()
        own[:, SOURCE], own[:, LOADED] = np.arange(len(own)), -1
        return Transmissions(self.tau[:, rows, : len(ALL_TERMS) + self.points], own)

    def evaluate_sums(self, q: FloatArray) -> FloatArray:
        """Return the joint values (t, n, a) of readings; of triangle drives lengths, else sums."""
        if not self.tau[..., 2 : len(TERMS)].any() and not self.points:
            readings = self._split_readings(q)[0]
            if len(self.tau) in (1, len(q)) and (self.tau[..., :2] == (0.0, 1.0)).all():
                return readings + 0.0  # no offset and no gain: one pass, with the same bits
            return self.tau[:, None, :, 0] + readings * self.tau[:, None, :, 1]
        return self._sum_terms(q)

    def evaluate_slopes(self, q: FloatArray) -> FloatArray:
        """Return d joint / d reading; of triangle drives d length / d reading."""
        if not self.tau[..., 2:7].any() and not self.points:
            return self.tau[:, None, :, 1]
        return self._sum_terms(q, derivative=True)

    def transmit(self, q: FloatArray) -> FloatArray:
        """Return what the transmissions give (t, n, a): joint values, or of summed drives sums."""
        values, triangles = self.evaluate_sums(q), self.triangles
        if len(triangles):
            values = np.array(values)
            terms = self.list_triangle_terms(triangles)
            values[..., triangles] = compute_angle(values[..., triangles], terms)
        return values

    def find_joints(self, q: FloatArray) -> FloatArray:
        """Return the joint values (t, n, a) of readings, NaN where no angle of a triangle drive
        reaches its length. Summed drives must have as many readings as joints.
        """
        values = self.transmit(q)
        if (weights := self.weights) is not None:
            return apply_weights(invert_weights(weights), values)
        return values

    def find_readings(self, joints: FloatArray, loads: FloatArray | None = None) -> FloatArray:
        """Return the readings (t, n, r) of joint values at loads (t | 1, n, a) of the rows, without
        backlash; Newton's method adds what is not linear; NaN where no reading gives the value.
        Other readings that are never commanded have their reference, and loads are zero without
        `loads`.
        """
        if (weights := self.weights) is not None:
            joints = apply_weights(weights, joints)
        fixed, count = self.fixed_rows, self._readings
        if fixed.any() or count > len(self.constants):
            given = None if loads is None else loads[..., ~fixed]
            readings = self._select(~fixed).find_readings(joints[..., ~fixed], given)
            source, load = self.constants[:, SOURCE : LOADED + 1 : 2].astype(int).T
            last = np.full((*readings.shape[:2], count), np.nan)
            last[..., source[~fixed]] = readings
            is_given, is_loaded = fixed & (source >= 0), load >= 0
            last[..., source[is_given]] = self.constants[is_given, REFERENCE]
            last[..., load[is_loaded]] = 0.0 if loads is None else loads[..., is_loaded]
            return last
        triangles = self.triangles
        if len(triangles):
            shape = np.broadcast_shapes(joints.shape, (len(self.tau), 1, 1))
            joints = np.array(np.broadcast_to(joints, shape))
            terms = self.list_triangle_terms(triangles)
            joints[..., triangles] = compute_length(joints[..., triangles], terms)
        tau = self.tau
        if loads is not None:
            joints = joints - tau[:, None, :, COMPLIANCE] * loads
        if len(tau) == 1 and not tau[..., 0].any() and bool((tau[..., 1] == 1.0).all()):
            readings = joints
        else:
            with np.errstate(divide="ignore", invalid="ignore"):  # a cam has no gain
                readings = (joints - tau[:, None, :, 0]) / tau[:, None, :, 1]
        if not tau[..., 2:7].any() and not self.points:
            return readings
        if self.points:
            readings = self._guess_readings(joints, readings)
        step = np.zeros_like(readings)
        for _ in range(20):
            slopes = self.evaluate_slopes(readings)
            step = (self.evaluate_sums(readings) - joints) / slopes
            readings = readings - step
            if np.abs(step).max(initial=0.0) <= 1e-15 * np.abs(readings).max(initial=1.0):
                break
        return np.where(np.abs(step) <= 1e-9 * (1.0 + np.abs(readings)), readings, np.nan)

    def _guess_readings(self, joints: FloatArray, readings: FloatArray) -> FloatArray:
        """Return first readings (t, n, a): of drives with tables by a line between points."""
        shape = np.broadcast_shapes(readings.shape, joints.shape)
        readings = np.array(np.broadcast_to(readings, shape))
        for a in np.flatnonzero(np.isfinite(self.constants[:, FIXED])):
            points = self.constants[a, FIXED:][np.isfinite(self.constants[a, FIXED:])]
            own = np.repeat(points[None, :, None], len(self.constants), axis=2)
            known = self.evaluate_sums(own)[..., a]
            sign = np.where(known[:, -1] < known[:, 0], -1.0, 1.0)[:, None]
            wanted, known = sign * joints[..., a], sign * known
            low = (wanted[..., None] > known[:, None, 1:-1]).sum(axis=-1)
            trials = np.broadcast_to(np.arange(len(known))[:, None], low.shape)
            first, step = known[trials, low], np.diff(known)[trials, low]
            with np.errstate(divide="ignore", invalid="ignore"):
                share = (wanted - first) / step
            readings[..., a] = points[low] + share * np.diff(points)[low]
        return readings

    def differentiate_terms(
        self, q: FloatArray, terms: Sequence[int] | None = None
    ) -> list[FloatArray]:
        """Return the derivative of what the transmissions give in each of the terms, or in some of
        them, arrays (t | 1, n, a).
        """
        end = len(ALL_TERMS) + self.points
        chosen = range(min(self.tau.shape[-1], end)) if terms is None else terms
        return self._divide_by_arms(self._evaluate_shapes(q, chosen), q, chosen)

    def differentiate(self, q: FloatArray) -> FloatArray:
        """Return d joint / d reading (t, n, a), of plain gains (t | 1, 1, a); of summed drives
        d sum / d reading.
        """
        return self._divide_by_arms([self.evaluate_slopes(q)], q)[0]

    def differentiate_by_readings(self, q: FloatArray) -> FloatArray:
        """Return the derivatives (t | 1, n | 1, a, readings) of what the transmissions give by all
        readings, loads among them.
        """
        columns = np.arange(self._readings)
        slopes = self.differentiate(q)
        by_readings = slopes[..., None] * (self.constants[:, SOURCE, None] == columns)
        if (self.constants[:, LOADED] < 0).all():
            return by_readings
        (by_load,) = self._divide_by_arms([self.tau[:, None, :, COMPLIANCE]], q)
        return by_readings + by_load[..., None] * (self.constants[:, LOADED, None] == columns)

    def differentiate_sums(self, q: FloatArray, joints: FloatArray) -> FloatArray:
        """Return d (s - W joints) / d tau (t, n, a, k) at given readings and joints (t, n, J)."""
        first = len(ALL_TERMS) + self.points
        t, n = (max(sizes) for sizes in zip(q.shape[:2], joints.shape[:2], strict=True))
        slopes = np.zeros((max(t, len(self.tau)), n, *self.tau.shape[1:]))
        for i, column in enumerate(self.differentiate_terms(q)):
            slopes[..., i] = column
        slopes[..., first:] = -joints[:, :, None]
        return slopes

    def _divide_by_arms(
        self, slopes: Sequence[FloatArray], q: FloatArray, terms: Sequence[int] = ()
    ) -> list[FloatArray]:
        """Return slopes (t | 1, n | 1, a) of angles, of those of the lengths of triangles; terms :
        by which the slopes are.
        """
        triangles = self.triangles
        if not len(triangles):
            return list(slopes)
        angles = self.transmit(q)[..., triangles]
        arm, by_term = differentiate_length(angles, self.list_triangle_terms(triangles))
        columns = [
            np.array(np.broadcast_to(s, (*arm.shape[:2], len(self.constants)))) for s in slopes
        ]
        for term, column in zip(terms, columns, strict=False):
            if len(TERMS) <= term < len(TERMS) + MOVABLE:
                column[..., triangles] = -by_term[..., term - len(TERMS)]
        with np.errstate(divide="ignore", invalid="ignore"):
            for column in columns:
                column[..., triangles] /= arm
        return columns

    def _sum_terms(self, q: FloatArray, derivative: bool = False) -> FloatArray:
        """Return the sum (t, n, a) of all terms but those of triangles, or its derivative by the
        reading.
        """
        first = len(ALL_TERMS)
        terms = [*range(len(TERMS)), *range(first, first + self.points)]
        shapes = self._evaluate_shapes(q, terms, derivative)
        parts = (shape * self.tau[:, None, :, i] for i, shape in zip(terms, shapes, strict=True))
        return sum(parts, start=np.zeros(1))

    def _evaluate_shapes(
        self, q: FloatArray, terms: Sequence[int], derivative: bool = False
    ) -> list[FloatArray]:
        """Return what each of the terms adds per unit to what the transmissions give, (t | 1, n,
        a), or its derivative by the reading; a dimension of a triangle adds nothing.
        """
        r, approach, load = self._split_readings(q)
        first, w = len(ALL_TERMS), self.constants[:, 0]
        has_points = any(term >= first for term in terms)
        of_points = self._weigh_tables(r, derivative) if has_points else r[..., None]

        def evaluate(term: int) -> FloatArray:
            if term >= first:
                return of_points[..., term - first]
            if term >= len(TERMS):
                return np.zeros_like(r)
            shape = SHAPES[TERMS[term]]
            if derivative:
                return shape.slope(r, w)
            return shape.value(r, load if term == COMPLIANCE else approach, w)

        return [evaluate(term) for term in terms]

    def _weigh_tables(self, r: FloatArray, derivative: bool) -> FloatArray:
        """Return the weights of the values of all tables at readings (t, n, a), (t, n, a, K), or
        their derivatives by the reading. Outside its points a table is straight.
        """
        weights = np.zeros((*r.shape, self.points))
        for a, row in enumerate(self.constants):
            points = row[FIXED:][np.isfinite(row[FIXED:])]
            if len(points):
                spline, own = make_spline(points.tobytes(), bool(row[1])), r[..., a]
                inside = np.where(np.isfinite(own), np.clip(own, points[0], points[-1]), points[0])
                slope = spline(inside, 1)
                chosen = slope if derivative else spline(inside) + slope * (own - inside)[..., None]
                weights[..., a, : len(points)] = chosen
        return weights

    def _split_readings(self, q: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the reading, approach direction and load of each row (.., a), 0 if not given."""
        numbers = self.constants[:, SOURCE : LOADED + 1 : 2].astype(int)
        a, source = int(numbers.max(initial=-1)) + 1, numbers[:, 0]
        parts = q[..., :a], q[..., a:] if q.shape[-1] == 2 * a else np.zeros_like(q[..., :a])
        if len(source) == a and bool((source == np.arange(a)).all()):
            return *parts, np.zeros_like(parts[0])
        none = np.zeros((*q.shape[:-1], 1))  # what a row with the number -1 reads
        readings, approach = (np.concatenate([part, none], axis=-1) for part in parts)
        return readings[..., source], approach[..., source], readings[..., numbers[:, 1]]

    def measure_excess(self, q: FloatArray) -> FloatArray:
        """Return by how much the lengths of triangles are out of their reach (t, n) [m], the
        largest. It is NaN where a reading is not a number.
        """
        triangles = self.triangles
        length = self.evaluate_sums(q)[..., triangles]
        low, high = compute_range(self.list_triangle_terms(triangles))
        return np.maximum(np.maximum(low - length, length - high), 0.0).max(axis=-1)

    def find_reversed(self, joints: FloatArray, triangles: IntArray) -> BoolArray:
        """Return which angles (t, n, k) of triangle drives lie beyond a dead center, on the side
        that their readings do not lead to.
        """
        triangle = self.list_triangle_terms(triangles)
        _, _, gamma = describe_triangle(triangle)
        return np.sin(joints[..., triangles] - gamma) * triangle[..., 8] < 0.0
