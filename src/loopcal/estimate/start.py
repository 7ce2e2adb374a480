# SPDX-License-Identifier: Apache-2.0
"""Warm starts: values from which the next linearization begins.

A start belongs to the deviations at which it was made. It predicts poses and nuisance parameters at
other deviations to first order. It only chooses where iterations begin: their results do not depend
on it beyond rounding, as long as it is near.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from loopcal import engine, geometry
from loopcal.estimate.poses.states import PoseStates, map_states
from loopcal.typing import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Start:
    """Warm start of t trials.

    Attributes
    ----------
    deviation : (t, p) where it was made.
    nuisance : (t, U) values of the nuisance parameters [SI]. slope : (t, U, p) their change.
    first_nuisance : (t, U) values with which the first linearization began.
    poses : states (t, n) of all poses; None where every solution begins at home.
    motion : (t, n, 6, p) change of the poses by the scaled parameters, in single precision because
        it only chooses a start; None where poses are not predicted.
    """

    deviation: FloatArray
    nuisance: FloatArray
    slope: FloatArray
    first_nuisance: FloatArray
    poses: PoseStates | None = None
    motion: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.deviation)

    def predict_nuisance(self, deviation: FloatArray) -> FloatArray:
        """Return the nuisance parameters (t, U) at deviations (t, p), to first order."""
        change = deviation - self.deviation
        return self.nuisance + np.matmul(self.slope, change[..., None])[..., 0]

    def predict_states(self, deviation: FloatArray) -> engine.State | None:
        """Return the states (t, n) at deviations (t, p), to first order; None to begin at home."""
        if self.poses is None or self.motion is None:
            return self.poses and self.poses.state
        change = (deviation - self.deviation).astype(np.float32)
        twist = np.matmul(self.motion, change[:, None, :, None])[..., 0].astype(np.float64)
        return replace(self.poses.state, T=geometry.apply_twist(self.poses.state.T, twist))

    def with_nuisance(self, values: FloatArray) -> Start:
        """Return this start with other nuisance parameters (t, U), which do not move."""
        values = np.broadcast_to(values, self.nuisance.shape)
        return replace(
            self, nuisance=values, first_nuisance=values, slope=np.zeros_like(self.slope)
        )

    def take(self, trials: IntArray) -> Start:
        """Return some trials; this object where these are all of them."""
        if np.array_equal(trials, np.arange(len(self))):
            return self
        return Start(
            self.deviation[trials],
            self.nuisance[trials],
            self.slope[trials],
            self.first_nuisance[trials],
            self.poses and self.poses.take(trials),
            None if self.motion is None else self.motion[trials],
        )

    def put(self, trials: IntArray, other: Start) -> Start:
        """Return this start with some trials taken from another one."""
        if np.array_equal(trials, np.arange(len(self))):
            return other

        def replaced(old: np.ndarray, new: np.ndarray) -> np.ndarray:
            out = np.array(old)
            out[trials] = new
            return out

        poses, motion = self.poses, other.motion
        if poses is not None and other.poses is not None:
            poses = poses.put((trials, slice(None)), other.poses)
        if motion is not None:
            whole = (len(self), *motion.shape[1:])
            old = np.zeros(whole, np.float32) if self.motion is None else self.motion
            motion = replaced(old, motion)
        return Start(
            replaced(self.deviation, other.deviation),
            replaced(self.nuisance, other.nuisance),
            replaced(self.slope, other.slope),
            replaced(self.first_nuisance, other.first_nuisance),
            poses,
            motion,
        )

    @staticmethod
    def join(parts: Sequence[Start]) -> Start:
        """Return the trials of all parts, one after the other."""
        if len(parts) == 1:
            return parts[0]
        poses = [part.poses for part in parts if part.poses is not None]
        motions = [part.motion for part in parts if part.motion is not None]
        return Start(
            np.concatenate([part.deviation for part in parts]),
            np.concatenate([part.nuisance for part in parts]),
            np.concatenate([part.slope for part in parts]),
            np.concatenate([part.first_nuisance for part in parts]),
            PoseStates.join(poses, 0) if poses else None,
            np.concatenate(motions) if motions else None,
        )


def spread_states(state: engine.State, trials: int, poses: int) -> engine.State:
    """Return a state (1, 1) or (1, n) as that of all trials and poses, without copying."""
    return map_states(lambda a: np.broadcast_to(a, (trials, poses, *a.shape[2:])), state)
