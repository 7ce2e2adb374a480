# SPDX-License-Identifier: Apache-2.0
"""Weights of a few units that maximise a score, by Newton's method on a logarithmic barrier.

    maximise  t score(w) + sum log w_i + sum log(c - w_i)   over sum w = n,   t growing

With Y = X R^-1 at the present weights and V = Y P', the second derivatives of the score are

    D: -|Y_i Y_k'|^2 (own columns' part taken away)        I, A: d_i d_k - 2 <Y_i Y_k', V_i V_k'> / |P|^2

At the maximum of the barrier the score is within (number of constraints) / t of the best. Boyd and
Vandenberghe, Convex Optimization (2004), chapter 11; derivation: docs/theory/planning.md.
"""

from __future__ import annotations

import numpy as np

from loopcal.planning.scoring import Scoring
from loopcal.typing import FloatArray

STEPS = 40
"""Newton steps at most for one t."""

GROWTH = 20.0
"""Factor from one t to the next."""


def maximise(
    scoring: Scoring, ready: FloatArray, w: FloatArray, cap: float | None, gap: float
) -> FloatArray:
    """Return weights (s,) with the sum of w whose score is within `gap` of the best, as a share of
    the efficiency.

    Parameters
    ----------
    ready : (s, r, Q) of a nonsingular set of units. w : (s,) inside all constraints. cap : c; None
        without.
    """
    constraints = len(w) * (1 if cap is None else 2)
    last = constraints / (gap * scoring.height)
    t = min(constraints / scoring.height, last)
    while True:
        w = _centre(scoring, ready, w, cap, t)
        if t >= last:
            return w
        t = min(GROWTH * t, last)


def _centre(
    scoring: Scoring, ready: FloatArray, w: FloatArray, cap: float | None, t: float
) -> FloatArray:
    """Newton's method for one t."""
    for _ in range(STEPS):
        slope, curve = derivatives(scoring, ready, w)
        gradient, bend = t * slope + 1.0 / w, 1.0 / w**2
        if cap is not None:
            gradient, bend = gradient - 1.0 / (cap - w), bend + 1.0 / (cap - w) ** 2
        # In units of each weight's own barrier, so that the system is well scaled however small a
        # weight is.
        unit = 1.0 / np.sqrt(bend)
        system = np.eye(len(w)) - t * unit[:, None] * curve * unit
        right = np.stack([unit * gradient, unit], axis=1)
        solved = np.linalg.solve(system, right)
        step = unit * (solved[:, 0] - solved[:, 1] * (unit @ solved[:, 0]) / (unit @ solved[:, 1]))
        decrement = float(gradient @ step)
        if decrement < 1e-2:
            return w + step if _inside(w + step, cap) else w
        w = _search(scoring, ready, w, cap, t, step, decrement)
    return w


def _search(
    scoring: Scoring,
    ready: FloatArray,
    w: FloatArray,
    cap: float | None,
    t: float,
    step: FloatArray,
    decrement: float,
) -> FloatArray:
    """Go along a step, staying inside, as far as the barrier grows by at least a tenth of what is
    promised.
    """
    room = np.where(step < 0.0, -w / np.where(step < 0.0, step, -1.0), np.inf)
    if cap is not None:
        room = np.minimum(
            room, np.where(step > 0.0, (cap - w) / np.where(step > 0.0, step, 1.0), np.inf)
        )
    length, before = min(1.0, 0.95 * float(room.min())), _barrier(scoring, ready, w, cap, t)
    while length > 1e-8:
        tried = w + length * step
        if _barrier(scoring, ready, tried, cap, t) >= before + 0.1 * length * decrement:
            return tried
        length *= 0.5
    return w


def _inside(w: FloatArray, cap: float | None) -> bool:
    """Tell whether all weights are strictly inside."""
    return bool((w > 0.0).all() and (cap is None or (w < cap).all()))


def _barrier(
    scoring: Scoring, ready: FloatArray, w: FloatArray, cap: float | None, t: float
) -> float:
    """Value of the barrier function."""
    walls = np.log(w).sum() + (0.0 if cap is None else np.log(cap - w).sum())
    return t * scoring.score(scoring.factor(np.sqrt(w)[:, None, None] * ready)) + float(walls)


def derivatives(
    scoring: Scoring, ready: FloatArray, w: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """First (s,) and second (s, s) derivatives of the score by the weights."""
    R, o = scoring.factor(np.sqrt(w)[:, None, None] * ready), scoring.own
    Y = ready @ np.linalg.inv(R)
    if scoring.spread is None:
        curve = -_sums(_products(Y) ** 2, len(w))
        if o:
            curve += _sums(_products(Y[:, :, :o]) ** 2, len(w))
        return (Y[:, :, o:] ** 2).sum(axis=(1, 2)), curve
    P = scoring.spreading(R)
    V, trace = Y[:, :, o:] @ P.T, float((P**2).sum())
    slope = (V**2).sum(axis=(1, 2)) / trace
    return slope, slope[:, None] * slope - 2.0 * _sums(_products(Y) * _products(V), len(w)) / trace


def _products(Y: FloatArray) -> FloatArray:
    """All products of rows (s r, s r)."""
    flat = Y.reshape(-1, Y.shape[-1])
    return flat @ flat.T


def _sums(products: FloatArray, s: int) -> FloatArray:
    """Sums over the blocks (s, s) of products (s r, s r)."""
    r = len(products) // s
    return products.reshape(s, r, s, r).sum(axis=(1, 3))
