# SPDX-License-Identifier: Apache-2.0
"""Where poses of uncertain readings begin: at the recorded reading, and where there is none at the measured pose, else as
the nearest pose in the list, else at home.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from loopcal import se3
from loopcal.calibrate.moves import mapped
from loopcal.calibrate.sensed import Sensed
from loopcal.calibrate.standing import Standing
from loopcal.linalg import FloatArray
from loopcal.measure import Pose
from loopcal.mechanism import Mechanism, Status, inverse
from loopcal.mechanism.trials import forward_trials, readings_at

STEPS = 20
"""Newton steps by which a pose is located from its measured components."""


def start_of(robot: Mechanism, recorded: FloatArray, sensed: Sequence[Sensed], trials: int) -> Standing:
    """Return where the poses of all trials begin, at the robot's present values.

    Parameters
    ----------
    recorded : (t | 1, n, a) [SI], NaN where a reading was not taken. sensed : what was measured.
    """
    missing = np.isnan(recorded)
    q = _nearest(recorded, readings_at(robot, robot.values[None], robot.home_state)[0, 0])
    shape = (len(q), q.shape[1])
    state = mapped(lambda array: np.broadcast_to(array, (*shape, *array.shape[2:])), robot.home_state)
    begin = Standing(state, q)
    if missing.any():
        T, known = measured_poses(robot, sensed, len(q), q.shape[1])
        trial, pose = np.nonzero(missing.any(axis=2) & known)
        if len(pose):
            found = inverse(robot, T[trial, pose])
            good = found.converged
            own = np.where(missing[trial, pose], found.q, q[trial, pose])
            there = mapped(lambda array: array[0, good], found.state)
            begin = begin.put((trial[good], pose[good]), Standing(there, own[good]))
    if robot.program.sigma is not None:
        begin = _placed(robot, begin)
    if len(q) < trials:
        begin = begin.of(np.zeros(trials, dtype=np.int64))
    return begin


def measured_poses(robot: Mechanism, sensed: Sequence[Sensed], trials: int, n: int) -> tuple[FloatArray, np.ndarray]:
    """Poses (t, n, 4, 4) of rows that measure one in full and in a known frame, and which there are (t, n)."""
    T = np.tile(robot.home, (trials, n, 1, 1))
    known = np.zeros((trials, n), dtype=bool)
    for s in sensed:
        if not isinstance(s.kind, Pose) or s.places.shape[1]:
            continue
        full = np.broadcast_to((np.einsum("trii->tri", s.whitener) != 0.0).all(axis=2), (trials, len(s.poses)))
        measured = np.broadcast_to(s.measured, (trials, *s.measured.shape[1:]))
        at = np.tile(robot.home, (trials, len(s.poses), 1, 1))
        for _ in range(STEPS):
            seen = s.kind.evaluate(at, measured)
            slope = np.where(full[..., None, None], seen.jacobian, np.eye(6))
            step = -np.linalg.solve(slope, np.where(full[..., None], seen.residual, 0.0)[..., None])[..., 0]
            at = se3.exp_update(at, step)
            if np.abs(step).max(initial=0.0) < 1e-12:
                break
        trial, row = np.nonzero(full & np.isfinite(at).all(axis=(2, 3)))
        T[trial, s.poses[row]], known[trial, s.poses[row]] = at[trial, row], True
    return T, known


def _nearest(recorded: FloatArray, home: FloatArray) -> FloatArray:
    """Readings (t, n, a), each missing one that of the nearest pose in the list which has it, else that of home."""
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
    """Poses of redundant readings by their weighted least squares; where that fails, of the nearest pose that has one."""
    state = forward_trials(robot, robot.values[None], begin.q, begin.state)
    good = np.asarray(state.status == Status.CONVERGED)
    n = good.shape[1]
    near = _nearest(np.where(good, np.arange(n, dtype=np.float64), np.nan)[..., None], np.full(1, np.nan))[..., 0]
    known = np.isfinite(near)
    pick = np.where(known, near, 0.0).astype(np.int64)
    trial = np.arange(len(good))[:, None]

    def chosen(solved: np.ndarray, first: np.ndarray) -> np.ndarray:
        spread = known.reshape(*known.shape, *[1] * (solved.ndim - 2))
        return np.where(spread, solved[trial, pick], first)

    placed = mapped(chosen, state, begin.state)
    return Standing(replace(placed, status=np.zeros_like(placed.status)), begin.q)
