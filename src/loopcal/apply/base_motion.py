# SPDX-License-Identifier: Apache-2.0
"""Motion of the base frame when identified values replace the current ones in a controller.

A controller with the current values leads a program to the poses T_i of the calibrated machine, and
with the identified values to the poses it commands, T'_i = the current model at the same readings.
The rigid motion M that minimizes sum |M T_i - T'_i|^2 moves all of a program alike. Where nothing
measured the base frame, M is a convention, such as which tower defines the x axis: values for which
the model gives M T_i keep programs where they are, and all relative accuracy.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from loopcal.diagnose.gauge_freedoms import probe_readings
from loopcal.errors import DataError
from loopcal.findings import Finding, Quantity, report_finding
from loopcal.geometry import align_point_sets, log_so3, make_pose
from loopcal.mechanism.kinematics import forward_trials
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.sensitivity import differentiate_pose
from loopcal.mechanism.solutions import forward
from loopcal.typing import FloatArray

VISIBLE = 5e-4  # root mean square motion, in sizes of the robot, from which it is stated
SAME = 1e-3  # largest remaining share of a motion that other values make exactly
STEPS = 5  # of Newton's method for these values


@dataclass(frozen=True, eq=False)
class BaseMotion:
    """Rigid motion (4, 4) of all positions of a program, and the identified robot with values that
    do without it, or without its rotation alone; None where no values do.
    """

    motion: FloatArray
    kept: Mechanism | None
    keeps_shift: bool

    @property
    def finding(self) -> Finding:
        """The motion in words."""
        turn, shift = log_so3(self.motion[:3, :3]), self.motion[:3, 3]
        return report_finding(
            "files.base-moves",
            turn=Quantity(math.degrees(float(np.linalg.norm(turn))), "deg"),
            shift=Quantity(1e3 * float(np.linalg.norm(shift)), "mm"),
            keeps="" if self.kept is None else "both" if self.keeps_shift else "turn",
        )


def choose_base(
    result: Mapping[str, Any], initial: Mechanism, robot: Mechanism, keep_frame: bool
) -> tuple[Mechanism, tuple[Finding, ...]]:
    """Return the identified robot of a result (of its JSON), and whether its values move a base
    frame that nothing measured; with `keep_frame` the robot with values that keep it.

    DataError : no values do.
    """
    error = result.get("expected_error") or {}
    if "base" not in error.get("finding", {}).get("data", {}).get("fitted", ()):
        return robot, ()
    is_planar = result.get("height_errors") is not None
    moved = find_base_motion(initial, robot, is_planar)
    if moved is not None and keep_frame:
        if moved.kept is None:
            raise DataError(moved.finding)
        robot = moved.kept
        moved = find_base_motion(initial, robot, is_planar)
    return robot, () if moved is None else (moved.finding,)


def find_base_motion(initial: Mechanism, robot: Mechanism, is_planar: bool) -> BaseMotion | None:
    """Return the motion of the base frame from an initial robot to the identified one; None where
    it is not visible. `is_planar` : heights are measured, so that x, y and the angle about z are
    all that may be moved.
    """
    readings = probe_readings(robot)
    new, old = forward(robot, readings), forward(initial, readings)
    usable = new.converged & old.converged
    if not usable.any():  # as where redundant readings contradict the initial values
        return None
    readings, new, old = readings[usable], new.T[usable], old.T[usable]
    arms = np.zeros((1, 3))
    if any(axis < 3 for axis in robot.program.freedoms):  # it rotates: three more points of it
        arms = np.concatenate([arms, 0.25 * robot.size * np.eye(3)])

    def place(T: FloatArray) -> FloatArray:
        """Return the points (n r, 3) of poses."""
        return (arms @ T[:, :3, :3].transpose(0, 2, 1) + T[:, None, :3, 3]).reshape(-1, 3)

    points, reference = place(new), place(old)
    level = np.array([1.0, 1.0, 0.0]) if is_planar else np.ones(3)
    M = align_point_sets(points * level, reference * level)
    moved = points @ M[:3, :3].T + M[:3, 3] - points
    if np.sqrt((moved**2).sum(axis=1).mean()) < VISIBLE * robot.size:
        return None
    for motion in (M, make_pose(M[:3, :3], np.zeros(3))):
        wanted = points @ motion[:3, :3].T + motion[:3, 3]
        kept, left = robot, np.linalg.norm(wanted - points)
        for _ in range(STEPS):
            kept = _step(kept, readings, arms, wanted - place(forward(kept, readings).T))
        rest = float(np.linalg.norm(wanted - place(forward(kept, readings).T)))
        if rest < SAME * left:
            return BaseMotion(M, kept, motion is M)
    return BaseMotion(M, None, False)


def _step(
    robot: Mechanism, readings: FloatArray, arms: FloatArray, wanted: FloatArray
) -> Mechanism:
    """Return a robot whose values move the points of `arms` (r, 3) by `wanted` (n r, 3), to first
    order, by the smallest change.
    """
    state = forward_trials(robot, robot.values[None], readings[None])
    twist = differentiate_pose(robot, robot.values[None], readings[None], state).parameters[0]
    arm = arms @ state.T[0][:, :3, :3].transpose(0, 2, 1)  # (n, r, 3)
    by_parameter = np.moveaxis(twist, -1, 0)[:, :, None]  # (p, n, 1, 6)
    rows = by_parameter[..., 3:] + np.cross(by_parameter[..., :3], arm)
    J = rows.reshape(len(rows), -1).T
    scale = 1.0 / np.maximum(np.linalg.norm(J, axis=0), 1e-12)
    step = np.linalg.lstsq(J * scale, wanted.ravel(), rcond=1e-9)[0]
    return robot.with_values(robot.values + scale * step)
