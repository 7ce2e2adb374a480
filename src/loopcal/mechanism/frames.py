# SPDX-License-Identifier: Apache-2.0
"""Where the links of a mechanism are: frames along every limb, for limits and pictures (not for
speed).
"""

from __future__ import annotations

import numpy as np

from loopcal import geometry
from loopcal.engine import LENGTH as ROD
from loopcal.engine import PITCH, Group, State
from loopcal.mechanism.model import Mechanism
from loopcal.typing import FloatArray


def compute_limb_frames(
    robot: Mechanism, values: FloatArray, state: State
) -> tuple[FloatArray, ...]:
    """Frames along each limb, in the mechanism's order of limbs.

    Parameters
    ----------
    values : (t, p). state : (t, n).

    Returns
    -------
    One (t, n, J + 2, 4, 4) array a limb: T_base_link behind each link 0..J (the last is the tip),
    then the attachment.
    """
    e, _ = robot.slots(values)
    found: dict[int, FloatArray] = {}
    for group, joints in zip(robot.program.groups, state.joints, strict=True):
        own = e[:, group.columns].reshape(len(e), len(group.limbs), -1)
        for k, limb in enumerate(group.limbs):
            found[limb] = _walk(group, k, own[:, k], joints[:, :, k], state.T)
    return tuple(found[i] for i in sorted(found))


def _walk(group: Group, k: int, own: FloatArray, joints: FloatArray, T: FloatArray) -> FloatArray:
    """Frames of limb k of a group for its displacements own (t, s) and joint values (t, n, J + 1)."""
    move = np.zeros((len(own), len(group.joints) + 2, 6))
    pitch = np.broadcast_to(group.pitch[k], (len(own), len(group.joints))).copy()
    for slot, value in zip(group.slots, own.T, strict=True):
        if slot.axis == PITCH:
            pitch[:, slot.element] += value
        elif slot.axis != ROD:
            move[:, slot.element, slot.axis] += value
    placed = group.links[k] @ geometry.make_pose(geometry.exp_so3(move[..., :3]), move[..., 3:])
    frames = [np.broadcast_to(placed[:, None, 0], T.shape)]
    for j, letter in enumerate(group.joints):
        value = joints[..., j]
        turn, shift = (
            (value, pitch[:, None, j] * value) if letter == "R" else (np.zeros_like(value), value)
        )
        along = np.stack([np.zeros_like(value), np.zeros_like(value), np.ones_like(value)], axis=-1)
        frames.append(
            frames[-1]
            @ geometry.make_pose(
                geometry.exp_so3(turn[..., None] * along), shift[..., None] * along
            )
            @ placed[:, None, j + 1]
        )
    return np.stack([*frames, T @ placed[:, None, -1]], axis=2)
