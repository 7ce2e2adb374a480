# SPDX-License-Identifier: Apache-2.0
"""Where poses of uncertain readings begin.

A pose begins at its recorded reading. Where a reading is missing or not believed, the pose begins
where its rows measure it in full; otherwise the missing reading is that of the nearest pose in the
list, that of home, or one of a few values across the stroke, whichever fits the rows best.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from loopcal.estimate.observation_rows import ObservationRows
from loopcal.estimate.poses.coordinates import stroke_of
from loopcal.estimate.poses.measured import measure_poses, sum_squares_at
from loopcal.estimate.poses.states import PoseStates, spread_states
from loopcal.mechanism import Mechanism, Status, compute_readings, forward_trials, inverse
from loopcal.numerics.trial_batch import map_arrays
from loopcal.typing import BoolArray, FloatArray, IntArray

TRIED = 9
"""Values of a missing reading, evenly across its stroke, that are tried."""


def first_poses(
    robot: Mechanism,
    recorded: FloatArray,
    sigma: FloatArray,
    rows: Sequence[ObservationRows],
    trials: int,
) -> PoseStates:
    """Return where the poses of all trials begin, at the robot's present values.

    Parameters
    ----------
    recorded : (t | 1, n, actuators) [SI], NaN where a reading was not taken.
    sigma : (n, actuators) [SI], infinite where a reading is not believed.
    rows : what was measured. trials : t.
    """
    missing = np.isnan(recorded) | np.isinf(sigma)
    home = compute_readings(robot, robot.values[None], robot.home_state)[0, 0]
    q = _fill_from_nearest(recorded, home)
    begin = PoseStates(spread_states(robot.home_state, len(q), q.shape[1]), q)
    if missing.any():
        trial, pose = np.nonzero(missing.any(axis=2))
        T, is_full = measure_poses(robot, rows, trial, pose)
        if is_full.any():
            where = (trial[is_full], pose[is_full])
            begin = _begin_at_measured(robot, begin, missing, T[is_full], where)
        if robot.program.sigma is None and not is_full.all():
            where = (trial[~is_full], pose[~is_full])
            begin = _begin_at_best_reading(robot, begin, missing, recorded, rows, where)
    if robot.program.sigma is not None:
        begin = _solve_redundant(robot, begin)
    if len(q) < trials:
        begin = begin.take(np.zeros(trials, dtype=np.int64))
    return begin


def _begin_at_measured(
    robot: Mechanism,
    begin: PoseStates,
    missing: BoolArray,
    T: FloatArray,
    where: tuple[IntArray, IntArray],
) -> PoseStates:
    """Return starts with poses (trials, poses) at T (k, 4, 4), missing readings as there."""
    solution = inverse(robot, T)
    good = solution.closed
    chosen = (where[0][good], where[1][good])
    q = np.where(missing[chosen], solution.q[good], begin.q[chosen])
    state = map_arrays(lambda array: array[0, good], solution.state)
    return begin.put_poses(*chosen, PoseStates(state, q))


def _begin_at_best_reading(
    robot: Mechanism,
    begin: PoseStates,
    missing: BoolArray,
    recorded: FloatArray,
    rows: Sequence[ObservationRows],
    where: tuple[IntArray, IntArray],
) -> PoseStates:
    """Return starts with poses (trials, poses) at the best of a few values of missing readings.

    The values are those of the nearest pose, of home, and across the stroke. Readings that were all
    recorded, if not believed, come first.
    """
    trial, pose = where
    is_recorded = np.asarray(np.isfinite(recorded[trial, pose]).all(axis=1))
    home = compute_readings(robot, robot.values[None], robot.home_state)[0, 0]
    width = np.array([stroke_of(robot, a) for a in robot.actuators])
    low = np.array(
        [
            h - w / 2 if a.stroke is None else a.stroke[0]
            for a, h, w in zip(robot.actuators, home, width, strict=True)
        ]
    )
    across = low + width * ((np.arange(TRIED) + 0.5) / TRIED)[:, None]
    own = begin.q[trial, pose][:, None]
    others = np.concatenate([home[None], across])
    tried = np.concatenate([own, np.where(missing[trial, pose][:, None], others, own)], axis=1)
    count = tried.shape[1]
    flat = tried.reshape(1, -1, len(home))
    state = forward_trials(robot, robot.values[None], flat, follow=False)
    closed = np.asarray(state.status[0] == Status.CONVERGED)
    T = np.where(closed[:, None, None], state.T[0], robot.home)
    squares = sum_squares_at(rows, np.repeat(trial, count), np.repeat(pose, count), T)
    squares = np.where(closed, squares, np.inf).reshape(-1, count)
    squares[is_recorded & np.isfinite(squares[:, 0]), 0] = -1.0
    best = squares.argmin(axis=1)
    good = np.isfinite(squares.min(axis=1))
    pick = (np.arange(len(pose)) * count + best)[good]
    chosen = map_arrays(lambda array: array[0, pick], state)
    q = tried[np.flatnonzero(good), best[good]]
    return begin.put_poses(trial[good], pose[good], PoseStates(chosen, q))


def _fill_from_nearest(recorded: FloatArray, home: FloatArray) -> FloatArray:
    """Return readings (t, n, a); a missing one is that of the nearest pose that has it, or home."""
    is_known = np.isfinite(recorded)
    n = recorded.shape[1]
    index = np.arange(n)[None, :, None]
    before = np.maximum.accumulate(np.where(is_known, index, -1), axis=1)
    after = np.minimum.accumulate(np.where(is_known, index, 2 * n)[:, ::-1], axis=1)[:, ::-1]
    near = np.where((before >= 0) & (index - before <= after - index), before, after)
    far = np.where(near < n, near, before)
    nearest = np.take_along_axis(recorded, np.clip(far, 0, n - 1), axis=1)
    filled = np.where((far >= 0) & np.isfinite(nearest), nearest, home)
    return np.where(is_known, recorded, filled)


def _solve_redundant(robot: Mechanism, begin: PoseStates) -> PoseStates:
    """Return poses of redundant readings by their weighted least squares.

    A pose where that fails begins at the nearest pose where it does not.
    """
    state = forward_trials(robot, robot.values[None], begin.q, begin.state)
    good = np.asarray(state.status == Status.CONVERGED)
    n = good.shape[1]
    numbers = np.where(good, np.arange(n, dtype=np.float64), np.nan)[..., None]
    near = _fill_from_nearest(numbers, np.full(1, np.nan))[..., 0]
    is_known = np.isfinite(near)
    pick = np.where(is_known, near, 0.0).astype(np.int64)
    trial = np.arange(len(good))[:, None]

    def chosen(solved: np.ndarray, first: np.ndarray) -> np.ndarray:
        spread = is_known.reshape(*is_known.shape, *[1] * (solved.ndim - 2))
        return np.where(spread, solved[trial, pick], first)

    placed = map_arrays(chosen, state, begin.state)
    return PoseStates(replace(placed, status=np.zeros_like(placed.status)), begin.q)
