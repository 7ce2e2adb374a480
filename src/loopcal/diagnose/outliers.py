# SPDX-License-Identifier: Apache-2.0
"""Which blocks of rows do not belong: each against what all others predict of it, at a level for
the whole family.

A block is named where the probability of its distance is below 1 - (1 - level)^(1/u), u blocks
tested (Sidak), so that data without a wrong block name none in 95 % of cases. Several wrong blocks
hide each other; therefore what is doubted is set aside, the others are fitted again (linearly,
which needs no kinematics), and every block is asked again, inside or outside, until the same blocks
are doubted twice. Nothing is set aside without which the others determine fewer parameters. A
doubted block is only named where no other would do as well: with j set aside instead of i, i must
still be doubted. With one degree of freedom every block explains the disagreement of all, and none
is named. Nothing is dropped: the names are for whoever decides.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from loopcal.diagnose.influence import Influence, compute_influence
from loopcal.estimate.fit_input import exclude_poses
from loopcal.estimate.inference.null_space import listed
from loopcal.estimate.observation_rows import linked_blocks
from loopcal.estimate.problem import Problem, problem_of
from loopcal.estimate.result import Identification
from loopcal.estimate.robust_descent import estimate_scale_of
from loopcal.estimate.start import Start
from loopcal.measure import Measurements, fill_in_reading_sigma
from loopcal.numerics.decomposition import Decomposition, decompose
from loopcal.typing import BoolArray, FloatArray

ROUNDS = 20
"""Times that blocks are set aside at most."""

MOST = 0.5
"""Share of the blocks that is set aside at most; with more, nothing can be said of the rest."""

COMPARED = 10
"""Doubted blocks, farthest first, for which it is asked whether others would do as well; more are a
matter of the model.
"""


@dataclass(frozen=True)
class Outlier:
    """A block that does not belong.

    Attributes
    ----------
    poses : its labels. distance : squared Mahalanobis norm of its residual against a fit of the
        others.
    degrees : degrees of freedom of that. p_value : probability of a larger one, for this block
        alone.
    """

    poses: tuple[str, ...]
    distance: float
    degrees: int
    p_value: float

    def __str__(self) -> str:
        names = (
            f"pose {self.poses[0]}" if len(self.poses) == 1 else f"poses {', '.join(self.poses)}"
        )
        times = np.sqrt(self.distance / self.degrees)
        return f"{names} does not fit the others: {times:.3g} times the noise expected of its {self.degrees} residuals"


@dataclass(frozen=True)
class Disagreement:
    """Blocks that do not fit each other, any one of which may be the wrong one.

    Attributes
    ----------
    poses : labels of each block. times : largest disagreement with a fit to all, in units of the
        noise expected of it.
    """

    poses: tuple[tuple[str, ...], ...]
    times: float

    def __str__(self) -> str:
        names = [
            ", ".join(block) if len(block) == 1 else f"({', '.join(block)})" for block in self.poses
        ]
        return f"rows of poses {listed(names)} disagree by {self.times:.3g} times the noise; which one is wrong cannot be told"


@dataclass(frozen=True, eq=False)
class OutlierCheck:
    """The outcome for all blocks.

    Attributes
    ----------
    outliers : what does not belong, farthest first. undecided : groups of blocks of which some one
        does not.
    settled : whether the same blocks were doubted twice; otherwise those doubted in turn are
        undecided.
    level : probability of naming any block if all are right.
    blocks : number of blocks tested. poses : labels of each of the u blocks.
    influence : of all blocks, with the doubted ones set aside. scale : factor on sigma used.
    sentence : what this means.
    """

    outliers: tuple[Outlier, ...]
    undecided: tuple[Disagreement, ...]
    settled: bool
    level: float
    blocks: int
    poses: tuple[tuple[str, ...], ...]
    influence: Influence
    scale: float
    sentence: str

    @property
    def names(self) -> tuple[str, ...]:
        """Labels of all poses of these blocks."""
        return tuple(label for outlier in self.outliers for label in outlier.poses)

    def to_dict(self) -> dict[str, Any]:
        """Return what was found by name for JSON."""
        return {
            "outliers": [vars(o) | {"poses": list(o.poses)} for o in self.outliers],
            "undecided": [{**vars(one), "sentence": str(one)} for one in self.undecided],
            "settled": self.settled,
            "level": self.level,
            "blocks": self.blocks,
            "scale": self.scale,
            "mean_leverage": float(
                self.influence.leverage.sum() / max(int(self.influence.residuals.sum()), 1)
            ),
            "sentence": self.sentence,
        }


@dataclass(frozen=True, eq=False)
class _State:
    """What a fit without the blocks `aside` (u,) says of every block; `used` is the number of
    directions it determines.

    `scale` is NaN where it is to be estimated and no block inside the fit can be tested.
    """

    aside: BoolArray
    found: Influence
    scale: float
    used: int

    @property
    def ratio(self) -> FloatArray:
        """(u,) distance for each degree of freedom, in units of the noise; zero where nothing can
        be tested.
        """
        return (
            np.where(
                self.found.degrees > 0, self.found.distance / np.maximum(self.found.degrees, 1), 0.0
            )
            / self.scale**2
        )

    def p_value(self) -> FloatArray:
        """(u,) probability of a larger distance; 1 where nothing can be tested."""
        from scipy.special import chdtrc

        degrees = self.found.degrees
        return np.where(
            degrees > 0, chdtrc(np.maximum(degrees, 1), self.found.distance / self.scale**2), 1.0
        )


def find_outliers(fit: Identification, data: Measurements, level: float = 0.05) -> OutlierCheck:
    """Name the blocks of rows that do not fit what all others say.

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

    begin = problem.linearize(z, problem.start(z)).next_start

    def ask(aside: BoolArray) -> _State:
        return _ask(fit, problem, member, aside, z, begin)

    whole = ask(np.zeros(len(numbers), dtype=bool))
    tested = int((whole.found.degrees > 0).sum())
    alone = -np.expm1(np.log1p(-level) / max(tested, 1))
    doubted_by_loss = np.zeros(len(numbers), dtype=bool)
    doubted_by_loss[member] = fit.pose_weights < 0.5
    start = ask(doubted_by_loss) if doubted_by_loss.any() else whole
    visited = _search(
        ask, whole, start if _bearable(start, whole) else whole, alone, int(MOST * tested)
    )
    end, settled = visited[-1], len(visited) == 1
    always = np.all([state.aside for state in visited], axis=0)
    groups = _rivals(ask, end, whole, alone) if settled else _in_turn(visited, always)
    unsure = np.any(groups, axis=0) if groups else np.zeros_like(always)
    p_value, ratio = end.p_value(), np.sqrt(whole.ratio)
    outliers = tuple(
        Outlier(
            labels[i],
            float(end.found.distance[i] / end.scale**2),
            int(end.found.degrees[i]),
            float(p_value[i]),
        )
        for i in np.argsort(p_value, kind="stable")
        if always[i] and not unsure[i]
    )
    undecided = tuple(
        Disagreement(tuple(labels[i] for i in np.flatnonzero(g)), float(ratio[g].max()))
        for g in groups
    )
    sentence = _sentence(fit, outliers, int(unsure.sum()), settled, tested, level)
    return OutlierCheck(
        outliers, undecided, settled, level, tested, labels, end.found, end.scale, sentence
    )


def _ask(
    fit: Identification,
    problem: Problem,
    member: np.ndarray,
    aside: BoolArray,
    z: FloatArray,
    start: Start,
) -> _State:
    """Fit linearly without the blocks aside (u,) and return what that says of every block."""
    weight = (~aside).astype(np.float64)
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
    found = compute_influence(problem, kept, member, d, penalty, weight, at)
    there = (found.degrees > 0) & ~aside
    scale = 1.0
    if fit.residual_test.noise == "estimated":
        degrees = found.degrees[there].astype(np.float64)
        scale = (
            estimate_scale_of(np.sqrt(found.distance[there]), degrees) if there.any() else np.nan
        )
    return _State(aside, found, scale, int(np.isfinite(penalty).sum()))


def _bearable(state: _State, whole: _State) -> bool:
    """Whether the blocks that are left determine as much as all do, and the noise where that is
    estimated.
    """
    return state.used >= whole.used and bool(np.isfinite(state.scale))


def _search(
    ask: Callable[[BoolArray], _State], whole: _State, start: _State, alone: float, most: int
) -> tuple[_State, ...]:
    """Set aside what is doubted until the same is doubted twice; return that state, or all those
    that are visited in turn.
    """
    visited = [start]
    while len(visited) <= ROUNDS:
        state = visited[-1]
        beyond = np.flatnonzero(state.p_value() < alone)
        order = beyond[np.argsort(-state.ratio[beyond], kind="stable")][:most]
        after = _farthest(ask, order, whole)
        if (after.aside == state.aside).all():
            return (state,)
        again = [i for i, old in enumerate(visited) if (old.aside == after.aside).all()]
        if again:
            return tuple(visited[again[0] :])
        visited.append(after)
    return tuple(visited)


def _farthest(ask: Callable[[BoolArray], _State], order: np.ndarray, whole: _State) -> _State:
    """Set aside as many blocks of the order as can be spared; that fewer can be spared if few can
    makes bisection find it.
    """

    def without(count: int) -> _State:
        aside = np.zeros_like(whole.aside)
        aside[order[:count]] = True
        return ask(aside) if count else whole

    good, bad, best = 0, len(order) + 1, whole
    count = len(order)
    while bad - good > 1:
        state = without(count)
        if _bearable(state, whole):
            good, best = count, state
        else:
            bad = count
        count = (good + bad) // 2
    return best


def _rivals(
    ask: Callable[[BoolArray], _State], end: _State, whole: _State, alone: float
) -> list[BoolArray]:
    """Return groups (u,) of blocks of which one set aside does as well as another.

    With i back in the fit, taking out block j lowers chi-square by d_j^2, and i after that by d_i^2
    - d_j^2 at least; so only a j whose d_j^2 comes near d_i^2 can do as well as i.
    """
    from scipy.special import chdtri

    groups: list[BoolArray] = []
    doubted = np.flatnonzero(end.aside)
    for i in doubted[np.argsort(-end.ratio[doubted], kind="stable")][:COMPARED]:
        aside = end.aside.copy()
        aside[i] = False
        back = ask(aside)
        square = back.found.distance / back.scale**2
        limit = float(chdtri(max(int(end.found.degrees[i]), 1), alone))
        group = np.zeros_like(aside)
        for j in np.flatnonzero(
            ~end.aside & (back.p_value() < alone) & (square > square[i] - limit)
        ):
            aside[j] = True
            instead = ask(aside)
            aside[j] = False
            group[j] = _bearable(instead, whole) and instead.p_value()[i] >= alone
        if group.any():
            group[i] = True
            groups.append(group)
    return _joined(groups)


def _joined(groups: list[BoolArray]) -> list[BoolArray]:
    """Join groups that share a block."""
    joined: list[BoolArray] = []
    for group in groups:
        apart = [other for other in joined if not (other & group).any()]
        shared = [other for other in joined if (other & group).any()]
        joined = [*apart, np.any([group, *shared], axis=0)]
    return joined


def _in_turn(visited: tuple[_State, ...], always: BoolArray) -> list[BoolArray]:
    """Return the one group (u,) of the blocks that are doubted in some of the states only."""
    return [np.any([state.aside for state in visited], axis=0) & ~always]


def _sentence(
    fit: Identification,
    outliers: tuple[Outlier, ...],
    unsure: int,
    settled: bool,
    tested: int,
    level: float,
) -> str:
    """Say how many blocks do not belong."""
    if tested == 0:
        return "no block of rows can be checked: each determines parameters that no other sees; measure more"
    if tested == 1:
        return "all rows belong to one block, which has no others to be compared with"
    if fit.residual_test.noise == "estimated" and round(fit.residual_test.dof) <= 1:
        return "no block of rows can be checked: one degree of freedom tells the noise or a wrong row; state sigma or measure more"
    named = f"{len(outliers)} of {tested} blocks of rows do not fit the others (chance names one in {level:.0%} of right data)"
    advice = "look at them; leave them out with drop, or fit with a loss"
    if not settled:
        found = f"{named}, and " if outliers else ""
        return f"{found}the search for wrong blocks of rows did not settle: {unsure} of {tested} are doubted in turn; measure more"
    if unsure:
        found = f"{named}: {advice}; " if outliers else ""
        return f"{found}{unsure} of {tested} blocks of rows disagree, and which is wrong cannot be told: measure more poses"
    if outliers:
        return f"{named}: {advice}"
    if fit.residual_test.failed:
        return f"none of {tested} blocks of rows stands out: what the noise does not explain is spread over them"
    return f"all {tested} blocks of rows fit each other (false alarm in {level:.0%} of data sets)"
