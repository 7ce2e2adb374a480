# SPDX-License-Identifier: Apache-2.0
"""Close the loops at target poses, and find which of them the start's mode reaches.

Limbs are closed one by one, see limbs.py. A pose is reached where the certificate proves it, or
where its sign is the start's and Newton's method from the start comes close to it, see newton.py.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from loopcal.engine.numpy_engine.certificate import certify
from loopcal.engine.numpy_engine.closure import stack
from loopcal.engine.program import CONVERGED, NEAR_GOAL, Program, Reached, State, Target
from loopcal.typing import BoolArray, FloatArray, IntArray


def reach(program: Program, e: FloatArray, target: Target, start: State) -> Reached:
    """Close the loops at target poses; see `loopcal.engine.reach`."""
    from loopcal.engine.numpy_engine.newton import solve

    return reach_by(solve, certify, program, e, target, start)


def reach_by(
    solve: Callable[..., State],
    certify: Callable[..., NDArray[np.int8]],
    program: Program,
    e: FloatArray,
    target: Target,
    start: State,
) -> Reached:
    """Return what `reach` returns by two other functions of an engine."""
    limbs, first = program.with_fixed_platform, replace(start, T=place_platforms(target))
    state = solve(limbs, e, program.list_drives(start.joints), first, free=True)
    proven = certify(program, e, start, state)
    sign, arrives = _follow(solve, program, e, start, state, proven)
    return Reached(replace(state, closure_sign=sign), arrives)


def _follow(
    solve: Callable[..., State],
    program: Program,
    e: FloatArray,
    start: State,
    state: State,
    proven: NDArray[np.int8],
) -> tuple[NDArray[np.int8], BoolArray]:
    """Return the signs of all rows, and which are proven or reached by Newton's method."""
    shape, sign, arrives = state.status.shape, proven.copy(), proven != 0
    trial, pose = np.nonzero(~arrives)
    if not len(trial):
        return sign, arrives
    own = state.select(shape, trial, pose)
    q = program.list_drives(own.joints)
    now = solve(program, _of_trials(e, trial), q, own, max_iterations=0).closure_sign[:, 0]
    sign[trial, pose] = now
    begun = np.broadcast_to(start.closure_sign, shape)[trial, pose]
    same = (now == begun) & (own.status[:, 0] == CONVERGED)
    trial, pose, q = trial[same], pose[same], q[same]
    if not len(trial):
        return sign, arrives
    own, first = state.select(shape, trial, pose), start.select(shape, trial, pose)
    back = solve(program, _of_trials(e, trial), q, first, goal=own)
    arrives[trial, pose] = back.status[:, 0] == NEAR_GOAL
    return sign, arrives


def _of_trials(e: FloatArray, trial: IntArray) -> FloatArray:
    """Return the displacements of trials; one row serves all."""
    return e[trial] if len(e) > 1 else e


def place_platforms(target: Target) -> FloatArray:
    """Return the poses (t | 1, n, 4, 4) of a target."""
    values = target.values
    T = np.empty((*values.shape[:2], 4, 4))
    T[:] = target.base
    for axis, column in enumerate(target.columns[:3]):
        if column >= 0:
            T[..., axis, 3] = values[..., column]
    if max(target.columns[3:]) >= 0:
        T[..., :3, :3] = np.moveaxis(_compute_rotations(target), (0, 1), (-2, -1))
    return T


def _compute_rotations(target: Target) -> FloatArray:
    """Return the rotations (3, 3, t | 1, n) of a target."""
    none = np.zeros(target.values.shape[:2])
    a, b, c = (
        target.values[..., column].copy() if column >= 0 else none for column in target.columns[3:]
    )
    third = c - a if target.torsion else c
    (sa, sb, sc), (ca, cb, cc) = ((f(a), f(b), f(third)) for f in (np.sin, np.cos))
    # the columns of Rz(a) Ry(b), of which the last turn combines two
    x, y, z = stack((ca * cb, sa * cb, -sb)), stack((-sa, ca, none)), stack((ca * sb, sa * sb, cb))
    if target.torsion:
        x, y = cc * x + sc * y, cc * y - sc * x
    else:
        y, z = cc * y + sc * z, cc * z - sc * y
    return np.stack([x, y, z], axis=1)
