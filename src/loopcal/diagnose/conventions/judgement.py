# SPDX-License-Identifier: Apache-2.0
"""Judge single interpretations: their frames, their misfit, and whether their fit is evidence."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from loopcal import measure
from loopcal.diagnose.conventions.interpretations.interpretation import Interpretation
from loopcal.diagnose.conventions.misfit import (
    QUICK,
    THOROUGH,
    Comparison,
    compare_with_robot,
    exclude_far_rows,
    select_reached,
)
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.findings import Quantity
from loopcal.measure import Measurements
from loopcal.mechanism import forward_trials
from loopcal.typing import BoolArray, FloatArray
from loopcal.units import Dimension

BETTER = 5.0
"""Factor by which another interpretation must fit better before data are refused: true data of a
robot far beyond its tolerances fit twice as well in none of them.
"""


def judge_data(
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


def compute_rms_residuals(comparison: Comparison) -> dict[Dimension, float]:
    """Return root mean squares [m or rad] of the first interpretation's residuals by dimension,
    without far rows.
    """
    square: dict[Dimension, list[FloatArray]] = {}
    for s, r in zip(comparison.problem.rows, comparison.residuals(), strict=True):
        present = np.einsum("rmm->rm", s.whitener[0]) != 0.0
        for j, column in enumerate(s.kind.noise_columns):
            square.setdefault(column.dimension, []).append(r.raw[0, present[:, j], j] ** 2)
    joined = {dimension: np.concatenate(squares) for dimension, squares in square.items()}
    return {d: float(np.sqrt(values.mean())) for d, values in joined.items() if len(values)}


def list_rms_residuals(comparison: Comparison) -> tuple[Quantity, ...]:
    """Return these root mean squares in units of the robot's file."""
    robot = comparison.problem.free.robot
    sizes = compute_rms_residuals(comparison)
    return tuple(robot.to_quantity(size, dimension) for dimension, size in sizes.items())


def guess_frames(
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
    start = measure.guess_nuisance_values_batch(data, measured, T, nuisance, most=most, steps=steps)
    sizes = [np.zeros((h, 0))]
    for o, places in zip(data.observations, nuisance.indices, strict=True):
        if len(o) and not o.kind.sensed_joints:
            residual = o.evaluate(T, start[:, places]).residual
            whitened = np.matmul(o.whitener, residual[..., None])[..., 0]
            sizes.append(np.linalg.norm(whitened, axis=-1))
    size = np.concatenate(sizes, axis=1)
    return start, np.median(size, axis=1) if size.shape[1] else np.zeros(h)


def is_informative(
    free: FreeParameters, data: Measurements, interpretation: Interpretation, misfit: float
) -> bool:
    """Return whether values that shrink fit far better than controls without information."""
    if not any(part.shrinks for part in interpretation.parts):
        return True
    for control in _list_controls(data, interpretation):
        comparison = judge_data(free, control)
        if comparison is not None and comparison.misfit < BETTER * misfit:
            return False
    return True


def _list_controls(data: Measurements, interpretation: Interpretation) -> Iterator[Measurements]:
    """Yield data with the values of other rows, and with constants in place of changed values:
    random numbers of any size fit as well at any pose, and zeros in every unit.
    """
    changed, rng = interpretation.apply(data), np.random.default_rng(0)
    shuffled = (
        replace(o, measured=o.measured[rng.permutation(len(o))]) for o in changed.observations
    )
    yield replace(changed, observations=tuple(shuffled))
    pairs = zip(data.observations, changed.observations, strict=True)
    constant = (
        replace(new, measured=_make_constant(old.measured, new.measured)) for old, new in pairs
    )
    readings = _make_constant(data.readings, changed.readings)
    yield replace(changed, readings=readings, observations=tuple(constant))


def _make_constant(old: FloatArray, new: FloatArray) -> FloatArray:
    """Return a table with the median of its column in place of the values that changed."""
    is_changed = ~np.isclose(old, new, rtol=1e-12, atol=0.0, equal_nan=True)
    if not is_changed.any():
        return new
    return np.where(is_changed, np.nanmedian(new, axis=0), new)
