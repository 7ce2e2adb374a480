# SPDX-License-Identifier: Apache-2.0
"""Search the observation blocks that a fit to all others does not explain.

Several wrong blocks hide each other. Therefore suspects are excluded, the others are fitted again
(linearly, which needs no kinematics), and every block is tested again, inside or outside the fit,
until the same blocks are suspected twice. A block is never excluded where the others would then
determine fewer parameters. A suspect is an outlier only where excluding another block would not do
as well: with j excluded instead of i, i must still be a suspect.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from loopcal.diagnose.fit_checks.influence import Influence, compute_influence
from loopcal.estimate.inference.residual_test import FEWEST_DEGREES, SIGNIFICANCE
from loopcal.estimate.linearization import Start
from loopcal.estimate.methods.penalties import decompose_for
from loopcal.estimate.problem import Problem
from loopcal.estimate.result import Identification
from loopcal.numerics.chi_square import (
    compute_chi_square_quantile,
    compute_chi_square_tail,
    compute_f_tail,
)
from loopcal.numerics.multiple_tests import compute_single_level
from loopcal.typing import BoolArray, FloatArray, IntArray, Progress, report_no_progress

MOST_ROUNDS = 20
"""Largest number of searches with other suspects."""

MOST_EXCLUDED = 0.5
"""Largest share of excluded blocks; beyond it nothing can be said of the others."""

SMALLEST_NOISE = 1e-12
"""Variance of the noise, in units of the stated one, below which residuals are rounding."""

MOST_COMPARED = 10
"""Suspects, farthest first, that are compared with others which would do as well; more suspects are
a matter of the model.
"""


class JudgingNoise(NamedTuple):
    """The noise by which each of u blocks is judged: that of the other fitted blocks.

    Attributes
    ----------
    variance : (u,) of the whitened rows, in units of the stated one.
    degrees : (u,) its degrees of freedom; infinite where the stated noise counts, 0 where nothing
        is known of it.
    """

    variance: FloatArray
    degrees: FloatArray


class PartialFit(NamedTuple):
    """A linear fit without some of u blocks, and its influence on every block.

    Attributes
    ----------
    excluded : (u,) blocks that are not fitted. influence : of all blocks.
    scale : factor on sigma; NaN where it is to be estimated and the fitted blocks do not show it.
    directions : number of directions that the fit determines.
    noise : by which noise each block is judged; by default that of `scale`, as if it were known.
    left : degrees of freedom of `scale`; 0 where the stated noise counts.
    """

    excluded: BoolArray
    influence: Influence
    scale: float
    directions: int
    noise: JudgingNoise | None = None
    left: float = 0.0

    @property
    def tested(self) -> int:
        """Number of blocks that have a degree of freedom."""
        return int((self.influence.degrees > 0).sum())

    @property
    def ratio(self) -> FloatArray:
        """(u,) distance per degree of freedom in units of the noise; zero without a test."""
        degrees = self.influence.degrees
        ratio = self.influence.distance / np.maximum(degrees, 1)
        variance = self.scale**2 if self.noise is None else self.noise.variance
        return np.where(degrees > 0, ratio, 0.0) / variance

    def p_value(self) -> FloatArray:
        """Return (u,) the probability of a larger distance; 1 where there is no test."""
        left = np.inf if self.noise is None else self.noise.degrees
        p_value = compute_f_tail(self.influence.degrees, left, self.ratio)
        return np.where(np.isnan(p_value), 1.0, p_value)

    @property
    def contradicts_noise(self) -> bool:
        """Whether the fitted blocks exceed the stated noise beyond doubt."""
        square = self.left * self.scale**2
        return self.left > 0.0 and bool(compute_chi_square_tail(self.left, square) < SIGNIFICANCE)

    def determines_as_much(self, whole: PartialFit) -> bool:
        """Return whether the fitted blocks determine as many directions as all blocks do, and the
        noise where it is estimated.
        """
        return self.directions >= whole.directions and bool(np.isfinite(self.scale))


class Refit(Protocol):
    """From the excluded blocks (u,) to the linear fit without them."""

    def __call__(self, excluded: BoolArray) -> PartialFit:
        """Fit without these blocks."""
        ...


@dataclass(frozen=True, eq=False)
class BlockSearch:
    """A search for blocks that do not fit.

    Attributes
    ----------
    refit : see `Refit`. whole : the fit to all blocks. limit : p-value below which a block is a
        suspect. fits : the fit without the suspects, or all fits of a cycle.
    """

    refit: Refit
    whole: PartialFit
    limit: float
    fits: tuple[PartialFit, ...]

    @property
    def end(self) -> PartialFit:
        """The last fit."""
        return self.fits[-1]

    @property
    def is_converged(self) -> bool:
        """Whether the same blocks were suspected twice."""
        return len(self.fits) == 1


def search_blocks(
    refit: Refit, low_weight: BoolArray, level: float, progress: Progress = report_no_progress
) -> BlockSearch:
    """Search the blocks that the others do not explain.

    Parameters
    ----------
    low_weight : (u,) blocks with a small weight in a robust fit; the search begins without them.
    level : probability of any suspect where all blocks are right.
    """
    whole = first = refit(np.zeros_like(low_weight))
    if low_weight.any() and (without := refit(low_weight)).determines_as_much(whole):
        first = without
    limit = compute_single_level(level, whole.tested)
    most = int(MOST_EXCLUDED * whole.tested)
    fits = search_suspects(refit, whole, first, limit, most, progress)
    return BlockSearch(refit, whole, limit, fits)


def fit_without(
    fit: Identification,
    problem: Problem,
    member: IntArray,
    excluded: BoolArray,
    deviation: FloatArray,
    start: Start,
    noise: str,
) -> PartialFit:
    """Fit linearly without the excluded blocks (u,), and compute the influence of every block.

    Parameters
    ----------
    fit : its method and rank tolerance are used. problem : of its data, unweighted.
    member : (n,) block of each pose. deviation, start : (1, p) to linearize at, and a warm start.
    noise : "given", or "estimated" from the fitted blocks.
    """
    weight = (~excluded).astype(np.float64)
    weighted = problem.weighted(weight[member])
    solution = weighted.solve(deviation, start, derivatives=True)
    kept = weighted.linearize_at(deviation, start, solution)
    d = decompose_for(fit.method, kept.factor, kept.equations, deviation, fit.spectrum.tolerance)
    penalty = np.array(fit.method.penalty(d), dtype=np.float64)
    fits = [(q, d.deviation(d.solution(q))) for q in (penalty, np.where(d.used, 0.0, np.inf))]
    # poses that are estimated depend on the excluded rows, which the influence needs
    shared = None if problem.is_uncertain else solution
    influence, plain = compute_influence(problem, kept, member, d, fits, weight, shared)
    left, is_given = float(d.rows[0] - d.rank[0]), noise == "given"
    judging = judge_noise(float(d.unexplained[0]), left, plain, excluded, is_given)
    scale, directions = 1.0 if is_given else np.nan, int(np.isfinite(penalty).sum())
    if left < (FEWEST_DEGREES if is_given else 1):
        return PartialFit(excluded, influence, scale, directions, judging)
    scale = float(np.sqrt(max(d.unexplained[0] / left, SMALLEST_NOISE)))
    return PartialFit(excluded, influence, scale, directions, judging, left)


def judge_noise(
    unexplained: float, degrees: float, plain: Influence, excluded: BoolArray, is_given: bool
) -> JudgingNoise:
    """Return the noise that the fitted blocks show to each block: without its own residuals, so
    that a wrong block cannot hide in it. No prior contributes.

    The sum of squares that no parameter explains is lower by d_j^2 without block j, and its
    degrees of freedom by those of d_j^2 (least squares). Where fewer than five are left, stated
    noise counts as it is.

    Parameters
    ----------
    unexplained, degrees : sum of squares of all fitted blocks that no parameter explains.
    plain : influence (u,) on the fit by least squares. excluded : (u,) blocks that are not fitted.
    is_given : whether the noise is stated.
    """
    left = degrees - np.where(excluded, 0, plain.degrees)
    square = unexplained - np.where(excluded, 0.0, plain.distance)
    is_shown = left >= (FEWEST_DEGREES if is_given else 1)
    variance = np.maximum(square / np.where(is_shown, left, 1.0), SMALLEST_NOISE)
    otherwise = np.inf if is_given else 0.0
    return JudgingNoise(np.where(is_shown, variance, 1.0), np.where(is_shown, left, otherwise))


def search_suspects(
    refit: Refit,
    whole: PartialFit,
    first: PartialFit,
    limit: float,
    most: int,
    progress: Progress = report_no_progress,
) -> tuple[PartialFit, ...]:
    """Exclude suspects until the same ones are suspected twice.

    Parameters
    ----------
    refit : see `Refit`. whole : the fit to all blocks. first : where the search begins.
    limit : p-value below which a block is a suspect. most : largest number of excluded blocks.

    Returns
    -------
    The fit without the suspects, or all fits of a cycle.
    """
    fits = [first]
    while len(fits) <= MOST_ROUNDS:
        progress(len(fits) - 1, MOST_ROUNDS, "searching for outliers")
        last = fits[-1]
        beyond = np.flatnonzero(last.p_value() < limit)
        order = beyond[np.argsort(-last.ratio[beyond], kind="stable")][:most]
        after = _exclude_farthest(refit, order, whole)
        if (after.excluded == last.excluded).all():
            return (last,)
        repeated = [i for i, old in enumerate(fits) if (old.excluded == after.excluded).all()]
        if repeated:
            return tuple(fits[repeated[0] :])
        fits.append(after)
    return tuple(fits)


def find_rivals(search: BlockSearch, progress: Progress = report_no_progress) -> list[BoolArray]:
    """Return groups (u,) of blocks of which excluding one does as well as excluding another.

    With i back in the fit, excluding block j lowers chi-square by d_j^2, and excluding i after that
    by at least d_i^2 - d_j^2; so only a j whose d_j^2 comes near d_i^2 can replace i.
    """
    refit, whole, end, limit = search.refit, search.whole, search.end, search.limit
    groups: list[BoolArray] = []
    suspects = np.flatnonzero(end.excluded)
    suspects = suspects[np.argsort(-end.ratio[suspects], kind="stable")][:MOST_COMPARED]
    for done, i in enumerate(suspects):
        progress(done, len(suspects), "comparing suspected poses with others")
        far = float(compute_chi_square_quantile(max(int(end.influence.degrees[i]), 1), limit))
        if not _may_have_rivals(end, i, far):
            continue
        excluded = end.excluded.copy()
        excluded[i] = False
        back = refit(excluded)
        square = back.influence.distance / end.scale**2
        group = np.zeros_like(excluded)
        near = ~end.excluded & (back.p_value() < limit) & (square > square[i] - far)
        for j in np.flatnonzero(near):
            excluded[j] = True
            instead = refit(excluded)
            excluded[j] = False
            group[j] = instead.determines_as_much(whole) and instead.p_value()[i] >= limit
        if group.any():
            group[i] = True
            groups.append(group)
    return _join_groups(groups)


def _may_have_rivals(end: PartialFit, i: int, far: float) -> bool:
    """Return whether any d_j^2 may come within `far` of d_i^2 with block i back in the fit.

    Block i then moves the fit by at most d_i in the norm of the information, and d_j by at most
    sqrt(g / (1 - g)) d_i, where the largest eigenvalue g of G_j is at most the leverage of j. Both
    d_i^2 and the information of the others are as before. Where one of very many blocks is far off,
    this takes the place of a fit.
    """
    leverage, distance = end.influence.leverage, np.sqrt(end.influence.distance) / end.scale
    inside = np.where(leverage < 1.0, leverage, 0.0)
    moved = np.where(leverage < 1.0, np.sqrt(inside / (1.0 - inside)), np.inf)
    largest = np.where(end.excluded, 0.0, distance + moved * distance[i])
    return bool((largest**2 > distance[i] ** 2 - far).any())


def list_suspected_in_turn(fits: tuple[PartialFit, ...]) -> list[BoolArray]:
    """Return the one group (u,) of the blocks that only some of the fits exclude."""
    excluded = np.array([fit.excluded for fit in fits])
    group: BoolArray = np.any(excluded, axis=0) & ~np.all(excluded, axis=0)
    return [group]


def _exclude_farthest(refit: Refit, order: IntArray, whole: PartialFit) -> PartialFit:
    """Exclude as many blocks of the order as possible without losing a direction, by bisection."""
    possible, impossible, best = 0, len(order) + 1, whole
    count = len(order)
    while impossible - possible > 1:
        excluded = np.zeros_like(whole.excluded)
        excluded[order[:count]] = True
        fit = refit(excluded)
        if fit.determines_as_much(whole):
            possible, best = count, fit
        else:
            impossible = count
        count = (possible + impossible) // 2
    return best


def _join_groups(groups: list[BoolArray]) -> list[BoolArray]:
    """Join groups that share a block."""
    joined: list[BoolArray] = []
    for group in groups:
        apart = [other for other in joined if not (other & group).any()]
        shared = [other for other in joined if (other & group).any()]
        joined = [*apart, np.any([group, *shared], axis=0)]
    return joined
