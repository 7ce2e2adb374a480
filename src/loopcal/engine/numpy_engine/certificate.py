# SPDX-License-Identifier: Apache-2.0
"""Prove that Newton's method from a start converges to a known solution, for many solutions.

The mechanism has six limbs, each a driven rod between base and platform. All goals share the
inverse C of the Jacobian at the start, so that a proof takes one step, one product with the
Jacobian at the goal and some norms: a fraction of solving. Derivation: docs/theory/kinematics.md.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from loopcal.engine.numpy_engine.closure import (
    cross,
    divide_rows,
    dot,
    exponential,
    matmul,
    matvec,
    place_links,
)
from loopcal.engine.program import Program, State
from loopcal.typing import BoolArray, FloatArray

# Largest product of the distance from the goal and the change of the Jacobian; proven: 2/3.
CONTRACTION = 0.6
# An angle is below 0.75 times the norm of the difference of the rotations, if this is below 1.
ANGLE = 0.75
SQRT2 = float(np.sqrt(2.0))
# Share of the first residual that may be left after the first step; step control allows 0.9999.
DECREASE = 0.99


def has_driven_rods(program: Program) -> bool:
    """Return whether the mechanism has six freedoms and six limbs, each a driven rod alone."""
    return (
        len(program.freedoms) == 6
        and not program.others
        and sum(len(group.limbs) for group in program.groups) == 6
        and all(
            g.ending == "distance" and not g.joints and g.actuator[0, 0] >= 0
            for g in program.groups
        )
    )


def certify(program: Program, e: FloatArray, start: State, goal: State) -> NDArray[np.int8]:
    """Return the closure signs of goals that are reached; see `loopcal.engine.certify`."""
    t, n = goal.T.shape[:2]
    out = np.zeros((t, n), np.int8)
    if not (has_driven_rods(program) and start.T.shape[1] == 1):
        return out
    with np.errstate(all="ignore"):
        begin = Begin.prepare(program, e, start)
        for i in range(t):
            of_trial = begin.select(min(i, len(e) - 1))
            for rows in divide_rows(n):
                goals = _repeat_single(goal.T[i, rows, :3].transpose(1, 2, 0))
                out[i, rows] = np.where(of_trial.reaches(goals), of_trial.sign, 0)[: n - rows.start]
    return out


class Begin(NamedTuple):
    """The start of each trial (.., t), a twist of which is (unit w, v) for an angle w.

    T : (3, 4, t) platform. tip, attachment : (3, 6, t) ends of the rods, in base and platform.
    unit : (t,) length for which the inverse is small. distance : (6, t) of the ends. inverse :
        (6, 6, t) of the Jacobian of the distances. sign : (t,) of its determinant.
    swing : (6, t) change of a gap by a unit twist. bend : (3, t) coefficients of 1, h, h^2 in the
        square of the change of the Jacobian, times the inverse, where 1 / h is the shortest rod.
    size : of the robot [m].
    """

    T: FloatArray
    tip: FloatArray
    attachment: FloatArray
    unit: FloatArray
    distance: FloatArray
    inverse: FloatArray
    sign: NDArray[np.int8]
    swing: FloatArray
    bend: FloatArray
    size: float

    @classmethod
    def prepare(cls, program: Program, e: FloatArray, start: State) -> Begin:
        """Return the start of a program that `has_driven_rods`, a pose for each trial."""
        links = [place_links(group, e) for group in program.groups]
        tip, attachment = (np.concatenate([p.origin[i] for p in links], axis=1) for i in (0, 1))
        T = np.broadcast_to(start.T[:, 0], (len(e), 4, 4))[:, :3].transpose(1, 2, 0)
        square = dot(attachment, attachment)
        unit = np.sqrt(2 * np.mean(square, axis=0))
        rows, distance = _measure_rods(T, tip, attachment, unit)
        jacobian = rows.transpose(2, 1, 0)
        good = np.asarray(np.isfinite(jacobian).all(axis=(1, 2)))
        sign = np.linalg.slogdet(np.where(good[:, None, None], jacobian, 0.0))[0]
        is_regular = np.abs(sign) > 0.0
        inverse = np.linalg.inv(np.where(is_regular[:, None, None], jacobian, np.eye(6)))
        norm = np.where(is_regular, np.linalg.norm(inverse, 2, axis=(1, 2)), np.inf)
        swing, ratio = np.sqrt(1 + square / unit**2), np.sqrt(square) / unit
        bend = np.array(
            [
                np.add.reduce((ratio / unit) ** 2, axis=0),
                np.add.reduce(2 * ratio**2 * swing / unit, axis=0),
                np.add.reduce(swing**4, axis=0),
            ]
        )
        begin = T, tip, attachment, unit, distance, inverse.transpose(1, 2, 0)
        return cls(*begin, sign.astype(np.int8), swing, norm**2 * bend, program.size)

    def select(self, trial: int) -> Begin:
        """Return the start of one trial, with an axis of length 1 in place of t."""
        arrays = {name: getattr(self, name) for name in self._fields[:-1]}
        return self._replace(**{name: array[..., [trial]] for name, array in arrays.items()})

    def reaches(self, goal: FloatArray) -> BoolArray:
        """Return which goals (3, 4, N) are proven for one trial, (N,)."""
        size, unit = self.size, self.unit
        rows, distance = _measure_rods(goal, self.tip, self.attachment, unit)
        stretch = distance - self.distance
        inverse = self.inverse[..., 0]
        step = np.einsum("ij,jn->in", inverse, stretch)
        turn, shift = step[:3] / unit, step[3:]
        length = np.maximum(np.abs(turn).max(axis=0) * size, np.abs(shift).max(axis=0))
        turned = matmul(exponential(turn), self.T[:, :3]) - goal[:, :3]
        missed = self.T[:, 3] + shift - goal[:, 3]
        apart = np.add.reduce(np.add.reduce(turned**2, axis=0), axis=0)
        error = np.sqrt((ANGLE * unit) ** 2 * apart + dot(missed, missed))
        left = np.sqrt(np.add.reduce(self.swing**2, axis=0)) * error
        falls = left**2 <= DECREASE**2 * np.add.reduce(stretch**2, axis=0)
        shortest = np.minimum.reduce(distance - self.swing * error, axis=0)
        h = 1 / shortest
        bend = self.bend[0] + (self.bend[1] + self.bend[2] * h) * h
        off = np.einsum("ij,fjn->fin", inverse, rows)
        off[range(6), range(6)] -= 1.0
        # two bounds of the spectral norm of `off`: its Frobenius norm, and where that is too large
        # to prove anything, the root of the Frobenius norm of off' off, which is smaller
        change, deviation = np.sqrt(bend) * error, np.sqrt(_sum_squares(off))
        contracts = change <= CONTRACTION * (1 - deviation)
        if not contracts.all():
            rest = np.flatnonzero(~contracts)
            deviation = _bound_norm(_repeat_single(off.take(rest, axis=-1)))[: len(rest)]
            contracts[rest] = change[rest] <= CONTRACTION * (1 - deviation)
        return (shortest > 0) & (apart <= 1) & (length <= size / 2) & falls & contracts


def _repeat_single(rows: FloatArray) -> FloatArray:
    """Return rows (.., N), a single one twice: sums of one have other bits."""
    return rows.repeat(2, axis=-1) if rows.shape[-1] == 1 else rows


def _sum_squares(matrix: FloatArray) -> FloatArray:
    """Return the sum of the squares (N,) of a matrix (r, c, N)."""
    return np.add.reduce(np.add.reduce(matrix**2, axis=0), axis=0)


def _bound_norm(matrix: FloatArray) -> FloatArray:
    """Return the root of the Frobenius norm (N,) of A A', from A' as an array (c, r, N)."""
    square = np.zeros(matrix.shape[-1])
    for f, column in enumerate(matrix):
        products = np.einsum("in,gin->gn", column, matrix[f:])
        products[1:] *= SQRT2  # they stand for their mirror images, too
        square += np.add.reduce(products**2, axis=0)
    return np.sqrt(np.sqrt(square))


def _measure_rods(
    T: FloatArray, tip: FloatArray, attachment: FloatArray, unit: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the Jacobian of the distances (6, N) of rods at platforms (3, 4, N), transposed:
    (6 components of a twist, 6 rods, N).
    """
    arm = matvec(T[:, :3, None], attachment)
    gap = arm + T[:, 3, None] - tip
    distance = np.sqrt(dot(gap, gap))
    rows = np.empty((6, *distance.shape))
    np.divide(gap, distance, out=rows[3:])
    np.divide(cross(arm, rows[3:]), unit, out=rows[:3])
    return rows, distance
