# SPDX-License-Identifier: Apache-2.0
"""States of a chain: those of its stages, joined, and the frames of its platforms."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from loopcal import geometry
from loopcal.engine import CONVERGED, EXHAUSTED, NOT_FINITE, STALLED, State
from loopcal.mechanism.model import Mechanism, Stage
from loopcal.typing import FloatArray, IntArray

SEVERITY = (CONVERGED, EXHAUSTED, STALLED, NOT_FINITE)
"""Statuses of stages, of which the last one in this order is that of the chain. Any other status,
such as that of another mode, is less severe than an open loop."""


@dataclass(frozen=True, eq=False)
class ChainState(State):
    """Positions of a chain for t trials and n poses.

    T is the end platform in the base, `joints` those of all stages one after the other. Status and
    residual are the worst of the stages, the closure sign is the product of theirs.

    Attributes
    ----------
    poses : for each stage, its platform in its own base (t, n, 4, 4) [m].
    signs : for each stage, its closure sign (t, n).
    """

    poses: tuple[FloatArray, ...] = ()
    signs: tuple[NDArray[np.int8], ...] = ()


def join_stage_states(robot: Mechanism, states: Sequence[State]) -> ChainState:
    """Return the state of a chain (t, n) whose stages have these states (t, n)."""
    poses = tuple(state.T for state in states)
    status = states[0].status
    for state in states[1:]:
        status = np.where(_rank(state.status) > _rank(status), state.status, status)
    return ChainState(
        locate_platforms(robot, poses)[-1],
        tuple(joints for state in states for joints in state.joints),
        status.astype(np.int8),
        np.maximum.reduce([state.residual for state in states]),
        np.maximum.reduce([state.iterations for state in states]),
        np.multiply.reduce([state.closure_sign for state in states]).astype(np.int8),
        poses,
        tuple(state.closure_sign for state in states),
    )


def _rank(status: NDArray[np.int8]) -> NDArray[np.int8]:
    """Return how severe statuses are: 0 converged, 1 another mode, then as in SEVERITY."""
    rank = np.ones(status.shape, np.int8)
    for place, known in enumerate(SEVERITY):
        rank[status == known] = 0 if known == CONVERGED else place + 1
    return rank


def split_stage_states(robot: Mechanism, state: State) -> list[State]:
    """Return the states of the stages of a chain; each has the status of the chain."""
    assert isinstance(state, ChainState)
    return [
        State(
            pose, state.joints[stage.groups], state.status, state.residual, state.iterations, sign
        )
        for stage, pose, sign in zip(robot.stages, state.poses, state.signs, strict=True)
    ]


def locate_stage_bases(
    robot: Mechanism, poses: Sequence[FloatArray]
) -> tuple[list[FloatArray], list[FloatArray]]:
    """Return the bases and the platforms of all stages in the base of the chain.

    poses : (.., 4, 4) of each stage. Both results have the same shapes, or (4, 4) for a base that
    does not move.
    """
    bases: list[FloatArray] = []
    platforms: list[FloatArray] = []
    for stage, pose in zip(robot.stages, poses, strict=True):
        base = stage.mount if stage.parent < 0 else platforms[stage.parent] @ stage.mount
        bases.append(base)
        platforms.append(base @ pose)
    return bases, platforms


def locate_platforms(robot: Mechanism, poses: Sequence[FloatArray]) -> list[FloatArray]:
    """Return the platforms of all stages in the base of the chain, each (.., 4, 4)."""
    return locate_stage_bases(robot, poses)[1]


def get_platforms(robot: Mechanism, state: State) -> list[FloatArray]:
    """Return the platforms of all stages in the base at a state (t, n), each (t, n, 4, 4)."""
    assert isinstance(state, ChainState)
    return locate_platforms(robot, state.poses)


def select_readings(q: FloatArray, stage: Stage, count: int) -> FloatArray:
    """Return the readings of a stage among those of a chain with `count` actuators.

    q : (.., a), or (.., 2 a) with the directions of approach behind the readings.
    """
    own = q[..., :count][..., stage.actuators]
    if q.shape[-1] == count:
        return own
    return np.concatenate([own, q[..., count:][..., stage.actuators]], axis=-1)


def compute_stage_limb_frames(
    robot: Mechanism,
    values: FloatArray,
    state: State,
    compute: Callable[[Mechanism, FloatArray, State], tuple[FloatArray, ...]],
) -> tuple[FloatArray, ...]:
    """Return the frames along the limbs of all stages in the base of the chain.

    compute : the same function of a stage in its own base.
    """
    assert isinstance(state, ChainState)
    bases, _ = locate_stage_bases(robot, state.poses)
    return tuple(
        (base if base.ndim == 2 else base[:, :, None]) @ frames
        for stage, base, own in zip(
            robot.stages, bases, split_stage_states(robot, state), strict=True
        )
        for frames in compute(stage.robot, values[:, stage.parameters], own)
    )


def list_carrying_stages(robot: Mechanism, end: int = -1) -> list[int]:
    """Return the stages that carry the platform of a stage (default: the end), from the base on."""
    carrying, i = [], end % len(robot.stages)
    while i >= 0:
        carrying.append(i)
        i = robot.stages[i].parent
    return carrying[::-1]


def find_carrying_actuators(robot: Mechanism) -> IntArray:
    """Return the places of the actuators that move the end platform."""
    places = np.arange(len(robot.actuators))
    if not robot.stages:
        return places
    stages = [robot.stages[i] for i in list_carrying_stages(robot)]
    return np.concatenate([places[stage.actuators] for stage in stages])


def transport_to_end(robot: Mechanism, state: State, end: int) -> list[tuple[int, FloatArray]]:
    """Return the stages that carry a platform, and the maps (t, n, 6, 6) of their twists to it.

    A stage's twist is in the axes of its own base, at the origin of its own platform. The result is
    in base axes, at the origin of platform `end`.
    """
    assert isinstance(state, ChainState)
    bases, platforms = locate_stage_bases(robot, state.poses)
    transports = []
    for i in list_carrying_stages(robot, end):
        rotation = bases[i][..., :3, :3]
        arm = platforms[end][..., :3, 3] - platforms[i][..., :3, 3]
        own = np.matmul(np.swapaxes(rotation, -1, -2), arm[..., None])[..., 0]
        transports.append((i, geometry.transport_matrix(own, rotation)))
    return transports
