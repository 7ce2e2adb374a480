# SPDX-License-Identifier: Apache-2.0
"""Solve closure limb by limb where the platform is given, in closed form.

A program without freedoms leaves the platform where it is, so that no limb depends on another. Here
are the limbs that end in a distance and have one unknown joint, their drive: a rod takes the
distance that is left; a prismatic joint takes one of two places, which a square root gives. Other
limbs are solved by Newton's method, see newton.py. Derivation: docs/theory/engine.md.
"""

from __future__ import annotations

import numpy as np

from loopcal.engine.numpy_engine.closure import Chain, PlacedLinks, divide_rows, dot, place_links
from loopcal.engine.program import CONVERGED, NOT_FINITE, STALLED, Group, Program, State
from loopcal.typing import FloatArray

OPEN = 1e-9
"""Residual of a closed row, relative to the robot's size."""


def have_closed_form(program: Program) -> bool:
    """Return whether every limb ends in a distance and its rod or a prismatic joint is unknown."""
    unknown = [g.unknown_joints(free=True) for g in program.groups]
    return all(
        g.ending == "distance" and len(j) == 1 and g.joints[j[0] : j[0] + 1] in ("", "P")
        for g, j in zip(program.groups, unknown, strict=True)
    )


def close_limbs(program: Program, e: FloatArray, q: FloatArray, start: State) -> State:
    """Return the state (t, n) with the platform of the start.

    A prismatic joint stays on the side of the start's value where the distance increases, or
    decreases.
    """
    t, n = max(len(e), len(q), len(start.T)), max(q.shape[1], start.T.shape[1])
    T = np.broadcast_to(start.T, (t, n, 4, 4)).reshape(-1, 4, 4)
    square, sign = np.zeros(t * n), np.ones(t * n)
    joints = []
    with np.errstate(all="ignore"):
        for group, values in zip(program.groups, start.joints, strict=True):
            links, shape = place_links(group, e), (t, n, *values.shape[2:])
            filled = group.insert_driven(np.broadcast_to(values, shape), q)
            flat = filled.reshape(t * n, *shape[2:])  # a copy where the start is broadcast
            for part in divide_rows(t * n):
                platform = T[part, :3].transpose(1, 2, 0).copy()
                theta = flat[part].transpose(2, 1, 0).copy()
                placed = links.select(np.arange(t * n)[part] // n)
                residual, signs = _close_group(group, placed, platform, theta, program.size)
                flat[part] = theta.transpose(2, 1, 0)
                square[part] += np.add.reduce(residual**2, axis=0)
                sign[part] *= np.multiply.reduce(signs, axis=0)
            joints.append(flat.reshape(shape))
        norm = np.sqrt(square)
        status = np.where(norm <= OPEN * program.size, CONVERGED, STALLED)
        status[~np.isfinite(norm)] = NOT_FINITE
    return State(
        T.reshape(t, n, 4, 4),
        tuple(joints),
        status.astype(np.int8).reshape(t, n),
        norm.reshape(t, n),
        np.zeros((t, n), np.int64),
        np.nan_to_num(sign).astype(np.int8).reshape(t, n),
    )


def _close_group(
    group: Group, links: PlacedLinks, T: FloatArray, theta: FloatArray, size: float
) -> tuple[FloatArray, FloatArray]:
    """Set the unknown joint in theta (J + 1, k, N); return residuals and signs of slopes (k, N).

    A step d along a prismatic axis a changes the gap g to g - a d. From |g - a d| = reach follows
    a'g - d = +- sqrt((a'g)^2 - |g|^2 + reach^2), whose sign is that of a'g.
    """
    (j,) = group.unknown_joints(free=True)
    chain = Chain(group, links, T, theta, size)
    if j == len(group.joints):
        theta[j] = chain.distance - links.length
        return chain.distance - (links.length + theta[j]), np.full(theta[j].shape, -1.0)
    axis, gap, reach = chain.axes[j], chain.gap, links.length + theta[-1]
    along = dot(axis, gap)
    square = along**2 - dot(gap, gap) + reach**2
    left = np.copysign(np.sqrt(np.maximum(square, 0.0)), along)
    theta[j] += along - left
    gap = gap - (along - left) * axis
    return np.sqrt(dot(gap, gap)) - reach, -np.sign(left)
