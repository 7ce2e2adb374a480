# SPDX-License-Identifier: Apache-2.0
"""Frames of the links along each limb, for limits of joints and for pictures."""

import numpy as np

from loopcal.engine import State
from loopcal.mechanism import stages
from loopcal.mechanism.closure.limb_frames import follow_limb
from loopcal.mechanism.model import Mechanism
from loopcal.typing import FloatArray


def compute_limb_frames(
    robot: Mechanism, values: FloatArray, state: State
) -> tuple[FloatArray, ...]:
    """Return the frames along each limb, for limits and pictures.

    Parameters
    ----------
    values : (t, p). state : (t, n).

    Returns
    -------
    For each limb of the mechanism, in its order, an array (t, n, J + 2, 4, 4): T_base_link behind
    each link 0..J (the last one is the tip), then the attachment.
    """
    if robot.stages:
        return stages.compute_stage_limb_frames(robot, values, state, compute_limb_frames)
    e, _ = robot.slots(values)
    frames: dict[int, FloatArray] = {}
    for group, joints in zip(robot.program.groups, state.joints, strict=True):
        displacements = e[:, group.columns].reshape(len(e), len(group.limbs), -1)
        for k, limb in enumerate(group.limbs):
            chain, attachment = follow_limb(group, k, displacements[:, k], joints[:, :, k])
            frames[limb] = np.stack(
                [*(np.broadcast_to(f, state.T.shape) for f in chain), state.T @ attachment], axis=2
            )
    return tuple(frames[i] for i in sorted(frames))
