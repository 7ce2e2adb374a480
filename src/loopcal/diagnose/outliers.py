# SPDX-License-Identifier: Apache-2.0
# size: one search with its two levels and its result
"""Detect poses that do not fit the others, at a false-alarm rate for the whole data set.

Rows that belong together form an observation block: a pose, or several poses that share rows. Each
block is compared with the prediction of all others. It is an outlier where the probability of its
distance is below 1 - (1 - level)^(1/u), u blocks tested (Sidak), so that data without a wrong block
raise no alarm in 95 % of cases.

Several wrong blocks hide each other. Therefore suspects are excluded, the others are fitted again
(linearly, which needs no kinematics), and every block is tested again, inside or outside the fit,
until the same blocks are suspected twice. A block is never excluded where the others would then
determine fewer parameters. A suspect is an outlier only where excluding another block would not do
as well: with j excluded instead of i, i must still be a suspect. With one degree of freedom every
block explains the misfit of all, and none is named. Nothing is removed from the data: the result
names the blocks for whoever decides.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from loopcal.diagnose.influence import Influence, compute_influence
from loopcal.estimate.fit_input import exclude_poses
from loopcal.estimate.minimization.robust_descent import estimate_scale_of
from loopcal.estimate.observation_rows import linked_blocks
from loopcal.estimate.problem import Problem, problem_of
from loopcal.estimate.result import Identification
from loopcal.estimate.start import Start
from loopcal.findings import Finding, report_finding
from loopcal.measure import Measurements, fill_in_reading_sigma
from loopcal.numerics.decomposition import Decomposition, decompose
from loopcal.typing import BoolArray, FloatArray, IntArray

MOST_ROUNDS = 20
"""Largest number of searches with other suspects."""

MOST_EXCLUDED = 0.5
"""Largest share of excluded blocks; beyond it nothing can be said of the others."""

MOST_COMPARED = 10
"""Suspects, farthest first, that are compared with others which would do as well; more suspects are
a matter of the model.
"""


@dataclass(frozen=True)
class Outlier:
    """A block that does not fit the others.

    Attributes
    ----------
    poses : its labels. distance : squared Mahalanobis norm of its residual against a fit of the
        others. degrees : degrees of freedom of the distance. p_value : probability of a larger one,
        for this block alone.
    """

    poses: tuple[str, ...]
    distance: float
    degrees: int
    p_value: float

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
    """Blocks that contradict each other, any one of which may be wrong.

    Attributes
    ----------
    poses : labels of each block. times : largest distance from a fit to all, in units of the
        expected noise.
    """

    poses: tuple[tuple[str, ...], ...]
    times: float

    @property
    def finding(self) -> Finding:
        """The conflict as a finding."""
        return report_finding("outliers.conflict", poses=self.poses, factor=self.times)


@dataclass(frozen=True, eq=False)
class OutlierCheck:
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

    @property
    def names(self) -> tuple[str, ...]:
        """Labels of all poses of the outliers."""
        return tuple(label for outlier in self.outliers for label in outlier.poses)

    @property
    def findings(self) -> tuple[Finding, ...]:
        """The summary, then every outlier and every conflict."""
        details = [one.finding for one in (*self.outliers, *self.ambiguous)]
        return (*self.summary, *details)

    def __repr__(self) -> str:
        return f"<OutlierCheck: {len(self.outliers)} of {self.blocks} blocks are outliers>"

    def __str__(self) -> str:
        return "\n".join(str(finding) for finding in self.findings)

    def to_dict(self) -> dict[str, Any]:
        """Return the result by name for JSON."""
        mean = self.influence.leverage.sum() / max(int(self.influence.residuals.sum()), 1)
        return {
            "outliers": self.outliers,
            "undecided": self.ambiguous,
            "settled": self.is_converged,
            "level": self.level,
            "blocks": self.blocks,
            "scale": self.scale,
            "mean_leverage": float(mean),
            "findings": self.findings,
        }


@dataclass(frozen=True, eq=False)
class _State:
    """A fit without the `excluded` blocks (u,), and its influence on every block.

    `directions` is the number of directions that it determines. `scale` is NaN where it is to be
    estimated and no block inside the fit can be tested.
    """

    excluded: BoolArray
    influence: Influence
    scale: float
    directions: int

    @property
    def ratio(self) -> FloatArray:
        """(u,) distance per degree of freedom in units of the noise; zero without a test."""
        degrees = self.influence.degrees
        ratio = self.influence.distance / np.maximum(degrees, 1)
        return np.where(degrees > 0, ratio, 0.0) / self.scale**2

    def p_value(self) -> FloatArray:
        """Return (u,) the probability of a larger distance; 1 where there is no test."""
        from scipy.special import chdtrc

        degrees = self.influence.degrees
        tail = chdtrc(np.maximum(degrees, 1), self.influence.distance / self.scale**2)
        return np.where(degrees > 0, tail, 1.0)


_Fit = Callable[[BoolArray], _State]
"""From the excluded blocks (u,) to the linear fit without them."""


def find_outliers(fit: Identification, data: Measurements, level: float = 0.05) -> OutlierCheck:
    """Find the observation blocks that do not fit what all others predict.

    Parameters
    ----------
    fit : the identification, with or without a loss. data : the measurements it was made from.
    level : probability of naming any block where none is wrong.
    """
    data = exclude_poses(fill_in_reading_sigma(fit.robot, data), fit.options.excluded_poses)
    problem = problem_of(fit.free_parameters, data)
    numbers, member = np.unique(linked_blocks(data), return_inverse=True)
    labels = tuple(tuple(np.array(data.labels)[member == i].tolist()) for i in range(len(numbers)))
    z = fit.free_parameters.deviation(fit.robot.values[None])

    start = problem.linearize(z, problem.start(z)).next_start

    def refit(excluded: BoolArray) -> _State:
        return _fit_without(fit, problem, member, excluded, z, start)

    whole = refit(np.zeros(len(numbers), dtype=bool))
    tested = int((whole.influence.degrees > 0).sum())
    limit = -np.expm1(np.log1p(-level) / max(tested, 1))
    low_weight = np.zeros(len(numbers), dtype=bool)
    low_weight[member] = fit.pose_weights < 0.5
    first = refit(low_weight) if low_weight.any() else whole
    first = first if _determines_as_much(first, whole) else whole
    states = _search(refit, whole, first, limit, int(MOST_EXCLUDED * tested))
    end, is_converged = states[-1], len(states) == 1
    always = np.all([state.excluded for state in states], axis=0)
    groups = _find_rivals(refit, end, whole, limit) if is_converged else _suspected_in_turn(states)
    ambiguous = np.any(groups, axis=0) if groups else np.zeros_like(always)
    p_value, ratio = end.p_value(), np.sqrt(whole.ratio)
    outliers = tuple(
        Outlier(
            labels[i],
            float(end.influence.distance[i] / end.scale**2),
            int(end.influence.degrees[i]),
            float(p_value[i]),
        )
        for i in np.argsort(p_value, kind="stable")
        if always[i] and not ambiguous[i]
    )
    conflicts = tuple(
        Conflict(tuple(labels[i] for i in np.flatnonzero(group)), float(ratio[group].max()))
        for group in groups
    )
    counts = {"outliers": len(outliers), "ambiguous": int(ambiguous.sum()), "blocks": tested}
    single = all(len(poses) == 1 for poses in labels)
    summary = _summarize(fit, counts, level, is_converged=is_converged, single_poses=single)
    return OutlierCheck(
        outliers, conflicts, is_converged, level, tested, labels, end.influence, end.scale, summary
    )


def _fit_without(
    fit: Identification,
    problem: Problem,
    member: IntArray,
    excluded: BoolArray,
    z: FloatArray,
    start: Start,
) -> _State:
    """Fit linearly without the excluded blocks (u,), and compute the influence of every block."""
    weight = (~excluded).astype(np.float64)
    kept = problem.weighted(weight[member]).linearize(z, start)
    method, p = fit.method, problem.parameters
    d: Decomposition = decompose(
        kept.factor,
        kept.equations,
        z,
        method.scale(p),
        fit.spectrum.tolerance,
        method.unpenalized(p),
    )
    penalty = np.array(method.penalty(d), dtype=np.float64)
    at = d.deviation(d.solution(penalty))
    influence = compute_influence(problem, kept, member, d, penalty, weight, at)
    inside = (influence.degrees > 0) & ~excluded
    scale = 1.0
    if fit.residual_test.noise == "estimated":
        degrees = influence.degrees[inside].astype(np.float64)
        scale = (
            estimate_scale_of(np.sqrt(influence.distance[inside]), degrees)
            if inside.any()
            else np.nan
        )
    return _State(excluded, influence, scale, int(np.isfinite(penalty).sum()))


def _determines_as_much(state: _State, whole: _State) -> bool:
    """Whether the remaining blocks determine as many directions as all do, and the noise where it
    is estimated.
    """
    return state.directions >= whole.directions and bool(np.isfinite(state.scale))


def _search(
    refit: _Fit, whole: _State, start: _State, limit: float, most: int
) -> tuple[_State, ...]:
    """Exclude suspects until the same ones are suspected twice.

    Return that state, or all states of a cycle.
    """
    states = [start]
    while len(states) <= MOST_ROUNDS:
        state = states[-1]
        beyond = np.flatnonzero(state.p_value() < limit)
        order = beyond[np.argsort(-state.ratio[beyond], kind="stable")][:most]
        after = _exclude_farthest(refit, order, whole)
        if (after.excluded == state.excluded).all():
            return (state,)
        again = [i for i, old in enumerate(states) if (old.excluded == after.excluded).all()]
        if again:
            return tuple(states[again[0] :])
        states.append(after)
    return tuple(states)


def _exclude_farthest(refit: _Fit, order: IntArray, whole: _State) -> _State:
    """Exclude as many blocks of the order as possible without losing a direction, by bisection."""

    def without(count: int) -> _State:
        excluded = np.zeros_like(whole.excluded)
        excluded[order[:count]] = True
        return refit(excluded) if count else whole

    good, bad, best = 0, len(order) + 1, whole
    count = len(order)
    while bad - good > 1:
        state = without(count)
        if _determines_as_much(state, whole):
            good, best = count, state
        else:
            bad = count
        count = (good + bad) // 2
    return best


def _find_rivals(refit: _Fit, end: _State, whole: _State, limit: float) -> list[BoolArray]:
    """Return groups (u,) of blocks of which excluding one does as well as excluding another.

    With i back in the fit, excluding block j lowers chi-square by d_j^2, and excluding i after that
    by at least d_i^2 - d_j^2; so only a j whose d_j^2 comes near d_i^2 can replace i.
    """
    from scipy.special import chdtri

    groups: list[BoolArray] = []
    suspects = np.flatnonzero(end.excluded)
    for i in suspects[np.argsort(-end.ratio[suspects], kind="stable")][:MOST_COMPARED]:
        excluded = end.excluded.copy()
        excluded[i] = False
        back = refit(excluded)
        square = back.influence.distance / back.scale**2
        far = float(chdtri(max(int(end.influence.degrees[i]), 1), limit))
        group = np.zeros_like(excluded)
        near = ~end.excluded & (back.p_value() < limit) & (square > square[i] - far)
        for j in np.flatnonzero(near):
            excluded[j] = True
            instead = refit(excluded)
            excluded[j] = False
            replaces = instead.p_value()[i] >= limit
            group[j] = _determines_as_much(instead, whole) and replaces
        if group.any():
            group[i] = True
            groups.append(group)
    return _join_groups(groups)


def _join_groups(groups: list[BoolArray]) -> list[BoolArray]:
    """Join groups that share a block."""
    joined: list[BoolArray] = []
    for group in groups:
        apart = [other for other in joined if not (other & group).any()]
        shared = [other for other in joined if (other & group).any()]
        joined = [*apart, np.any([group, *shared], axis=0)]
    return joined


def _suspected_in_turn(states: tuple[_State, ...]) -> list[BoolArray]:
    """Return the one group (u,) of the blocks that are suspected in some of the states only."""
    excluded = np.array([state.excluded for state in states])
    group: BoolArray = np.any(excluded, axis=0) & ~np.all(excluded, axis=0)
    return [group]


def _summarize(
    fit: Identification,
    counts: dict[str, int],
    level: float,
    *,
    is_converged: bool,
    single_poses: bool,
) -> tuple[Finding, ...]:
    """Return the findings on all blocks together."""
    blocks, ambiguous = counts["blocks"], counts["ambiguous"]
    if blocks == 0:
        return (report_finding("outliers.not-testable"),)
    if blocks == 1:
        return (report_finding("outliers.single-block"),)
    if fit.residual_test.noise == "estimated" and round(fit.residual_test.dof) <= 1:
        return (report_finding("outliers.unknown-noise"),)
    shared = {"blocks": blocks, "single_poses": single_poses}
    findings = []
    if counts["outliers"]:
        code, count = "outliers.some", counts["outliers"]
        findings.append(report_finding(code, count=count, level=level, **shared))
    if not is_converged:
        code = "outliers.search-not-converged"
        findings.append(report_finding(code, count=ambiguous, **shared))
    elif ambiguous:
        findings.append(report_finding("outliers.ambiguous", count=ambiguous, **shared))
    if findings:
        return tuple(findings)
    if fit.residual_test.failed:
        return (report_finding("outliers.none-but-misfit", **shared),)
    return (report_finding("outliers.none", level=level, **shared),)
