# SPDX-License-Identifier: Apache-2.0
"""How passive joints move with parameters and readings.

The rows of closure that were spent on a limb's own joints read U dtheta + A y + E de + Q dq = 0;
with the platform's motion y known, dtheta = -U^-1 (A y + E de + Q dq). Derivation:
docs/theory/engine.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopcal.engine import State
from loopcal.mechanism.model import Mechanism, Status
from loopcal.mechanism.sensitivity import (
    LinearizedLimbs,
    select_block,
    select_state_block,
    split_rows,
)
from loopcal.typing import FloatArray


@dataclass(frozen=True)
class PassiveSensitivity:
    """Derivatives of the passive joints.

    Attributes
    ----------
    names : of the j passive joints, as in `Solution.passive_names`.
    parameters : (t, n, j, p) change of each joint [m, rad] per unit of each parameter. readings :
        (t, n, j, a).
    """

    names: tuple[str, ...]
    parameters: FloatArray
    readings: FloatArray


def differentiate_passive_joints(
    robot: Mechanism, values: FloatArray, q: FloatArray, state: State
) -> PassiveSensitivity:
    """Derivative of every passive joint in every parameter and reading.

    Parameters
    ----------
    values : (t | 1, p). q : (t | 1, n, a) readings. state : (t, n), converged rows.

    Returns
    -------
    PassiveSensitivity; a held joint (one that only spins its limb) has zeros, failed rows NaN.
    """
    limbs = robot.assembly.limbs
    passive = [
        (i, j)
        for i, limb in enumerate(limbs)
        for j, joint in enumerate(limb.joints)
        if joint.actuator is None
    ]
    place = {entry: row for row, entry in enumerate(passive)}
    t, n = state.T.shape[:2]
    parameters = np.zeros((t, n, len(passive), len(robot.parameters)))
    readings = np.zeros((t, n, len(passive), len(robot.actuators)))
    for rows in split_rows(t, n):
        work = LinearizedLimbs(
            robot,
            select_block(values, rows[:1]),
            select_block(q, rows),
            select_state_block(state, rows),
        )
        by_parameter, by_reading = work.platform()
        found = work.limbs(work.blocks.passive)
        for group, block, joints in zip(
            robot.program.groups, work.blocks.passive, work.blocks.joints, strict=True
        ):
            for k, limb in enumerate(group.limbs):
                A, columns, of_parameters, drives, of_drives = next(found)
                if not joints:
                    continue
                moved, driven = np.matmul(A, by_parameter), np.matmul(A, by_reading)
                moved[..., columns] += of_parameters
                driven[..., drives] += of_drives
                both = solve_passive_motion(
                    block.U[:, :, k], np.concatenate([moved, driven], axis=-1)
                )
                at = [place[limb, j] for j in joints]
                parameters[rows][:, :, at], readings[rows][:, :, at] = np.split(
                    both, [moved.shape[-1]], axis=-1
                )
    lost = (state.status != Status.CONVERGED) & (state.status != Status.OTHER_MODE)
    parameters[lost], readings[lost] = np.nan, np.nan
    return PassiveSensitivity(name_passive_joints(robot), parameters, readings)


def name_passive_joints(robot: Mechanism) -> tuple[str, ...]:
    """Names `limb.joint` of all passive joints, limb by limb."""
    return tuple(
        f"{limb.name}.{joint.name}"
        for limb in robot.assembly.limbs
        for joint in limb.joints
        if joint.actuator is None
    )


def solve_passive_motion(U: FloatArray, right: FloatArray) -> FloatArray:
    """-U^-1 right for upper triangular U (t, n, u, u) and right (t, n, u, c); a zero pivot gives
    infinities or NaN.
    """
    out = np.empty_like(right)
    with np.errstate(all="ignore"):
        for i in range(U.shape[-1] - 1, -1, -1):
            known = (U[..., i, i + 1 :, None] * out[..., i + 1 :, :]).sum(axis=-2)
            out[..., i, :] = -(right[..., i, :] + known) / U[..., i, i, None]
    return out
