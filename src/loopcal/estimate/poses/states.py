# SPDX-License-Identifier: Apache-2.0
"""States of the poses of many trials, with the joint values that belong to them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from loopcal import engine
from loopcal.typing import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class PoseStates:
    """Poses of a trials: states (a, n) and true readings q (a, n, actuators) [SI]."""

    state: engine.State
    q: FloatArray

    def take(self, trials: IntArray) -> PoseStates:
        """Return some trials."""
        return PoseStates(map_states(lambda array: array[trials], self.state), self.q[trials])

    def at_poses(self, poses: IntArray) -> PoseStates:
        """Return some poses."""
        return PoseStates(map_states(lambda array: array[:, poses], self.state), self.q[:, poses])

    def put(
        self, chosen: tuple[IntArray | slice, IntArray | slice], other: PoseStates
    ) -> PoseStates:
        """Return a copy in which the chosen (trials, poses) are those of another value."""

        def replaced(old: np.ndarray, new: np.ndarray) -> np.ndarray:
            out = np.array(old)
            out[chosen] = new
            return out

        return PoseStates(map_states(replaced, self.state, other.state), replaced(self.q, other.q))

    @staticmethod
    def join(parts: Sequence[PoseStates], axis: int, order: IntArray | None = None) -> PoseStates:
        """Return parts side by side along an axis, 0 trials or 1 poses, then in an order."""

        def joined(*arrays: np.ndarray) -> np.ndarray:
            whole = arrays[0] if len(arrays) == 1 else np.concatenate(arrays, axis=axis)
            return whole if order is None else np.take(whole, order, axis=axis)

        state = map_states(joined, *(part.state for part in parts))
        return PoseStates(state, joined(*(part.q for part in parts)))


def map_states(function: Callable[..., np.ndarray], *states: engine.State) -> engine.State:
    """Return the state whose arrays are a function of the arrays of the given states."""
    first, columns = states[0], range(len(states[0].joints))
    joints = tuple(function(*(s.joints[g] for s in states)) for g in columns)
    names = [f.name for f in dataclasses.fields(first) if f.name != "joints"]
    arrays = {name: function(*(getattr(s, name) for s in states)) for name in names}
    return engine.State(joints=joints, **arrays)
