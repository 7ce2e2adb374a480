# SPDX-License-Identifier: Apache-2.0
"""Certified designs: a convex relaxation with its bound, and exchange algorithms, whose designs no
swap (Fedorov) or no move of a coordinate improves. Derivations: docs/theory/planning.md.

The relaxation maximizes the score of M(w) = M_0 + sum w_i X_i'X_i over weights of sum n, w_i >= 0,
and w_i <= 1 where a group may be measured once only. With d_i the derivative of the score by w_i
and d_0 the derivative by a multiple of the prior, every design of n groups satisfies

    score <= score(w) + h log((d_0 + sum of the n largest d_i) / h)

for any w (with repeats: n times the largest d_i). At the optimum this is the equivalence theorem of
Kiefer and Wolfowitz. The weights of the candidates that matter maximize a logarithmic barrier,

    t score(w) + sum log w_i + sum log(c - w_i)   over sum w = n,   t growing,

by Newton's method on the weights and the prices of their limits; other candidates enter while the
bound shows that they could help. With Y = X R^-1 at the present weights and V = Y P', the second
derivatives of the score are

    D: -|Y_i Y_k'|^2 (minus the part of the nuisance columns)
    I, A: d_i d_k - 2 <Y_i Y_k', V_i V_k'> / |P|^2

At the maximum of the barrier the score is within (number of limits) / t of the best; Boyd and
Vandenberghe, Convex Optimization (2004), chapter 11.

Fedorov exchange chooses from a list of candidates. Group after group of the design, in random
order, is replaced by the candidate that gains most (the order of exchanges of Cook and Nachtsheim).
A certified design begins with the rounding of the relaxed design, is perturbed and exchanged again.
Coordinate exchange has no list: one coordinate of one group moves to the best of a
few levels (Meyer and Nachtsheim 1995, Technometrics 37). Both compute the gain of all alternatives
at once with the formulas of `design_space`, compute the factor anew after every exchange, and
accept an exchange only if the new score is larger.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from loopcal.errors import EstimationError
from loopcal.planning.design_space import (
    Criterion,
    DesignProblem,
    ObservableSpace,
    PriorInformation,
    ScaledCandidates,
    Scoring,
    SwapTerms,
    compute_slopes,
    compute_swap_terms,
    divide_by_factor,
    find_slope_columns,
    is_allowed,
    is_determined,
    score_additions,
    score_swaps,
)
from loopcal.typing import FloatArray, IntArray, Progress, report_no_progress

ROUNDS = 40  # largest number of times that candidates enter the barrier problem
WARM_UP = 12  # multiplicative steps over all candidates that select those to begin with
NEWTON_STEPS = 100  # largest number of Newton steps
GROWTH = 10.0  # factor from the t that the prices of the limits belong to, to that of the next step


@dataclass(frozen=True, eq=False)
class RelaxedDesign:
    """The best design with fractional weights, and its certificate."""

    weights: FloatArray  # (N,) of sum n; at most 1 without repeats
    # (N,) derivatives of the score by the weights; 0 where a group is not allowed
    slopes: FloatArray
    value: float  # of the criterion at these weights
    bound: float  # no design of n groups is better than this value
    candidates: ScaledCandidates  # the allowed groups
    converged: bool  # whether value and bound agree within the requested gap

    def efficiency(self, value: float) -> float:
        """Return a lower bound on the efficiency of a design with this value, 0 to 1."""
        return self.candidates.problem.compare(value, self.bound)


def relax_design(problem: DesignProblem, n: int, gap: float = 1e-3) -> RelaxedDesign:
    """Return the best fractional weights of n groups, and the bound.

    gap : of the efficiency at which to stop. The bound holds whether or not it was reached.
    """
    candidates = problem.scale_candidates(n)
    scoring, indices = candidates.scoring, candidates.indices
    w, d, score, best = _solve(candidates, n, gap)
    weights, slopes = np.zeros(len(problem.rows)), np.zeros(len(problem.rows))
    weights[indices], slopes[indices] = w, d
    converged = bool(score >= best + scoring.height * np.log1p(-gap))
    value, bound = scoring.value(score), scoring.value(best)
    return RelaxedDesign(weights, slopes, value, bound, candidates, converged)


def _solve(
    candidates: ScaledCandidates, n: int, gap: float
) -> tuple[FloatArray, FloatArray, float, float]:
    """Maximize by barrier over the candidates that matter, adding others while they could help.

    Returns weights (N,), slopes (N,), their score, and the smallest bound of the score.
    """
    scoring, scaled, repeats = candidates.scoring, candidates.rows, candidates.repeats
    N, cap = len(scaled), np.inf if repeats else 1.0

    def measure(w: FloatArray) -> tuple[FloatArray, float, float]:
        """Return the slopes at weights, their score, and the bound that follows."""
        R = _factor(scoring, scaled, w)
        columns, score = find_slope_columns(scoring, R), scoring.score(R)
        d = compute_slopes(scaled, columns)
        d0 = float(compute_slopes(scoring.prior_rows[None], columns)[0])  # by the prior's weight
        most = n * d.max() if repeats else np.partition(d, N - n)[N - n :].sum()
        return d, score, score + scoring.height * float(np.log((d0 + most) / scoring.height))

    w, bound = np.full(N, n / N), np.inf
    if n == N and not repeats:
        d, score, _ = measure(w)
        return w, d, score, score
    for _ in range(WARM_UP):
        d, score, limit = measure(w)
        bound = min(bound, limit)
        w = w * np.sqrt(d)
        if not w.sum() > 0.0:  # no group adds information to the prior: all designs are equal
            return np.full(N, n / N), d, score, score
        w *= n / w.sum()
    order, count = np.argsort(-w, kind="stable"), max(2 * n, 40)
    while count < len(w) and not candidates.is_determined(order[:count]):
        count *= 2
    chosen = order[:count]
    inside = np.full(len(chosen), n / len(chosen))
    target, rounds = 0.2 * gap, 0
    while True:
        rounds += 1
        inside = _maximize_weights(scoring, scaled[chosen], inside, cap, target)
        w = np.zeros(N)
        w[chosen] = inside
        d, score, limit = measure(w)
        bound = min(bound, limit)
        if rounds == ROUNDS or score >= bound + scoring.height * np.log1p(-gap):
            return w, d, score, bound
        # The slope that a group must exceed to deserve a weight: the mean of those partly used,
        # weighted by how free they are.
        free = w * np.clip(cap - w, 0.0, 1.0)
        price = float((free * d).sum() / free.sum()) if free.sum() > 0.0 else float(d[w > 0].min())
        outside = np.setdiff1d(np.flatnonzero(d > price), chosen)
        if not len(outside):
            target *= 0.2
        entering = outside[np.argsort(-d[outside], kind="stable")][:n]
        keep = (inside > 1e-6 * n / N) | (d[chosen] > price)
        chosen = np.concatenate([chosen[keep], entering])
        inside = np.concatenate([inside[keep], np.zeros(len(entering))])
        # a tenth of equal weights moves all of them inside the limits
        inside = 0.9 * inside * (n / inside.sum()) + 0.1 * n / len(inside)
        if inside.max() >= cap:
            inside = np.full(len(inside), n / len(inside))


def _factor(scoring: Scoring, scaled: FloatArray, w: FloatArray) -> FloatArray:
    """Return R of the prior and groups with weights w (N,)."""
    used = w > 0.0
    return scoring.factor(np.sqrt(w[used])[:, None, None] * scaled[used])


def _maximize_weights(
    scoring: Scoring, scaled: FloatArray, w: FloatArray, cap: float, gap: float
) -> FloatArray:
    """Return weights (s,) with the same sum, 0 < w < cap, whose score is within `gap` of the best,
    as a share of the efficiency.

    The distances of the weights from their limits have prices, 1 / t of these distances at the
    maximum of the barrier; Newton's method solves for both (primal-dual interior points).

    scaled : (s, r, Q) of a nonsingular set of groups.
    """
    sides = np.array([[1.0], [-1.0]])[: 2 if np.isfinite(cap) else 1]

    def measure_room(w: FloatArray) -> FloatArray:
        """Return the distances (1 | 2, s) of weights from their limits."""
        return np.stack([w, cap - w])[: len(sides)]

    R, room = _factor(scoring, scaled, w), measure_room(w)
    last = room.size / (gap * scoring.height)
    t = min(room.size / scoring.height, last)
    price = 1.0 / (t * room)
    for _ in range(NEWTON_STEPS):
        t = min(max(t, GROWTH * room.size / float((price * room).sum())), last)
        slope, curvature = differentiate_score(scoring, scaled, R)
        gradient = slope + (sides / room).sum(axis=0) / t
        # In units of each weight's own barrier, so that the system is well scaled however small a
        # weight is.
        unit = 1.0 / np.sqrt((price / room).sum(axis=0))
        system = np.eye(len(w)) - unit[:, None] * curvature * unit
        x, y = np.linalg.solve(system, np.stack([unit * gradient, unit], axis=1)).T
        step = unit * (x - y * (unit @ x) / (unit @ y))
        turn = 1.0 / (t * room) - price - price / room * sides * step
        gain, length = t * float(gradient @ step), _limit_length(room, sides * step)
        if t == last and gain < 1e-2:
            return w + length * step
        # along the step, until the barrier has grown by at least a tenth of the predicted gain
        before = t * scoring.score(R) + np.log(room).sum()
        while True:
            trial = w + length * step
            R, room = _factor(scoring, scaled, trial), measure_room(trial)
            after = t * scoring.score(R) + np.log(room).sum()
            if after >= before + 0.1 * length * gain:
                break
            length *= 0.5
            if length < 1e-8:
                return w
        w, price = trial, price + _limit_length(price, turn) * turn
    return w


def _limit_length(values: FloatArray, step: FloatArray) -> float:
    """Return the part of a step, at most 1, that leaves positive values a twentieth at least."""
    room = np.full(values.shape, np.inf)
    np.divide(-values, step, out=room, where=step < 0.0)
    return min(1.0, 0.95 * float(room.min()))


def differentiate_score(
    scoring: Scoring, scaled: FloatArray, R: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return first (s,) and second (s, s) derivatives of the score by the weights of groups
    (s, r, Q), at the factor R (Q, Q).
    """
    o = scoring.n_nuisance
    Y = divide_by_factor(scaled, R)
    if scoring.prediction is None:
        curvature = -_multiply_pairs(Y, Y)
        if o:
            curvature += _multiply_pairs(Y[:, :, :o], Y[:, :, :o])
        return (Y[:, :, o:] ** 2).sum(axis=(1, 2)), curvature
    P = scoring.predict(R)
    V, trace = Y[:, :, o:] @ P.T, float((P**2).sum())
    slope = (V**2).sum(axis=(1, 2)) / trace
    return slope, slope[:, None] * slope - 2.0 * _multiply_pairs(Y, V) / trace


def _multiply_pairs(Y: FloatArray, V: FloatArray) -> FloatArray:
    """Return <Y_i Y_k', V_i V_k'> = <Y_i' V_i, Y_k' V_k> (s, s) of rows (s, r, Q) and (s, r, q)."""
    s, r, q = V.shape
    if 2 * r * r > q:  # fewer operations
        products = (Y.swapaxes(1, 2) @ V).reshape(s, -1)
        return products @ products.T
    # row by row of the groups, so that the sum runs over whole matrices (s, s)
    first, second = (x.swapaxes(0, 1).reshape(r * s, -1) for x in (Y, V))
    products = (first @ first.T) * (second @ second.T)
    return products.reshape(r, s, r, s).sum(axis=(0, 2))


GAIN = 1e-7  # an exchange or a move must multiply the efficiency by more than 1 + this
# Ridge that is added to a singular start, as a ratio of standard deviations to the mean design.
RIDGE = 1e-3
EXCHANGES = 100  # exchanges of each group of a design, on average and at most: a few are enough
# Default number of perturbations: the first over the number of groups, at least the second.
PERTURBATIONS, LEAST_PERTURBATIONS = 1600, 20
# Efficiency from which a design is not perturbed: the remaining gain is not worth the time.
GOOD = 0.99
PERTURBED = 0.15  # share of the groups that a perturbation replaces; at least two groups
# Candidates of the exchange after a perturbation: the first times the size of the design, at
# least the second.
AMONG, FEWEST = 6, 100
CURVE_PERTURBATIONS = 10  # number of perturbations of each design of a curve
SINGULAR_EXCESS = 1.0 + 1e-9  # excess of a size without a regular design: the next is a step larger
ROUNDING = 1e-12  # excess that meets a target: the rounding of a criterion
BOUND_GAP = 3e-3  # gap of the relaxation where only the size is needed


@dataclass(frozen=True, eq=False)
class Design:
    """A chosen set of groups with its certificate."""

    chosen: IntArray  # (n,) indices of the candidates, ascending
    value: float  # of the criterion
    relaxed: RelaxedDesign  # weights and bound
    # whether no single exchange improves it; False where the exchanges ran out
    is_converged: bool

    @property
    def efficiency(self) -> float:
        """Lower bound on the efficiency relative to the best possible design."""
        return self.relaxed.efficiency(self.value)


def choose_design(
    problem: DesignProblem,
    n: int,
    seed: int = 0,
    perturbations: int | None = None,
    gap: float = 1e-3,
    first: Iterable[IntArray] = (),
    progress: Progress = report_no_progress,
) -> Design:
    """Choose n of N groups, with a certificate.

    perturbations : their number; default PERTURBATIONS / n. gap : of the relaxation.
    first : more designs to start from; one of fewer than n groups is completed by the groups that
        gain most.
    """
    relaxed = relax_design(problem, n, gap)
    candidates, random = relaxed.candidates, np.random.default_rng(seed)
    scoring, usable = candidates.scoring, candidates.indices
    weights, slopes = relaxed.weights[usable], relaxed.slopes[usable]
    begins = [_round_weights(weights, n, problem.repeats)]
    begins += [_complete_design(candidates, np.searchsorted(usable, done), n) for done in first]
    ends = [exchange_from_start(candidates, begin, random) for begin in begins]
    chosen, history = max(ends, key=lambda end: end[1][-1])
    _require_determined(history[-1], n, len(usable), scoring.space)
    times = max(PERTURBATIONS // n, LEAST_PERTURBATIONS) if perturbations is None else perturbations
    if times and relaxed.efficiency(scoring.value(history[-1])) < GOOD:
        steep = np.argsort(-slopes, kind="stable")[: max(AMONG * n, FEWEST)]
        among = np.union1d(steep, chosen)
        best = _perturb(
            candidates.take(among),
            np.searchsorted(among, chosen),
            weights[among],
            times,
            random,
            progress,
        )
        chosen, history = _exchange_groups(candidates, among[best], random)
    value = scoring.value(history[-1])
    return Design(np.sort(usable[chosen]), value, relaxed, not _is_exhausted(history, n))


def _require_determined(score: float, n: int, count: int, space: ObservableSpace) -> None:
    """Refuse the best of n of `count` groups where its score says that it is singular."""
    if not np.isfinite(score):
        counts: dict[str, Any] = {"chosen": n, "available": count, "unknowns": space.n_unknowns}
        raise EstimationError.of("plan.design-singular", **counts)


def exchange_from_start(
    candidates: ScaledCandidates, chosen: IntArray, stream: np.random.Generator
) -> tuple[IntArray, list[float]]:
    """Exchange from one start; a singular start is first exchanged with a ridge."""
    if not candidates.is_determined(chosen):
        ridged = replace(candidates, scoring=candidates.scoring.with_ridge(RIDGE))
        chosen, _ = _exchange_groups(ridged, chosen, stream)
        if not candidates.is_determined(chosen):
            return chosen, [-np.inf]
    return _exchange_groups(candidates, chosen, stream)


def _exchange_groups(
    candidates: ScaledCandidates, chosen: IntArray, stream: np.random.Generator
) -> tuple[IntArray, list[float]]:
    """Exchange the chosen groups (n,) until no single swap gains; they must be nonsingular.

    Returns the groups, and the scores at the beginning and after each exchange.
    """
    scoring, rows = candidates.scoring, candidates.rows
    chosen, n, least = chosen.copy(), len(chosen), GAIN * scoring.height

    def prepare(R: FloatArray) -> tuple[FloatArray, IntArray, SwapTerms]:
        """Return all slopes, the groups that may gain, and the terms of the chosen and of these."""
        slopes = compute_slopes(rows, find_slope_columns(scoring, R))
        may_gain = slopes > slopes[chosen].min()
        may_gain[chosen] &= candidates.repeats
        listed = np.flatnonzero(may_gain)
        return slopes, listed, compute_swap_terms(scoring, R, rows[np.append(chosen, listed)])

    R = candidates.factor(chosen)
    history, (slopes, listed, terms) = [scoring.score(R)], prepare(R)
    idle = np.zeros(n, dtype=bool)  # groups that no swap has improved since the last exchange
    while not (idle.all() or _is_exhausted(history, n)):
        for j in stream.permutation(n).tolist():
            # The score is concave: a swap gains at most the difference of the slopes.
            useful = np.flatnonzero(slopes[listed] > slopes[chosen[j]] + 0.5 * least)
            gain = score_swaps(terms, j, n + useful) if len(useful) else np.zeros(0)
            idle[j] = True
            if gain.max(initial=-np.inf) > least:
                trial = chosen.copy()
                trial[j] = listed[useful[np.argmax(gain)]]
                R = candidates.factor(trial)
                score = scoring.score(R)
                if score > history[-1]:
                    chosen, idle = trial, np.zeros(n, dtype=bool)
                    slopes, listed, terms = prepare(R)
                    history.append(score)
            if idle.all() or _is_exhausted(history, n):
                break
    return chosen, history


def _is_exhausted(history: Sequence[float], n: int) -> bool:
    """Return whether the exchange of n groups ended because it had made all of its exchanges."""
    return len(history) > EXCHANGES * n


def _complete_design(candidates: ScaledCandidates, chosen: IntArray, n: int) -> IntArray:
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


def _round_weights(weights: FloatArray, n: int, repeats: bool) -> IntArray:
    """Round weights (N,) of sum n to n groups: whole parts first, then the largest remainders."""
    whole = np.floor(weights if repeats else 0.0 * weights).astype(np.int64)
    order = np.argsort(whole - weights, kind="stable")
    whole[order[: n - int(whole.sum())]] += 1
    return np.repeat(np.arange(len(weights)), whole)


def _perturb(
    candidates: ScaledCandidates,
    best: IntArray,
    weights: FloatArray,
    times: int,
    random: np.random.Generator,
    progress: Progress,
) -> IntArray:
    """Return the best groups (n,) after perturbing a design and exchanging it among candidates."""
    # a design found again has the same score up to rounding: in one order, it is the same design
    n, repeats, best = len(best), candidates.repeats, np.sort(best)
    score = candidates.scoring.score(candidates.factor(best))
    count = min(n, max(2, round(PERTURBED * n)))
    for done in range(times if len(candidates) > n or repeats else 0):
        progress(done, times, "exchanging poses")
        kept = random.permutation(best)[count:]
        new = draw_groups(candidates, random, n, weights)
        new = new if repeats else np.setdiff1d(new, kept, assume_unique=True)
        trial = np.concatenate([kept, new[:count]])
        if not candidates.is_determined(trial):
            continue
        trial, history = _exchange_groups(candidates, trial, random)
        if history[-1] >= score:
            best, score = np.sort(trial), history[-1]
    return best


# Designs of several sizes.


def compute_design_curve(
    problem: DesignProblem,
    sizes: Sequence[int],
    seed: int = 0,
    perturbations: int = CURVE_PERTURBATIONS,
    progress: Progress = report_no_progress,
) -> list[Design]:
    """Return designs of several sizes, ascending; each starts from the one before, too, so that
    none is worse than a smaller one.

    `progress` receives the sizes that are done.
    """
    designs: list[Design] = []
    for done, n in enumerate(sorted(set(sizes))):
        progress(done, len(set(sizes)), "computing the error by the number of poses")
        first = [designs[-1].chosen] if designs else []
        designs.append(choose_design(problem, n, seed, perturbations, first=first))
    return designs


def find_smallest_design(
    problem: DesignProblem,
    target: float,
    most: int | None = None,
    seed: int = 0,
    perturbations: int = CURVE_PERTURBATIONS,
    evaluate: Callable[[IntArray], float] | None = None,
) -> tuple[Design, int]:
    """Return the smallest design found whose criterion is at least as good as a target, and the
    size below which no design can be.

    target : value of the criterion (for I a variance: the square of an rms standard deviation).
    most : largest number of groups; default: all that are allowed.
    evaluate : from the groups (n,) of a design to what must meet the target in place of the
        criterion, and is never better than it. Below the returned size no design is then as good
        in the criterion as the design found.
    """
    count = len(problem.allowed)
    most = count if most is None else most if problem.repeats else min(most, count)
    problem.require_enough(most)
    bounds, made = dict[int, float](), dict[int, Design]()

    def find_least(target: float, low: int, high: int) -> int:
        def excess(n: int) -> float:
            bounds[n] = relax_design(problem, n, BOUND_GAP).bound
            return problem.compare(target, bounds[n])

        return search_size(excess, low, high)

    def make(n: int) -> float:
        smaller = [k for k in made if k < n]
        first = [made[max(smaller)].chosen] if smaller else []
        try:
            made[n] = choose_design(problem, n, seed, perturbations, first=first)
        except EstimationError as error:
            if error.code != "plan.design-singular" or n == most:
                raise
            return SINGULAR_EXCESS
        value = made[n].value if evaluate is None else evaluate(made[n].chosen)
        return problem.compare(target, value)

    at_least = find_least(target, problem.n_needed, most)
    name = problem.criterion.name
    numbers = {"size": most, "available": count, "criterion": name, "target": target}
    if at_least > most:
        best = bounds[most]
        raise EstimationError.of("plan.target-impossible", best=best, **numbers)
    n = search_size(make, at_least, most)
    if n > most:
        best = made[most].value
        raise EstimationError.of("plan.target-not-reached", best=best, **numbers)
    if evaluate is not None:
        at_least = find_least(made[n].value, at_least, n)
    return made[n], at_least


def search_size(excess: Callable[[int], float], low: int, high: int) -> int:
    """Return the smallest size from low to high whose excess is 1 or less, else high + 1.

    excess : variance of a size over the target. The next size is that which meets the target where
        information grows with the size. Until one meets it, steps at least double and sizes at most
        do; then every other step halves the interval. Larger sizes are assumed to meet it, too.
    """
    failed, met, size, step, halve = low - 1, high + 1, low, 1, False
    while failed + 1 < met:
        times = excess(size)
        failed, met = (failed, size) if times <= 1.0 + ROUNDING else (size, met)
        guess = np.ceil(size * times)
        if met > high:
            guess, step = min(max(guess, size + step), 2 * size), 2 * step
        elif halve:
            guess = (failed + met) // 2
        halve = met <= high and not halve
        size = int(min(max(guess, failed + 1), met - 1))
    return met


# Coordinate exchange.

# (b,) indices of groups, (b, c) coordinates -> rows (b, r, o + p), NaN where not allowed.
LinearizeGroups = Callable[[IntArray, FloatArray], FloatArray]
SWEEP_GAIN = 1e-3  # sweeps end when one has multiplied the efficiency by less than 1 + this
# Copies of each group at random levels, which with the first design define the observable
# directions.
PROBES = 4


@dataclass(frozen=True, eq=False)
class MovedDesign:
    """A design of groups that were moved."""

    design: FloatArray  # (u, c) coordinates
    rows: FloatArray  # (u, r, o + p) of it
    # value of the criterion before the first sweep (-inf for D, inf for I and A where it is
    # singular), and after each
    history: tuple[float, ...]
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
    """
    design = np.array(design0, dtype=np.float64)
    indices = np.arange(len(design))
    rows = np.array(linearize(indices, design))
    excluded = np.flatnonzero(~is_allowed(rows))
    if len(excluded):
        raise EstimationError(
            f"group {excluded[0]} of the first design is forbidden. Start from allowed groups"
        )
    random, moved = np.random.default_rng(0), np.tile(design, (PROBES, 1))
    for c, values in enumerate(levels):
        if len(values):
            moved[:, c] = random.choice(np.asarray(values), len(moved))
    probes = np.concatenate([rows, linearize(np.tile(indices, PROBES), moved)])
    problem = DesignProblem(probes, criterion, prior, repeats=True)
    problem.require_enough(len(design))
    scoring = problem.build_scoring(len(design))

    def score_rows() -> float:
        """Return the score of the design; -inf where it is singular."""
        R = scoring.factor(scoring.scale_rows(rows))
        return scoring.score(R) if is_determined(R) else -np.inf

    history, is_converged = [score_rows()], False
    for sweep in range(sweeps):
        used = scoring if np.isfinite(history[-1]) else scoring.with_ridge(RIDGE)
        for c, values in enumerate(levels):
            progress(sweep * len(levels) + c, sweeps * len(levels), "moving points")
            moved = np.repeat(design[:, None], len(values), axis=1)
            moved[:, :, c] = values
            which, flat = np.repeat(indices, len(values)), moved.reshape(-1, design.shape[1])
            trials = linearize(which, flat) if len(values) else rows[:0]
            trials = trials.reshape(len(design), len(values), *rows.shape[1:])
            best = _choose_levels(used, rows, trials)
            accepted = np.flatnonzero(best >= 0)
            design[accepted, c] = np.asarray(values)[best[accepted]]
            rows[accepted] = trials[accepted, best[accepted]]
        history.append(score_rows())
        is_converged = history[-1] - history[-2] < SWEEP_GAIN * scoring.height
        if is_converged:
            break
    _require_determined(history[-1], len(design), len(design), problem.space)
    values = tuple(scoring.value(score) for score in history)
    return MovedDesign(design, rows, values, is_converged)


def _choose_levels(scoring: Scoring, rows: FloatArray, trials: FloatArray) -> IntArray:
    """Return the best level (u,) of each group in turn, -1 where it stays.

    rows : (u, r, c) at present. trials : (u, k, r, c) at the levels.
    """
    u, k = trials.shape[:2]
    best = np.full(u, -1, dtype=np.int64)
    usable = is_allowed(trials.reshape(u * k, *rows.shape[1:])).reshape(u, k)
    present = scoring.scale_rows(rows)
    scaled = scoring.scale_rows(np.where(usable[:, :, None, None], trials, 0.0))
    R, least = scoring.factor(present), GAIN * scoring.height
    score, columns = scoring.score(R), find_slope_columns(scoring, R)
    for i in np.flatnonzero(usable.any(axis=1)):
        rows = np.concatenate([present[i : i + 1], scaled[i]])
        slopes = compute_slopes(rows, columns)
        # as for groups, a level gains at most the difference of the slopes
        useful = np.flatnonzero(usable[i] & (slopes[1:] > slopes[0] + 0.5 * least))
        if not len(useful):
            continue
        terms = compute_swap_terms(scoring, R, rows[np.append(0, useful + 1)])
        gain = score_swaps(terms, 0)[1:]
        if gain.max() <= least:
            continue
        level = int(useful[np.argmax(gain)])
        old = present[i].copy()
        present[i] = scaled[i, level]
        new_R = scoring.factor(present)
        new_score = scoring.score(new_R)
        if new_score > score:
            R, score, best[i] = new_R, new_score, level
            columns = find_slope_columns(scoring, R)
        else:
            present[i] = old
    return best
