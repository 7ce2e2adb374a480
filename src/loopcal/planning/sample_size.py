# SPDX-License-Identifier: Apache-2.0
"""Number of poses: expected errors by number, and the smallest number that reaches a goal.

The relaxed design bounds what any choice of so many poses can reach, and so shows below which
number a goal is out of reach. Where the instrument compares poses, numbers count pairs: few poses
make many pairs, and a bound on pairs is none on poses.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from loopcal.errors import EstimationError
from loopcal.findings import Finding, report_finding
from loopcal.mechanism import Mechanism
from loopcal.planning.design import DesignCurve, compute_design_curve, find_smallest_design
from loopcal.planning.options import N_POSES, Target
from loopcal.planning.prediction import DIMENSIONS, ExpectedErrors
from loopcal.planning.problem import PlanningProblem, name_groups
from loopcal.typing import FloatArray, IntArray, Progress, report_no_progress

SIZES = 6
"""Numbers of poses on a curve."""
RANGE = 4
"""A curve goes from the smallest number to this many times the requested one."""
MOST = 400
"""Largest number of poses for a goal: more is over a day's work."""
PERTURBATIONS = 4
"""Number of perturbations of each design of a curve."""


@dataclass(frozen=True, eq=False)
class ErrorCurve:
    """Expected errors by the number of poses, or of pairs where poses are compared.

    Attributes
    ----------
    numbers : (k,) of poses or pairs, ascending.
    expected : errors after measuring a good design of each number.
    target : the error that the designs make small.
    values, bounds : (k,) that error [m, rad], and the smallest that any choice of so many
        candidates can have.
    goal : requested error [m, rad], or None.
    enough : smallest of the numbers that reaches the goal.
    at_least : no smaller number of candidates reaches the goal.
    poses_per_group : 1 where each pose counts alone.
    n_candidates : number of candidate poses or pairs.
    """

    numbers: IntArray
    expected: tuple[ExpectedErrors, ...]
    target: Target
    values: FloatArray
    bounds: FloatArray
    goal: float | None = None
    enough: int | None = None
    at_least: int | None = None
    poses_per_group: int = 1
    n_candidates: int = 0

    @property
    def counted(self) -> str:
        """Plural noun for what the numbers count."""
        return name_groups(self.poses_per_group)

    def report(self, robot: Mechanism) -> Finding:
        """Return the result of the curve: the number that reaches the goal, or all errors."""
        if self.goal is None:
            points = tuple(
                {"number": n, "errors": errors.to_quantities(robot)}
                for n, errors in zip(self.numbers.tolist(), self.expected, strict=True)
            )
            return report_finding("plan.error-curve", counted=self.counted, points=points)
        return report_finding(
            "plan.goal-reached",
            number=self.enough,
            counted=self.counted,
            target=self.target,
            goal=robot.to_quantity(self.goal, DIMENSIONS[self.target]),
            at_least=self.at_least,
            candidates=self.n_candidates,
            decided_by_equations=bool(self.enough == self.numbers[0]),
        )

    def to_dict(self) -> dict[str, Any]:
        """Return everything by name for JSON, SI."""
        return {
            "target": self.target,
            "counted": self.counted,
            "n_candidates": self.n_candidates,
            "numbers": self.numbers.tolist(),
            "position": [e.position for e in self.expected],
            "orientation": [e.orientation for e in self.expected],
            "values": self.values.tolist(),
            "bounds": self.bounds.tolist(),
            "goal": self.goal,
            "enough": self.enough,
            "at_least": self.at_least,
        }


def compute_error_curve(
    problem: PlanningProblem, progress: Progress = report_no_progress
) -> ErrorCurve:
    """Return expected errors from the smallest number of poses to RANGE times the requested one."""
    k, count, options = problem.poses_per_group, problem.n_candidates, problem.options
    requested = options.n_poses or N_POSES
    last = min(max(RANGE * requested // k, 2 * problem.min_groups), count)
    first = min(problem.min_groups, last)
    sizes = np.geomspace(first, last, SIZES).round().astype(int)
    sizes = np.unique(np.append(sizes, min(max(requested // k, first), last))).tolist()
    rows, criterion, prior = problem.groups.rows, problem.build_criterion("I"), problem.prior
    designs = compute_design_curve(
        rows, sizes, criterion, prior, options.seed, PERTURBATIONS, progress=progress
    )
    return _convert_curve(problem, designs)


def find_sample_size(
    problem: PlanningProblem, progress: Progress = report_no_progress
) -> ErrorCurve:
    """Return the smallest number of poses that reaches the goal of the options.

    The curve covers the expected errors from the smallest number to twice that one.

    Raises
    ------
    EstimationError
        The goal is not a number above 0, or out of reach; then with the best possible error.
    """
    options, robot, rows = problem.options, problem.robot, problem.groups.rows
    target, goal, dimension = options.target, options.goal, DIMENSIONS[options.target]
    assert goal is not None, "the caller has a goal"
    if not goal > 0.0 or not np.isfinite(goal):
        raise EstimationError(
            f"the accuracy goal is {robot.to_quantity(goal, dimension)}; give a number above 0 "
            "with its unit, such as 20um"
        )
    criterion, prior, count = problem.build_criterion("I"), problem.prior, problem.n_candidates
    most = min(MOST // problem.poses_per_group, count)
    problem.require_equations(most)
    try:
        smallest = find_smallest_design(
            rows, goal**2, criterion, prior, most, options.seed, PERTURBATIONS
        )
    except EstimationError:
        best = compute_design_curve(rows, [most], criterion, prior, options.seed, 0)
        raise EstimationError(
            report_finding(
                "plan.goal-unreachable",
                target=target,
                goal=robot.to_quantity(goal, dimension),
                number=most,
                counted=problem.group_name,
                candidates=count,
                best=robot.to_quantity(float(np.sqrt(best.values[0])), dimension),
                bound=robot.to_quantity(float(np.sqrt(best.bounds[0])), dimension),
            )
        ) from None
    n = max(smallest.n, problem.min_groups)
    others = np.geomspace(problem.min_groups, min(2 * n, count), SIZES - 1).round().astype(int)
    sizes = np.unique(np.append(others, n)).tolist()
    curve = compute_design_curve(
        rows, sizes, criterion, prior, options.seed, PERTURBATIONS, progress=progress
    )
    if n == smallest.n:  # the design of the search, where that of the curve is less good
        place = sizes.index(n)
        designs = (*curve.designs[:place], smallest.certified, *curve.designs[place + 1 :])
        better = np.minimum(curve.values, smallest.certified.design.value)
        values = np.where(curve.sizes == n, better, curve.values)
        curve = replace(curve, designs=designs, values=values)
    return replace(_convert_curve(problem, curve), goal=goal, enough=n, at_least=smallest.at_least)


def _convert_curve(problem: PlanningProblem, curve: DesignCurve) -> ErrorCurve:
    """Return a curve of variances as a curve of errors."""
    expected = [problem.predict_errors(made.design.chosen) for made in curve.designs]
    return ErrorCurve(
        curve.sizes,
        tuple(errors for errors in expected if errors is not None),  # every design is determined
        problem.options.target,
        np.sqrt(curve.values),
        np.sqrt(np.maximum(curve.bounds, 0.0)),
        poses_per_group=problem.poses_per_group,
        n_candidates=problem.n_candidates,
    )
