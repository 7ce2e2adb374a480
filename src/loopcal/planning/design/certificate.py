# SPDX-License-Identifier: Apache-2.0
"""A good design with its certificate: relaxation, rounding, exchange and perturbation.

The relaxed design shows which candidates matter (those of the steepest slopes) and how good any
design can be. Its rounding is exchanged among these candidates. Then a few groups are replaced
again and again by others, drawn with the relaxed weights, the design is exchanged anew, and the
result is kept where it is better. The last exchange is among all candidates. See
docs/theory/planning.md.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from loopcal.planning.design.criteria import Criterion
from loopcal.planning.design.design_space import Design, PriorInformation, is_allowed
from loopcal.planning.design.exchange import (
    complete_design,
    draw_groups,
    exchange_from_start,
    exchange_groups,
    require_determined,
    round_weights,
)
from loopcal.planning.design.relaxation import RelaxedDesign, relax_design
from loopcal.planning.design.scoring import Scoring, build_scoring, is_determined
from loopcal.typing import FloatArray, IntArray, Progress, report_no_progress

PERTURBATIONS, LEAST_PERTURBATIONS = 1600, 20
"""Default number of perturbations: the first over the number of groups, at least the second."""

GOOD = 0.99
"""Efficiency from which a design is not perturbed: the remaining gain is not worth the time."""

PERTURBED = 0.15
"""Share of the groups that a perturbation replaces; at least two groups."""

AMONG, FEWEST = 6, 100
"""Candidates of the exchange after a perturbation: the first times the size of the design, at least
the second.
"""


@dataclass(frozen=True, eq=False)
class CertifiedDesign:
    """A design and its certificate.

    Attributes
    ----------
    design : the chosen groups. relaxed : weights and bound.
    efficiency : lower bound on the efficiency relative to the best possible design.
    """

    design: Design
    relaxed: RelaxedDesign
    efficiency: float


def choose_design(
    rows: FloatArray,
    n: int,
    criterion: Criterion,
    prior: PriorInformation,
    seed: int = 0,
    perturbations: int | None = None,
    repeats: bool = False,
    gap: float = 1e-3,
    first: Iterable[IntArray] = (),
    progress: Progress = report_no_progress,
) -> CertifiedDesign:
    """Choose n of N groups, with a certificate.

    Parameters
    ----------
    rows, n, criterion, prior, seed, repeats, first : see `fedorov_exchange`.
    perturbations : their number; default PERTURBATIONS / n.
    gap : of the relaxation. progress : receives the perturbations that are done.

    Raises
    ------
    EstimationError
        n groups cannot determine the unknowns, or fewer are allowed than requested.
    """
    relaxed = relax_design(rows, n, criterion, prior, gap, repeats)
    space, usable = relaxed.space, np.flatnonzero(is_allowed(rows))
    scoring = build_scoring(rows[usable], n / len(usable), criterion, prior, space)
    scaled, random = scoring.scale_rows(rows[usable]), np.random.default_rng(seed)
    weights, slopes = relaxed.weights[usable], relaxed.slopes[usable]
    begins = [
        round_weights(weights, n, repeats),
        *(
            complete_design(scoring, scaled, np.searchsorted(usable, chosen), n, repeats)
            for chosen in first
        ),
    ]
    chosen, history = max(
        (exchange_from_start(scoring, scaled, begin, random, repeats) for begin in begins),
        key=lambda end: end[1][-1],
    )
    require_determined(history[-1], n, len(usable), space)
    steep = np.argsort(-slopes, kind="stable")[: max(AMONG * n, FEWEST)]
    among = np.union1d(steep, chosen)
    times = max(PERTURBATIONS // n, LEAST_PERTURBATIONS) if perturbations is None else perturbations
    begin = np.searchsorted(among, chosen)
    if relaxed.efficiency(scoring.value(history[-1])) >= GOOD:
        times = 0
    best, scores = _perturb(
        scoring, scaled[among], begin, weights[among], times, random, repeats, progress
    )
    chosen, last = exchange_groups(scoring, scaled, among[best], random, repeats)
    values = tuple(scoring.value(score) for score in (*history, *scores, *last[1:]))
    ends = tuple(scoring.value(score) for score in (history[-1], last[-1]))
    design = Design(np.sort(usable[chosen]), values[-1], values, ends, space)
    return CertifiedDesign(design, relaxed, relaxed.efficiency(design.value))


def _perturb(
    scoring: Scoring,
    scaled: FloatArray,
    best: IntArray,
    weights: FloatArray,
    times: int,
    random: np.random.Generator,
    repeats: bool,
    progress: Progress,
) -> tuple[IntArray, list[float]]:
    """Perturb a design and exchange it among scaled groups (N, r, Q).

    Returns
    -------
    best : (n,) the best groups. scores : those that were better than all before.
    """
    n = len(best)
    scores = [scoring.score(scoring.factor(scaled[best]))]
    count = min(n, max(2, round(PERTURBED * n)))
    for done in range(times if len(scaled) > n or repeats else 0):
        progress(done, times, "exchanging poses")
        kept = random.permutation(best)[count:]
        new = draw_groups(random, len(scaled), n, repeats, weights)
        trial = np.concatenate(
            [kept, (new if repeats else np.setdiff1d(new, kept, assume_unique=True))[:count]]
        )
        if not is_determined(scoring.factor(scaled[trial])):
            continue
        trial, history = exchange_groups(scoring, scaled, trial, random, repeats)
        if history[-1] >= scores[-1]:
            best = trial
            scores.append(history[-1])
    return best, scores[1:]
