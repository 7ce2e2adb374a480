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
from typing import Protocol

import numpy as np

from loopcal.diagnose.fit_checks.influence import Influence, compute_influence
from loopcal.estimate.linearization import Start
from loopcal.estimate.methods.penalties import decompose_for
from loopcal.estimate.minimization.robust_descent import estimate_scale_of
from loopcal.estimate.problem import Problem
from loopcal.estimate.result import Identification
from loopcal.numerics.chi_square import compute_chi_square_quantile, compute_chi_square_tail
from loopcal.typing import BoolArray, FloatArray, IntArray, Progress, report_no_progress

MOST_ROUNDS = 20
"""Largest number of searches with other suspects."""

MOST_EXCLUDED = 0.5
"""Largest share of excluded blocks; beyond it nothing can be said of the others."""

MOST_COMPARED = 10
"""Suspects, farthest first, that are compared with others which would do as well; more suspects are
a matter of the model.
"""


@dataclass(frozen=True, eq=False)
class PartialFit:
    """A linear fit without some of u blocks, and its influence on every block.

    Attributes
    ----------
    excluded : (u,) blocks that are not fitted. influence : of all blocks.
    scale : factor on sigma; NaN where it is to be estimated and no fitted block can be tested.
    directions : number of directions that the fit determines.
    """

    excluded: BoolArray
    influence: Influence
    scale: float
    directions: int

    @property
    def tested(self) -> int:
        """Number of blocks that have a degree of freedom."""
        return int((self.influence.degrees > 0).sum())

    @property
    def ratio(self) -> FloatArray:
        """(u,) distance per degree of freedom in units of the noise; zero without a test."""
        degrees = self.influence.degrees
        ratio = self.influence.distance / np.maximum(degrees, 1)
        return np.where(degrees > 0, ratio, 0.0) / self.scale**2

    def p_value(self) -> FloatArray:
        """Return (u,) the probability of a larger distance; 1 where there is no test."""
        statistic = self.influence.distance / self.scale**2
        return compute_chi_square_tail(self.influence.degrees, statistic)

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

    @property
    def is_exhausted(self) -> bool:
        """Whether as many blocks are excluded as may be; then it is no matter of single blocks."""
        most = int(MOST_EXCLUDED * self.whole.tested)
        return any(int(fit.excluded.sum()) >= max(most, 1) for fit in self.fits)


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
    limit = -float(np.expm1(np.log1p(-level) / max(whole.tested, 1)))
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
    kept = problem.weighted(weight[member]).linearize(deviation, start)
    d = decompose_for(fit.method, kept.factor, kept.equations, deviation, fit.spectrum.tolerance)
    penalty = np.array(fit.method.penalty(d), dtype=np.float64)
    solved = d.deviation(d.solution(penalty))
    influence = compute_influence(problem, kept, member, d, penalty, weight, solved)
    inside, scale = (influence.degrees > 0) & ~excluded, 1.0
    if noise != "given":
        distance, degrees = np.sqrt(influence.distance[inside]), influence.degrees[inside]
        scale = estimate_scale_of(distance, degrees.astype(np.float64)) if inside.any() else np.nan
    return PartialFit(excluded, influence, scale, int(np.isfinite(penalty).sum()))


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
        excluded = end.excluded.copy()
        excluded[i] = False
        back = refit(excluded)
        square = back.influence.distance / back.scale**2
        far = float(compute_chi_square_quantile(max(int(end.influence.degrees[i]), 1), limit))
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
