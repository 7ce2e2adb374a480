# SPDX-License-Identifier: Apache-2.0
"""Fedorov exchange: from a set of candidates, swap one chosen against one not chosen while the criterion improves."""

from __future__ import annotations

import numpy as np

from loopcal.calibrate.plan.criteria import Criterion, D, evaluate
from loopcal.calibrate.plan.design import Design, Start, allowed, design_factor, directions, require_enough
from loopcal.linalg import FloatArray


def fedorov_exchange(
    rows: FloatArray, n: int, criterion: Criterion, start: Start, seed: int = 0, starts: int = 20, repeats: bool = False
) -> Design:
    """Choose n of N units.

    Parameters
    ----------
    rows : (N, r, o + p) whitened and tolerance-scaled; NaN where a unit is not allowed.
    n : units to choose. criterion : D, I or A. start : what is known before.
    seed : of the random starts. starts : their number. repeats : whether a unit may be chosen more than once.

    Returns
    -------
    Design

    Raises
    ------
    EstimationError
        n units cannot determine the unknowns, or fewer are allowed than asked for.
    """
    space = directions(rows, start)
    require_enough(n, rows, start, space)
    sign = 1.0 if isinstance(criterion, D) else -1.0

    def gain(chosen: list[int]) -> float:
        return sign * evaluate(criterion, design_factor(rows[chosen], start, space), space.machine)

    usable, best, values = np.flatnonzero(allowed(rows)), None, []
    for stream in np.random.default_rng(seed).spawn(starts):
        chosen = stream.choice(usable, n, replace=repeats).tolist()
        history, better = [gain(chosen)], True
        while better:
            better = False
            for i in range(n):
                tried = [k for k in usable.tolist() if repeats or k not in chosen]
                found = [gain([*chosen[:i], k, *chosen[i + 1 :]]) for k in tried]
                if found and max(found) > history[-1] + 1e-9:
                    chosen[i], better = tried[int(np.argmax(found))], True
                    history.append(max(found))
        values.append(sign * history[-1])
        if best is None or history[-1] > best[1][-1]:
            best = (chosen, history)
    assert best is not None
    history = tuple(sign * value for value in best[1])
    return Design(np.sort(np.array(best[0], dtype=np.int64)), history[-1], history, tuple(values), space)
