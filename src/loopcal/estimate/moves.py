# SPDX-License-Identifier: Apache-2.0
"""Poses of a robot and how they move with its parameters; and where the next solution of them
begins.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from loopcal import engine, geometry
from loopcal.estimate.sensed import Sensed
from loopcal.measure import Evaluation
from loopcal.typing import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Moves:
    """Poses of a block and how they move.

    T (a, n, 4, 4), ok (a, n), failed (a,) where a needed pose is out of reach; D (a, n, 6, p) by
    the scaled unknowns; closure's step (a, n, 6) where it is not solved; values (a | 1, n) and
    slopes (a, n, p) of joints that kinds look at.
    """

    T: FloatArray
    ok: np.ndarray
    failed: np.ndarray
    D: FloatArray = dataclasses.field(default_factory=lambda: np.zeros((1, 0, 6, 0)))
    step: FloatArray | None = None
    joints: Mapping[str, FloatArray] = dataclasses.field(default_factory=dict)
    slopes: Mapping[str, FloatArray] = dataclasses.field(default_factory=dict)


def machine_columns(
    sensed: Sensed, found: Evaluation, white: FloatArray, moves: Moves
) -> FloatArray:
    """Whitened derivatives (a, r, m, p) of a kind's rows by the machine's deviations."""
    D = moves.D
    if sensed.kind.poses_per_row > 1:
        parts = (
            found.jacobian[:, :, i] @ D[:, sensed.poses[:, i]]
            for i in range(sensed.kind.poses_per_row)
        )
        return np.matmul(white, sum(parts, start=np.zeros(1)))
    if not np.array_equal(sensed.poses, np.arange(D.shape[1])):
        D = D[:, sensed.poses]
    columns = np.matmul(np.matmul(white, found.jacobian), D)
    for j, name in enumerate(sensed.kind.sensed_joints):
        if name in moves.slopes and found.joints is not None:
            slope = moves.slopes[name][:, sensed.poses, None, :]
            columns = columns + np.matmul(white, found.joints[..., j, None] * slope)
    return columns


def evaluated(
    sensed: Sensed, moves: Moves, trials: IntArray, values: FloatArray | None
) -> tuple[Evaluation, FloatArray]:
    """A kind's residuals and derivatives at the poses of a block, and its whiteners; values (a, U)
    of own unknowns.
    """
    measured, white = sensed.trials(trials)
    T = moves.T
    if not np.array_equal(sensed.poses, np.arange(T.shape[1])):
        T = T[:, sensed.poses]
    T = np.broadcast_to(T, (len(trials), *T.shape[1:]))
    own = values[:, sensed.places] if values is not None and sensed.places.shape[1] else None
    names = sensed.kind.sensed_joints
    joints = None
    if names:
        seen = np.stack([moves.joints[name][:, sensed.poses] for name in names], axis=-1)
        joints = np.broadcast_to(seen, (len(trials), *seen.shape[1:]))
    return sensed.kind.evaluate(T, measured, own, joints), white


class Last:
    """The last solved state of every trial and pose, moved on by its sensitivities: where the next
    solution begins.

    The sensitivities only choose a start, so they are kept in single precision.
    """

    def __init__(self, home: engine.State, trials: int, poses: int) -> None:
        self.shape = (trials, poses)
        self.state = mapped(self._spread, home)
        self.deviation: FloatArray | None = None
        self.moves = np.zeros(0, np.float32)

    def take(self, trials: IntArray, deviation: FloatArray) -> engine.State:
        """Return the states of some trials, as far as first order takes them to deviations (a, p)."""
        state = (
            self.state if len(trials) == self.shape[0] else mapped(lambda a: a[trials], self.state)
        )
        if self.deviation is None:
            return state
        change = (deviation - self.deviation[trials]).astype(np.float32)
        twist = np.matmul(self.moves[trials], change[:, None, :, None])[..., 0]
        return dataclasses.replace(state, T=geometry.apply_twist(state.T, twist.astype(np.float64)))

    def put(
        self,
        trials: IntArray,
        state: engine.State,
        ok: np.ndarray,
        deviation: FloatArray,
        D: FloatArray,
    ) -> None:
        """Keep the states of poses that are solved; one state stands for all trials where there is
        one only.
        """
        if ok.all() and len(trials) == self.shape[0]:
            self.state = mapped(self._spread, state)
        else:
            mapped(lambda old, new: _overwrite(old, new, trials, ok), self.state, state)
        if self.deviation is None:
            self.deviation = np.zeros((self.shape[0], deviation.shape[1]))
            self.moves = np.zeros((*self.shape, 6, deviation.shape[1]), np.float32)
        self.deviation[trials], self.moves[trials] = deviation, D

    def _spread(self, array: np.ndarray) -> np.ndarray:
        return np.array(np.broadcast_to(array, (*self.shape, *array.shape[2:])))


def _overwrite(old: np.ndarray, new: np.ndarray, trials: IntArray, ok: np.ndarray) -> np.ndarray:
    """Write the solved poses (ok) of some trials into working memory."""
    solved = ok.reshape(*ok.shape, *[1] * (new.ndim - 2))
    old[trials] = np.where(solved, new, old[trials])
    return old


def mapped(function: Callable[..., np.ndarray], *states: engine.State) -> engine.State:
    """Return the state whose arrays are the function of those of the given states."""
    first, columns = states[0], range(len(states[0].joints))
    joints = tuple(function(*(s.joints[g] for s in states)) for g in columns)
    fields = {f.name: f.name for f in dataclasses.fields(first) if f.name != "joints"}
    return engine.State(
        joints=joints, **{name: function(*(getattr(s, name) for s in states)) for name in fields}
    )
