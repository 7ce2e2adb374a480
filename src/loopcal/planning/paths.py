# SPDX-License-Identifier: Apache-2.0
"""Is the straight way between two poses allowed? Followed step by step, many ways at once.

A way is straight in the controlled coordinates: positions and angles change evenly, the shorter way
round, and a tilt given by phi and theta as the vector (theta cos phi, theta sin phi), which is
regular at zero tilt. Every step is solved from the step before it, so that a way keeps its branch;
it must end with the readings that its end is commanded with.
"""

from __future__ import annotations

import numpy as np

from loopcal import geometry
from loopcal.mechanism import POSITION, TILT, Mechanism, inverse
from loopcal.planning.constraints import Rules, Verdicts
from loopcal.typing import FloatArray
from loopcal.units import Dimension

STEPS = 40
"""Steps in which a way from end to end of the robot's size, or of one radian, is followed."""
WAYS = 4096
"""Ways that are followed at once."""
BRANCH = 1e-6
"""Difference of readings, in the robot's size or in radians, above which a way ended on another
branch than its end.
"""


def between(
    robot: Mechanism, start: FloatArray, end: FloatArray, share: float | FloatArray
) -> FloatArray:
    """Coordinates (n, c) at a share (number or (n,)) of the straight ways from start to end, (n, c)
    each.
    """
    names, s = robot.controlled, np.asarray(share, dtype=float)
    angular = np.array([name not in POSITION for name in names])
    step = end - start
    step = np.where(angular, geometry.wrap_angle(step), step)
    found = start + (s[..., None] if s.ndim else s) * step
    if "phi" in names:
        places = [names.index(name) for name in TILT[:2]]
        vector = (1.0 - s) * _tilt(start, places) + s * _tilt(end, places)
        found[:, places] = np.stack([np.angle(vector), np.abs(vector)], axis=1)
    return found


def distance(robot: Mechanism, start: FloatArray, end: FloatArray) -> FloatArray:
    """Length (..,) of straight ways [m]: the root of the squared changes, angles times the robot's
    size.
    """
    names = robot.controlled
    scale = np.array([1.0 if name in POSITION else robot.size for name in names])
    step = np.where(scale == 1.0, end - start, geometry.wrap_angle(end - start)) * scale
    if "phi" in names:
        places = [names.index(name) for name in TILT[:2]]
        tilted = robot.size * (_tilt(end, places) - _tilt(start, places))
        step[..., places] = np.stack([tilted.real, tilted.imag], axis=-1)
    return np.linalg.norm(step, axis=-1)


def follow(rules: Rules, start: FloatArray, end: FloatArray, steps: int = STEPS) -> Verdicts:
    """Judge straight ways from start (n, c) to end (n, c), both ends included; the line of sight is
    not asked for.

    Parameters
    ----------
    rules : the robot's. steps : in a way as long as the robot's size; longer ways get more, every
        one at least 4.
    """
    robot, n = rules.robot, len(start)
    allowed, why = np.ones(n, dtype=bool), np.full(n, "", dtype=object)
    order = np.argsort(distance(robot, start, end), kind="stable")
    for first in range(0, n, WAYS):
        rows = order[first : first + WAYS]
        verdict = _followed(rules, start[rows], end[rows], steps)
        allowed[rows], why[rows] = verdict.allowed, verdict.why
    return Verdicts(allowed, why)


def _followed(rules: Rules, start: FloatArray, end: FloatArray, steps: int) -> Verdicts:
    """Follow ways of about one length, all in the same number of steps."""
    robot = rules.robot
    longest = float(distance(robot, start, end).max(initial=0.0)) / robot.size
    count = max(int(np.ceil(steps * longest)), 4)
    here = inverse(robot, start)
    verdict = rules.judge(here, at_pose=False)
    why = np.array(verdict.why)
    alive = np.flatnonzero(verdict.allowed)
    here = here.take(alive)
    for i in range(1, count + 1):
        if not len(alive):
            break
        here = inverse(robot, between(robot, start[alive], end[alive], i / count), here)
        step = rules.judge(here, at_pose=False)
        why[alive] = step.why
        alive, here = alive[step.allowed], here.take(step.allowed)
    if len(alive):
        scale = np.array(
            [robot.size if a.dimension is Dimension.LENGTH else 1.0 for a in robot.actuators]
        )
        off = np.abs(here.q - inverse(robot, end[alive]).q) / scale
        why[alive[~(off <= BRANCH).all(axis=1)]] = (
            "it arrives on another branch than the pose is commanded with"
        )
    return Verdicts(np.array([not reason for reason in why], dtype=bool), why)


def _tilt(coordinates: FloatArray, places: list[int]) -> np.ndarray:
    """Tilt vector (..,) as a complex number: theta at the angle phi."""
    return coordinates[..., places[1]] * np.exp(1j * coordinates[..., places[0]])
