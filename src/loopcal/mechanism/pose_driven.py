# SPDX-License-Identifier: Apache-2.0
"""Redundant actuators where the pose is what is given: their readings follow from it, each by its
own limb.

Closure linearised reads A y + E de + Q dq = 0. With more actuators than freedoms each limb has one
actuator and one equation, so Q is diagonal and dq = -Q^-1 (A y + E de); its passive joints follow.
The pose and the parameters move freely, which `sensitivity`, where readings are given and
contradict each other, cannot say. Derivation: docs/theory/latent.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from loopcal import engine, geometry
from loopcal.engine import State
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.passive_joints import name_passive_joints, solve_passive_motion
from loopcal.mechanism.sensitivity import (
    LinearizedLimbs,
    select_block,
    select_state_block,
    split_rows,
)
from loopcal.mechanism.states import driven_values
from loopcal.mechanism.transmission import readings_from_joints
from loopcal.typing import FloatArray


@dataclass(frozen=True)
class PoseDrivenSensitivity:
    """Derivatives by parameters (.., p) with the pose held, and by the platform's freedoms (.., m).

    Attributes
    ----------
    readings : (t, n, a, p) and (t, n, a, m). passive : (t, n, j, p) and (t, n, j, m), in the order
        of `names`.
    """

    names: tuple[str, ...]
    readings: tuple[FloatArray, FloatArray]
    passive: tuple[FloatArray, FloatArray]


def solve_at_pose(
    robot: Mechanism, values: FloatArray, T: FloatArray, begin: State
) -> tuple[State, FloatArray]:
    """Close every limb with the platform at T (t, n, 4, 4): states, and the readings (t, n, a)
    there.

    Parameters
    ----------
    values : (t | 1, p). begin : (t, n), whose joints choose how each limb bends.
    """
    e, tau = robot.slots(values)
    freedoms, size = list(robot.program.freedoms), robot.size
    target = np.array(T, dtype=np.float64).reshape(-1, 4, 4)

    def task(here: FloatArray, rows: np.ndarray) -> tuple[FloatArray, FloatArray]:
        whole = np.zeros((len(here), 4, 4))
        whole[:, :3], whole[:, 3, 3] = here, 1.0
        scale = np.array([size] * 3 + [1.0] * 3)
        gap = geometry.pose_difference(whole, target[rows]) * scale
        return gap[:, freedoms], np.broadcast_to(
            np.diag(scale)[freedoms], (len(here), len(freedoms), 6)
        )

    guess = driven_values(robot.program, begin)
    state = engine.solve(robot.program, e, guess, replace(begin, T=T), task, free=True)
    return state, readings_from_joints(
        driven_values(robot.program, state), tau, robot.slots.frequency
    )


def differentiate_at_pose(
    robot: Mechanism, values: FloatArray, q: FloatArray, state: State
) -> PoseDrivenSensitivity:
    """Linearise the limbs at states (t, n) of redundant actuators, their readings q (t | 1, n, a)
    closing every limb.
    """
    t, n = state.T.shape[:2]
    names = name_passive_joints(robot)
    a, p, m = len(robot.actuators), len(robot.parameters), len(robot.freedoms)
    readings, passive = np.zeros((t, n, a, p + m)), np.zeros((t, n, len(names), p + m))
    for rows in split_rows(t, n):
        work = LinearizedLimbs(
            robot,
            select_block(values, rows[:1]),
            select_block(q, rows),
            select_state_block(state, rows),
        )
        for A, columns, of_parameters, drives, of_drives in work.limbs(work.blocks.closure):
            both = np.concatenate([np.zeros((*A.shape[:2], p)), A[:, :, 0]], axis=-1)
            both[..., :p][..., columns] += of_parameters[:, :, 0]
            with np.errstate(all="ignore"):
                readings[rows][:, :, drives] = -(both / of_drives[:, :, 0])[:, :, None]
        for places, part in _passive(robot, work, names, readings[rows]):
            passive[rows][:, :, places] = part
    return PoseDrivenSensitivity(
        names, (readings[..., :p], readings[..., p:]), (passive[..., :p], passive[..., p:])
    )


def _passive(
    robot: Mechanism, work: LinearizedLimbs, names: tuple[str, ...], readings: FloatArray
) -> Iterator[tuple[list[int], FloatArray]]:
    """Places of each limb's passive joints and how they move, (t, n, j, p + m): U dtheta = -(A y +
    E de + Q dq).
    """
    limbs, p = robot.assembly.limbs, len(robot.parameters)
    found = work.limbs(work.blocks.passive)
    for group, block, joints in zip(
        robot.program.groups, work.blocks.passive, work.blocks.joints, strict=True
    ):
        for k, limb in enumerate(group.limbs):
            A, columns, of_parameters, drives, of_drives = next(found)
            if not joints:
                continue
            moved = np.matmul(of_drives, readings[:, :, drives])
            moved[..., p:] += A
            moved[..., :p][..., columns] += of_parameters
            places = [
                names.index(f"{limbs[limb].name}.{limbs[limb].joints[j].name}") for j in joints
            ]
            yield places, solve_passive_motion(block.U[:, :, k], moved)
