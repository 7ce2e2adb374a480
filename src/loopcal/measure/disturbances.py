# SPDX-License-Identifier: Apache-2.0
"""Errors of simulated machines that no fit knows of, and the true poses under them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from loopcal.engine import State
from loopcal.mechanism import Mechanism, Status, forward_trials, solve_at_pose
from loopcal.numerics.trial_batch import map_arrays
from loopcal.typing import BoolArray, FloatArray


@dataclass(frozen=True, eq=False)
class Disturbance:
    """What happens at each measured pose although the model does not contain it.

    Attributes
    ----------
    values : (t | 1, n, p) [SI] added to the true parameter values, such as thermal growth; None
        where these are the same at all poses.
    readings : (t | 1, n, a) [SI] true joint values minus readings, such as backlash; None for 0.
    motion : (t | 1, n, 3) [m] displacement of what is measured, in base axes, such as the drift of
        an instrument; None for 0. It is no part of the true poses.
    """

    values: FloatArray | None = None
    readings: FloatArray | None = None
    motion: FloatArray | None = None

    def displace(self, T: FloatArray) -> FloatArray:
        """Return the poses (t, n, 4, 4) that are measured at true poses T."""
        if self.motion is None:
            return T
        moved = np.array(T)
        moved[..., :3, 3] += self.motion
        return moved


NO_DISTURBANCE = Disturbance()


def reach_poses(
    robot: Mechanism,
    values: FloatArray,
    readings: FloatArray,
    start: State,
    disturbance: Disturbance,
) -> tuple[FloatArray, State]:
    """Return the true readings (t | 1, n, a) and the states (t, n) of t machines.

    Parameters
    ----------
    robot : structure of the machines. values : (t, p) [SI] of each of them.
    readings : (n, a) [SI] of the controller. start : (1, n) state of the commanded poses.
    """
    true = readings[None]
    if disturbance.readings is not None:
        true = true + disturbance.readings
    shape = (len(values), len(readings))
    if disturbance.values is not None:  # every pose is a machine of its own
        values = (values[:, None] + disturbance.values).reshape(-1, values.shape[1])
        true = np.broadcast_to(true, (*shape, readings.shape[1]))
        true = true.reshape(-1, 1, readings.shape[1])
        start = _reshape_state(start, shape, (-1, 1))
    state = forward_trials(robot, values, true, start)
    # Redundant actuators of a wrong geometry contradict each other: their true readings are those
    # of the reached pose. Where they contradict each other so widely that they lead to none, the
    # machine is moved to the commanded pose, with all but the needed actuators following it.
    if robot.program.sigma is not None:
        lost = (state.status != Status.CONVERGED)[..., None, None]
        begin = replace(state, T=np.where(lost, start.T, state.T))
        placed, closed = solve_at_pose(robot, values, begin.T, begin)
        state = map_arrays(partial(_select_lost, lost[..., 0, 0]), placed, state)
        true = np.where(np.isfinite(closed), closed, true)
    if disturbance.values is not None:
        true, state = true.reshape(*shape, -1), _reshape_state(state, (len(values), 1), shape)
    return true, state


def _select_lost(lost: BoolArray, placed: np.ndarray, reached: np.ndarray) -> np.ndarray:
    """Return the arrays of poses (t, n, ..), those of lost ones (t, n) as they are placed."""
    return np.where(lost.reshape(*lost.shape, *[1] * (reached.ndim - 2)), placed, reached)


def _reshape_state(state: State, shape: tuple[int, int], wanted: tuple[int, int]) -> State:
    """Return a state, broadcast to `shape` of trials and poses, with another shape of these."""

    def change(array: np.ndarray) -> np.ndarray:
        return np.broadcast_to(array, (*shape, *array.shape[2:])).reshape(*wanted, *array.shape[2:])

    return map_arrays(change, state)
