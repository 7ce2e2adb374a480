# SPDX-License-Identifier: Apache-2.0
"""Which directions that the data cannot tell only move a frame as a whole: the base's, or the
platform's.

A direction n of the parameters moves every pose by D(x) n. If that is at all poses one rigid motion
of the base frame, (w, c + w x t), and one of the platform frame, (R w', R c'), no geometry of the
machine changes with n: it is a gauge direction. See docs/theory/gauge.md and uncertainty.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopcal import geometry
from loopcal.estimate.inference.posterior import Posterior
from loopcal.mechanism import (
    Mechanism,
    Status,
    compute_readings,
    differentiate_pose,
    forward_trials,
)
from loopcal.typing import BoolArray, FloatArray
from loopcal.units import Dimension

PROBES = 24
"""Poses at which motions are compared: 144 equations for the 12 numbers of two frames and the
directions in question.
"""

SPREAD_LENGTH, SPREAD_ANGLE = 0.05, 0.1
"""How far readings go to each side of home, in the robot's size and in radians."""

NO_MOTION = 1e-8
"""Motion below this share of what all parameters together do is none: the square root of double
rounding.
"""


@dataclass(frozen=True, eq=False)
class FrameMotions:
    """The d directions not seen, and which of their combinations move a frame as a whole.

    Attributes
    ----------
    kept : (p, d) the directions with those combinations taken out; zero columns where nothing else
        is left.
    frames : which frames they move: (), ("base",), ("platform",) or both. count : how many
        independent ones do.
    """

    kept: FloatArray
    frames: tuple[str, ...]
    count: int


def find_frame_motions(known: Posterior) -> FrameMotions:
    """Take the motions of frames out of the directions that the rows of a fit do not determine."""
    null = known.directions[:, ~known.determined]
    if null.shape[1] == 0:
        return FrameMotions(null, (), 0)
    D, base, platform = _motions(known)
    limit = NO_MOTION * float(np.linalg.norm(D))
    moved = D @ null
    _, s, vt = np.linalg.svd(
        _outside(np.concatenate([base, platform], axis=1), moved), full_matrices=False
    )
    gauge = vt[s <= limit].T
    moving = moved @ gauge
    count = int((np.linalg.svd(moving, compute_uv=False) > limit).sum()) if gauge.shape[1] else 0
    frames = _frames(moving, base, platform, limit) if count else ()
    return FrameMotions(
        null @ _without(gauge, np.isinf(known.variance[~known.determined])), frames, count
    )


def _without(gauge: FloatArray, infinite: BoolArray) -> FloatArray:
    """Projector (d, d) along `gauge` (d, g) that first takes out coordinates of infinite variance,
    then the others.

    Which frame is fitted is a convention; this one leaves nothing infinite that a motion of a frame
    can take away.
    """
    d = len(gauge)
    u, s, vt = np.linalg.svd(gauge[infinite], full_matrices=True)
    rank = int((s > NO_MOTION).sum())
    first, second = gauge @ vt[:rank].T, gauge @ vt[rank:].T
    one = np.eye(d)
    one[:, infinite] -= (first / s[:rank]) @ u[:, :rank].T
    basis = np.linalg.qr(second)[0]
    return one - basis @ (basis.T @ one)


def twist_weights(robot: Mechanism) -> FloatArray:
    """(6,) factors that make rotations [rad] comparable with displacements [m]: the robot's size,
    and one.
    """
    return np.array([robot.size] * 3 + [1.0] * 3)


def _motions(known: Posterior) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Weighted motions (6 n, p), (6 n, 6), (6 n, 6) by directions' coordinates, by the base and by
    the platform.
    """
    robot = known.robot
    rng = np.random.default_rng(0)
    home = compute_readings(robot, robot.values[None], robot.home_state)[0, 0]
    spread = [
        SPREAD_LENGTH * robot.size if a.dimension is Dimension.LENGTH else SPREAD_ANGLE
        for a in robot.actuators
    ]
    q = home + rng.uniform(-1.0, 1.0, (PROBES, len(home))) * spread
    state = forward_trials(robot, robot.values[None], q[None])
    good = state.status[0] == Status.CONVERGED
    D = differentiate_pose(robot, robot.values[None], q[None], state).parameters[0]
    good &= np.isfinite(D).all(axis=(1, 2))
    R, t = state.T[0, good, :3, :3], state.T[0, good, :3, 3]
    zero, turn = np.zeros_like(R), np.broadcast_to(np.eye(3), R.shape)
    base = np.concatenate(
        [np.concatenate([turn, zero], 2), np.concatenate([-geometry.hat(t), turn], 2)], axis=1
    )
    platform = np.concatenate([np.concatenate([R, zero], 2), np.concatenate([zero, R], 2)], axis=1)
    weight = twist_weights(robot)[:, None]
    of_parameters = (D[good][:, :, known.places] * known.unit) * weight
    flat = (of_parameters, base * weight, platform * weight)
    return tuple(a.reshape(-1, a.shape[-1]) for a in flat)  # pyright: ignore[reportReturnType]


def _outside(frames: FloatArray, moved: FloatArray) -> FloatArray:
    """What no motion of the frames explains of some motions."""
    u, s, _ = np.linalg.svd(frames, full_matrices=False)
    basis = u[:, s > NO_MOTION * s[0]]
    return moved - basis @ (basis.T @ moved)


def _frames(
    moving: FloatArray, base: FloatArray, platform: FloatArray, limit: float
) -> tuple[str, ...]:
    """Name the frames that explain the motions: one where it alone does."""
    for name, frame in (("base", base), ("platform", platform)):
        if np.linalg.norm(_outside(frame, moving)) <= limit:
            return (name,)
    return ("base", "platform")
