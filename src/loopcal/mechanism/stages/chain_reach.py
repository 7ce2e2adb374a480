# SPDX-License-Identifier: Apache-2.0
"""A sphere that the platform cannot leave, from the lengths of the links.

Turning joints change no distance between neighboring joints, so that a limb from its first joint c
to the platform's origin p spans at most the sum of its links, |p - c| <= sum |link|. Sliding
joints, screws and driven rods have no such bound: strokes are no part of inverse kinematics. A
chain spans the sum of its stages.
"""

from __future__ import annotations

import numpy as np

from loopcal.engine import PITCH, Group
from loopcal.mechanism.closure.limb_frames import follow_limb, measure_rod
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.platform_coordinates import POSITION
from loopcal.mechanism.stages.chain_state import list_carrying_stages
from loopcal.typing import FloatArray

ROUNDING = 1e-9
"""Excess, relative to the robot's size, of a target at the bound itself."""


def measure_target_excess(robot: Mechanism, values: FloatArray, target: FloatArray) -> FloatArray:
    """Return how far (R,) coordinates (R, c) lie beyond what links can span [m]; at most 0 within.

    values : (1 | R, p). Coordinates of the position that are not controlled are free.
    """
    columns = [i for i, name in enumerate(robot.controlled) if name in POSITION]
    if not columns:
        return np.full(len(target), -np.inf)
    center, radius = bound_platform(robot, values)
    axes = [POSITION.index(robot.controlled[i]) for i in columns]
    far = np.linalg.norm(target[:, columns] - center[:, axes], axis=1)
    return far - radius - ROUNDING * robot.size


def bound_platform(robot: Mechanism, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return center (t, 3) and radius (t,) of a sphere around all positions of the platform [m].

    values : (t, p). The radius is infinite where no limb bounds it.
    """
    if not robot.stages:
        return _bound_by_limbs(robot, values)
    whole, first = np.zeros(len(values)), np.zeros((len(values), 3))
    for number, i in enumerate(list_carrying_stages(robot)):
        stage = robot.stages[i]
        center, radius = bound_platform(stage.robot, values[:, stage.parameters])
        center = center @ stage.mount[:3, :3].T + stage.mount[:3, 3]
        if number:  # both turn with the platform before
            whole = whole + np.linalg.norm(center, axis=1)
        else:
            first = center
        whole = whole + radius
    return first, whole


def _bound_by_limbs(robot: Mechanism, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the smallest sphere (t, 3), (t,) about the first joint of a limb."""
    center, radius = np.zeros((len(values), 3)), np.full(len(values), np.inf)
    is_exact = robot.is_serial or (robot.program.is_square and not robot.program.may_stay_open)
    if not is_exact:  # loops of redundant actuators, among others, may stay open
        return center, radius
    e, _ = robot.slots(values)
    for group, joints in zip(robot.program.groups, robot.home_state.joints, strict=True):
        displacements = e[:, group.columns].reshape(len(e), len(group.limbs), -1)
        for k in range(len(group.limbs)):
            if not _has_fixed_links(group, k):
                continue
            own = displacements[:, k]
            start = np.broadcast_to(joints[:1, :1, k], (len(own), 1, joints.shape[-1]))
            frames, attachment = follow_limb(group, k, own, start)
            points = np.stack([frame[:, 0, :3, 3] for frame in frames], axis=1)
            length = np.linalg.norm(np.diff(points, axis=1), axis=-1).sum(axis=1)
            length = length + np.linalg.norm(attachment[:, 0, :3, 3], axis=-1)
            length = length + measure_rod(group, k, own)
            shorter = length < radius
            center = np.where(shorter[:, None], points[:, 0], center)
            radius = np.where(shorter, length, radius)
    return center, radius


def _has_fixed_links(group: Group, k: int) -> bool:
    """Return whether no joint of limb k of a group changes the distance of its neighbors."""
    slides = "P" in group.joints or bool(group.pitch[k].any()) or group.actuator[-1, k] >= 0
    return not (slides or any(slot.axis == PITCH for slot in group.slots))
