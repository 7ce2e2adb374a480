# SPDX-License-Identifier: Apache-2.0
"""Poses at which touched surfaces have exactly the gaps that were recorded.

The rank of a Jacobian with residuals contains second-order terms. Turn a robot with its surfaces
about a line: what is left between the points and the line turns as well, so that a first-order row
contains the rotation in proportion to the residual, though the sum of squares does not depend on
it. At poses without residuals no such term exists, and there J'J is the curvature of the sum of
squares. Rank is therefore decided at these poses, next to the measured ones. See
docs/theory/identification.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from loopcal.estimate.linearization import Start
from loopcal.estimate.observation_rows import ObservationRows
from loopcal.estimate.pose_linearization import PoseSolution, PoseStates, spread_states
from loopcal.estimate.pose_rows import PoseRows
from loopcal.numerics.decomposition import RANK_TOLERANCE, are_nonzero
from loopcal.numerics.gauss_newton import Halving
from loopcal.typing import FloatArray, IntArray

CONTROL = Halving(steps=10, attempts=10, relative=0.0, absolute=1e-9, stuck=1e-3)
"""Control of the iteration to consistent poses: until residuals are rounding, or out of reach."""

LOOSE = 1e3
"""Standard deviation of a reading that moves freely, in sizes of the robot or in radians."""

SIGNIFICANT = 3.0
"""Recorded gaps below this multiple of their noise (root mean square) count as zero."""


def select_mixing_rows(rows: Sequence[ObservationRows]) -> tuple[ObservationRows, ...]:
    """Return the rows of kinds whose residual components a rigid motion mixes.

    Recorded gaps that are only noise become zero.
    """
    return tuple(_without_noise(r) for r in rows if r.kind.mixes_components and len(r.poses))


def _without_noise(rows: ObservationRows) -> ObservationRows:
    """Return rows with gaps of zero where the recorded ones are not larger than their noise."""
    gaps = np.matmul(rows.whitener, np.nan_to_num(rows.measured)[..., None])[..., 0]
    count = np.maximum(rows.is_present.sum(axis=(1, 2)), 1)
    is_noise = (gaps**2).sum(axis=(1, 2)) <= SIGNIFICANT**2 * count
    measured = np.broadcast_to(rows.measured, (len(is_noise), *rows.measured.shape[1:]))
    cleared = np.where(is_noise[:, None, None] & np.isfinite(measured), 0.0, measured)
    return replace(rows, measured=cleared)


class ConsistentPoses(NamedTuple):
    """Finds poses, near given ones, at which rows have no residual.

    Attributes
    ----------
    poses : rows to satisfy, and readings so uncertain that they follow.
    readings : (T | 1, n, actuators) [SI] where exact readings begin.
    """

    poses: PoseRows
    readings: FloatArray

    def move(
        self, solution: PoseSolution, z: FloatArray, trials: IntArray, start: Start
    ) -> PoseStates:
        """Return poses (a, n) and readings at which the rows have the recorded gaps.

        Parameters
        ----------
        solution : of the problem, whose nuisance parameters stay. z : (a, p) deviations.
        trials : (a,) their numbers.
        """
        begin = solution.states
        if solution.estimates is None or begin is None:
            q = self.readings if len(self.readings) == 1 else self.readings[trials]
            q = np.broadcast_to(q, (len(trials), *q.shape[1:]))
            state = self.poses.free.robot.home_state if begin is None else begin.state
            begin = PoseStates(spread_states(state, *q.shape[:2]), q)
        moved = self.poses.solve(
            z, trials, replace(start, poses=begin), CONTROL, fixed=solution.nuisance
        )
        assert moved.states is not None
        return moved.states


def remove_null_space(
    factor: FloatArray, reference: FloatArray, tolerance: float = RANK_TOLERANCE
) -> FloatArray:
    """Return a factor without the directions that the rows of a reference do not determine.

    With the null space N of the reference, A becomes A (I - N N'). Where the reference has full
    rank, or numbers that are not finite, the factor stays as it is.

    Parameters
    ----------
    factor, reference : (t, p + 1, p + 1) upper triangular, of rows [A | b] with the same columns.
    """
    p = factor.shape[-1] - 1
    finite = np.isfinite(reference).all(axis=(1, 2))
    finite = np.asarray(finite & np.isfinite(factor).all(axis=(1, 2)))
    _, s, vt = np.linalg.svd(np.where(finite[:, None, None], reference[:, :p, :p], 0.0))
    determined = are_nonzero(s, tolerance)
    changed = np.flatnonzero(finite & ~determined.all(axis=1))
    if not changed.size:
        return factor
    basis = np.where(determined[changed, :, None], vt[changed], 0.0)
    rows = np.array(factor[changed])
    rows[:, :, :p] = np.matmul(np.matmul(rows[:, :, :p], basis.swapaxes(-1, -2)), basis)
    result = np.array(factor)
    result[changed] = np.linalg.qr(rows, mode="r")
    return result
