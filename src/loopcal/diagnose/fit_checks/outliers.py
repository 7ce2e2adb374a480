# SPDX-License-Identifier: Apache-2.0
"""Detect poses that do not fit the others, at a false-alarm rate for the whole data set.

Rows that belong together form an observation block: a pose, or several poses that share rows. Each
block is compared with the prediction of all others. It is an outlier where the probability of its
distance is below 1 - (1 - level)^(1/u), u blocks tested (Sidak), so that data without a wrong block
raise no alarm in 95 % of cases. Several wrong blocks hide each other: see `outlier_search`. With
one degree of freedom every block explains the misfit of all, and none is named. Nothing is removed
from the data: the result names the blocks for whoever decides.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from loopcal.diagnose.fit_checks.influence import Influence
from loopcal.diagnose.fit_checks.outlier_search import (
    PartialFit,
    find_rivals,
    fit_without,
    list_suspected_in_turn,
    search_suspects,
)
from loopcal.estimate.fit_input import check_fitted_data, exclude_poses
from loopcal.estimate.observation_rows import linked_blocks
from loopcal.estimate.problem_construction import problem_of
from loopcal.estimate.result import Identification
from loopcal.findings import Finding, report_finding
from loopcal.measure import Measurements, fill_in_reading_sigma
from loopcal.typing import BoolArray, Progress, report_no_progress

MOST_EXCLUDED = 0.5
"""Largest share of excluded blocks; beyond it nothing can be said of the others."""


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
        details = [result.finding for result in (*self.outliers, *self.ambiguous)]
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


def find_outliers(
    fit: Identification,
    data: Measurements,
    level: float = 0.05,
    progress: Progress = report_no_progress,
) -> OutlierCheck:
    """Find the observation blocks that do not fit what all others predict.

    Parameters
    ----------
    fit : the identification, with or without a loss. data : the measurements it was made from.
    level : probability of naming any block where none is wrong.
    progress : receives the rounds of the search.
    """
    check_fitted_data(fit, data)
    data = exclude_poses(fill_in_reading_sigma(fit.robot, data), fit.options.excluded_poses)
    problem = problem_of(fit.free_parameters, data)
    numbers, member = np.unique(linked_blocks(data), return_inverse=True)
    names = np.array(data.labels)
    labels = tuple(tuple(names[member == i].tolist()) for i in range(len(numbers)))
    z = fit.free_parameters.deviation(fit.robot.values[None])
    start = problem.linearize(z, problem.start(z)).next_start

    def refit(excluded: BoolArray) -> PartialFit:
        return fit_without(fit, problem, member, excluded, z, start)

    whole = first = refit(np.zeros(len(numbers), dtype=bool))
    tested = int((whole.influence.degrees > 0).sum())
    limit = -np.expm1(np.log1p(-level) / max(tested, 1))
    low_weight = np.zeros(len(numbers), dtype=bool)
    low_weight[member] = fit.pose_weights < 0.5
    if low_weight.any() and (without := refit(low_weight)).determines_as_much(whole):
        first = without
    fits = search_suspects(refit, whole, first, limit, int(MOST_EXCLUDED * tested), progress)
    end, is_converged = fits[-1], len(fits) == 1
    if is_converged:
        groups = find_rivals(refit, end, whole, limit, progress)
    else:
        groups = list_suspected_in_turn(fits)
    always = np.all([partial.excluded for partial in fits], axis=0)
    ambiguous = np.any(groups, axis=0) if groups else np.zeros_like(always)
    p_value, ratio, influence = end.p_value(), np.sqrt(whole.ratio), end.influence
    outliers = tuple(
        Outlier(
            labels[i],
            float(influence.distance[i] / end.scale**2),
            int(influence.degrees[i]),
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
        outliers, conflicts, is_converged, level, tested, labels, influence, end.scale, summary
    )


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
    if count := counts["outliers"]:
        findings.append(report_finding("outliers.some", count=count, level=level, **shared))
    if ambiguous or not is_converged:
        code = "outliers.ambiguous" if is_converged else "outliers.search-not-converged"
        findings.append(report_finding(code, count=ambiguous, **shared))
    if findings:
        return tuple(findings)
    if fit.residual_test.failed:
        return (report_finding("outliers.none-but-misfit", **shared),)
    return (report_finding("outliers.none", level=level, **shared),)
