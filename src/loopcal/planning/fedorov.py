# SPDX-License-Identifier: Apache-2.0
"""Fedorov exchange: from a set of candidates, swap one chosen against one not chosen while the
criterion improves.

Unit after unit of the design, in random order, is exchanged for the candidate that gains most (the
order of exchanges of Cook and Nachtsheim), all candidates being tried at once by the formulas of
`swaps`. The factor is made anew after every exchange, and an exchange counts only if the score so
made has grown. The end is a design that no single swap improves. Sources and derivation:
docs/theory/planning.md.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from loopcal.errors import EstimationError
from loopcal.planning.criteria import Criterion
from loopcal.planning.design import Design, Start, allowed, directions, require_enough
from loopcal.planning.relaxation import Relaxed
from loopcal.planning.scoring import GAIN, RIDGE, Scoring, determines, make_scoring
from loopcal.planning.swaps import additions, see, swaps
from loopcal.typing import FloatArray, IntArray

TOO_FEW = (
    "no {n} of the {allowed} allowed candidates were found that determine all {unknowns} unknowns;"
    " ask for more poses or state tolerances as prior knowledge"
)


def fedorov_exchange(
    rows: FloatArray,
    n: int,
    criterion: Criterion,
    start: Start,
    seed: int = 0,
    starts: int = 20,
    repeats: bool = False,
    relaxed: Relaxed | None = None,
    first: Iterable[IntArray] = (),
) -> Design:
    """Choose n of N units.

    Parameters
    ----------
    rows : (N, r, o + p) whitened and tolerance-scaled; NaN where a unit is not allowed.
    n : units to choose. criterion : D, I or A. start : what is known before.
    seed : of the random starts; start i has always the same stream. starts : their number.
    repeats : whether a unit may be chosen more than once.
    relaxed : the relaxed design of the same problem: its rounding is one more start, and random
        starts are drawn with its weights instead of evenly.
    first : more designs to start from; where one has fewer than n units, those are added that gain
        most.

    Returns
    -------
    Design; the best of all starts.

    Raises
    ------
    EstimationError
        n units cannot determine the unknowns, fewer are allowed than asked for, or there is nothing
        to start from.
    """
    space = directions(rows, start) if relaxed is None else relaxed.directions
    require_enough(n, rows, start, space, repeats)
    usable = np.flatnonzero(allowed(rows))
    scoring = make_scoring(rows[usable], n / len(usable), criterion, start, space)
    ready = scoring.ready(rows[usable])
    weights = None if relaxed is None else relaxed.weights[usable]
    begins = [] if weights is None else [rounded(weights, n, repeats)]
    begins += [
        grown(scoring, ready, np.searchsorted(usable, chosen), n, repeats) for chosen in first
    ]
    if not begins and starts < 1:
        raise EstimationError(
            f"an exchange of {starts} starts has nothing to begin with; ask for one at least"
        )
    streams = np.random.default_rng(seed).spawn(len(begins) + starts)
    found = []
    for i, stream in enumerate(streams):
        chosen = begins[i] if i < len(begins) else drawn(stream, len(usable), n, repeats, weights)
        found.append(settle(scoring, ready, chosen, stream, repeats))
    scores = [history[-1] for _, history in found]
    chosen, history = found[int(np.argmax(scores))]
    if not np.isfinite(history[-1]):
        raise EstimationError(TOO_FEW.format(n=n, allowed=len(usable), unknowns=space.unknowns))
    values = tuple(scoring.value(score) for score in history)
    ends = tuple(scoring.value(score) for score in scores)
    return Design(np.sort(usable[chosen]), values[-1], values, ends, space)


def settle(
    scoring: Scoring,
    ready: FloatArray,
    chosen: IntArray,
    stream: np.random.Generator,
    repeats: bool,
) -> tuple[IntArray, list[float]]:
    """Exchange from one start, with a ridge first where the start leaves directions open."""
    if not determines(scoring.factor(ready[chosen])):
        chosen, _ = exchange(scoring.lent(RIDGE), ready, chosen, stream, repeats)
        if not determines(scoring.factor(ready[chosen])):
            return chosen, [-np.inf]
    return exchange(scoring, ready, chosen, stream, repeats)


def exchange(
    scoring: Scoring,
    ready: FloatArray,
    chosen: IntArray,
    stream: np.random.Generator,
    repeats: bool,
) -> tuple[IntArray, list[float]]:
    """Exchange units chosen (n,) of ready ones (N, r, Q), nonsingular, until none has a better one.

    Returns
    -------
    chosen : (n,). history : scores at the beginning and after each exchange.
    """
    chosen, n = chosen.copy(), len(chosen)
    R = scoring.factor(ready[chosen])
    history, seen, idle = [scoring.score(R)], see(scoring, R, ready), 0
    while idle < n:
        for j in stream.permutation(n):
            out = chosen[j]
            gain = swaps(seen, seen.Y[out], None if seen.V is None else seen.V[out])
            if not repeats:
                gain[chosen] = -np.inf
            idle += 1
            if gain.max() > GAIN * scoring.height:
                tried = chosen.copy()
                tried[j] = int(np.argmax(gain))
                R = scoring.factor(ready[tried])
                score = scoring.score(R)
                if score > history[-1]:
                    chosen, seen, idle = tried, see(scoring, R, ready), 0
                    history.append(score)
            if idle >= n:
                break
    return chosen, history


def grown(scoring: Scoring, ready: FloatArray, chosen: IntArray, n: int, repeats: bool) -> IntArray:
    """Return a design (n,) made of chosen units, at most n, and those whose additions gain most,
    one after another.
    """
    lent = scoring if determines(scoring.factor(ready[chosen])) else scoring.lent(RIDGE)
    while len(chosen) < n:
        gain = additions(see(lent, lent.factor(ready[chosen]), ready))
        if not repeats:
            gain[chosen] = -np.inf
        chosen = np.append(chosen, np.argmax(gain))
    return chosen


def drawn(
    stream: np.random.Generator, N: int, n: int, repeats: bool, weights: FloatArray | None
) -> IntArray:
    """Draw n of N units, evenly or by weights (with a little for every unit, so that n can be
    drawn).
    """
    share = None if weights is None else (weights + 1e-3 * n / N) / (weights + 1e-3 * n / N).sum()
    return stream.choice(N, n, replace=repeats, p=share)


def rounded(weights: FloatArray, n: int, repeats: bool) -> IntArray:
    """Round weights (N,) of sum n to n units: whole parts first, then the largest remainders."""
    whole = (
        np.floor(weights).astype(np.int64) if repeats else np.zeros(len(weights), dtype=np.int64)
    )
    order = np.argsort(whole - weights, kind="stable")
    whole[order[: n - int(whole.sum())]] += 1
    return np.repeat(np.arange(len(weights)), whole)
