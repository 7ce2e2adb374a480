# SPDX-License-Identifier: Apache-2.0
"""Close the loops at target poses, and find which of them the start's mode reaches.

A pose is reached where a certificate proves it, or where its sign is the start's and Newton's
method from the start comes close to it, see newton.py.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from loopcal.engine.program import CONVERGED, NEAR_GOAL, Program, Reached, State, Target
from loopcal.typing import FloatArray


def reach_by(
    solve: Callable[..., State],
    certify: Callable[..., NDArray[np.int8]] | None,
    program: Program,
    e: FloatArray,
    target: Target,
    start: State,
) -> Reached:
    """Close the loops at target poses by two functions of an engine; see `loopcal.engine.reach`."""
    limbs, first = program.with_fixed_platform, replace(start, T=target.poses)
    state = solve(limbs, e, program.list_drives(start.joints), first, free=True)
    q = program.list_drives(state.joints)
    sign = solve(program, e, q, state, max_iterations=0).closure_sign
    proven = np.zeros(q.shape[:2], bool)
    if certify is not None:
        proven = certify(program, e, start, state) != 0
    open_rows = ~proven & (sign == start.closure_sign) & (state.status == CONVERGED)
    # other rows end at once
    back = solve(program, e, np.where(open_rows[..., None], q, np.nan), start, goal=state)
    arrives = proven | (back.status == NEAR_GOAL)
    return Reached(replace(state, closure_sign=sign), arrives)
