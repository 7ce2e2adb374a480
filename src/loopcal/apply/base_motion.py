# SPDX-License-Identifier: Apache-2.0
"""Motion of the base and platform frames when identified values replace those in a controller.

A controller with the current values leads a program to the poses T_i of the calibrated machine, and
with the identified values to the poses it commands, T'_i = the current model at the same readings.
The rigid motions M and P that minimize sum |M T_i P - T'_i|^2 move all of a program alike, and the
tool on the platform. Where nothing measured a frame, its motion is a convention, such as which
tower defines the x axis: values for which the model gives M T_i P keep programs where they are, and
all relative accuracy.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import compress
from typing import Any

import numpy as np

from loopcal import geometry
from loopcal.diagnose.gauge_freedoms import observe_motions, probe_readings
from loopcal.errors import DataError
from loopcal.findings import Finding, Quantity, report_finding
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import forward
from loopcal.typing import BoolArray, FloatArray

VISIBLE = 5e-4  # root mean square motion, in sizes of the robot, above which it is stated
SAME = 1e-3  # largest remaining share of a motion that other values make exactly
STEPS = 5  # of Newton's method for motions and for these values
ROUNDING = 1e-9  # share of the robot's size below which a frame does not move
FRAMES = ("base", "platform")


def choose_base(
    result: Mapping[str, Any],
    initial: Mechanism,
    robot: Mechanism,
    keep_frame: bool,
    visible: float = VISIBLE,
) -> tuple[Mechanism, tuple[Finding, ...]]:
    """Return the identified robot of a result (of its JSON), and whether its values move frames
    that nothing measured; with `keep_frame` the robot with values that keep them. `visible` : root
    mean square motion, in sizes of the robot, from which they move.

    DataError : no values do.
    """
    error = result.get("expected_error") or {}
    fitted = error.get("finding", {}).get("data", {}).get("fitted", ())
    is_planar = result.get("height_errors") is not None  # heights determine the rest
    finding, kept = find_base_motion(initial, robot, is_planar, fitted, visible)
    if finding is not None and keep_frame:
        if kept is None:
            raise DataError(finding)
        robot, finding = kept, find_base_motion(initial, kept, is_planar, fitted)[0]
    return robot, () if finding is None else (finding,)


def find_base_motion(
    initial: Mechanism,
    robot: Mechanism,
    is_planar: bool,
    frames: Sequence[str] = FRAMES,
    visible: float = VISIBLE,
) -> tuple[Finding | None, Mechanism | None]:
    """Return the motion of frames from an initial robot to the identified one, None where it is not
    visible, and the identified robot with values that do without it, or without its rotation alone;
    None where no values do. `is_planar` : only x, y and the angle about z of the base count.
    """
    allowed = np.repeat([frame in frames for frame in FRAMES], 6)
    if is_planar:
        allowed[[0, 1, *range(5, 12)]] = False
    is_turning = min(robot.program.freedoms) < 3
    if not is_turning and allowed[:6].any():  # a tool's place moves all poses as the base does
        allowed[6:] = False
    if not allowed.any():
        return None, None
    readings = probe_readings(robot)
    new, old = forward(robot, readings), forward(initial, readings)
    usable = new.converged & old.converged
    if not usable.any():  # as where redundant readings contradict the initial values
        return None, None
    readings = readings[usable]
    arms = np.zeros((1, 3))
    if is_turning:  # three more points of it
        arms = np.concatenate([arms, 0.25 * robot.size * np.eye(3)])

    T = new.T[usable]
    level = np.array([1.0, 1.0, 0.0 if is_planar else 1.0])
    M, P = _fit_motions(T, old.T[usable], arms, level, allowed)
    points = _place(T, arms)
    moved = _place(M @ T @ P, arms) - points
    if np.sqrt((moved**2).sum(axis=1).mean()) <= visible * robot.size:
        return None, None
    keeps, kept = "", None
    for word, share in (("both", 1.0), ("turn", 0.0)):
        before, after = (geometry.make_pose(F[:3, :3], share * F[:3, 3]) for F in (M, P))
        wanted, trial = _place(before @ T @ after, arms), robot
        for _ in range(STEPS):
            reached, twist = observe_motions(trial, readings)
            if len(reached) < len(readings):
                break
            J = _list_rows(reached, twist, arms)
            step = _solve(J, (wanted - _place(reached, arms)).ravel())
            trial = trial.with_values(trial.values + step)
        rest = np.linalg.norm(wanted - _place(forward(trial, readings).T, arms))
        if rest < SAME * np.linalg.norm(wanted - points):
            keeps, kept = word, trial
            break
    sizes: dict[str, Any] = {"keeps": keeps, "frames": [*compress(FRAMES, allowed[[3, 9]])]}
    for frame, F in zip(FRAMES, (M, P), strict=True):
        angle, length = (float(np.linalg.norm(v)) for v in (geometry.log_so3(F[:3, :3]), F[:3, 3]))
        angle *= angle > ROUNDING
        is_moved = angle * robot.size + length > ROUNDING * robot.size
        sizes[f"{frame}_turn"] = Quantity(math.degrees(angle), "deg") if is_moved else 0
        sizes[f"{frame}_shift"] = Quantity(1e3 * length, "mm") if is_moved else 0
    return report_finding("files.base-moves", **sizes), kept


def _place(T: FloatArray, arms: FloatArray) -> FloatArray:
    """Return the points (n r, 3) of poses (n, 4, 4) at arms (r, 3) from their origin [m]."""
    return (arms @ T[:, :3, :3].transpose(0, 2, 1) + T[:, None, :3, 3]).reshape(-1, 3)


def _list_rows(T: FloatArray, twists: FloatArray, arms: FloatArray) -> FloatArray:
    """Return the motions (n r 3, k) of the points by twists (n, 6, k) of poses."""
    arm = (arms @ T[:, :3, :3].transpose(0, 2, 1))[..., None]
    rows = twists[:, None, 3:] + np.cross(twists[:, None, :3], arm, axis=2)
    return rows.reshape(-1, twists.shape[-1])


def _fit_motions(
    T: FloatArray, reference: FloatArray, arms: FloatArray, level: FloatArray, allowed: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Return the motions M and P for which M T P is nearest to reference poses, of those that are
    allowed (12,); `level` (3,) weighs directions.
    """
    M, P = np.eye(4), np.eye(4)
    for _ in range(STEPS):
        moved, step = M @ T @ P, np.zeros(12)
        J = _list_rows(moved, geometry.differentiate_by_frames(moved)[..., allowed], arms)
        left = (_place(reference, arms) - _place(moved, arms)) * level
        step[allowed] = _solve(J * np.tile(level, len(left))[:, None], left.ravel())
        M = geometry.make_pose(geometry.exp_so3(step[:3]), step[3:6]) @ M
        P = P @ geometry.make_pose(geometry.exp_so3(step[6:9]), step[9:])
    return M, P


def _solve(J: FloatArray, left: FloatArray) -> FloatArray:
    """Return the shortest step (k,), in units of its effects, that removes what is left (m,)."""
    scale = 1.0 / np.maximum(np.linalg.norm(J, axis=0), 1e-12)
    return scale * geometry.solve_least_squares(J * scale, left)
