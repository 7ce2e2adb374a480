# SPDX-License-Identifier: Apache-2.0
"""Where poses of uncertain readings begin: at the recorded reading, and where there is none that is
believed, at the pose that rows measure in full, else with the reading of the nearest pose in the
list, at home, or across the stroke, whichever the rows of the pose agree with best.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from loopcal.estimate.measured_poses import measured_poses, squares_at
from loopcal.estimate.moves import mapped
from loopcal.estimate.sensed import Sensed
from loopcal.estimate.standing import Standing, stroke_of
from loopcal.mechanism import Mechanism, Status, compute_readings, forward_trials, inverse
from loopcal.typing import FloatArray, IntArray

TRIED = 9
"""Values of a missing reading, evenly across its stroke, that are tried as a start."""


def start_of(
    robot: Mechanism, recorded: FloatArray, sigma: FloatArray, sensed: Sequence[Sensed], trials: int
) -> Standing:
    """Return where the poses of all trials begin, at the robot's present values.

    Parameters
    ----------
    recorded : (t | 1, n, a) [SI], NaN where a reading was not taken. sigma : (n, a) [SI], infinite
        where it is not believed.
    sensed : what was measured.
    """
    missing = np.isnan(recorded) | np.isinf(sigma)
    q = _nearest(recorded, compute_readings(robot, robot.values[None], robot.home_state)[0, 0])
    shape = (len(q), q.shape[1])
    state = mapped(
        lambda array: np.broadcast_to(array, (*shape, *array.shape[2:])), robot.home_state
    )
    begin = Standing(state, q)
    if missing.any():
        trial, pose = np.nonzero(missing.any(axis=2))
        T, known = measured_poses(robot, sensed, trial, pose)
        if known.any():
            begin = _at_measured(robot, begin, missing, T[known], (trial[known], pose[known]))
        if robot.program.sigma is None and not known.all():
            said = np.asarray(np.isfinite(recorded[trial, pose]).all(axis=1))
            begin = _tried(
                robot, begin, missing, said[~known], sensed, (trial[~known], pose[~known])
            )
    if robot.program.sigma is not None:
        begin = _placed(robot, begin)
    if len(q) < trials:
        begin = begin.of(np.zeros(trials, dtype=np.int64))
    return begin


def _at_measured(
    robot: Mechanism,
    begin: Standing,
    missing: np.ndarray,
    T: FloatArray,
    where: tuple[IntArray, IntArray],
) -> Standing:
    """Poses (trials, poses) begun at T (k, 4, 4), missing readings as there."""
    found = inverse(robot, T)
    good = found.converged
    chosen = (where[0][good], where[1][good])
    q = np.where(missing[chosen], found.q[good], begin.q[chosen])
    return begin.put(chosen, Standing(mapped(lambda array: array[0, good], found.state), q))


def _tried(
    robot: Mechanism,
    begin: Standing,
    missing: np.ndarray,
    said: np.ndarray,
    sensed: Sequence[Sensed],
    where: tuple[IntArray, IntArray],
) -> Standing:
    """Poses (trials, poses) begun at the best of a few values of the missing readings: the nearest
    pose's, home's, across the stroke; where all were said (k,), if not believed, at these.
    """
    trial, pose = where
    home = compute_readings(robot, robot.values[None], robot.home_state)[0, 0]
    width = np.array([stroke_of(robot, a) for a in robot.actuators])
    low = np.array(
        [
            h - w / 2 if a.stroke is None else a.stroke[0]
            for a, h, w in zip(robot.actuators, home, width, strict=True)
        ]
    )
    across = low + width * ((np.arange(TRIED) + 0.5) / TRIED)[:, None]
    own = begin.q[trial, pose]
    others = np.concatenate([home[None], across])
    tried = np.concatenate(
        [own[:, None], np.where(missing[trial, pose][:, None], others, own[:, None])], axis=1
    )
    count = tried.shape[1]
    state = forward_trials(robot, robot.values[None], tried.reshape(1, -1, len(home)), follow=False)
    closed = np.asarray(state.status[0] == Status.CONVERGED)
    T = np.where(closed[:, None, None], state.T[0], robot.home)
    squares = squares_at(sensed, np.repeat(trial, count), np.repeat(pose, count), T)
    squares = np.where(closed, squares, np.inf).reshape(-1, count)
    squares[said & np.isfinite(squares[:, 0]), 0] = -1.0
    best = squares.argmin(axis=1)
    good = np.isfinite(squares.min(axis=1))
    pick = (np.arange(len(pose)) * count + best)[good]
    there = Standing(
        mapped(lambda array: array[0, pick], state), tried[np.flatnonzero(good), best[good]]
    )
    return begin.put((trial[good], pose[good]), there)


def _nearest(recorded: FloatArray, home: FloatArray) -> FloatArray:
    """Readings (t, n, a), each missing one that of the nearest pose in the list which has it, else
    that of home.
    """
    there = np.isfinite(recorded)
    n = recorded.shape[1]
    index = np.arange(n)[None, :, None]
    before = np.maximum.accumulate(np.where(there, index, -1), axis=1)
    after = np.minimum.accumulate(np.where(there, index, 2 * n)[:, ::-1], axis=1)[:, ::-1]
    near = np.where((before >= 0) & (index - before <= after - index), before, after)
    far = np.where(near < n, near, before)
    found = np.take_along_axis(recorded, np.clip(far, 0, n - 1), axis=1)
    return np.where(there, recorded, np.where((far >= 0) & np.isfinite(found), found, home))


def _placed(robot: Mechanism, begin: Standing) -> Standing:
    """Poses of redundant readings by their weighted least squares; where that fails, of the nearest
    pose that has one.
    """
    state = forward_trials(robot, robot.values[None], begin.q, begin.state)
    good = np.asarray(state.status == Status.CONVERGED)
    n = good.shape[1]
    near = _nearest(
        np.where(good, np.arange(n, dtype=np.float64), np.nan)[..., None], np.full(1, np.nan)
    )[..., 0]
    known = np.isfinite(near)
    pick = np.where(known, near, 0.0).astype(np.int64)
    trial = np.arange(len(good))[:, None]

    def chosen(solved: np.ndarray, first: np.ndarray) -> np.ndarray:
        spread = known.reshape(*known.shape, *[1] * (solved.ndim - 2))
        return np.where(spread, solved[trial, pick], first)

    placed = mapped(chosen, state, begin.state)
    return Standing(replace(placed, status=np.zeros_like(placed.status)), begin.q)
