# SPDX-License-Identifier: Apache-2.0
"""Exchange algorithms: designs that no swap (Fedorov) or no move of a coordinate improves.

Fedorov exchange chooses from a list of candidates. Group after group of the design, in random
order, is replaced by the candidate that gains most (the order of exchanges of Cook and
Nachtsheim). Coordinate exchange has no list: one coordinate of one group moves to the best of a few
levels (Meyer and Nachtsheim 1995, Technometrics 37). Both compute the gain of all alternatives at
once with the formulas of `scoring`, compute the factor anew after every exchange, and accept an
exchange only if the new score is larger. Sources and derivations: docs/theory/planning.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from loopcal.errors import EstimationError
from loopcal.findings import report_finding
from loopcal.planning.design_space import (
    GAIN,
    RIDGE,
    Criterion,
    D,
    Design,
    ObservableSpace,
    PriorInformation,
    ScaledCandidates,
    Scoring,
    build_scoring,
    compute_swap_terms,
    count_groups_needed,
    find_observable_space,
    is_allowed,
    is_determined,
    require_enough,
    scale_candidates,
    score_additions,
    score_swaps,
)
from loopcal.planning.relaxation import RelaxedDesign, relax_design
from loopcal.typing import FloatArray, IntArray, Progress, report_no_progress

# (b,) indices of groups, (b, c) coordinates -> rows (b, r, o + p), NaN where not allowed.
LinearizeGroups = Callable[[IntArray, FloatArray], FloatArray]
SWEEP_GAIN = 1e-3  # sweeps end when one has multiplied the efficiency by less than 1 + this
EXCHANGES = 100  # exchanges of each group of a design, on average and at most: a few are enough
# Copies of each group at random levels, which with the first design define the observable
# directions.
PROBES = 4


def fedorov_exchange(
    rows: FloatArray,
    n: int,
    criterion: Criterion,
    prior: PriorInformation,
    seed: int = 0,
    starts: int = 20,
    repeats: bool = False,
    relaxed: RelaxedDesign | None = None,
    first: Iterable[IntArray] = (),
) -> Design:
    """Choose n of N groups by exchange from several starts.

    rows : (N, r, o + p) whitened and in tolerances; NaN where a group is not allowed.
    n : number of groups to choose. starts : their number.
    repeats : whether a group may be chosen more than once.
    relaxed : the relaxed design of the same problem. Its rounding is one more start, and random
        starts are drawn with its weights instead of evenly.
    first : more designs to start from; one of fewer than n groups is completed by the groups that
        gain most.
    Returns Design; the best of all starts.
    """
    candidates, weights = (
        (scale_candidates(rows, n, criterion, prior, repeats), None)
        if relaxed is None
        else (relaxed.candidates, relaxed.weights[relaxed.candidates.indices])
    )
    begins = list_starts(candidates, n, weights, first)
    if not begins and starts < 1:
        raise EstimationError(f"exchange needs a start; {starts} were requested, give 1 or more")
    ends = []
    for i, stream in enumerate(np.random.default_rng(seed).spawn(len(begins) + starts)):
        begin = begins[i] if i < len(begins) else draw_groups(candidates, stream, n, weights)
        ends.append(exchange_from_start(candidates, begin, stream))
    scoring, scores = candidates.scoring, [history[-1] for _, history in ends]
    chosen, history = ends[int(np.argmax(scores))]
    require_determined(history[-1], n, len(candidates), scoring.space)
    values = tuple(scoring.value(score) for score in history)
    final = tuple(scoring.value(score) for score in scores)
    chosen = np.sort(candidates.indices[chosen])
    is_converged = not is_exhausted(history, n)
    return Design(chosen, values[-1], values, final, scoring.space, is_converged)


def list_starts(
    candidates: ScaledCandidates, n: int, weights: FloatArray | None, first: Iterable[IntArray]
) -> list[IntArray]:
    """Return the rounding of weights (N,), where given, and the completed first designs.

    first : designs by the indices of their groups among all.
    """
    rounded = [] if weights is None else [round_weights(weights, n, candidates.repeats)]
    places = (np.searchsorted(candidates.indices, chosen) for chosen in first)
    return rounded + [complete_design(candidates, chosen, n) for chosen in places]


def require_determined(score: float, n: int, count: int, space: ObservableSpace) -> None:
    """Refuse the best of n of `count` groups where its score says that it is singular."""
    if not np.isfinite(score):
        raise EstimationError(
            report_finding(
                "plan.design-singular", chosen=n, available=count, unknowns=space.n_unknowns
            )
        )


def exchange_from_start(
    candidates: ScaledCandidates, chosen: IntArray, stream: np.random.Generator
) -> tuple[IntArray, list[float]]:
    """Exchange from one start; a singular start is first exchanged with a ridge."""
    if not candidates.is_determined(chosen):
        ridged = replace(candidates, scoring=candidates.scoring.with_ridge(RIDGE))
        chosen, _ = exchange_groups(ridged, chosen, stream)
        if not candidates.is_determined(chosen):
            return chosen, [-np.inf]
    return exchange_groups(candidates, chosen, stream)


def exchange_groups(
    candidates: ScaledCandidates, chosen: IntArray, stream: np.random.Generator
) -> tuple[IntArray, list[float]]:
    """Exchange the chosen groups (n,) until no single swap gains; they must be nonsingular.

    Returns chosen : (n,). history : scores at the beginning and after each exchange; see
        `is_exhausted`.
    """
    scoring, rows = candidates.scoring, candidates.rows
    chosen, n = chosen.copy(), len(chosen)
    R = candidates.factor(chosen)
    history, terms, idle = [scoring.score(R)], compute_swap_terms(scoring, R, rows), 0
    while idle < n and not is_exhausted(history, n):
        for j in stream.permutation(n):
            gain = score_swaps(terms, int(chosen[j]))
            if not candidates.repeats:
                gain[chosen] = -np.inf
            idle += 1
            if gain.max() > GAIN * scoring.height:
                trial = chosen.copy()
                trial[j] = int(np.argmax(gain))
                R = candidates.factor(trial)
                score = scoring.score(R)
                if score > history[-1]:
                    chosen, terms, idle = trial, compute_swap_terms(scoring, R, rows), 0
                    history.append(score)
            if idle >= n or is_exhausted(history, n):
                break
    return chosen, history


def is_exhausted(history: Sequence[float], n: int) -> bool:
    """Return whether the exchange of n groups ended because it had made all of its exchanges."""
    return len(history) > EXCHANGES * n


def complete_design(candidates: ScaledCandidates, chosen: IntArray, n: int) -> IntArray:
    """Return a design (n,): the chosen groups, and one after another the groups that gain most."""
    scoring = candidates.scoring
    scoring = scoring if candidates.is_determined(chosen) else scoring.with_ridge(RIDGE)
    while len(chosen) < n:
        R = scoring.factor(candidates.rows[chosen])
        gain = score_additions(compute_swap_terms(scoring, R, candidates.rows))
        if not candidates.repeats:
            gain[chosen] = -np.inf
        chosen = np.append(chosen, np.argmax(gain))
    return chosen


def draw_groups(
    candidates: ScaledCandidates, stream: np.random.Generator, n: int, weights: FloatArray | None
) -> IntArray:
    """Draw n of N groups, evenly or by weights; every group has a small weight, so that n exist."""
    N = len(candidates)
    share = None if weights is None else (weights + 1e-3 * n / N) / (weights + 1e-3 * n / N).sum()
    return stream.choice(N, n, replace=candidates.repeats, p=share)


def round_weights(weights: FloatArray, n: int, repeats: bool) -> IntArray:
    """Round weights (N,) of sum n to n groups: whole parts first, then the largest remainders."""
    whole = (
        np.floor(weights).astype(np.int64) if repeats else np.zeros(len(weights), dtype=np.int64)
    )
    order = np.argsort(whole - weights, kind="stable")
    whole[order[: n - int(whole.sum())]] += 1
    return np.repeat(np.arange(len(weights)), whole)


@dataclass(frozen=True, eq=False)
class MovedDesign:
    """A design of groups that were moved."""

    design: FloatArray  # (u, c) coordinates
    rows: FloatArray  # (u, r, o + p) of it
    value: float  # of the criterion
    # value before the first sweep (-inf for D, inf for I and A where it is singular), and after
    # each
    history: tuple[float, ...]
    evaluated: int  # number of groups that were linearized in all
    space: ObservableSpace  # the directions in which the value counts
    # whether the last sweep gained hardly anything; False where the sweeps ran out
    is_converged: bool


def coordinate_exchange(
    linearize: LinearizeGroups,
    design0: FloatArray,
    levels: Sequence[FloatArray],
    criterion: Criterion,
    prior: PriorInformation,
    sweeps: int = 10,
    progress: Progress = report_no_progress,
) -> MovedDesign:
    """Improve a design by moving one coordinate of one group at a time.

    linearize : (indices (b,), coordinates (b, c)) -> rows (b, r, o + p), NaN where not allowed. It
        is called for all groups and all levels of one coordinate at once. Rows of a group may
        depend on its index and its coordinates only, so that an accepted move leaves the rows of
        the other groups valid.
    design0 : (u, c) coordinates to start from.
    levels : for each of the c coordinates its allowed values (k,); none for one that stays.
    sweeps : largest number of passes over all coordinates.
    Returns MovedDesign; the same for the same arguments.
    """
    design = np.array(design0, dtype=np.float64)
    indices = np.arange(len(design))
    rows = np.array(linearize(indices, design))
    excluded = np.flatnonzero(~is_allowed(rows))
    if len(excluded):
        raise EstimationError(
            f"group {excluded[0]} of the first design is not allowed; start from groups that are"
        )
    probes = _probe_levels(linearize, design, rows, levels)
    space = find_observable_space(probes, prior)
    require_enough(len(design), rows, prior, space)
    allowed = is_allowed(probes)
    weight = len(design) / int(allowed.sum())
    scoring = build_scoring(probes[allowed], weight, criterion, prior, space)
    history, evaluated, is_converged = [_score_design(scoring, rows)], len(probes), False
    for sweep in range(sweeps):
        used = scoring if np.isfinite(history[-1]) else scoring.with_ridge(RIDGE)
        for c, values in enumerate(levels):
            progress(sweep * len(levels) + c, sweeps * len(levels), "moving points")
            moved = np.repeat(design[:, None], len(values), axis=1)
            moved[:, :, c] = values
            which, flat = np.repeat(indices, len(values)), moved.reshape(-1, design.shape[1])
            trials = linearize(which, flat) if len(values) else rows[:0]
            trials = trials.reshape(len(design), len(values), *rows.shape[1:])
            evaluated += len(which)
            best = _choose_levels(used, rows, trials)
            accepted = np.flatnonzero(best >= 0)
            design[accepted, c] = np.asarray(values)[best[accepted]]
            rows[accepted] = trials[accepted, best[accepted]]
        history.append(_score_design(scoring, rows))
        is_converged = history[-1] - history[-2] < SWEEP_GAIN * scoring.height
        if is_converged:
            break
    require_determined(history[-1], len(design), len(design), space)
    values = tuple(scoring.value(score) for score in history)
    return MovedDesign(design, rows, values[-1], values, evaluated, space, is_converged)


def _probe_levels(
    linearize: LinearizeGroups, design: FloatArray, rows: FloatArray, levels: Sequence[FloatArray]
) -> FloatArray:
    """Return rows of the design and of its groups moved to random levels of all coordinates."""
    random = np.random.default_rng(0)
    moved = np.tile(design, (PROBES, 1))
    for c, values in enumerate(levels):
        if len(values):
            moved[:, c] = random.choice(np.asarray(values), len(moved))
    return np.concatenate([rows, linearize(np.tile(np.arange(len(design)), PROBES), moved)])


def _score_design(scoring: Scoring, rows: FloatArray) -> float:
    """Return the score of a design; -inf where it is singular."""
    R = scoring.factor(scoring.scale_rows(rows))
    return scoring.score(R) if is_determined(R) else -np.inf


def _choose_levels(scoring: Scoring, rows: FloatArray, trials: FloatArray) -> IntArray:
    """Return the best level (u,) of each group in turn, -1 where it stays.

    rows : (u, r, c) at present. trials : (u, k, r, c) at the levels.
    """
    u, k = trials.shape[:2]
    best = np.full(u, -1, dtype=np.int64)
    usable = is_allowed(trials.reshape(u * k, *rows.shape[1:])).reshape(u, k)
    present = scoring.scale_rows(rows)
    scaled = scoring.scale_rows(np.where(usable[:, :, None, None], trials, 0.0))
    R = scoring.factor(present)
    score = scoring.score(R)
    for i in np.flatnonzero(usable.any(axis=1)):
        terms = compute_swap_terms(scoring, R, np.concatenate([present[i : i + 1], scaled[i]]))
        gain = np.where(usable[i], score_swaps(terms, 0)[1:], -np.inf)
        if gain.max() <= GAIN * scoring.height:
            continue
        level = int(np.argmax(gain))
        old = present[i].copy()
        present[i] = scaled[i, level]
        new_R = scoring.factor(present)
        new_score = scoring.score(new_R)
        if new_score > score:
            R, score, best[i] = new_R, new_score, level
        else:
            present[i] = old
    return best


# A good design with its certificate: relaxation, rounding, exchange and perturbation.

# Default number of perturbations: the first over the number of groups, at least the second.
PERTURBATIONS, LEAST_PERTURBATIONS = 1600, 20
# Efficiency from which a design is not perturbed: the remaining gain is not worth the time.
GOOD = 0.99
PERTURBED = 0.15  # share of the groups that a perturbation replaces; at least two groups
# Candidates of the exchange after a perturbation: the first times the size of the design, at
# least the second.
AMONG, FEWEST = 6, 100
CURVE_PERTURBATIONS = 10  # number of perturbations of each design of a curve
BOUND_GAP = 3e-3  # gap of the relaxation where only the size is needed


@dataclass(frozen=True, eq=False)
class CertifiedDesign:
    """A design and its certificate."""

    design: Design  # the chosen groups
    relaxed: RelaxedDesign  # weights and bound
    efficiency: float  # lower bound on the efficiency relative to the best possible design


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

    rows, n, criterion, prior, seed, repeats, first : see `fedorov_exchange`.
    perturbations : their number; default PERTURBATIONS / n. gap : of the relaxation.
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

    Returns best : (n,) the best groups. scores : those that were better than all before.
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
    """Values of designs by their number of groups."""

    sizes: IntArray  # (k,) numbers of groups, ascending
    values: FloatArray  # (k,) of the criterion, never worse with more groups
    bounds: FloatArray  # (k,) values that no design of the same size exceeds
    designs: tuple[CertifiedDesign, ...]  # k designs


@dataclass(frozen=True, eq=False)
class SmallestDesign:
    """The smallest design found that meets a target."""

    n: int  # its number of groups
    at_least: int  # no smaller number of groups can meet the target
    certified: CertifiedDesign  # the design
    curve: DesignCurve  # all designs that the search made


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

    target : value of the criterion (for I a variance: the square of an rms standard deviation).
    most : largest number of groups; default: all that are allowed.
    others : see `choose_design`.
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

    n : first size to try. q : number of observable directions.
    """
    low, limit, step = low - 1, high + 1, 0
    high = limit
    while high - low > 1:
        n = min(max(n, low + 1), high - 1)
        value, step = value_of(n), step + 1
        low, high = (
            (low, n)
            if (value >= target if isinstance(criterion, D) else value <= target)
            else (n, high)
        )
        if step % 2:
            growth = np.exp((target - value) / q) if isinstance(criterion, D) else value / target
            n = int(np.ceil(n * min(growth, 4.0)))
        else:
            n = 2 * n if high == limit else (low + high) // 2
    return high


def _collect_curve(designs: list[CertifiedDesign]) -> DesignCurve:
    """Return the curve of designs, ascending in size."""
    sizes = np.array([len(made.design.chosen) for made in designs], dtype=np.int64)
    values = np.array([made.design.value for made in designs])
    bounds = np.array([made.relaxed.bound for made in designs])
    return DesignCurve(sizes, values, bounds, tuple(designs))
