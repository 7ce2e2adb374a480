# SPDX-License-Identifier: Apache-2.0
"""Rows of poses as the library reads them: all kinds of rows pose by pose."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from loopcal.engine import TwistRows
from loopcal.typing import FloatArray, IntArray
from loopcal_native.library import Strided, as_reals, locate
from loopcal_native.library import TwistRows as StridedRows
from loopcal_native.programs import require


class FlatRows(NamedTuple):
    """M rows: pose (M,) of each, ascending; by_twist (t | 1, M, 6), residual (t | 1, M)."""

    pose: IntArray
    by_twist: FloatArray
    residual: FloatArray

    def describe(self) -> StridedRows:
        """Return the addresses and strides of these arrays, which must be kept."""
        count, strided = len(self.pose), []
        for array, size in ((self.by_twist, 6 * count), (self.residual, count)):
            strided.append(Strided(locate(array), size if len(array) > 1 else 0, 0))
        return StridedRows(count, locate(self.pose), *strided)


def flatten_rows(observed: Sequence[TwistRows], t: int, n: int) -> FlatRows:
    """Return the rows of all kinds, those of one pose behind each other.

    Raises
    ------
    ValueError : shapes differ from those of `TwistRows`, or a pose is not one of n.
    """
    poses, twists, residuals = [], [], []
    for rows in observed:
        r, m = rows.residual.shape[1:]
        require(len(rows.residual) in (1, t), f"residuals of {t} trials")
        expected = rows.by_twist.shape in ((1, r, m, 6), (t, r, m, 6))
        require(expected, f"derivatives ({t} | 1, {r}, {m}, 6), not {rows.by_twist.shape}")
        index = np.asarray(rows.poses, np.int64)
        require(index.shape == (r,), f"poses ({r},), not {index.shape}")
        require(bool(((index >= 0) & (index < n)).all()), f"poses of {n}")
        poses.append(np.repeat(index, m))
        twists.append(rows.by_twist.reshape(len(rows.by_twist), r * m, 6))
        residuals.append(rows.residual.reshape(len(rows.residual), r * m))
    if not observed:
        return FlatRows(np.zeros(0, np.int64), np.zeros((1, 0, 6)), np.zeros((1, 0)))
    pose, by_twist, residual = poses[0], twists[0], residuals[0]
    if len(observed) > 1:
        pose = np.concatenate(poses)
        by_twist, residual = (_join(arrays, t) for arrays in (twists, residuals))
    if (pose[1:] < pose[:-1]).any():
        order = np.argsort(pose, kind="stable")
        pose, by_twist, residual = pose[order], by_twist[:, order], residual[:, order]
    return FlatRows(pose, as_reals(by_twist), as_reals(residual))


def _join(arrays: Sequence[FloatArray], t: int) -> FloatArray:
    """Return the rows (t, M, ..) of all kinds behind each other."""
    return np.concatenate([np.broadcast_to(a, (t, *a.shape[1:])) for a in arrays], axis=1)
