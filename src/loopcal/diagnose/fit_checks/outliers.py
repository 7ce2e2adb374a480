# SPDX-License-Identifier: Apache-2.0
"""Detect poses that do not fit the others, at a false-alarm rate for the whole data set.

Rows that belong together form an observation block: a pose, or several poses that share rows. Each
block is compared with the prediction of all others. It is an outlier where the probability of its
distance is below 1 - (1 - level)^(1/u), u blocks tested (Sidak), so that data without a wrong block
raise no alarm in 95 % of cases. Several wrong blocks hide each other: see `outlier_search`. With
one degree of freedom every block explains the misfit of all, and none is named. Nothing is removed
from the data: the result names the blocks for whoever decides.

The distance is judged by the noise that the other blocks show (an F ratio), not by the stated one.
A wrong sigma therefore makes no outliers, and a misfit that is spread over all blocks names none.
The stated noise counts only where the others leave fewer than five degrees of freedom.

A fit that contradicts the stated noise is no good reference: one wrong row of a meter pulls the
geometry so far that right poses seem wrong. Blocks are then compared at a robust fit (Tukey).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from loopcal.diagnose.fit_checks.influence import Influence
from loopcal.diagnose.fit_checks.outlier_search import (
    PartialFit,
    find_rivals,
    fit_without,
    list_suspected_in_turn,
    search_blocks,
)
from loopcal.errors import LoopcalError
from loopcal.estimate.fit_input import check_fitted_data, exclude_poses
from loopcal.estimate.identification import identify
from loopcal.estimate.linearization import Start
from loopcal.estimate.methods.losses import Tukey
from loopcal.estimate.minimization.robust_descent import estimate_scale_of, measure_block_distances
from loopcal.estimate.observation_rows import linked_blocks, list_block_labels
from loopcal.estimate.problem import Problem
from loopcal.estimate.problem_construction import problem_of
from loopcal.estimate.result import Identification
from loopcal.findings import Finding, report_finding
from loopcal.measure import Measurements, fill_in_reading_sigma
from loopcal.presentation import TableResult
from loopcal.typing import BoolArray, FloatArray, IntArray, Progress, report_no_progress

MOST_ROBUST = 20_000
"""Blocks that a robust fit is made from: it is where the others are compared, not a result."""


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

    @property
    def names(self) -> tuple[str, ...]:
        """Labels of all poses of the outliers."""
        return tuple(label for outlier in self.outliers for label in outlier.poses)

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
        if [finding.code for finding in self.summary] == ["outliers.one-degree"]:
            return self.summary
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
    problem = problem_of(fit.free_parameters, data, fit.options.nuisance)
    member = np.unique(linked_blocks(data), return_inverse=True)[1]
    labels = list_block_labels(data.labels, member)
    reference = _refit_robustly(fit, data, member, progress) if fit.residual_test.failed else fit
    z = fit.free_parameters.deviation(reference.robot.values[None])
    start = problem.linearize(z, problem.start(z)).next_start
    low_weight = np.zeros(len(labels), dtype=bool)
    if len(reference.pose_weights) == len(member):
        low_weight[member] = reference.pose_weights < 0.5
    else:
        low_weight = _weigh_blocks(problem, z, start, member) < 0.5

    noise = fit.residual_test.noise
    refit = partial(fit_without, fit, problem, member, deviation=z, start=start, noise=noise)
    search = search_blocks(refit, low_weight, level, progress)
    if search.is_converged:
        groups = find_rivals(search, progress)
    else:
        groups = list_suspected_in_turn(search.fits)
    fits, end, tested = search.fits, search.end, search.whole.tested
    always = np.all([each.excluded for each in fits], axis=0)
    ambiguous = np.any(groups, axis=0) if groups else np.zeros_like(always)
    outliers = _list_outliers(end, labels, always & ~ambiguous)
    ratio = np.sqrt(search.whole.ratio)
    conflicts = tuple(
        Conflict(tuple(labels[i] for i in np.flatnonzero(group)), float(ratio[group].max()))
        for group in groups
    )
    counts = {"outliers": len(outliers), "ambiguous": int(ambiguous.sum()), "blocks": tested}
    single = all(len(poses) == 1 for poses in labels)
    shared = {"blocks": tested, "single_poses": single}
    summary = _summarize(fit, counts, level, shared, is_converged=search.is_converged)
    if noise == "given" and outliers and end.contradicts_noise:
        times = report_finding("outliers.larger-noise", times=end.scale, **shared)
        summary = (times, *summary)
    return OutlierCheck(
        outliers,
        conflicts,
        search.is_converged,
        level,
        tested,
        labels,
        end.influence,
        end.scale,
        summary,
    )


def _refit_robustly(
    fit: Identification, data: Measurements, member: IntArray, progress: Progress
) -> Identification:
    """Return a robust fit; the fit itself where it does not converge.

    `member` (n,) is the block of each pose. Of many blocks, an even choice is fitted.
    """
    count = int(member.max()) + 1
    if count > MOST_ROBUST:
        chosen = np.linspace(0, count - 1, MOST_ROBUST).astype(np.int64)
        data = data.take(np.isin(member, chosen))
    options = replace(fit.options, loss=Tukey(), noise="estimated")
    try:
        robust = identify(fit.initial, data, options=options, progress=progress)
    except LoopcalError:
        return fit
    return robust if robust.converged else fit


def _list_outliers(
    end: PartialFit, labels: tuple[tuple[str, ...], ...], is_outlier: BoolArray
) -> tuple[Outlier, ...]:
    """Return the outliers among the blocks (u,) of a fit without them, the least probable first."""
    p_value, degrees = end.p_value(), end.influence.degrees
    return tuple(
        Outlier(labels[i], float(end.ratio[i] * degrees[i]), int(degrees[i]), float(p_value[i]))
        for i in np.argsort(p_value, kind="stable")
        if is_outlier[i]
    )


def _weigh_blocks(problem: Problem, z: FloatArray, start: Start, member: IntArray) -> FloatArray:
    """Return the weights (u,) of blocks in a robust fit at z (1, p), which others determined."""
    distance, degrees = measure_block_distances(problem, z, start, member, problem)
    return Tukey().weight(distance / estimate_scale_of(distance, degrees), degrees)


def _summarize(
    fit: Identification,
    counts: dict[str, int],
    level: float,
    shared: dict[str, Any],
    *,
    is_converged: bool,
) -> tuple[Finding, ...]:
    """Return the findings on all blocks together."""
    blocks, ambiguous = counts["blocks"], counts["ambiguous"]
    if blocks == 0:
        return (report_finding("outliers.not-testable"),)
    if blocks == 1:
        return (report_finding("outliers.single-block"),)
    if round(fit.residual_test.dof) <= 1:
        is_given = fit.residual_test.noise == "given"
        return (report_finding("outliers.one-degree" if is_given else "outliers.unknown-noise"),)
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
