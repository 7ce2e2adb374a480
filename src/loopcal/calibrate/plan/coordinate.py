# SPDX-License-Identifier: Apache-2.0
"""Coordinate exchange: units move freely, one coordinate of one unit at a time, each to the best of a few levels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from loopcal.calibrate.plan.criteria import Criterion, D, evaluate
from loopcal.calibrate.plan.design import Directions, Start, design_factor, directions, require_enough
from loopcal.linalg import FloatArray, IntArray

Evaluate = Callable[[IntArray, FloatArray], FloatArray]
"""(b,) numbers of units, (b, c) coordinates -> rows (b, r, o + p), NaN where not allowed."""


@dataclass(frozen=True, eq=False)
class MovedDesign:
    """A design of units that were moved.

    Attributes
    ----------
    design : (u, c) coordinates. rows : (u, r, o + p) of it. value : of the criterion.
    history : value before the first sweep and after each. evaluated : rows of units that were asked for in all.
    directions : the space in which it is counted.
    """

    design: FloatArray
    rows: FloatArray
    value: float
    history: tuple[float, ...]
    evaluated: int
    directions: Directions


def coordinate_exchange(
    evaluate_rows: Evaluate,
    design0: FloatArray,
    levels: Sequence[FloatArray],
    criterion: Criterion,
    start: Start,
    sweeps: int = 3,
) -> MovedDesign:
    """Improve a design by moving one coordinate at a time.

    Parameters
    ----------
    evaluate_rows : (which (b,), values (b, c)) -> rows (b, r, o + p), NaN where not allowed; asked for all units and
        all levels of one coordinate at once.
    design0 : (u, c) coordinates to start from. levels : for each of the c coordinates, the values (k,) that it may take.
    criterion : D, I or A. start : what is known before. sweeps : at most, over all coordinates; ends when none moves.

    Returns
    -------
    MovedDesign

    Raises
    ------
    EstimationError
        The first design is not allowed, or its units cannot determine the unknowns.
    """
    design = np.array(design0, dtype=np.float64)
    u = len(design)
    rows = np.array(evaluate_rows(np.arange(u), design))
    space = directions(rows, start)
    require_enough(u, rows, start, space)
    sign = 1.0 if isinstance(criterion, D) else -1.0
    value = sign * evaluate(criterion, design_factor(rows, start, space), space.machine)
    history, evaluated = [value], u
    for _ in range(sweeps):
        for c, values in enumerate(levels):
            moved = np.repeat(design[:, None], len(values), axis=1)
            moved[:, :, c] = values
            found = evaluate_rows(np.repeat(np.arange(u), len(values)), moved.reshape(-1, design.shape[1]))
            found = found.reshape(u, len(values), *rows.shape[1:])
            evaluated += u * len(values)
            for i in range(u):
                for k in np.flatnonzero(np.isfinite(found[i]).all(axis=(1, 2))):
                    tried = rows.copy()
                    tried[i] = found[i, k]
                    new = sign * evaluate(criterion, design_factor(tried, start, space), space.machine)
                    if new > value + 1e-9:
                        value, rows, design[i, c] = new, tried, values[k]
        history.append(value)
        if history[-1] == history[-2]:
            break
    return MovedDesign(design, rows, sign * value, tuple(sign * v for v in history), evaluated, space)
