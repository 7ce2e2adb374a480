# SPDX-License-Identifier: Apache-2.0
"""Select the interpretation of measurements that fits a robot far better than the stated one.

All interpretations of the measured values are compared by a few rows first; the promising ones are
judged by all rows. Interpretations of the actuator readings are tested only where none of these is
allowed, because each needs its own poses.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from loopcal.diagnose.conventions.interpretations import (
    Interpretation,
    list_interpretations,
    list_reading_interpretations,
)
from loopcal.diagnose.conventions.misfit import (
    MOST_EXCLUDED,
    QUICK,
    THOROUGH,
    Comparison,
    compare_with_robot,
    compute_misfits,
    exclude_far_rows,
    refine_misfit,
    select_reached,
)
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.measure import Measurements
from loopcal.measure.initial_values import guess_nuisance_values_batch
from loopcal.mechanism import find_directly_reachable, forward_trials
from loopcal.typing import BoolArray, FloatArray, IntArray

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


class Selection(NamedTuple):
    """The selected interpretation, its comparison with the robot and its misfit, and others that
    fit equally well.
    """

    interpretation: Interpretation
    comparison: Comparison
    misfit: float
    alternatives: tuple[Interpretation, ...]


def select_interpretation(
    free: FreeParameters, data: Measurements, stated: Comparison | None, misfit: float
) -> Selection | None:
    """Select the interpretation that fits far better than the stated one; None without one.

    Parameters
    ----------
    data : as written. stated : their comparison at the poses that the robot reaches; None where it
        reaches too few. misfit : of the data as written.
    """
    tested = [] if stated is None else _test_values(free, stated.data, misfit)
    if not any(value <= ALLOWED for _, value in tested):
        tested += _test_readings(free, data, misfit)

    def written(interpretation: Interpretation) -> Measurements:
        return data if interpretation.observation is None or stated is None else stated.data

    better = [
        (interpretation, value)
        for interpretation, value in tested
        if value * BETTER < misfit
        and _is_informative(free, written(interpretation), interpretation, value)
    ]
    if not better:
        return None
    smallest = min(value for _, value in better)
    best, *others = [
        interpretation for interpretation, value in better if value <= max(EQUALLY * smallest, 1.0)
    ]
    comparison = _judge(free, best.apply(written(best)))
    if comparison is None:
        return None
    least, _ = refine_misfit(comparison)
    return Selection(best, comparison, least, tuple(others)) if least * BETTER < misfit else None


def shares_poses(data: Measurements) -> bool:
    """Return whether rows share more than their pose: pairs of poses, or groups."""
    return any(o.kind.poses_per_row > 1 or bool((o.group != "").any()) for o in data.observations)


def _select_few(data: Measurements) -> IntArray:
    """Return poses spread over the data by which many interpretations are compared; all where rows
    share more than their pose.
    """
    n = data.n_poses
    equations = sum(o.whitener.shape[-1] * len(o) for o in data.observations)
    count = max(FEWEST_POSES, -(-FEW_ROWS * n // max(equations, 1)))
    if n <= count or shares_poses(data):
        return np.arange(n)
    return np.unique(np.linspace(0, n - 1, count).astype(np.intp))


def _test_values(
    free: FreeParameters, data: Measurements, misfit: float
) -> list[tuple[Interpretation, float]]:
    """Return interpretations of the measured values that promise to fit far better, with their
    misfits.
    """
    listed = list(list_interpretations(data))
    screened = compute_misfits(free, data.take(_select_few(data)), listed, QUICK)
    promising = [listed[i] for i in _select_promising(screened, misfit)]
    misfits = compute_misfits(free, data, promising, THOROUGH)
    return list(zip(promising, misfits.tolist(), strict=True))


def _test_readings(
    free: FreeParameters, data: Measurements, misfit: float
) -> list[tuple[Interpretation, float]]:
    """Return interpretations of the readings that promise to fit far better, with their misfits."""
    robot, poses = free.robot, _select_few(data)
    listed = list(list_reading_interpretations(data, robot.actuators))
    readings = np.stack([interpretation.change(data.readings)[poses] for interpretation in listed])
    reached = find_directly_reachable(
        robot, robot.values[None], readings.reshape(1, -1, readings.shape[-1])
    ).reshape(readings.shape[:2])
    near = np.flatnonzero(reached.mean(axis=1) >= 1.0 - MOST_EXCLUDED)
    start, size = _guess_frames(free, data.take(poses), readings[near], reached[near])
    has_frames = len(data.nuisance_parameters) > 0
    order = np.sort(np.argsort(size)[:NEAREST]) if has_frames else np.arange(len(near))
    nearest = [listed[i] for i in near[order]]
    few = [
        _judge(free, interpretation.apply(data).take(poses), start[[i]])
        for i, interpretation in zip(order, nearest, strict=True)
    ]
    screened = np.array(
        [np.inf if interpretation is None else interpretation.misfit for interpretation in few]
    )
    promising = [nearest[i] for i in _select_promising(screened, misfit)]
    judged = [
        (interpretation, _judge(free, interpretation.apply(data))) for interpretation in promising
    ]
    return [
        (interpretation, comparison.misfit)
        for interpretation, comparison in judged
        if comparison is not None
    ]


def _guess_frames(
    free: FreeParameters, data: Measurements, readings: FloatArray, reached: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Guess nuisance parameters (h, U) for h sets of readings (h, n, a), and return the median (h,)
    of the sizes of whitened residuals with them, the robot as it is.

    Poses that the robot does not reach, by `reached` (h, n), are taken at home.
    """
    robot, nuisance, h = free.robot, data.nuisance_parameters, len(readings)
    T = np.broadcast_to(robot.home_state.T.reshape(-1, 4, 4)[0], (*reached.shape, 4, 4)).copy()
    T[reached] = forward_trials(robot, robot.values[None], readings[reached][None]).T[0]
    measured = [np.broadcast_to(o.measured, (h, *o.measured.shape)) for o in data.observations]
    most, steps = QUICK.candidates, QUICK.guess_steps
    start = guess_nuisance_values_batch(data, measured, T, nuisance, most=most, steps=steps)
    sizes = [np.zeros((h, 0))]
    for o, places in zip(data.observations, nuisance.indices, strict=True):
        if len(o) and not o.kind.sensed_joints:
            residual = o.evaluate(T, start[:, places]).residual
            whitened = np.matmul(o.whitener, residual[..., None])[..., 0]
            sizes.append(np.linalg.norm(whitened, axis=-1))
    size = np.concatenate(sizes, axis=1)
    return start, np.median(size, axis=1) if size.shape[1] else np.zeros(h)


def _judge(
    free: FreeParameters, data: Measurements, start: FloatArray | None = None
) -> Comparison | None:
    """Compare measurements with the robot without far rows, quickly from a given start; None where
    it reaches too few poses.
    """
    reach = select_reached(free, data)
    if not reach.is_enough:
        return None
    effort = THOROUGH if start is None else QUICK
    return exclude_far_rows(compare_with_robot(free, reach.data, (), effort, start))


def _select_promising(misfits: FloatArray, misfit: float) -> IntArray:
    """Return the places of the best misfits that may belong to a far better fit than `misfit`."""
    finite = np.sort(misfits[np.isfinite(misfits)])
    bound = min(PROMISING * misfit / BETTER, *finite[MOST_JUDGED - 1 : MOST_JUDGED], np.inf)
    return np.flatnonzero(misfits <= bound)


def _is_informative(
    free: FreeParameters, data: Measurements, interpretation: Interpretation, misfit: float
) -> bool:
    """Return whether values that shrink fit far better than a constant would: zeros fit every
    unit.
    """
    if not interpretation.shrinks:
        return True

    def make_constant(values: FloatArray) -> FloatArray:
        changed = interpretation.change(values)
        return np.where(changed != values, np.nanmedian(changed, axis=0), changed)

    control = _judge(free, replace(interpretation, change=make_constant).apply(data))
    return control is None or not control.misfit < BETTER * misfit
