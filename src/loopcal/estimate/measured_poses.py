# SPDX-License-Identifier: Apache-2.0
"""Poses that rows measure in full: a robot with m freedoms stands where its rows fit best, if these
tell m directions.

Gauss-Newton from home over what the platform can do, with all rows of a pose that need nothing but
the pose: a position tells all of a delta robot, two coordinates all of a planar one. Readings are
not used. See docs/theory/latent.md.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from loopcal import geometry
from loopcal.estimate.sensed import Sensed
from loopcal.mechanism import (
    Mechanism,
    Status,
    differentiate_by_coordinates,
    inverse_trials,
    read_coordinates,
)
from loopcal.typing import FloatArray, IntArray

STEPS = 30
"""Gauss-Newton steps; a position takes one, an orientation four."""

LONGEST = 0.5
"""Of a step, as a share of the robot's size."""

REST = 1e-6
"""Step, as a share of the size, below which a pose is found: it is where a search begins, no more.
"""

RANK = 1e-6
"""Smallest singular value of the whitened rows, columns of length one, relative to the largest,
with which they tell all.
"""


def measured_poses(
    robot: Mechanism, sensed: Sequence[Sensed], trial: IntArray, pose: IntArray
) -> tuple[FloatArray, np.ndarray]:
    """Return where the rows of k poses put the platform (k, 4, 4), and which poses they give in
    full (k,).

    Rows of unknown frames, those that compare poses and those that look at joints are passed over.

    Parameters
    ----------
    robot : at its present values. sensed : what was measured. trial, pose : (k,) the poses asked
        for.
    """
    rows = _usable(sensed, pose)
    T = np.tile(robot.home, (len(pose), 1, 1))
    known = np.zeros(len(pose), dtype=bool)
    if not rows:
        return T, known
    state, free = None, set(robot.controlled) == set(robot.freedoms) or len(robot.controlled) == 6
    for _ in range(STEPS):
        parts = [_whitened(s, places, trial, T) for s, places in rows]
        residual, by_twist = (np.concatenate([part[i] for part in parts], axis=1) for i in (0, 1))
        if free:
            slope = np.diag([1.0 / robot.size] * 3 + [1.0] * 3)[:, robot.program.freedoms]
        else:
            state = inverse_trials(
                robot, robot.values[None], read_coordinates(T[None], robot.controlled), state
            )
            slope = differentiate_by_coordinates(robot, robot.values[None], state)[0]
        step, full = _step(by_twist @ slope, residual)
        length = np.linalg.norm(step, axis=1)
        step *= np.minimum(1.0, LONGEST * robot.size / np.maximum(length, LONGEST * robot.size))[
            :, None
        ]
        closed = (
            np.ones(len(pose), dtype=bool) if state is None else state.status[0] == Status.CONVERGED
        )
        at = T if state is None else np.where(closed[:, None, None], state.T[0], T)
        T = geometry.apply_twist(at, np.matmul(slope, step[..., None])[..., 0])
        known = full & closed & (length < REST * robot.size)
        if (known | ~full).all():
            break
    return T, known


def squares_at(
    sensed: Sequence[Sensed], trial: IntArray, pose: IntArray, T: FloatArray
) -> FloatArray:
    """Return the sum of whitened squares (k,) of the same rows of k poses, the platform at T (k, 4,
    4).
    """
    parts = [_whitened(s, places, trial, T)[0] for s, places in _usable(sensed, pose)]
    return sum(((part**2).sum(axis=1) for part in parts), start=np.zeros(len(pose)))


def _usable(sensed: Sequence[Sensed], pose: IntArray) -> list[tuple[Sensed, IntArray]]:
    """Kinds whose rows need nothing but a pose, with the rows (k, c) of each of k poses."""
    if not len(pose):
        return []
    usable = [
        s
        for s in sensed
        if not s.places.shape[1]
        and s.kind.poses_per_row == 1
        and not s.kind.sensed_joints
        and len(s.poses)
    ]
    return [(s, _rows_of(s, pose)) for s in usable]


def _rows_of(sensed: Sensed, pose: IntArray) -> IntArray:
    """Rows (k, c) of a kind that saw each of k poses, -1 where there are fewer than c."""
    order = np.argsort(sensed.poses, kind="stable")
    count = np.bincount(sensed.poses, minlength=pose.max() + 1)
    nth = np.arange(len(order)) - np.repeat(np.cumsum(count) - count, count)
    table = np.full((len(count), count.max()), -1)
    table[sensed.poses[order], nth] = order
    return table[pose]


def _whitened(
    sensed: Sensed, rows: IntArray, trial: IntArray, T: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Whitened residuals (k, c m) of a kind at poses T (k, 4, 4), and their derivatives (k, c m, 6)
    by the twist.
    """
    k, c = rows.shape
    measured, white = (
        array[np.where(len(array) > 1, trial, 0)[:, None], np.maximum(rows, 0)]
        for array in (sensed.measured, sensed.whitener)
    )
    seen = sensed.kind.evaluate(np.repeat(T, c, axis=0)[None], measured.reshape(1, k * c, -1))
    white = np.where(rows[..., None, None] >= 0, white, 0.0)
    m = white.shape[-1]
    residual = np.matmul(white, seen.residual.reshape(k, c, m, 1))
    return residual.reshape(k, c * m), np.matmul(white, seen.jacobian.reshape(k, c, m, 6)).reshape(
        k, c * m, 6
    )


def _step(rows: FloatArray, residual: FloatArray) -> tuple[FloatArray, np.ndarray]:
    """Least-squares step (k, m) from rows (k, h, m), zero where they do not tell all of it; and
    where they do (k,).
    """
    k, h, m = rows.shape
    finite = np.asarray(np.isfinite(rows).all(axis=(1, 2)) & np.isfinite(residual).all(axis=1))
    length = np.linalg.norm(np.where(finite[:, None, None], rows, 0.0), axis=1)
    full = finite & (length > 0.0).all(axis=1) & (h >= m)
    step = np.zeros((k, m))
    if full.any():
        U, s, Vt = np.linalg.svd(rows[full] / length[full, None], full_matrices=False)
        full[full] = told = s[:, -1] > RANK * s[:, 0]
        across = (
            np.matmul(np.swapaxes(U[told], 1, 2), -residual[full][..., None]) / s[told][..., None]
        )
        step[full] = np.matmul(np.swapaxes(Vt[told], 1, 2), across)[..., 0] / length[full]
    return step, full
