# SPDX-License-Identifier: Apache-2.0
"""Search the interpretation of measurements that fits a robot far better than the stated one.

All interpretations of the measured values are compared by a few rows first; the promising ones are
judged by all rows. Interpretations of the actuator readings are tested only where none of these is
allowed, because each needs its own poses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from loopcal.diagnose.conventions.interpretations import (
    Interpretation,
    list_interpretations,
    list_reading_interpretations,
)
from loopcal.diagnose.conventions.interpreted_data import (
    MOST_EXCLUDED,
    InterpretedData,
    guess_setups,
    refine_misfit,
)
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.measure import Measurements
from loopcal.mechanism import find_directly_reachable
from loopcal.typing import FloatArray, IntArray

BETTER = 5.0
"""Factor by which another interpretation must fit better before data are refused: true data of a
robot far beyond its tolerances fit twice as well in none of them.
"""

ALLOWED = 4.0
"""Misfit up to which tolerances and noise explain a residual."""

FEW_ROWS, FEWEST_POSES = 60, 20
"""Number of rows, and smallest number of poses, by which all interpretations are compared first."""

PROMISING, MOST_JUDGED = 2.0, 8
"""Factor by which the misfit on these rows may exceed the limit of a far better fit, and largest
number of interpretations that are judged by all rows.
"""

NEAREST = 8
"""Number of interpretations of the readings that are judged where frames are unknown: those of the
smallest misfit before parameters change.
"""

EQUALLY = 1.2
"""Ratio of misfits up to which two interpretations fit equally well; the first in the list is
reported, the others as alternatives.
"""

_Tested = list[tuple[Interpretation, float]]
"""Interpretations with their misfits."""


def find_best_interpretation(
    free: FreeParameters, stated: InterpretedData, misfit: float, sources: Sequence[str]
) -> tuple[InterpretedData, float, tuple[Interpretation, ...]] | None:
    """Return the interpretation that fits far better than the stated one, its misfit, and others
    that fit as well; None without one.
    """
    ranked = [
        (value, one)
        for one, value in _test_all(free, stated, misfit, sources)
        if value * BETTER < misfit
    ]
    ranked = [(value, one) for value, one in ranked if _is_informative(free, stated, one, value)]
    if not ranked:
        return None
    smallest = min(value for value, _ in ranked)
    near = [one for value, one in ranked if value <= max(EQUALLY * smallest, 1.0)]
    best = InterpretedData(free, near[0].apply(stated.whole), applied=near[0])
    best.misfits()
    best.exclude_far_rows()
    least = min(best.misfit(), refine_misfit(best))
    return (best, least, tuple(near[1:])) if least * BETTER < misfit else None


def shares_poses(data: Measurements) -> bool:
    """Return whether rows share more than their pose: pairs of poses, or groups."""
    return any(o.kind.poses_per_row > 1 or bool((o.group != "").any()) for o in data.observations)


def _select_few(data: Measurements) -> IntArray:
    """Poses spread over the data by which many interpretations are compared; all where rows share
    more than their pose.
    """
    n = data.n_poses
    equations = sum(o.whitener.shape[-1] * len(o) for o in data.observations)
    count = max(FEWEST_POSES, -(-FEW_ROWS * n // max(equations, 1)))
    if n <= count or shares_poses(data):
        return np.arange(n)
    return np.unique(np.linspace(0, n - 1, count).astype(np.intp))


def _test_all(
    free: FreeParameters, stated: InterpretedData, misfit: float, sources: Sequence[str]
) -> _Tested:
    """Interpretations that promise to fit far better, with their misfits to first order without far
    rows.

    All are compared by few rows first. Other interpretations of the readings are tested only where
    no interpretation of the measured values is allowed: each needs its own poses.
    """
    tested: _Tested = []
    if stated.has_enough:
        data = stated.data
        few = data.take(_select_few(data))
        screened = _compute_misfits(
            free, few, tuple(list_interpretations(few, sources)), is_quick=True
        )
        chosen = _select_promising(screened, misfit)
        listed = {one.key: one for one in list_interpretations(data, sources)}
        judged = tuple(listed[key] for key in chosen if key in listed)
        tested = _compute_misfits(free, data, judged)
    if not any(value <= ALLOWED for _, value in tested):
        tested += _test_readings(free, stated.whole, misfit, sources)
    return [(one, value) for one, value in tested if np.isfinite(value)]


def _test_readings(
    free: FreeParameters, data: Measurements, misfit: float, sources: Sequence[str]
) -> _Tested:
    """Interpretations of the readings, as `_test_all` returns them."""
    robot, poses = free.robot, _select_few(data)
    names = tuple(a.name for a in robot.actuators)
    dimensions = tuple(a.dimension for a in robot.actuators)
    listed = tuple(list_reading_interpretations(data, names, dimensions, sources))
    readings = np.stack([one.values[poses] for one in listed])
    reached = find_directly_reachable(
        robot, robot.values[None], readings.reshape(1, -1, readings.shape[-1])
    ).reshape(readings.shape[:2])
    near = np.flatnonzero(reached.mean(axis=1) >= 1.0 - MOST_EXCLUDED)
    start, size = guess_setups(free, data.take(poses), readings[near], reached[near])
    has_frames = len(data.nuisance_parameters) > 0
    order = np.argsort(size)[:NEAREST] if has_frames else np.arange(len(near))

    def judge(one: Interpretation, start: FloatArray | None = None) -> float:
        read, is_quick = one.apply(data), start is not None
        read = read.take(poses) if is_quick else read
        interpreted = InterpretedData(free, read, applied=one, is_quick=is_quick, start=start)
        interpreted.misfits()
        interpreted.exclude_far_rows()
        return interpreted.misfit()

    tested = [(listed[near[i]], judge(listed[near[i]], start[i : i + 1])) for i in np.sort(order)]
    chosen = _select_promising(tested, misfit)
    return [(one, judge(one)) for one, _ in tested if one.key in chosen]


def _select_promising(tested: _Tested, misfit: float) -> list[tuple[Any, ...]]:
    """Keys of the best interpretations, in the order given, that may fit far better than the stated
    one.
    """
    finite = sorted(value for _, value in tested if np.isfinite(value))
    bound = min(PROMISING * misfit / BETTER, *finite[MOST_JUDGED - 1 : MOST_JUDGED], np.inf)
    return [one.key for one, value in tested if value <= bound]


def _compute_misfits(
    free: FreeParameters,
    data: Measurements,
    interpretations: tuple[Interpretation, ...],
    *,
    is_quick: bool = False,
) -> _Tested:
    """Misfits of interpretations of the values, all at once; each half by itself where one cannot
    be evaluated.
    """
    if not interpretations:
        return []
    together = InterpretedData(free, data, interpretations, is_quick=is_quick)
    values = together.misfits()
    if together.has_failed and len(interpretations) > 1:
        middle = len(interpretations) // 2
        halves = (interpretations[:middle], interpretations[middle:])
        return [
            one for half in halves for one in _compute_misfits(free, data, half, is_quick=is_quick)
        ]
    if np.isfinite(values).all():
        together.exclude_far_rows()
        values = together.misfits()
    return list(zip(interpretations, values.tolist(), strict=True))


def _is_informative(
    free: FreeParameters, stated: InterpretedData, one: Interpretation, misfit: float
) -> bool:
    """Whether values that shrink fit far better than a constant would: zeros fit every unit."""
    if not one.shrinks:
        return True
    written = (
        stated.whole.readings
        if one.observation is None
        else stated.whole.observations[one.observation].measured
    )
    constant = np.where(one.values != written, np.nanmedian(one.values, axis=0), one.values)
    applied = replace(one, values=constant).apply(stated.whole)
    control = InterpretedData(free, applied, applied=one)
    control.misfits()
    control.exclude_far_rows()
    return not control.misfit() < BETTER * misfit
