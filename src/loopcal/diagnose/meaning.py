# SPDX-License-Identifier: Apache-2.0
"""What a robot does with a change of its parameters, in words: nothing at all, or a rigid motion of
platform or base.

A direction n moves the platform by the twist D(x) n at the pose x. That is a motion of the platform
under its own name where it equals (R w, R c) for one w and c at all poses, and one of the base
where it equals (w, c + w x t). Either changes no dimension of the machine: it is a matter of where
frames are put. See docs/theory/gauge.md.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from loopcal import geometry
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.inference.null_space import Combination
from loopcal.estimate.information import ObservedPoses, observe_poses
from loopcal.mechanism import Mechanism, compute_readings
from loopcal.typing import FloatArray
from loopcal.units import Dimension

PROBES = 24
"""Poses at which motions are compared."""

SPREAD_LENGTH, SPREAD_ANGLE = 0.05, 0.1
"""How far readings go to each side of home, in the robot's size and in radians."""

NOTHING = 1e-8
"""Motion below this share of what all parameters together do is none: the square root of double
rounding.
"""

ALIKE = 1e-6
"""Relative difference of motions that are called the same."""


def probed(free: FreeParameters, joints: Iterable[str] = ()) -> ObservedPoses:
    """Poses about home, reached for certain by no more than chance: readings spread evenly, those
    out of reach left out.
    """
    robot = free.robot
    found = observe_poses(free, _spread_readings(robot), joints)
    return observe_poses(free, found.readings[found.is_reached], joints)


def _spread_readings(robot: Mechanism) -> FloatArray:
    """Readings (PROBES, a) about those of home."""
    home = compute_readings(robot, robot.values[None], robot.home_state)[0, 0]
    spread = [
        SPREAD_LENGTH * robot.size if a.dimension is Dimension.LENGTH else SPREAD_ANGLE
        for a in robot.actuators
    ]
    return home + np.random.default_rng(0).uniform(-1.0, 1.0, (PROBES, len(home))) * spread


def with_meaning(
    free: FreeParameters, found: tuple[Combination, ...], directions: FloatArray
) -> tuple[Combination, ...]:
    """Add to combinations, given as directions (d, p) in tolerances, what the robot does with them."""
    if not found:
        return found
    at = probed(free)
    if not len(at.readings):
        return found
    size = free.robot.size
    weight = np.array([size] * 3 + [1.0] * 3)[:, None]
    D, R, t = at.twists[0], at.T[0, :, :3, :3], at.T[0, :, :3, 3]
    eye, zero = np.broadcast_to(np.eye(3), R.shape), np.zeros_like(R)
    frames = {
        "platform": np.concatenate(
            [np.concatenate([R, zero], axis=2), np.concatenate([zero, R], axis=2)], axis=1
        ),
        "base": np.concatenate(
            [np.concatenate([eye, zero], axis=2), np.concatenate([-geometry.hat(t), eye], axis=2)],
            axis=1,
        ),
    }
    flat = {name: (weight * frame).reshape(-1, 6) for name, frame in frames.items()}
    moves = (weight * D).reshape(-1, D.shape[-1])
    limit = NOTHING * float(np.linalg.norm(moves))
    pairs = zip(found, directions, strict=True)
    return tuple(
        replace(c, meaning=_meaning(moves @ (n / np.linalg.norm(n)), flat, limit, size))
        for c, n in pairs
    )


def _meaning(moved: FloatArray, frames: dict[str, FloatArray], limit: float, size: float) -> str:
    """The sentence on a motion (6 n,)."""
    if np.linalg.norm(moved) <= limit:
        return "no pose depends on it"
    for name, frame in frames.items():
        motion = _fitted(frame, moved)
        if np.linalg.norm(frame @ motion - moved) <= ALIKE * np.linalg.norm(moved):
            return f"it is the whole {name} {_rigid(motion, size)}"
    both = np.concatenate(list(frames.values()), axis=1)
    if np.linalg.norm(both @ _fitted(both, moved) - moved) <= ALIKE * np.linalg.norm(moved):
        return "it moves base and platform as wholes"
    return ""


def _fitted(frame: FloatArray, moved: FloatArray) -> FloatArray:
    """The smallest motion (c,) that explains most."""
    return np.asarray(np.linalg.lstsq(frame, moved, rcond=NOTHING)[0], dtype=np.float64)


def _rigid(motion: FloatArray, size: float) -> str:
    """A twist (6,) in words: turned about an axis, or shifted along one."""
    w, c = motion[:3], motion[3:]
    turn = float(np.linalg.norm(w))
    if turn * size <= ALIKE * np.linalg.norm(c):
        return f"shifted along {_axis(c)}"
    arm = float(np.linalg.norm(np.cross(w, c))) / turn**2
    along = abs(float(w @ c)) / turn**2
    words = f"turned about {'its' if arm <= ALIKE * size else 'an axis along'} {_axis(w)}"
    return words if along <= ALIKE * size else f"{words} and shifted along it"


def _axis(vector: FloatArray) -> str:
    """A direction as x, y or z, or by its components."""
    unit = vector / np.linalg.norm(vector)
    largest = int(np.argmax(np.abs(unit)))
    if np.linalg.norm(np.delete(unit, largest)) <= ALIKE:
        return "xyz"[largest]
    shown = np.where(np.abs(unit) <= ALIKE, 0.0, unit * np.sign(unit[largest]))
    return "(" + ", ".join(f"{x:.3g}" for x in shown) + ")"
