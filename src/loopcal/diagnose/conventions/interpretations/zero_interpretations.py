# SPDX-License-Identifier: Apache-2.0
"""Interpretations of actuator readings that are counted from another zero, in either direction.

Readings q of one actuator, or of all of a dimension, are read as `s q + b + c`. s is 1 or -1, and b
is 0, the home readings (readings that begin at zero there), or the sum of both ends of the stroke
(counted from its other end). The constant c is scanned over all values that keep the readings
inside the strokes. The best ones have the smallest median residual of the given robot; repeated
scans of their neighborhood refine them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from loopcal.diagnose.conventions.interpretations.interpretation import Interpretation
from loopcal.diagnose.conventions.judgement import guess_frames
from loopcal.diagnose.conventions.misfit import MOST_EXCLUDED
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.measure import Measurements
from loopcal.mechanism import compute_readings, find_directly_reachable
from loopcal.typing import FloatArray, IntArray

SCANNED, NARROWER, SCANS = 25, 8.0, 4
"""Number of constants in a scan, factor by which the next scan is narrower, and number of scans."""

BEST = 3
"""Number of hypotheses that are scanned again."""

BESIDE = 0.02
"""Share of the stroke by which readings may be outside: the stroke is nominal, too."""


class _Zero(NamedTuple):
    """Readings `sign q + base + c` of some actuators, with c between two limits.

    Attributes
    ----------
    columns : of the actuators. sign : 1 or -1. base : (k,) of each of them [m or rad].
    low, high : of c [m or rad].
    """

    columns: tuple[int, ...]
    sign: float
    base: FloatArray
    low: float
    high: float

    def apply(self, readings: FloatArray, constant: float) -> FloatArray:
        """Return the readings (n, a) with a value of c."""
        chosen = list(self.columns)
        changed = np.array(readings)
        changed[:, chosen] = self.sign * readings[:, chosen] + self.base + constant
        return changed


def find_zero_interpretations(
    free: FreeParameters, data: Measurements, poses: IntArray, reversed_only: bool
) -> list[Interpretation]:
    """Find the zeros with which the given robot fits best, the best first.

    Parameters
    ----------
    data : as written. poses : by which they are compared. reversed_only : only readings that are
        counted in the opposite direction.
    """
    robot = free.robot
    zeros = [zero for zero in _list_zeros(free, data) if zero.sign < 0.0 or not reversed_only]
    few, constants = data.take(poses), np.zeros(0)
    for scan in range(SCANS):
        if not zeros:
            return []
        grids = [np.linspace(zero.low, zero.high, SCANNED) for zero in zeros]
        sizes = _compute_sizes(free, few, zeros, grids)
        best = np.argsort(sizes.min(axis=1), kind="stable")[:BEST]
        best = best[np.isfinite(sizes.min(axis=1)[best])]
        zeros = [zeros[i] for i in best]
        constants = np.array([grids[i][np.argmin(sizes[i])] for i in best])
        if scan < SCANS - 1:
            zeros = [_narrow(*pair) for pair in zip(zeros, constants.tolist(), strict=True)]
    result = []
    for zero, constant in zip(zeros, constants.tolist(), strict=True):
        total = zero.base + constant
        dimension = robot.actuators[zero.columns[0]].dimension
        shown = [robot.to_quantity(float(value), dimension) for value in total]
        same = np.ptp(total) < 1e-9 * max(float(np.abs(total).max()), 1e-9)
        details = {
            "actuators": tuple(robot.actuators[j].name for j in zero.columns),
            "reversed": zero.sign < 0.0,
            "zeros": tuple(shown[:1] if same else shown),
        }
        change = partial(zero.apply, constant=constant)
        result.append(Interpretation("reading-zero", details, "", None, change))
    return result


def _list_zeros(free: FreeParameters, data: Measurements) -> Iterator[_Zero]:
    """Yield the hypotheses about zeros, those of all actuators of a dimension first."""
    robot = free.robot
    home = compute_readings(robot, robot.values[None], robot.home_state)[0, 0]
    smallest, largest = np.nanmin(data.readings, axis=0), np.nanmax(data.readings, axis=0)
    spread = largest - smallest
    strokes = [
        actuator.stroke or (home[j] - spread[j], home[j] + spread[j])
        for j, actuator in enumerate(robot.actuators)
    ]
    low, high = np.array(strokes).T
    low, high = low - BESIDE * (high - low), high + BESIDE * (high - low)
    dimensions = [actuator.dimension for actuator in robot.actuators]
    together = [
        tuple(j for j, other in enumerate(dimensions) if other is dimension)
        for dimension in dict.fromkeys(dimensions)
    ]
    singles = [(j,) for j in range(len(dimensions))]
    for columns in dict.fromkeys([*together, *singles]):
        chosen = list(columns)
        zero, start, ends = np.zeros(len(chosen)), home[chosen], (low + high)[chosen]
        bases = [(1.0, zero), (1.0, start), (-1.0, zero), (-1.0, start), (-1.0, ends)]
        if len(chosen) == 1:  # the scan contains the others
            bases = [(1.0, zero), (-1.0, zero)]
        for sign, base in bases:
            ends_of = np.sort(sign * np.array([smallest, largest])[:, chosen], axis=0) + base
            least = float((low[chosen] - ends_of[0]).max())
            most = float((high[chosen] - ends_of[1]).min())
            if least < most:
                yield _Zero(columns, sign, base, least, most)


def _narrow(zero: _Zero, constant: float) -> _Zero:
    """Return the hypothesis with narrower limits around a constant."""
    half = 0.5 * (zero.high - zero.low) / NARROWER
    return zero._replace(low=constant - half, high=constant + half)


def _compute_sizes(
    free: FreeParameters, data: Measurements, zeros: Sequence[_Zero], grids: Sequence[FloatArray]
) -> FloatArray:
    """Return the median residual sizes (h, SCANNED) of the given robot; infinite where it reaches
    too few poses.
    """
    robot = free.robot
    readings = np.stack(
        [
            zero.apply(data.readings, constant)
            for zero, grid in zip(zeros, grids, strict=True)
            for constant in grid.tolist()
        ]
    )
    reached = find_directly_reachable(
        robot, robot.values[None], readings.reshape(1, -1, readings.shape[-1])
    ).reshape(readings.shape[:2])
    near = np.flatnonzero(reached.mean(axis=1) >= 1.0 - MOST_EXCLUDED)
    sizes = np.full(len(readings), np.inf)
    if len(near):
        sizes[near] = guess_frames(free, data, readings[near], reached[near])[1]
    return np.nan_to_num(sizes, nan=np.inf).reshape(len(zeros), SCANNED)
