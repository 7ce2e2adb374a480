# SPDX-License-Identifier: Apache-2.0
"""Coordinate exchange: units move freely, one coordinate of one unit at a time, each to the best of
a few levels.

Rows of all units at all levels of one coordinate are asked for at once: they depend on the unit's
own coordinates only, so that accepting a move of one unit leaves those of the others as they are.
The moves are then tried unit by unit by the formulas of `swaps`, through a factor that is made anew
after every move. Meyer and Nachtsheim (1995), Technometrics 37; cost and derivation:
docs/theory/planning.md.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from loopcal.errors import EstimationError
from loopcal.planning.criteria import Criterion
from loopcal.planning.design import Directions, Start, allowed, directions, require_enough
from loopcal.planning.scoring import GAIN, RIDGE, Scoring, determines, make_scoring
from loopcal.planning.swaps import see, swaps
from loopcal.typing import FloatArray, IntArray

Evaluate = Callable[[IntArray, FloatArray], FloatArray]
"""(b,) numbers of units, (b, c) coordinates -> rows (b, r, o + p), NaN where not allowed."""

ENOUGH = 1e-3
"""Sweeps end when one has multiplied the efficiency by less than 1 + this."""

PROBES = 4
"""Units moved to random levels, per unit of the design, which with it show the directions that can
be known.
"""


@dataclass(frozen=True, eq=False)
class MovedDesign:
    """A design of units that were moved.

    Attributes
    ----------
    design : (u, c) coordinates. rows : (u, r, o + p) of it. value : of the criterion.
    history : value before the first sweep (-inf for D, inf for I and A where it leaves directions
        open), and after each.
    evaluated : units whose rows were asked for in all. directions : the space in which it is
        counted.
    """

    design: FloatArray
    rows: FloatArray
    value: float
    history: tuple[float, ...]
    evaluated: int
    directions: Directions


def coordinate_exchange(
    evaluate: Evaluate,
    design0: FloatArray,
    levels: Sequence[FloatArray],
    criterion: Criterion,
    start: Start,
    sweeps: int = 10,
) -> MovedDesign:
    """Improve a design by moving one coordinate at a time.

    Parameters
    ----------
    evaluate : (which (b,), values (b, c)) -> rows (b, r, o + p), NaN where not allowed; asked for
        all units and all levels of one coordinate at once. Rows of a unit may depend on that unit's
        number and coordinates only.
    design0 : (u, c) coordinates to start from. levels : for each of the c coordinates, the values
        (k,) that it may take; none for one that stays.
    criterion : D, I or A. start : what is known before. sweeps : at most, over all coordinates.

    Returns
    -------
    MovedDesign; the same for the same arguments.

    Raises
    ------
    EstimationError
        A unit of the first design is not allowed, or the units cannot determine the unknowns.
    """
    design = np.array(design0, dtype=np.float64)
    numbers = np.arange(len(design))
    rows = np.array(evaluate(numbers, design))
    wrong = np.flatnonzero(~allowed(rows))
    if len(wrong):
        raise EstimationError(
            f"unit {wrong[0]} of the first design is not allowed; start from units that are"
        )
    seen = _probed(evaluate, design, rows, levels)
    space = directions(seen, start)
    require_enough(len(design), rows, start, space)
    scoring = make_scoring(
        seen[allowed(seen)], len(design) / int(allowed(seen).sum()), criterion, start, space
    )
    history, evaluated = [_score(scoring, rows)], len(seen)
    for _ in range(sweeps):
        used = scoring if np.isfinite(history[-1]) else scoring.lent(RIDGE)
        for c, values in enumerate(levels):
            moved = np.repeat(design[:, None], len(values), axis=1)
            moved[:, :, c] = values
            which = np.repeat(numbers, len(values))
            found = evaluate(which, moved.reshape(-1, design.shape[1])) if len(values) else rows[:0]
            evaluated += len(which)
            best = _moves(used, rows, found.reshape(len(design), len(values), *rows.shape[1:]))
            chosen = np.flatnonzero(best >= 0)
            design[chosen, c] = np.asarray(values)[best[chosen]]
            rows[chosen] = found.reshape(len(design), len(values), *rows.shape[1:])[
                chosen, best[chosen]
            ]
        history.append(_score(scoring, rows))
        if history[-1] - history[-2] < ENOUGH * scoring.height:
            break
    if not np.isfinite(history[-1]):
        raise EstimationError(
            f"{len(design)} units were moved and still leave some of the {space.unknowns} unknowns "
            "open;"
            " ask for more units or state tolerances as prior knowledge"
        )
    values = tuple(scoring.value(score) for score in history)
    return MovedDesign(design, rows, values[-1], values, evaluated, space)


def _probed(
    evaluate: Evaluate, design: FloatArray, rows: FloatArray, levels: Sequence[FloatArray]
) -> FloatArray:
    """Rows of the design, and of its units moved to random levels of all coordinates at once."""
    random = np.random.default_rng(0)
    moved = np.tile(design, (PROBES, 1))
    for c, values in enumerate(levels):
        if len(values):
            moved[:, c] = random.choice(np.asarray(values), len(moved))
    return np.concatenate([rows, evaluate(np.tile(np.arange(len(design)), PROBES), moved)])


def _score(scoring: Scoring, rows: FloatArray) -> float:
    """Score of a design; -inf where it leaves a direction open."""
    R = scoring.factor(scoring.ready(rows))
    return scoring.score(R) if determines(R) else -np.inf


def _moves(scoring: Scoring, rows: FloatArray, found: FloatArray) -> IntArray:
    """Best level (u,) of each unit in turn, -1 where it stays: rows (u, r, c) at present, found (u,
    k, r, c).
    """
    u, k = found.shape[:2]
    best = np.full(u, -1, dtype=np.int64)
    usable = allowed(found.reshape(u * k, *rows.shape[1:])).reshape(u, k)
    now = scoring.ready(rows)
    tried = scoring.ready(np.where(usable[:, :, None, None], found, 0.0))
    R = scoring.factor(now)
    score = scoring.score(R)
    for i in np.flatnonzero(usable.any(axis=1)):
        seen = see(scoring, R, np.concatenate([now[i : i + 1], tried[i]]))
        gain = swaps(seen, seen.Y[0], None if seen.V is None else seen.V[0])[1:]
        gain = np.where(usable[i], gain, -np.inf)
        if gain.max() <= GAIN * scoring.height:
            continue
        level = int(np.argmax(gain))
        old = now[i].copy()
        now[i] = tried[i, level]
        new_R = scoring.factor(now)
        new = scoring.score(new_R)
        if new > score:
            R, score, best[i] = new_R, new, level
        else:
            now[i] = old
    return best
