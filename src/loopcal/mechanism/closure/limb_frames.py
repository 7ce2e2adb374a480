# SPDX-License-Identifier: Apache-2.0
"""Frames along a limb for displacements and joint values, and the length of its rod."""

from __future__ import annotations

import numpy as np

from loopcal import geometry
from loopcal.engine import LENGTH, PITCH, Group
from loopcal.typing import FloatArray


def follow_limb(
    group: Group, k: int, displacements: FloatArray, joints: FloatArray
) -> tuple[list[FloatArray], FloatArray]:
    """Return the frames along limb k of a group.

    Parameters
    ----------
    displacements : (t, s) of this limb. joints : (t, n, J + 1) its joint values.

    Returns
    -------
    frames : T_base_link behind each link 0..J, each (t, n | 1, 4, 4); the last one is the tip.
    attachment : T_platform_attachment (t, 1, 4, 4).
    """
    move = np.zeros((len(displacements), len(group.joints) + 2, 6))
    pitch = np.broadcast_to(group.pitch[k], (len(displacements), len(group.joints))).copy()
    for slot, value in zip(group.slots, displacements.T, strict=True):
        if slot.axis == PITCH:
            pitch[:, slot.element] += value
        elif slot.axis != LENGTH:
            move[:, slot.element, slot.axis] += value
    displaced = geometry.make_pose(geometry.exp_so3(move[..., :3]), move[..., 3:])
    placed = (group.links[k] @ displaced)[:, None]
    frames = [placed[:, :, 0]]
    for j, letter in enumerate(group.joints):
        motion = _move_joint(letter, joints[..., j], pitch[:, None, j])
        frames.append(frames[-1] @ motion @ placed[:, :, j + 1])
    return frames, placed[:, :, -1]


def measure_rod(group: Group, k: int, displacements: FloatArray) -> FloatArray:
    """Return the lengths (t,) of the rod that ends limb k of a group [m]; 0 without one.

    displacements : (t, s) of this limb. The value of its joint, if it is driven, is added to it.
    """
    length = np.full(len(displacements), group.length[k] if group.ending == "distance" else 0.0)
    for slot, value in zip(group.slots, displacements.T, strict=True):
        if slot.axis == LENGTH:
            length = length + value
    return length


def _move_joint(letter: str, value: FloatArray, pitch: FloatArray) -> FloatArray:
    """Return the motion (.., 4, 4) of a joint about (R) or along (P) the z axis."""
    T = np.zeros((*value.shape, 4, 4))
    T[..., 2, 2] = T[..., 3, 3] = 1.0
    if letter == "R":
        T[..., 0, 0] = T[..., 1, 1] = np.cos(value)
        T[..., 1, 0] = np.sin(value)
        T[..., 0, 1] = -T[..., 1, 0]
        T[..., 2, 3] = pitch * value
    else:
        T[..., 0, 0] = T[..., 1, 1] = 1.0
        T[..., 2, 3] = value
    return T
