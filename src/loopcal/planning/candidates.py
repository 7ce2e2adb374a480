# SPDX-License-Identifier: Apache-2.0
"""Candidate poses, drawn inside the workspace and at its boundary, and checked by all constraints.

Informative poses lie at the boundary of what can be reached. Half of the candidates are therefore
drawn inside. The other half are drawn on faces, edges and corners of the stated ranges; where these
cannot be reached, they move back along a straight line towards the middle until they can.
Candidates have an allowed straight path from home, so that every pose can be approached via home.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from loopcal.errors import MechanismError
from loopcal.findings import Finding, report_finding
from loopcal.mechanism import workspace
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.platform_coordinates import list_dimensions
from loopcal.mechanism.solutions import Solution, inverse
from loopcal.planning.constraints import (
    ConstraintChecker,
    Constraints,
    Violation,
    build_checker,
    list_reasons,
)
from loopcal.planning.path import check_paths, interpolate_path, locate_home, measure_distance
from loopcal.typing import BoolArray, FloatArray
from loopcal.units import Dimension, find_unit

HALVINGS = 12  # bisections of the line to the middle: the boundary is located to 1/4096 of it
DIGITS = 5  # decimal places to which coordinates are commanded, see `list_steps`
ROUNDING = 1e-6  # part of a step that is the rounding of a bound's own number
# Share of the coordinates of a boundary pose that are put to an end of their range.
ON_BOUNDARY = 0.7


@dataclass(frozen=True, eq=False)
class Candidates:
    """Poses that may be measured."""

    coordinates: FloatArray  # (n, c) controlled coordinates [m, rad]
    solution: Solution  # their readings and poses
    is_uniform: BoolArray  # (n,) True for those drawn evenly from the workspace, which represent it
    excluded: Counter[Violation]  # violation -> number of poses that it excluded
    n_drawn: int  # number of poses before exclusion
    checker: ConstraintChecker  # the constraints

    def __len__(self) -> int:
        return len(self.coordinates)

    def report(self) -> Finding:
        """Return how many poses remain, and which constraints excluded the others."""
        reasons = list_reasons(self.excluded)
        return report_finding(
            "plan.candidates", allowed=len(self), total=self.n_drawn, reasons=reasons
        )


def draw_candidates(
    robot: Mechanism,
    constraints: Constraints | None = None,
    count: int = 1000,
    seed: int | np.random.Generator = 0,
) -> Candidates:
    """Draw about `count` allowed poses from the workspace, half of them at its boundary."""
    rng = np.random.default_rng(seed)
    checker, bounds = _build_home_checker(robot, constraints), workspace.workspace_ranges(robot)
    excluded: Counter[Violation] = Counter()
    wanted, batches, kept, n_drawn = count - count // 2, [], 0, 0
    while kept < wanted:
        number = wanted if not kept else max(wanted - kept, wanted // 10, 1)
        poses = round_coordinates(
            robot, workspace.draw_coordinates(rng, robot.controlled, bounds, number)
        )
        check = checker.check_poses(inverse(robot, poses))
        excluded.update(check.count_violations())
        batches.append(poses[check.allowed])
        kept, n_drawn = kept + len(batches[-1]), n_drawn + len(poses)
        if n_drawn >= workspace.MIN_DRAWS and kept < workspace.MIN_REACHABLE_SHARE * n_drawn:
            counts = {"allowed": kept, "total": n_drawn, "reasons": list_reasons(excluded)}
            raise MechanismError.of("plan.workspace-excluded", robot=robot.name, **counts)
    inside = np.concatenate(batches)
    edge = _draw_boundary(checker, rng, bounds, count // 2, inside)
    poses = np.concatenate([inside, edge])
    uniform = np.arange(len(poses)) < len(inside)
    return _keep_reachable(checker, poses, uniform, excluded, n_drawn + len(edge))


def check_listed_poses(
    robot: Mechanism, poses: FloatArray, constraints: Constraints | None = None
) -> Candidates:
    """Return those of the given poses (n, c) [m, rad] that are allowed; they represent the
    workspace themselves.
    """
    checker = _build_home_checker(robot, constraints)
    poses = np.unique(poses, axis=0)
    check = checker.check_poses(inverse(robot, poses))
    excluded, good = check.count_violations(), poses[check.allowed]
    if not len(good):
        counts = {"total": len(poses), "reasons": list_reasons(excluded)}
        raise MechanismError.of("plan.listed-poses-excluded", robot=robot.name, **counts)
    return _keep_reachable(checker, good, np.ones(len(good), dtype=bool), excluded, len(poses))


def list_steps(robot: Mechanism, dimensions: Sequence[Dimension], digits: int) -> FloatArray:
    """Return the steps [m, rad] of numbers that a person can type: so many decimal places of the
    robot's size and of a radian, in its units.
    """
    factors = np.array([find_unit(robot.units[d]).factor_to_si for d in dimensions])
    scale = np.array([robot.size if d is Dimension.LENGTH else 1.0 for d in dimensions])
    return 10.0 ** (np.floor(np.log10(scale / factors)) - digits) * factors


def round_coordinates(
    robot: Mechanism, coordinates: FloatArray, towards: FloatArray | None = None
) -> FloatArray:
    """Round coordinates (n, c) to steps of DIGITS; all are rounded `towards` a place (c,)."""
    steps = list_steps(robot, list_dimensions(robot.controlled), DIGITS)
    counts = coordinates / steps
    if towards is None:
        return np.round(counts) * steps
    is_above = coordinates > towards
    return np.where(is_above, np.floor(counts + ROUNDING), np.ceil(counts - ROUNDING)) * steps


def _build_home_checker(robot: Mechanism, constraints: Constraints | None) -> ConstraintChecker:
    """Return the checker of a robot whose home is allowed, since every path starts there."""
    checker = build_checker(robot, constraints)
    check = checker.check_poses(inverse(robot, locate_home(robot)[None]), at_pose=False)
    if not check.allowed[0]:
        raise _refuse_home(robot, check.count_violations(), is_isolated=False)
    return checker


def _refuse_home(
    robot: Mechanism, counts: Counter[Violation], *, is_isolated: bool
) -> MechanismError:
    """Return the error of a home that no path of a plan can leave."""
    facts = {"robot": robot.name, "reasons": list_reasons(counts), "is_isolated": is_isolated}
    return MechanismError.of("plan.home-excluded", **facts)


def _draw_boundary(
    checker: ConstraintChecker,
    rng: np.random.Generator,
    bounds: Mapping[str, tuple[float, float]],
    count: int,
    inside: FloatArray,
) -> FloatArray:
    """Draw poses (count, c) at the ends of ranges, moved back to the boundary of the allowed."""
    robot, names = checker.robot, checker.robot.controlled
    low, high = np.array([bounds[name] for name in names]).T
    full = np.isclose(high - low, 2.0 * np.pi)
    poses = workspace.draw_coordinates(rng, names, bounds, count)
    end = rng.random((count, len(names))) < 0.5
    put = (rng.random((count, len(names))) < ON_BOUNDARY) & ~full
    if not full.all():  # at least one coordinate is at an end, unless none has an end
        put[np.arange(count), rng.choice(np.flatnonzero(~full), count)] = True
    poses = np.where(put, np.where(end, high, low), poses)
    median = np.median(inside, axis=0)[None]
    middle = inside[np.argmin(measure_distance(robot, inside, median))]
    anchor = np.broadcast_to(middle, poses.shape)
    good = np.zeros(count)
    good[checker.check_poses(inverse(robot, poses)).allowed] = 1.0
    bad = np.ones(count)
    for _ in range(HALVINGS):
        left = np.flatnonzero(good < 1.0)
        if not len(left):
            break
        share = (good[left] + bad[left]) / 2.0
        trial = interpolate_path(robot, anchor[left], poses[left], share)
        allowed = checker.check_poses(inverse(robot, trial)).allowed
        good[left[allowed]], bad[left[~allowed]] = share[allowed], share[~allowed]
    moved = interpolate_path(robot, anchor, poses, good)
    edge = np.where(good[:, None] == 1.0, poses, moved)[good > 0.0]
    # towards the middle, so that rounding does not leave the allowed region
    edge = np.unique(round_coordinates(robot, edge, middle), axis=0)
    return edge[checker.check_poses(inverse(robot, edge)).allowed]


def _keep_reachable(
    checker: ConstraintChecker,
    poses: FloatArray,
    uniform: BoolArray,
    excluded: Counter[Violation],
    n_drawn: int,
) -> Candidates:
    """Return the poses that an allowed straight path connects with home."""
    robot = checker.robot
    path = check_paths(checker, np.broadcast_to(locate_home(robot), poses.shape), poses)
    counts = path.count_violations()
    excluded.update({replace(why, on_path=True): count for why, count in counts.items()})
    if not path.allowed.any():
        raise _refuse_home(robot, counts, is_isolated=True)
    kept = poses[path.allowed]
    return Candidates(kept, inverse(robot, kept), uniform[path.allowed], excluded, n_drawn, checker)
