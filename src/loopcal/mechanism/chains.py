# SPDX-License-Identifier: Apache-2.0
"""Chains of stages: their states from those of the stages, and the transport of twists.

With T_s = T_parent M_s X_s(q_s), M_s the mount and X_s the pose of stage s in its own base, the
twist of the end platform is the sum of the twists of the stages that carry it, each transported:
omega = R_s omega_s, v = R_s v_s + omega x (p_end - p_s). Derivation: docs/theory/kinematics.md.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from loopcal import geometry
from loopcal.engine import State
from loopcal.mechanism.limb_rows import name_entries
from loopcal.mechanism.model import Mechanism, Stage
from loopcal.typing import FloatArray, IntArray

# States of a chain: those of its stages, joined, and the frames of its platforms.

# Ranks of CONVERGED, STALLED, EXHAUSTED, NOT_FINITE and others: the highest one among its stages is
# that of a chain. Another mode is less severe than an open loop.
SEVERITY = 0, 3, 2, 4, 1


@dataclass(frozen=True, eq=False)
class ChainState(State):
    """Positions of a chain for t trials and n poses.

    T is the end platform in the base, `joints` those of all stages one after the other. Status and
    residual are the worst of the stages, the closure sign is the product of theirs.

    poses : for each stage, its platform in its own base (t, n, 4, 4) [m].
    signs : for each stage, its closure sign (t, n).
    """

    poses: tuple[FloatArray, ...] = ()
    signs: tuple[NDArray[np.int8], ...] = ()


def join_stage_states(robot: Mechanism, states: Sequence[State]) -> State:
    """Return the state (t, n) of a robot whose blocks have these states (t, n)."""
    if not robot.stages:
        return states[0]
    poses = tuple(state.T for state in states)
    statuses = np.stack([state.status for state in states])
    severity = np.take(SEVERITY, statuses, mode="clip")
    status = np.take_along_axis(statuses, severity.argmax(axis=0)[None], axis=0)[0]
    return ChainState(
        locate_stage_bases(robot.stages, poses)[1][-1],
        tuple(joints for state in states for joints in state.joints),
        status.astype(np.int8),
        np.maximum.reduce([state.residual for state in states]),
        np.maximum.reduce([state.iterations for state in states]),
        np.multiply.reduce([state.closure_sign for state in states]).astype(np.int8),
        tuple(body for state in states for body in state.others),
        poses,
        tuple(state.closure_sign for state in states),
    )


def split_stage_states(robot: Mechanism, state: State) -> list[State]:
    """Return the states of the blocks of a robot; those of a chain have its status."""
    if not robot.stages:
        return [state]
    assert isinstance(state, ChainState)
    counts = [len(stage.robot.program.others) for stage in robot.stages]
    first = np.cumsum([0, *counts])
    return [
        State(
            pose,
            state.joints[stage.groups],
            state.status,
            state.residual,
            state.iterations,
            sign,
            state.others[first[i] : first[i + 1]],
        )
        for i, (stage, pose, sign) in enumerate(
            zip(robot.stages, state.poses, state.signs, strict=True)
        )
    ]


def locate_stage_bases(
    stages: Sequence[Stage], poses: Sequence[FloatArray]
) -> tuple[list[FloatArray], list[FloatArray]]:
    """Return the bases and the platforms of all stages in the base of the chain, of the poses (..,
    4, 4) of stages; a base that does not move is (4, 4).
    """
    bases: list[FloatArray] = []
    platforms: list[FloatArray] = []
    for stage, pose in zip(stages, poses, strict=True):
        base = stage.mount if stage.parent < 0 else platforms[stage.parent] @ stage.mount
        bases.append(base)
        platforms.append(base @ pose)
    return bases, platforms


def locate_bodies(robot: Mechanism, state: State) -> dict[str, FloatArray]:
    """Return the platforms of stages, or the bodies beside the platform, in the base at a state (t,
    n), each (t, n, 4, 4), by name.
    """
    if not robot.stages:
        return dict(zip(robot.assembly.bodies, state.others, strict=True))
    assert isinstance(state, ChainState)
    platforms = locate_stage_bases(robot.stages, state.poses)[1]
    return dict(zip((stage.name for stage in robot.stages), platforms, strict=True))


class StagePart(NamedTuple):
    """A stage of a chain with its values (t | 1, p), its state (t, n), and its readings (t | 1, n,
    a), or these with their directions of approach.
    """

    stage: Stage
    values: FloatArray
    state: State
    readings: FloatArray


NO_READINGS = np.zeros((1, 1, 0))


def each_stage(
    robot: Mechanism, values: FloatArray, state: State, q: FloatArray = NO_READINGS
) -> Iterator[StagePart]:
    """Yield the blocks of a robot with their own values, states and readings."""
    count = len(robot.actuators)
    for stage, own in zip(robot.blocks, split_stage_states(robot, state), strict=True):
        readings = q[..., :count][..., stage.actuators]
        if q.shape[-1] > count:
            directions = q[..., count:][..., stage.actuators]
            readings = np.concatenate([readings, directions], axis=-1)
        yield StagePart(stage, values[:, stage.parameters], own, readings)


def list_carrying_stages(robot: Mechanism, end: int = -1) -> list[int]:
    """Return the stages that carry the platform of a stage (default: the end), from the base on."""
    carrying, i = [], end % len(robot.blocks)
    while i >= 0:
        carrying.append(i)
        i = robot.blocks[i].parent
    return carrying[::-1]


def find_carrying_actuators(robot: Mechanism) -> IntArray:
    """Return the places of the independent actuators that move the end platform, unless held."""
    places = np.flatnonzero(robot.is_commanded)
    names, carrying = [actuator.name for actuator in robot.actuators], list[int]()
    for stage in (robot.blocks[i] for i in list_carrying_stages(robot)):
        own, chosen = np.arange(len(names))[stage.actuators], stage.robot.independent
        carrying += (own if chosen is None else own[chosen]).tolist()
    held = robot.assembly.held
    return np.array([i for i in carrying if i in places and names[i] not in held], int)


def has_spare_drives(robot: Mechanism) -> bool:
    """Return whether a pose has infinitely many readings, because independent drives are more than
    the coordinates.
    """
    is_known = bool(robot.stages) or robot.independent is not None
    return is_known and len(find_carrying_actuators(robot)) > len(robot.controlled)


def transport_to_end(robot: Mechanism, state: State, end: int) -> list[tuple[int, FloatArray]]:
    """Return the stages that carry a platform, and the maps (t, n, 6, 6) of their twists to it.

    A twist of a stage is in the axes of its base, at its platform; the result in base axes, at
    `end`.
    """
    assert isinstance(state, ChainState)
    bases, platforms = locate_stage_bases(robot.stages, state.poses)
    transports = []
    for i in list_carrying_stages(robot, end):
        rotation = bases[i][..., :3, :3]
        arm = platforms[end][..., :3, 3] - platforms[i][..., :3, 3]
        own = np.matmul(np.swapaxes(rotation, -1, -2), arm[..., None])[..., 0]
        transports.append((i, geometry.transport_matrix(own, rotation)))
    return transports


def select_entries(robot: Mechanism, state: State) -> dict[str, FloatArray]:
    """Return the numbers of the poses of `locate_bodies` by name, each (t, n)."""
    entries: dict[str, FloatArray] = {}
    for body, T in locate_bodies(robot, state).items():
        numbers = np.moveaxis(T[..., :3, :].reshape(*T.shape[:-2], 12), -1, 0)
        entries |= dict(zip(name_entries(body), numbers, strict=True))
    return entries
