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
from typing import Any

import numpy as np

from loopcal.diagnose.gauge_freedoms import observe_motions, probe_readings
from loopcal.errors import DataError
from loopcal.findings import Finding, Quantity, report_finding
from loopcal.geometry import align_point_sets, log_so3, make_pose
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import forward
from loopcal.typing import FloatArray

VISIBLE = 5e-4  # root mean square motion, in sizes of the robot, from which it is stated
SAME = 1e-3  # largest remaining share of a motion that other values make exactly
STEPS = 5  # of Newton's method for these values


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
    is_planar = result.get("height_errors") is not None  # heights determine the rest
    finding, kept = find_base_motion(initial, robot, is_planar)
    if finding is not None and keep_frame:
        if kept is None:
            raise DataError(finding)
        robot, finding = kept, find_base_motion(initial, kept, is_planar)[0]
    return robot, () if finding is None else (finding,)


def find_base_motion(
    initial: Mechanism, robot: Mechanism, is_planar: bool
) -> tuple[Finding | None, Mechanism | None]:
    """Return the motion from an initial robot to the identified one, None where it is not visible,
    and the identified robot with values that do without it, or without its rotation alone; None
    where no values do. `is_planar` : only x, y and the angle about z count.
    """
    readings = probe_readings(robot)
    new, old = forward(robot, readings), forward(initial, readings)
    usable = new.converged & old.converged
    if not usable.any():  # as where redundant readings contradict the initial values
        return None, None
    readings = readings[usable]
    arms = np.zeros((1, 3))
    if min(robot.program.freedoms) < 3:  # it rotates: three more points of it
        arms = np.concatenate([arms, 0.25 * robot.size * np.eye(3)])

    def place(T: FloatArray) -> FloatArray:
        """Return the points (n r, 3) of poses."""
        return (arms @ T[:, :3, :3].transpose(0, 2, 1) + T[:, None, :3, 3]).reshape(-1, 3)

    points, reference = place(new.T[usable]), place(old.T[usable])
    level = np.array([1.0, 1.0, 0.0 if is_planar else 1.0])
    M = align_point_sets(points * level, reference * level)
    turn, shift = M[:3, :3], M[:3, 3]
    moved = points @ turn.T + shift - points
    if np.sqrt((moved**2).sum(axis=1).mean()) < VISIBLE * robot.size:
        return None, None
    keeps, kept = "", None
    for word, motion in (("both", M), ("turn", make_pose(turn, np.zeros(3)))):
        wanted, trial = points @ motion[:3, :3].T + motion[:3, 3], robot
        for _ in range(STEPS):
            T, twist = observe_motions(trial, readings)
            if len(T) < len(readings):
                break
            arm, by_parameter = arms @ T[:, :3, :3].transpose(0, 2, 1), np.moveaxis(twist, -1, 0)
            by_parameter = by_parameter[:, :, None]  # (p, n, 1, 6)
            rows = by_parameter[..., 3:] + np.cross(by_parameter[..., :3], arm)
            J, left = rows.reshape(len(rows), -1).T, (wanted - place(T)).ravel()
            scale = 1.0 / np.maximum(np.linalg.norm(J, axis=0), 1e-12)
            step = scale * np.linalg.lstsq(J * scale, left, rcond=1e-9)[0]
            trial = trial.with_values(trial.values + step)
        rest = np.linalg.norm(wanted - place(forward(trial, readings).T))
        if rest < SAME * np.linalg.norm(wanted - points):
            keeps, kept = word, trial
            break
    angle, length = (float(np.linalg.norm(v)) for v in (log_so3(turn), shift))
    sizes = {
        "turn": Quantity(math.degrees(angle), "deg"),
        "shift": Quantity(1e3 * length, "mm"),
        "keeps": keeps,
    }
    return report_finding("files.base-moves", **sizes), kept
