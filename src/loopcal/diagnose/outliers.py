# SPDX-License-Identifier: Apache-2.0
"""Detect poses that do not fit the others, at a false-alarm rate for the whole data set.

Rows that belong together form an observation block: a pose, or several poses that share rows. With
the information M = sum_j w_j A_j'A_j + P (P the penalty) and G = A_j M^-1 A_j' of eigenvalues g,
the squared Mahalanobis norm of the residual that block j has with respect to a fit without it is
d^2 = sum r^2 / ((1 - w g)(1 + (1 - w) g)) in the eigenvectors of G. If block and model are right it
is a chi-square with as many degrees of freedom as there are directions with 1 - w g > 0. The
leverage is the trace of w G. See docs/theory/residual-patterns.md.

A block is an outlier where the probability of its distance is below 1 - (1 - level)^(1/u), u blocks
tested (Sidak). Several wrong blocks hide each other: suspects are excluded until the same ones are
suspected twice. With one degree of freedom every block explains the misfit of all, and none is
named. Nothing is removed from the data: the result names the blocks for whoever decides.

The distance is judged by the noise that the other blocks show (an F ratio), not by the stated one.
A wrong sigma therefore makes no outliers, and a misfit that is spread over all blocks names none.
A fit that contradicts the stated noise is no good reference: one wrong row of a meter pulls the
geometry so far that right poses seem wrong. Blocks are then compared at a robust fit (Tukey).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar, NamedTuple

import numpy as np

from loopcal.errors import EstimationError, LoopcalError
from loopcal.estimate import residual_test
from loopcal.estimate.fit_descent import estimate_scale_of, measure_block_distances
from loopcal.estimate.identification import identify, prepare_fitted_data
from loopcal.estimate.linearization import LeverageRows, Linearization, PoseSolution, Start
from loopcal.estimate.losses import Tukey
from loopcal.estimate.observation_rows import linked_blocks, list_block_labels
from loopcal.estimate.penalties import decompose_for
from loopcal.estimate.problem import Problem, problem_of
from loopcal.estimate.result import Identification
from loopcal.findings import Finding, report_finding
from loopcal.measure.measurements import Measurements
from loopcal.numerics import statistics
from loopcal.numerics.decomposition import Decomposition
from loopcal.numerics.elimination import spread_columns
from loopcal.results.description import Field, fields, label_axes
from loopcal.results.result import TableResult
from loopcal.typing import BoolArray, FloatArray, IntArray, Progress, report_no_progress

# Variance of a residual of the fit, in units of the noise, below which only this block determines
# its direction, so that it tests nothing.
TESTABLE = 1e-6
# Variance of a predicted residual outside the fit above which the fit does not predict it.
UNPREDICTABLE = 1e10
# Standard deviation in spreads that stands in G for a direction that the fit does not use.
UNDETERMINED = 1e6
TOGETHER = 1_000_000  # numbers of the blocks that are compared together, about


class Influence(NamedTuple):
    """The influence of u blocks, one entry for each."""

    leverage: FloatArray  # (u,) trace of w G: number of parameters that the block determines
    residuals: IntArray  # (u,) number of residuals
    distance: FloatArray  # (u,) d^2
    degrees: IntArray  # (u,) its degrees of freedom

    def fill(self, blocks: IntArray, values: Influence) -> None:
        """Set the entries of some blocks."""
        for array, of_blocks in zip(self, values, strict=True):
            array[blocks] = of_blocks


def compute_influence(
    problem: Problem,
    linearization: Linearization,
    member: IntArray,
    decomposition: Decomposition,
    fits: Sequence[tuple[FloatArray, FloatArray]],
    weight: FloatArray,
    solution: PoseSolution | None = None,
) -> list[Influence]:
    """Return the influence of every block (one trial) on fits of the same rows, in one pass.

    problem : unweighted. linearization : of the weighted problem.
    member : (n,) block 0..u-1 of each pose. decomposition : of the weighted fits.
    fits : the penalty of each fit, and the deviation (1, p) at which its residuals are evaluated,
        to first order.
    weight : (u,) weight of each block in the fits.
    solution : poses and nuisance parameters of the rows, see `Problem.leverage_rows`.
    """
    d, u, p = decomposition, len(weight), decomposition.directions.shape[1]
    roots, changes = [], []
    for penalty, solved in fits:
        variance = d.variances(penalty)[0]
        sd = np.sqrt(np.where(np.isfinite(variance), variance, UNDETERMINED**2))
        roots.append(d.directions[0] * sd)
        changes.append((solved - linearization.deviation)[0])
    results = [make_empty_influence(u) for _ in fits]
    total = problem.poses.count_rows(member, u)
    rows = problem.leverage_rows(linearization, solution)
    for blocks, _, columns, r in iterate_blocks(rows, member, total):
        # nuisance parameters come first, in units of their standard deviation
        A, nuisance = columns[..., -p:], columns[..., :-p]
        present = np.any(A != 0.0, axis=2) | np.any(nuisance != 0.0, axis=2) | (r != 0.0)
        for result, root, change in zip(results, roots, changes, strict=True):
            half = np.concatenate([nuisance, A @ root], axis=2)
            residual = r + A @ change
            result.fill(blocks, compute_block_influence(half, residual, present, weight[blocks]))
    return results


def make_empty_influence(blocks: int) -> Influence:
    """Return an influence of zeros, to be filled."""
    (leverage, distance), (residuals, degrees) = np.zeros((2, blocks)), np.zeros((2, blocks), int)
    return Influence(leverage, residuals, distance, degrees)


def compute_block_influence(
    half: FloatArray, residual: FloatArray, present: BoolArray, weight: FloatArray
) -> Influence:
    """Return the influence of b blocks of equal size.

    half : (b, m, k) square root of G. residual : (b, m). present : (b, m) rows that exist; the
        others are zero. weight : (b,) of the blocks in the fit, 1 or 0.
    """
    G, identity = half @ half.swapaxes(-1, -2), np.eye(half.shape[1])
    variance = identity + (1.0 - 2.0 * weight)[:, None, None] * G
    leverage, count = np.einsum("bii->b", G), present.sum(axis=1)
    with suppress(np.linalg.LinAlgError):  # raised where a direction is beyond these limits
        np.linalg.cholesky(variance - TESTABLE * identity)
        if (leverage < UNPREDICTABLE).all():
            solved = np.linalg.solve(variance, residual[..., None])[..., 0]
            return Influence(weight * leverage, count, (residual * solved).sum(axis=1), count)
    v, vectors = np.linalg.eigh(variance)
    # absent rows are zero: eigenvectors of value one and residual zero, subtracted below
    tested = (v > TESTABLE) & (v < UNPREDICTABLE)
    square = np.matmul(residual[:, None, :], vectors)[:, 0] ** 2
    distance = np.divide(square, v, out=np.zeros_like(v), where=tested).sum(axis=1)
    return Influence(
        weight * leverage, count, distance, tested.sum(axis=1) - (~present).sum(axis=1)
    )


def iterate_blocks(
    rows_of_problem: Iterable[list[LeverageRows]], member: IntArray, total: IntArray
) -> Iterator[tuple[IntArray, IntArray, FloatArray, FloatArray]]:
    """Yield blocks of equal size together: numbers (b,), the nuisance parameters (b, c) that they
    move, -1 for none, matrices (b, m, c + p) by these and the machine, and residuals (b, m).

    A block whose rows come with several chunks of poses waits until the last of them. `total` (u,)
    is the number of rows of each block, see `PoseRows.count_rows`.
    """
    waiting: list[tuple[IntArray, IntArray, FloatArray, FloatArray]] = []
    for rows_of_block in rows_of_problem:
        for rows in rows_of_block:
            (k, m), w = rows.rows.shape[:2], rows.unknowns.shape[1]
            blocks = np.repeat(member[rows.poses], m)
            flat = rows.rows.reshape(k * m, -1)
            waiting.append((blocks, rows.unknowns.repeat(m, axis=0), flat[:, :w], flat[:, w:]))
        if not waiting:
            continue
        width = max(of_part.shape[1] for _, of_part, *_ in waiting)
        block_of_row, unknowns, moved, machine = (
            np.concatenate(arrays)
            for arrays in zip(*(_widen(part, width) for part in waiting), strict=True)
        )
        order = np.argsort(block_of_row, kind="stable")
        block_of_row = block_of_row[order]
        numbers, first, sizes = np.unique(block_of_row, return_index=True, return_counts=True)
        complete = sizes == total[numbers]
        for size in statistics.find_distinct(sizes[complete]):
            alike = np.flatnonzero(complete & (sizes == size))
            most = max(1, TOGETHER // int(size * (size + machine.shape[1] + width)))
            for chosen in np.split(alike, range(most, len(alike), most)):
                places = order[first[chosen][:, None] + np.arange(size)]
                own, columns = join_columns(unknowns[places], moved[places])
                rest = machine[places]
                columns = np.concatenate([columns, rest[..., :-1]], axis=2)
                yield numbers[chosen], own, columns, rest[..., -1]
        is_left = np.repeat(~complete, sizes)
        left = order[is_left]
        waiting = [(block_of_row[is_left], unknowns[left], moved[left], machine[left])]
        waiting = waiting if left.size else []


def _widen(
    part: tuple[IntArray, IntArray, FloatArray, FloatArray], width: int
) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
    """Return rows whose columns by nuisance parameters (n, w) are as many as `width`."""
    blocks, unknowns, moved, machine = part
    more = (0, 0), (0, width - unknowns.shape[1])
    return blocks, np.pad(unknowns, more, constant_values=-1), np.pad(moved, more), machine


def join_columns(unknowns: IntArray, moved: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return the distinct nuisance parameters (b, c) of the rows of each block, and the rows
    (b, m, c) by them, from rows (b, m, w) by `unknowns` (b, m, w).
    """
    b, m, w = unknowns.shape
    if not m * w or (unknowns == unknowns[:, :1]).all():
        return unknowns.reshape(b, m * w)[:, :w], moved
    flat = unknowns.reshape(b, m * w)
    order = np.argsort(flat, axis=1, kind="stable")
    ordered = np.take_along_axis(flat, order, axis=1)
    number = np.zeros_like(flat)
    number[:, 1:] = np.cumsum(ordered[:, 1:] != ordered[:, :-1], axis=1)
    place = np.empty_like(flat)
    np.put_along_axis(place, order, number, axis=1)
    c = int(number.max()) + 1
    own, columns = np.full((b, c), -1), place.reshape(b * m, w)
    np.put_along_axis(own, number, ordered, axis=1)
    wide = spread_columns(moved.reshape(b * m, 1, w), columns, c)
    return own, wide.reshape(b, m, c)


MOST_ROUNDS = 20  # largest number of searches with other suspects
MOST_EXCLUDED = 0.5  # largest share of excluded blocks; beyond it nothing can be said of the others
# Variance of the noise, in units of the stated one, below which residuals are rounding.
SMALLEST_NOISE = 1e-12
# Suspects, farthest first, that are compared with others which would do as well; more suspects
# are a matter of the model.
MOST_COMPARED = 10


class PartialFit(NamedTuple):
    """A linear fit without some of u blocks, and its influence on every block."""

    excluded: BoolArray  # (u,) blocks that are not fitted
    influence: Influence  # of all blocks
    # factor on sigma; NaN where it is to be estimated and the fitted blocks do not show it
    scale: float
    directions: int  # number of directions that the fit determines
    # the noise by which each block is judged, that of the other fitted blocks: (u,) variance of the
    # whitened rows in units of the stated one, and (u,) its degrees of freedom, infinite where the
    # stated noise counts, 0 where nothing is known; by default that of `scale`, as if it were known
    noise: tuple[FloatArray, FloatArray] | None = None
    left: float = 0.0  # degrees of freedom of `scale`; 0 where the stated noise counts

    @property
    def tested(self) -> int:
        """Number of blocks that have a degree of freedom."""
        return int((self.influence.degrees > 0).sum())

    @property
    def ratio(self) -> FloatArray:
        """(u,) distance per degree of freedom in units of the noise; zero without a test."""
        degrees = self.influence.degrees
        ratio = self.influence.distance / np.maximum(degrees, 1)
        variance = self.scale**2 if self.noise is None else self.noise[0]
        return np.where(degrees > 0, ratio, 0.0) / variance

    def p_value(self) -> FloatArray:
        """Return (u,) the probability of a larger distance; 1 where there is no test."""
        left = np.inf if self.noise is None else self.noise[1]
        p_value = statistics.compute_f_tail(self.influence.degrees, left, self.ratio)
        return np.where(np.isnan(p_value), 1.0, p_value)

    def determines_as_much(self, whole: PartialFit) -> bool:
        """Return whether the fitted blocks determine as many directions as all, and the noise."""
        return self.directions >= whole.directions and bool(np.isfinite(self.scale))


Refit = Callable[[BoolArray], PartialFit]  # from the excluded blocks (u,) to the fit without them


@dataclass(frozen=True, eq=False)
class BlockSearch:
    """A search for blocks that do not fit."""

    refit: Refit  # see `Refit`
    whole: PartialFit  # the fit to all blocks
    limit: float  # p-value below which a block is a suspect
    fits: tuple[PartialFit, ...]  # the fit without the suspects, or all fits of a cycle

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
    """Search the blocks that the others do not explain: exclude suspects until the same ones are
    suspected twice.

    low_weight : (u,) blocks with a small weight in a robust fit; the search begins without them.
    level : probability of any suspect where all blocks are right.
    """
    whole = first = refit(np.zeros_like(low_weight))
    if low_weight.any() and (without := refit(low_weight)).determines_as_much(whole):
        first = without
    limit = statistics.compute_single_level(level, whole.tested)
    most, fits = int(MOST_EXCLUDED * whole.tested), [first]
    while len(fits) <= MOST_ROUNDS:
        progress(len(fits) - 1, MOST_ROUNDS, "searching for outliers")
        last = fits[-1]
        beyond = np.flatnonzero(last.p_value() < limit)
        order = beyond[np.argsort(-last.ratio[beyond], kind="stable")][:most]
        after = _exclude_farthest(refit, order, whole)
        repeated = [i for i, old in enumerate(fits) if (old.excluded == after.excluded).all()]
        if repeated:  # the last one again, or a cycle
            fits = fits[repeated[0] :]
            break
        fits.append(after)
    return BlockSearch(refit, whole, limit, tuple(fits))


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

    Each block is judged by the noise that the other fitted blocks show, so that a wrong block
    cannot hide in it: the sum of squares that no parameter explains is lower by d_j^2 without block
    j, and its degrees of freedom by those of d_j^2 (least squares; no prior contributes). Where
    fewer than five are left, stated noise counts as it is.

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
    unexplained, degrees = float(d.unexplained[0]), float(d.rows[0] - d.rank[0])
    is_given = noise == "given"
    fewest, otherwise, scale = (
        (residual_test.FEWEST_DEGREES, np.inf, 1.0) if is_given else (1, 0.0, np.nan)
    )
    left = degrees - np.where(excluded, 0, plain.degrees)
    square = unexplained - np.where(excluded, 0.0, plain.distance)
    is_shown = left >= fewest
    variance = np.maximum(square / np.where(is_shown, left, 1.0), SMALLEST_NOISE)
    judging = (np.where(is_shown, variance, 1.0), np.where(is_shown, left, otherwise))
    if degrees >= fewest:
        scale = float(np.sqrt(max(unexplained / degrees, SMALLEST_NOISE)))
    directions = int(np.isfinite(penalty).sum())
    return PartialFit(
        excluded, influence, scale, directions, judging, degrees if degrees >= fewest else 0.0
    )


def find_ambiguous(search: BlockSearch, progress: Progress = report_no_progress) -> list[BoolArray]:
    """Return groups (u,) of blocks of which any may be wrong: those suspected in turn, or those of
    which excluding one does as well as excluding another.

    With i back in the fit, excluding block j lowers chi-square by d_j^2, and excluding i after that
    by at least d_i^2 - d_j^2; so only a j whose d_j^2 comes near d_i^2 can replace i.
    """
    if not search.is_converged:
        excluded = np.array([fit.excluded for fit in search.fits])
        in_turn: BoolArray = np.any(excluded, axis=0) & ~np.all(excluded, axis=0)
        return [in_turn]
    refit, whole, end, limit = search.refit, search.whole, search.end, search.limit
    groups: list[BoolArray] = []
    suspects = np.flatnonzero(end.excluded)
    suspects = suspects[np.argsort(-end.ratio[suspects], kind="stable")][:MOST_COMPARED]
    for done, i in enumerate(suspects):
        progress(done, len(suspects), "comparing suspected poses with others")
        far = float(
            statistics.compute_chi_square_quantile(max(int(end.influence.degrees[i]), 1), limit)
        )
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
    joined: list[BoolArray] = []  # groups that share a block are one
    for group in groups:
        apart = [other for other in joined if not (other & group).any()]
        shared = [other for other in joined if (other & group).any()]
        joined = [*apart, np.any([group, *shared], axis=0)]
    return joined


def _may_have_rivals(end: PartialFit, i: int, far: float) -> bool:
    """Return whether any d_j^2 may come within `far` of d_i^2 with block i back in the fit: it
    moves the fit by at most d_i in the norm of the information, and d_j by at most
    sqrt(g / (1 - g)) d_i, where the largest eigenvalue g of G_j is at most the leverage of j.
    """
    leverage, distance = end.influence.leverage, np.sqrt(end.influence.distance) / end.scale
    inside = np.where(leverage < 1.0, leverage, 0.0)
    moved = np.where(leverage < 1.0, np.sqrt(inside / (1.0 - inside)), np.inf)
    largest = np.where(end.excluded, 0.0, distance + moved * distance[i])
    return bool((largest**2 > distance[i] ** 2 - far).any())


def _exclude_farthest(refit: Refit, order: IntArray, whole: PartialFit) -> PartialFit:
    """Exclude as many blocks of the order as possible without losing a direction, by bisection."""
    possible, impossible, best, count = 0, len(order) + 1, whole, len(order)
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


# Blocks that a robust fit is made from: it is where the others are compared, not a result.
MOST_ROBUST = 20_000


@dataclass(frozen=True)
class Outlier:
    """A block that does not fit the others."""

    poses: tuple[str, ...]  # its labels
    distance: float  # squared Mahalanobis norm of its residual against a fit of the others
    degrees: int  # degrees of freedom of the distance
    p_value: float  # probability of a larger one, for this block alone

    @property
    def finding(self) -> Finding:
        """The outlier as a finding."""
        return report_finding(
            "outliers.pose",
            poses=self.poses,
            factor=float(np.sqrt(self.distance / self.degrees)),
            residuals=self.degrees,
            p_value=self.p_value,
        )


@dataclass(frozen=True)
class Conflict:
    """Blocks that contradict each other, any one of which may be wrong."""

    poses: tuple[tuple[str, ...], ...]  # labels of each block
    times: float  # largest distance from a fit to all, in units of the expected noise

    @property
    def finding(self) -> Finding:
        """The conflict as a finding."""
        return report_finding("outliers.conflict", poses=self.poses, factor=self.times)


@dataclass(frozen=True, eq=False, repr=False)
class OutlierCheck(TableResult):
    """The result for all blocks.

    Attributes
    ----------
    outliers : blocks that do not fit, farthest first. ambiguous : groups of blocks of which at
        least one does not fit.
    is_converged : whether the same blocks were suspected twice; otherwise those suspected in turn
        are ambiguous.
    level : probability of any outlier where all blocks are right.
    blocks : number of tested blocks. poses : labels of each of the u blocks.
    influence : of all blocks, with the suspects excluded. scale : factor on sigma used.
    summary : the finding on all blocks.
    """

    outliers: tuple[Outlier, ...]
    ambiguous: tuple[Conflict, ...]
    is_converged: bool
    level: float
    blocks: int
    poses: tuple[tuple[str, ...], ...]
    influence: Influence
    scale: float
    summary: tuple[Finding, ...]

    FIELDS: ClassVar[tuple[Field, ...]] = (
        *fields("outliers", undecided="ambiguous", settled="is_converged", level="level"),
        *fields("blocks", "scale", mean_leverage="mean_leverage", findings="findings"),
        Field("state", lambda check: list(map(check.judge, check.poses)), "poses"),
    )
    LABELS: ClassVar[Mapping[str, Any]] = label_axes(
        poses=lambda check: [", ".join(poses) for poses in check.poses]
    )

    @property
    def names(self) -> tuple[str, ...]:
        """Labels of all poses of the outliers."""
        return tuple(label for outlier in self.outliers for label in outlier.poses)

    @property
    def mean_leverage(self) -> float:
        """Share of the residuals that the parameters take up."""
        residuals = max(int(self.influence.residuals.sum()), 1)
        return float(self.influence.leverage.sum() / residuals)

    def judge(self, poses: tuple[str, ...]) -> str:
        """Return whether a block of poses fits the others, in words."""
        if set(poses) <= set(self.names):
            return "outlier"
        return "contradicts others" if set(poses) <= set(self.suspects) else "fits"

    @property
    def suspects(self) -> tuple[str, ...]:
        """Labels of all poses of the outliers, and of the blocks of which one does not fit."""
        blocks = (poses for conflict in self.ambiguous for poses in conflict.poses)
        return (*self.names, *(label for poses in blocks for label in poses))

    @property
    def findings(self) -> tuple[Finding, ...]:
        """The summary, then every outlier and every conflict.

        With one degree of freedom all blocks contradict each other by the same number, which the
        test of the residuals reports.
        """
        if [finding.data.get("reason") for finding in self.summary] == ["one-degree"]:
            return self.summary
        details = [result.finding for result in (*self.outliers, *self.ambiguous)]
        return (*self.summary, *details)


def find_outliers(
    fit: Identification,
    data: Measurements,
    level: float = residual_test.FALSE_ALARMS["outliers"],
    progress: Progress = report_no_progress,
) -> OutlierCheck:
    """Find the observation blocks that do not fit what all others predict.

    Parameters
    ----------
    fit : the identification, with or without a loss. data : the measurements it was made from.
    level : probability of naming any block where none is wrong.
    progress : receives the rounds of the search.

    EstimationError : the fit did not converge.
    """
    if not fit.converged:
        raise EstimationError.of("sampling.not-converged")
    data = prepare_fitted_data(fit, data)
    problem = problem_of(fit.free_parameters, data, fit.options.nuisance)
    member = np.unique(linked_blocks(data), return_inverse=True)[1]
    labels = list_block_labels(data.labels, member)
    reference = (
        _refit_robustly(fit, data, member, progress) if fit.residual_test.exceeds_sigma else fit
    )
    z = fit.free_parameters.deviation(reference.robot.values[None])
    start = problem.start(z, seek=False).with_nuisance(reference.nuisance.estimate[None])
    start = problem.linearize(z, start).next_start
    low_weight = np.zeros(len(labels), dtype=bool)
    if len(reference.pose_weights) == len(member):
        low_weight[member] = reference.pose_weights < 0.5
    else:
        distance, degrees = measure_block_distances(problem, z, start, member, problem)
        scale = estimate_scale_of(distance, degrees)
        low_weight = Tukey().weight(distance / scale, degrees) < 0.5
    noise = fit.residual_test.noise
    refit = partial(fit_without, fit, problem, member, deviation=z, start=start, noise=noise)
    search = search_blocks(refit, low_weight, level, progress)
    groups, end, tested = find_ambiguous(search, progress), search.end, search.whole.tested
    always = np.all([each.excluded for each in search.fits], axis=0)
    ambiguous = np.any(groups, axis=0) if groups else np.zeros_like(always)
    p_value, degrees = end.p_value(), end.influence.degrees
    outliers = tuple(
        Outlier(labels[i], float(end.ratio[i] * degrees[i]), int(degrees[i]), float(p_value[i]))
        for i in np.argsort(p_value, kind="stable")
        if always[i] and not ambiguous[i]
    )
    ratio = np.sqrt(search.whole.ratio)
    conflicts = tuple(
        Conflict(tuple(labels[i] for i in np.flatnonzero(group)), float(ratio[group].max()))
        for group in groups
    )
    shared = {"blocks": tested, "single_poses": all(len(poses) == 1 for poses in labels)}
    is_converged, suspected = search.is_converged, int(ambiguous.sum())
    summary = _summarize(fit, len(outliers), suspected, level, shared, is_converged=is_converged)
    # whether the fitted blocks exceed the stated noise beyond doubt
    stated = residual_test.count_sigma_degrees(noise, fit.options.sigma_uncertainty)
    tail = statistics.compute_f_tail(end.left, stated, end.scale**2)
    if noise == "given" and outliers and end.left > 0.0 and tail < residual_test.SIGNIFICANCE:
        summary = (report_finding("outliers.larger-noise", times=end.scale, **shared), *summary)
    return OutlierCheck(
        outliers, conflicts, is_converged, level, tested, labels, end.influence, end.scale, summary
    )


def _refit_robustly(
    fit: Identification, data: Measurements, member: IntArray, progress: Progress
) -> Identification:
    """Return a robust fit of an even choice of blocks, of which `member` (n,) is that of each pose;
    the fit itself where it does not converge.
    """
    count = int(member.max()) + 1
    if count > MOST_ROBUST:
        data = data.take(np.isin(member, statistics.choose_evenly(count, MOST_ROBUST)))
    options = replace(fit.options, loss=Tukey(), noise="estimated")
    try:
        robust = identify(fit.initial, data, options=options, progress=progress)
    except LoopcalError:
        return fit
    return robust if robust.converged else fit


def _summarize(
    fit: Identification,
    outliers: int,
    ambiguous: int,
    level: float,
    shared: dict[str, Any],
    *,
    is_converged: bool,
) -> tuple[Finding, ...]:
    """Return the findings on all blocks together."""
    test, blocks = fit.residual_test, shared["blocks"]
    if blocks < 2 or round(test.dof) <= 1:
        few = "one-degree" if test.noise == "given" else "unknown-noise"
        reason = few if blocks > 1 else ("no-block", "single-block")[blocks]
        return (report_finding("outliers.not-testable", reason=reason),)
    findings = []
    if outliers:
        findings.append(report_finding("outliers.some", count=outliers, level=level, **shared))
    if ambiguous or not is_converged:
        code = "outliers.ambiguous" if is_converged else "outliers.search-not-converged"
        findings.append(report_finding(code, count=ambiguous, **shared))
    if not findings and test.failed:
        findings.append(report_finding("outliers.none-but-misfit", **shared))
    elif not findings:
        findings.append(report_finding("outliers.none", level=level, **shared))
    return tuple(findings)
