# SPDX-License-Identifier: Apache-2.0
"""A good design with its certificate: the relaxation rounded, exchanged, and shaken out of local
optima.

The relaxed design says which candidates matter (those of the steepest slopes) and how good any
design can be. Its rounding is exchanged among them; then a few units are again and again replaced
by others drawn with the relaxed weights, the rest is exchanged anew, and the result is kept where
it is better. The end is exchanged among all candidates. See docs/theory/planning.md.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from loopcal.errors import EstimationError
from loopcal.planning.criteria import Criterion
from loopcal.planning.design import Design, Start, allowed
from loopcal.planning.fedorov import TOO_FEW, drawn, exchange, grown, rounded, settle
from loopcal.planning.relaxation import Relaxed, relaxed_design
from loopcal.planning.scoring import Scoring, determines, make_scoring
from loopcal.typing import FloatArray, IntArray

SHAKES, LEAST_SHAKES = 1600, 20
"""Times that a design is shaken by default: this number over the number of units, and at least so
often.
"""

GOOD = 0.99
"""Efficiency from which a design is not shaken: what is left is not worth the time."""

SHAKEN = 0.15
"""Share of the units replaced in a shake, two at least."""

AMONG, FEWEST = 6, 100
"""Candidates among which a shaken design is exchanged: this many times the design, and at least so
many.
"""


@dataclass(frozen=True, eq=False)
class Certified:
    """A design and how good it is.

    Attributes
    ----------
    design : the units. relaxed : weights and bound. efficiency : the design is at least this share
        of the best possible.
    """

    design: Design
    relaxed: Relaxed
    efficiency: float


def certified_design(
    rows: FloatArray,
    n: int,
    criterion: Criterion,
    start: Start,
    seed: int = 0,
    shakes: int | None = None,
    repeats: bool = False,
    gap: float = 1e-3,
    first: Iterable[IntArray] = (),
) -> Certified:
    """Choose n of N units, with a certificate.

    Parameters
    ----------
    rows, n, criterion, start, seed, repeats, first : as of `fedorov_exchange`.
    shakes : how often to shake; default: SHAKES / n. gap : of the relaxation.

    Raises
    ------
    EstimationError
        n units cannot determine the unknowns, or fewer are allowed than asked for.
    """
    relaxed = relaxed_design(rows, n, criterion, start, gap, repeats)
    space, usable = relaxed.directions, np.flatnonzero(allowed(rows))
    scoring = make_scoring(rows[usable], n / len(usable), criterion, start, space)
    ready, random = scoring.ready(rows[usable]), np.random.default_rng(seed)
    weights, slopes = relaxed.weights[usable], relaxed.slopes[usable]
    begins = [
        rounded(weights, n, repeats),
        *(grown(scoring, ready, np.searchsorted(usable, c), n, repeats) for c in first),
    ]
    chosen, history = max(
        (settle(scoring, ready, begin, random, repeats) for begin in begins),
        key=lambda found: found[1][-1],
    )
    if not np.isfinite(history[-1]):
        raise EstimationError(TOO_FEW.format(n=n, allowed=len(usable), unknowns=space.unknowns))
    steep = np.argsort(-slopes, kind="stable")[: max(AMONG * n, FEWEST)]
    among = np.union1d(steep, chosen)
    times = max(SHAKES // n, LEAST_SHAKES) if shakes is None else shakes
    begin = np.searchsorted(among, chosen)
    if relaxed.efficiency(scoring.value(history[-1])) >= GOOD:
        times = 0
    best, scores = _shaken(scoring, ready[among], begin, weights[among], times, random, repeats)
    chosen, last = exchange(scoring, ready, among[best], random, repeats)
    values = tuple(scoring.value(score) for score in (*history, *scores, *last[1:]))
    ends = tuple(scoring.value(score) for score in (history[-1], last[-1]))
    design = Design(np.sort(usable[chosen]), values[-1], values, ends, space)
    return Certified(design, relaxed, relaxed.efficiency(design.value))


def _shaken(
    scoring: Scoring,
    ready: FloatArray,
    best: IntArray,
    weights: FloatArray,
    shakes: int,
    random: np.random.Generator,
    repeats: bool,
) -> tuple[IntArray, list[float]]:
    """Shake a design and exchange among ready units (N, r, Q): the best units, and the scores that
    were better.
    """
    n = len(best)
    scores = [scoring.score(scoring.factor(ready[best]))]
    count = min(n, max(2, round(SHAKEN * n)))
    for _ in range(shakes if len(ready) > n or repeats else 0):
        kept = random.permutation(best)[count:]
        new = drawn(random, len(ready), n, repeats, weights)
        tried = np.concatenate(
            [kept, (new if repeats else np.setdiff1d(new, kept, assume_unique=True))[:count]]
        )
        if not determines(scoring.factor(ready[tried])):
            continue
        tried, history = exchange(scoring, ready, tried, random, repeats)
        if history[-1] >= scores[-1]:
            best = tried
            scores.append(history[-1])
    return best, scores[1:]
