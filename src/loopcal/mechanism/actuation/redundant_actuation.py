# SPDX-License-Identifier: Apache-2.0
"""Redundant actuation with a prescribed pose: readings and passive joints follow limb by limb.

Linearized closure reads A y + E de + Q dq = 0. With more actuators than freedoms each limb has one
actuator and one equation, so Q is diagonal and dq = -Q^-1 (A y + E de); the passive joints of the
limb follow. Pose and parameters are independent here. `differentiate_pose` answers the other
question, in which readings are given and contradict each other. Derivation:
docs/theory/uncertain-readings.md.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from loopcal import engine
from loopcal.engine import State
from loopcal.mechanism.closure.limb_rows import (
    linearize_limbs,
    name_passive_joints,
    solve_passive_motion,
)
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.states import driven_values
from loopcal.mechanism.transmission.terms import readings_from_joints
from loopcal.typing import FloatArray


class PoseDrivenSensitivity(NamedTuple):
    """Derivatives by parameters (.., p) at constant pose, and by the platform's freedoms (.., m).

    Attributes
    ----------
    names : of the j passive joints.
    readings : (t, n, a, p) and (t, n, a, m). passive : (t, n, j, p) and (t, n, j, m).
    """

    names: tuple[str, ...]
    readings: tuple[FloatArray, FloatArray]
    passive: tuple[FloatArray, FloatArray]


def solve_at_pose(
    robot: Mechanism, values: FloatArray, T: FloatArray, begin: State
) -> tuple[State, FloatArray]:
    """Close every limb with the platform at T (t, n, 4, 4); return states and readings (t, n, a).

    Parameters
    ----------
    values : (t | 1, p). begin : (t, n), whose joints select the branch of each limb.
    """
    e, tau = robot.slots(values)
    guess, limbs = driven_values(robot.program, begin), robot.program.with_fixed_platform
    state = engine.solve(limbs, e, guess, replace(begin, T=T), free=True)
    joints = driven_values(robot.program, state)
    return state, readings_from_joints(joints, tau, robot.slots.frequency)


def differentiate_at_pose(
    robot: Mechanism, values: FloatArray, q: FloatArray, state: State
) -> PoseDrivenSensitivity:
    """Differentiate readings and passive joints of redundant actuators at states (t, n).

    With summed drives the derivatives are those of the driven joints in place of readings.

    Parameters
    ----------
    values : (t | 1, p). q : (t | 1, n, a) readings that close every limb; not used for sums.
    """
    t, n = state.T.shape[:2]
    names = name_passive_joints(robot)
    a, p, m = robot.program.n_joints, len(robot.parameters), len(robot.freedoms)
    readings, passive = np.zeros((t, n, a, p + m)), np.zeros((t, n, len(names), p + m))
    for rows, limbs in linearize_limbs(robot, values, q, state):
        for limb in limbs.rows(limbs.blocks.closure):
            both = np.concatenate([np.zeros((*limb.A.shape[:2], p)), limb.A[:, :, 0]], axis=-1)
            both[..., :p][..., limb.parameters] += limb.by_parameter[:, :, 0]
            with np.errstate(all="ignore"):
                by_pose = -(both / limb.by_reading[:, :, 0])
            readings[rows][:, :, limb.readings] = by_pose[:, :, None]
        for places, U, limb in limbs.passive_joints(names):
            moved = np.matmul(limb.by_reading, readings[rows][:, :, limb.readings])
            moved[..., p:] += limb.A
            moved[..., :p][..., limb.parameters] += limb.by_parameter
            passive[rows][:, :, places] = solve_passive_motion(U, moved)
        for place, column, by_values in limbs.turned_joints(names):
            slope = limbs.joints_by_reading[:, :, column, None]
            passive[rows][:, :, place] = slope * readings[rows][:, :, column]
            passive[rows][:, :, place, :p] += by_values
    return PoseDrivenSensitivity(
        names, (readings[..., :p], readings[..., p:]), (passive[..., :p], passive[..., p:])
    )
