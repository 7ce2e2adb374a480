# SPDX-License-Identifier: Apache-2.0
"""Poses of a batch of trials: their states, and what solving for them gives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from loopcal import engine
from loopcal.estimate.poses.linearization import LinearizedPoses
from loopcal.mechanism import DrivenJoints
from loopcal.numerics.trial_batch import TrialBatch, map_arrays
from loopcal.typing import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class PoseStates(TrialBatch):
    """Poses of a trials: states (a, n) and true readings q (a, n, actuators) [SI]."""

    state: engine.State
    q: FloatArray

    def take_poses(self, poses: IntArray) -> PoseStates:
        """Return some poses."""
        return map_arrays(lambda array: array[:, poses], self)

    def put_poses(self, trials: IntArray, poses: IntArray, other: PoseStates) -> PoseStates:
        """Return a copy in which k poses of given trials and numbers (k,) are other ones (k,)."""

        def replaced(old: np.ndarray, new: np.ndarray) -> np.ndarray:
            out = np.array(old)
            out[trials, poses] = new
            return out

        return map_arrays(replaced, self, other)

    @staticmethod
    def join_poses(states: Sequence[PoseStates], order: IntArray) -> PoseStates:
        """Return the poses of all states side by side, then in an order."""
        return map_arrays(lambda *arrays: np.concatenate(arrays, axis=1)[:, order], *states)


def spread_states(state: engine.State, trials: int, poses: int) -> engine.State:
    """Return a state (1, 1) or (1, n) as that of all trials and poses, without copying."""
    return map_arrays(lambda a: np.broadcast_to(a, (trials, poses, *a.shape[2:])), state)


@dataclass(frozen=True, eq=False)
class PoseEstimates(TrialBatch):
    """Poses of t trials that are unknown because readings are uncertain, where all rows fit best.

    Attributes
    ----------
    states : (t, n) closed poses and true readings. is_reached : (t, n).
    rank : (t, components) coordinates of poses that rows determine.
    is_undetermined : (t, n) poses with a coordinate that no row determines; they stay where the
        search began.
    is_converged : (t,).
    """

    states: PoseStates
    is_reached: BoolArray
    rank: IntArray
    is_undetermined: BoolArray
    is_converged: BoolArray


@dataclass(frozen=True, eq=False)
class PoseSolution:
    """Poses and nuisance parameters of a trials at given deviations.

    Attributes
    ----------
    nuisance : (a, U) values that fit best, or as given; None without any.
    linearized : the poses of the only block; None where there are several, which are solved again
        block by block.
    states : (a, n) of the only block, for the next start; None as above.
    estimates : of uncertain poses; None where readings are exact.
    driven : joints of the only block; None where the next step has no use for them.
    """

    nuisance: FloatArray | None
    linearized: LinearizedPoses | None = None
    states: PoseStates | None = None
    estimates: PoseEstimates | None = None
    driven: DrivenJoints | None = None

    @property
    def has_derivatives(self) -> bool:
        """Whether poses of a single block are linearized."""
        return self.linearized is not None and self.linearized.by_parameters.shape[-1] > 0
