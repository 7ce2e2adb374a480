# SPDX-License-Identifier: Apache-2.0
"""A good design with its certificate: relaxation, rounding, exchange and perturbation.

The relaxed design shows which candidates matter (those of the steepest slopes) and how good any
design can be. Its rounding is exchanged among these candidates. Then a few groups are replaced
again and again by others, drawn with the relaxed weights, the design is exchanged anew, and the
result is kept where it is better. The last exchange is among all candidates. See
docs/theory/planning.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from loopcal.errors import EstimationError
from loopcal.findings import report_finding
from loopcal.planning.design.criteria import Criterion, D
from loopcal.planning.design.design_space import (
    Design,
    PriorInformation,
    count_groups_needed,
    find_observable_space,
    is_allowed,
    require_enough,
)
from loopcal.planning.design.exchange import (
    draw_groups,
    exchange_from_start,
    exchange_groups,
    is_exhausted,
    list_starts,
    require_determined,
)
from loopcal.planning.design.relaxation import RelaxedDesign, relax_design
from loopcal.planning.design.scoring import ScaledCandidates
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

CURVE_PERTURBATIONS = 10
"""Number of perturbations of each design of a curve."""

BOUND_GAP = 3e-3
"""Gap of the relaxation where only the size is needed."""


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
    candidates, random = relaxed.candidates, np.random.default_rng(seed)
    scoring, usable = candidates.scoring, candidates.indices
    weights, slopes = relaxed.weights[usable], relaxed.slopes[usable]
    chosen, history = max(
        (
            exchange_from_start(candidates, begin, random)
            for begin in list_starts(candidates, n, weights, first)
        ),
        key=lambda end: end[1][-1],
    )
    require_determined(history[-1], n, len(usable), scoring.space)
    steep = np.argsort(-slopes, kind="stable")[: max(AMONG * n, FEWEST)]
    among = np.union1d(steep, chosen)
    times = max(PERTURBATIONS // n, LEAST_PERTURBATIONS) if perturbations is None else perturbations
    begin = np.searchsorted(among, chosen)
    if relaxed.efficiency(scoring.value(history[-1])) >= GOOD:
        times = 0
    best, scores = _perturb(candidates.take(among), begin, weights[among], times, random, progress)
    chosen, last = exchange_groups(candidates, among[best], random)
    values = tuple(scoring.value(score) for score in (*history, *scores, *last[1:]))
    ends = tuple(scoring.value(score) for score in (history[-1], last[-1]))
    final = np.sort(usable[chosen]), values[-1], values, ends, scoring.space
    design = Design(*final, is_converged=not is_exhausted(last, n))
    return CertifiedDesign(design, relaxed, relaxed.efficiency(design.value))


def _perturb(
    candidates: ScaledCandidates,
    best: IntArray,
    weights: FloatArray,
    times: int,
    random: np.random.Generator,
    progress: Progress,
) -> tuple[IntArray, list[float]]:
    """Perturb a design and exchange it among the candidates (N).

    Returns
    -------
    best : (n,) the best groups. scores : those that were better than all before.
    """
    # a design found again has the same score up to rounding: in one order, it is the same design
    n, repeats, best = len(best), candidates.repeats, np.sort(best)
    scores = [candidates.scoring.score(candidates.factor(best))]
    count = min(n, max(2, round(PERTURBED * n)))
    for done in range(times if len(candidates) > n or repeats else 0):
        progress(done, times, "exchanging poses")
        kept = random.permutation(best)[count:]
        new = draw_groups(candidates, random, n, weights)
        new = new if repeats else np.setdiff1d(new, kept, assume_unique=True)
        trial = np.concatenate([kept, new[:count]])
        if not candidates.is_determined(trial):
            continue
        trial, history = exchange_groups(candidates, trial, random)
        if history[-1] >= scores[-1]:
            best = np.sort(trial)
            scores.append(history[-1])
    return best, scores[1:]


@dataclass(frozen=True, eq=False)
class DesignCurve:
    """Values of designs by their number of groups.

    Attributes
    ----------
    sizes : (k,) numbers of groups, ascending.
    values : (k,) of the criterion, never worse with more groups.
    bounds : (k,) values that no design of the same size exceeds.
    designs : k designs.
    """

    sizes: IntArray
    values: FloatArray
    bounds: FloatArray
    designs: tuple[CertifiedDesign, ...]


@dataclass(frozen=True, eq=False)
class SmallestDesign:
    """The smallest design found that meets a target.

    Attributes
    ----------
    n : its number of groups. at_least : no smaller number of groups can meet the target.
    certified : the design. curve : all designs that the search made.
    """

    n: int
    at_least: int
    certified: CertifiedDesign
    curve: DesignCurve


def compute_design_curve(
    rows: FloatArray,
    sizes: Sequence[int],
    criterion: Criterion,
    prior: PriorInformation,
    seed: int = 0,
    perturbations: int = CURVE_PERTURBATIONS,
    repeats: bool = False,
    progress: Progress = report_no_progress,
) -> DesignCurve:
    """Return designs of several sizes with their values and bounds; arguments as `choose_design`.

    `progress` receives the sizes that are done.

    Raises
    ------
    EstimationError
        The smallest size cannot determine the unknowns, or fewer candidates are allowed than the
        largest.
    """
    designs: list[CertifiedDesign] = []
    for done, n in enumerate(sorted(set(sizes))):
        progress(done, len(set(sizes)), "computing the error by the number of poses")
        first = [designs[-1].design.chosen] if designs else []
        designs.append(
            choose_design(rows, n, criterion, prior, seed, perturbations, repeats, first=first)
        )
    return _collect_curve(designs)


def find_smallest_design(
    rows: FloatArray,
    target: float,
    criterion: Criterion,
    prior: PriorInformation,
    most: int | None = None,
    seed: int = 0,
    perturbations: int = CURVE_PERTURBATIONS,
    repeats: bool = False,
) -> SmallestDesign:
    """Return the smallest design found whose criterion is at least as good as a target.

    Parameters
    ----------
    target : value of the criterion (for I a variance: the square of an rms standard deviation).
    most : largest number of groups; default: all that are allowed.
    others : see `choose_design`.

    Raises
    ------
    EstimationError
        No design of this many groups meets the target (so the bound says), or none was found.
    """
    count = int(is_allowed(rows).sum())
    most = count if most is None else most if repeats else min(most, count)
    space = find_observable_space(rows, prior)
    require_enough(most, rows, prior, space, repeats)
    bounds: dict[int, float] = {}

    def bound_of(n: int) -> float:
        bounds[n] = relax_design(rows, n, criterion, prior, BOUND_GAP, repeats).bound
        return bounds[n]

    made: dict[int, CertifiedDesign] = {}

    def value_of(n: int) -> float:
        smaller = [k for k in made if k < n]
        first = [made[max(smaller)].design.chosen] if smaller else []
        made[n] = choose_design(
            rows, n, criterion, prior, seed, perturbations, repeats, first=first
        )
        return made[n].design.value

    least, q = count_groups_needed(rows.shape[1], prior, space), len(space)
    at_least = search_size(bound_of, least, most, min(2 * least, most), criterion, target, q)
    numbers = {"size": most, "available": count, "criterion": criterion.name, "target": target}
    if at_least > most:
        raise EstimationError(
            report_finding("plan.target-impossible", best=bounds[most], **numbers)
        )
    n = search_size(value_of, at_least, most, at_least, criterion, target, q)
    if n > most:
        best = made[most].design.value
        raise EstimationError(report_finding("plan.target-not-reached", best=best, **numbers))
    return SmallestDesign(n, at_least, made[n], _collect_curve([made[k] for k in sorted(made)]))


def search_size(
    value_of: Callable[[int], float],
    low: int,
    high: int,
    n: int,
    criterion: Criterion,
    target: float,
    q: int,
) -> int:
    """Return the smallest size from low to high whose value meets the target, else high + 1.

    Values are assumed to be monotone. The next size is estimated as if the information grew with
    the size; every second step halves the interval, or doubles the size while no size has met the
    target.

    Parameters
    ----------
    n : first size to try. q : number of observable directions.
    """
    low, limit, step = low - 1, high + 1, 0
    high = limit
    while high - low > 1:
        n = min(max(n, low + 1), high - 1)
        value, step = value_of(n), step + 1
        low, high = (low, n) if _meets_target(criterion, value, target) else (n, high)
        if step % 2:
            growth = np.exp((target - value) / q) if isinstance(criterion, D) else value / target
            n = int(np.ceil(n * min(growth, 4.0)))
        else:
            n = 2 * n if high == limit else (low + high) // 2
    return high


def _meets_target(criterion: Criterion, value: float, target: float) -> bool:
    """Return whether a value is at least as good as the target."""
    return value >= target if isinstance(criterion, D) else value <= target


def _collect_curve(designs: list[CertifiedDesign]) -> DesignCurve:
    """Return the curve of designs, ascending in size."""
    sizes = np.array([len(made.design.chosen) for made in designs], dtype=np.int64)
    values = np.array([made.design.value for made in designs])
    bounds = np.array([made.relaxed.bound for made in designs])
    return DesignCurve(sizes, values, bounds, tuple(designs))
